"""One pure, differentiable step: the single source of the mathematics.

``step`` is a function of tensors, and of whatever behaves like tensors: ``scalar`` records it on numbers that remember
where they came from, and prints compiled code from that.

Shapes: what belongs to vehicles is ``[..., n]``, in SI units; parameters are scalars or ``[..., n]``.
"""

import dataclasses
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor

from idm_env import parameters
from idm_env.delay_buffer import PAST, History
from idm_env.effects.base import HOOKS, CarFollowing, Effect, Hook
from idm_env.effects.limits import unspoken
from idm_env.roads import merging
from idm_env.roads.base import Road
from idm_env.types import FAR, Driver, Inputs, Motion, Neighbour, Params, PastScenes, Scene, State

Integration = Literal["ballistic", "euler", "midpoint"]
S = TypeVar("S", bound="CarFollowingStep")


@dataclass(frozen=True)
class CarFollowingStep:
    """A road, a tuple of effects and a time step (s): all of a simulator that is one step.

    One step is: scene of the road → perceive → adapt → Σ accelerate → limit → integrate → place → gaps. It knows
    one lane's neighbours: what several lanes need comes before it (``multilane.before``, in ``Simulator.step``).

    ``integration`` is ``"ballistic"`` (``x += v Δt + a Δt²/2``, and a car that would reverse stops inside the step) or
    ``"euler"`` (the paper's: ``x += v Δt`` with the old speed). ``"midpoint"`` is ballistic with speeds and gaps of the
    scene taken half a step ahead, by the accelerations of the step before: second order for one evaluation a step. The
    other two act on the past half step, a hidden delay of Δt/2 that a search for missing effects would find.

    Where an effect can add to what the driver wants, the sum is held to what tyres can (``effects.Traction``, by its
    default unless it is named).

    ValueError: what is no road or no effect, two effects of one name, not exactly one car-following effect, or a step
    longer than any time gap.
    """

    road: Road
    effects: tuple[Effect, ...]
    dt: float = 0.1
    integration: Integration = "ballistic"

    def __post_init__(self) -> None:
        if isinstance(self.road, type) or not hasattr(self.road, "beside"):
            raise ValueError(f"road: {type(self.road).__name__} is no road. Take Ring(230.0), Lane() or Lanes(2).")
        effects = self.effects if isinstance(self.effects, Iterable) else (self.effects,)
        object.__setattr__(self, "effects", tuple(effects))
        for e in self.effects:
            if isinstance(e, type) or not hasattr(e, "hook"):
                raise ValueError(f"effects: {type(e).__name__} is no effect. Take instances, such as Brakes().")
            who = f"effect '{e.name}': {type(e).__name__}"
            parameters.at_least(f"{who}.looks_back", e.looks_back, 0.0, "s", 3600.0)
            parameters.at_least(f"{who}.decides_every", e.decides_every, 0.0, "s", 3600.0)
            parameters.whole(f"{who}.decides_in_blocks", e.decides_in_blocks, 0, 10**9)
        names = [e.name for e in self.effects]
        if double := {n for n in names if names.count(n) > 1}:
            raise ValueError(f"effect '{double.pop()}' is given twice. Every effect of a simulator needs its own name.")
        following = [e.name for e in self.effects if isinstance(e, CarFollowing)]
        if len(following) != 1:
            raise ValueError(
                f"a simulator needs exactly one car-following effect, got {following or 'none'}. Add IDM() or drop one."
            )
        sideways = next((e.name for e in self.effects if e.hook == "change"), None)
        if sideways and not self.road.beside:
            raise ValueError(f"effect '{sideways}' changes lanes: this road has one, or its own rule. Take Lanes(2).")
        parameters.one_of("integration", self.integration, INTEGRATORS)
        if self.decides_in_blocks and self.sees_mergers:
            raise ValueError("who takes turns to decide does not see who signals: leave stagger or that effect out.")
        parameters.at_least("dt", self.dt, 0.0, "s")
        longest = next((p.high for p in self._following.parameters if p.name == "time_gap"), float("inf"))
        if not 0.0 < self.dt <= longest:
            raise ValueError(f"dt = {self.dt:g} s is outside (0, {longest:g}] s: no step is longer than a time gap.")

    # -- composition ---------------------------------------------------------------------------------------------

    def adding(self: S, *effects: Effect) -> S:
        """Return this simulator with more effects."""
        return dataclasses.replace(self, effects=(*self.effects, *effects))

    def without(self: S, *names: str) -> S:
        """Return this simulator without the named effects; ValueError if one is not there."""
        for name in names:
            if name not in self.by_name:
                raise ValueError(f"effect '{name}' is not in this simulator.{parameters.nearest(name, self.by_name)}")
        return dataclasses.replace(self, effects=tuple(e for e in self.effects if e.name not in names))

    @cached_property
    def by_name(self) -> dict[str, Effect]:
        """Effects by name."""
        return {e.name: e for e in self.effects}

    @cached_property
    def _following(self) -> CarFollowing:
        return next(e for e in self.effects if isinstance(e, CarFollowing))

    @property
    def base(self) -> CarFollowing:
        """The car-following effect: what wants an acceleration before any other effect, and owns the driver."""
        return self._following

    @cached_property
    def _hooks(self) -> dict[Hook, tuple[Effect, ...]]:
        hooks: dict[Hook, tuple[Effect, ...]] = {
            hook: tuple(e for e in self.effects if e.hook == hook) for hook in HOOKS
        }
        hooks["perceive"] = tuple(sorted(hooks["perceive"], key=lambda e: e.rank))
        hooks["limit"] = tuple(sorted((*hooks["limit"], *unspoken(self.effects)), key=lambda e: e.rank))
        return hooks

    @cached_property
    def own(self) -> bool:
        """Whether an effect of the user's own is at work."""
        return any(e.own for e in self.effects)

    @cached_property
    def lane_change_models(self) -> tuple[Effect, ...]:
        """Effects that change lanes."""
        return self._hooks["change"]

    @property
    def sees_mergers(self) -> bool:
        """Whether drivers look at who signals beside them."""
        return "merger" in self._needs

    @property
    def sees_lanes(self) -> bool:
        """Whether drivers look at which lane they are on."""
        return "lane" in self._needs

    @cached_property
    def rooms(self) -> tuple[Effect, ...]:
        """Effects that say how far drivers can go on, or want to, on a lane."""
        return tuple(e for e in self.effects if type(e).room is not Effect.room)

    @cached_property
    def decides_after(self) -> int:
        """Steps between two decisions about lanes."""
        return max(1, round(min((e.decides_every for e in self.lane_change_models), default=1.0) / self.dt))

    @cached_property
    def decides_in_blocks(self) -> int:
        """Slots of a block that decides together, blocks taking turns a step apart; 0: all at once."""
        return max((e.decides_in_blocks for e in self.lane_change_models), default=0)

    def turns(self, vehicles: int) -> Tensor:
        """Return at which of the ``decides_after`` steps from one decision to the next every slot decides."""
        block = self.decides_in_blocks or max(vehicles, 1)
        return torch.arange(vehicles).div(block, rounding_mode="floor") % self.decides_after

    def due(self, state: State) -> Tensor:
        """Return a mask of the vehicles that decide about lanes now (bool), broadcasting to ``(..., vehicles)``."""
        phase = state.clock.remainder(self.decides_after)
        return phase == (self.turns(state.speed.shape[-1]).to(phase.device) if self.decides_in_blocks else 0)

    @cached_property
    def _unspoken(self) -> dict[str, dict[str, float]]:
        return {e.name: {p.name: p.default for p in e.parameters} for e in unspoken(self.effects)}

    @cached_property
    def looks_back(self) -> float:
        """Seconds of the past that some effect may ask for."""
        return max((e.looks_back for e in self.effects), default=0.0)

    @cached_property
    def draws(self) -> tuple[str, ...]:
        """Names of the effects whose input is one standard normal per vehicle and step."""
        return tuple(e.name for e in self.effects if e.draws)

    @cached_property
    def _needs(self) -> frozenset[str]:
        return frozenset().union(*(e.needs for e in self.effects))

    def defaults(self, **kind: Any) -> dict[str, dict[str, Tensor]]:
        """Return the default parameters; ``dtype`` and ``device`` as in ``torch.tensor``."""
        return parameters.defaults(self.effects, **kind)

    def check(self, params: Params, inputs: Inputs | None = None) -> None:
        """Raise ValueError, in one line, for parameters or inputs that do not belong to this simulator.

        A step must not be longer than the shortest time gap T: whoever cannot react within T drives into his leader.
        """
        parameters.check(self.effects, params)
        time_gap = self._following.driver(dict(params[self._following.name])).time_gap
        shortest = float(torch.as_tensor(time_gap).detach().min())
        if self.dt > shortest * (1.0 + 1e-6):
            raise ValueError(
                f"dt = {self.dt:g} s is longer than the shortest time gap, {self._following.name}.time_gap = "
                f"{shortest:g} s: a driver must react within it. Take dt = {shortest:g} s or less."
            )
        for name in inputs or {}:
            if name not in self.by_name:
                raise ValueError(f"input '{name}' belongs to no effect.{parameters.nearest(name, self.by_name)}")

    # -- the function --------------------------------------------------------------------------------------------

    def state(
        self,
        position: Tensor,
        speed: Tensor,
        params: Params,
        *,
        length: Tensor | float = 5.0,
        accel: Tensor | None = None,
        present: Tensor | None = None,
        step: Tensor | int = 0,
        circumference: Tensor | float | None = None,
        seed: int | None = None,
        lane: Tensor | int | None = None,
    ) -> State:
        """Return the state at the start, with gaps built from positions (differentiably) and memories filled.

        ``position`` and ``speed`` have shape ``(..., vehicles)``, front first; ``length`` (m) broadcasts; ``step`` sets
        the clock; ``circumference`` (m) is a ring's, one per batch row; ``lane`` (whole numbers, 0 on the right) is
        needed on a road of several, where slots may be in any order. ``seed`` draws how drivers who drift are at the
        start, from how they are in the long run; without it they begin at their mean. ValueError for shapes that do
        not fit.
        """
        parameters.refuse_incomplete(self.effects, params)
        shapes = [tuple(x.shape) if isinstance(x, Tensor) else parameters.shown(x) for x in (position, speed)]
        if shapes[0] != shapes[1] or not isinstance(position, Tensor) or position.dim() == 0:
            raise ValueError(f"position {shapes[0]} and speed {shapes[1]} must be tensors of one shape (…, vehicles).")
        length = torch.as_tensor(length, dtype=position.dtype, device=position.device).expand_as(position)
        if present is None and self.road.leaving:
            present = torch.ones_like(position.detach())
        if present is not None:
            present = present.to(position.dtype).expand_as(position)
        still = torch.zeros_like(speed) if accel is None else accel
        clock = torch.as_tensor(step, device=position.device)
        lanes = self.road.lane_state(position, length, lane, present)
        start = State(position, speed, still, position, length, clock, present, {}, lanes)  # gaps: once roads see it
        road = self.road.view(start)
        gap = road.gaps(position, length, circumference)
        if present is not None:
            gap = torch.where(road.leader_present(present, position) > 0, gap, FAR)
        start = start._replace(gap=gap)
        return start._replace(memory=self.remembered(start, params, seed))

    def remembered(self, state: State, params: Params, seed: int | None = None) -> dict[str, Tensor]:
        """Return the memories of drivers who have just begun to drive."""
        scene = self.scene(state._replace(memory={}), {})
        driver = self._following.driver(dict(params[self._following.name]))
        memory: dict[str, Tensor] = {}
        for effect in self.effects:
            held = effect.initial_memory(scene, driver, dict(params[effect.name]))
            if held is not None:
                random = effect.draws and seed is not None
                memory[effect.name] = normals(f"{effect.name} at the start", seed or 0, held) if random else held
        if self.looks_back:
            memory[PAST] = History.beginning(scene, self.looks_back).buffer
        if self.sees_lanes:
            on_one = torch.zeros_like(state.speed)
            memory[merging.LANE] = on_one if state.lanes is None else state.lanes.lane.to(state.speed.dtype)
        return {**memory, **merging.nobody(state.speed)} if self.sees_mergers else memory

    def scene(self, state: State, inputs: Inputs) -> Scene:
        """Return the scene of this step, as every vehicle sees it."""
        road = self.road.view(state)
        led = road.leader_present(state.present, state.speed)
        leader = road.leader(state.gap, state.speed, state.accel, led)
        scene = Scene(
            position=state.position,
            speed=state.speed,
            accel=state.accel,
            leader=leader,
            second_leader=(
                road.second_leader(leader, state.length, state.speed) if "second_leader" in self._needs else None
            ),
            behind=road.behind(leader, state.speed, state.accel) if "behind" in self._needs else None,
            time=self.time(state),
            dt=self.dt,
            euler=self.integration == "euler",
            inputs=inputs,
            memory=state.memory,
            history=self._history(state),
            merger=merging.merger(state.memory, state.speed) if self.sees_mergers else None,
            lane=state.memory.get(merging.LANE) if self.sees_lanes else None,
        )
        return half_ahead(scene) if self.integration == "midpoint" else scene

    def _history(self, state: State) -> PastScenes | None:
        return History(state.memory[PAST], self.dt) if PAST in state.memory else None

    def event(self, state: State, params: Params, now: Tensor) -> Any:
        """Raise NotImplementedError: the decisions of events on a network, ``(..., n)`` each, are a simulator's."""
        raise NotImplementedError("events of networks belong to a Simulator.")

    def time(self, state: State) -> Tensor:
        """Return the time (s), shaped to broadcast against ``(..., vehicles)``."""
        time = state.step.to(state.position.dtype) * self.dt
        return time if time.dim() == 0 else time.unsqueeze(-1)

    def wanted(self, scene: Scene, params: Params) -> tuple[Tensor, Scene, Driver]:
        """Return the wanted accelerations (m/s²), the scene as drivers see it, and their parameters in force."""
        seen = scene
        for effect in self._hooks["perceive"]:
            seen = effect.perceive(seen, params[effect.name])  # type: ignore[arg-type]
        driver = self._following.driver(params[self._following.name])  # type: ignore[arg-type]
        for effect in self._hooks["adapt"]:
            view = scene if effect.sees_truth else seen
            driver = effect.adapt(driver, view, params[effect.name])  # type: ignore[arg-type]
        accel: Tensor | None = None
        for effect in self._hooks["accelerate"]:
            view = scene if effect.sees_truth else seen
            part = effect.accelerate(view, driver, params[effect.name])  # type: ignore[arg-type]
            accel = part if accel is None else accel + part
        assert accel is not None  # the car-following effect accelerates
        return accel, seen, driver

    def _respond(self, state: State, inputs: Inputs, params: Params) -> tuple[Tensor, Scene, Driver]:
        scene = self.scene(state, inputs)
        accel, driver = self.answered(scene, params)
        return accel, scene, driver

    def answered(self, scene: Scene, params: Params) -> tuple[Tensor, Driver]:
        """Return the accelerations in a scene (m/s²), within limits, and the drivers' parameters in force."""
        accel, seen, driver = self.wanted(scene, params)
        for effect in self._hooks["limit"]:
            view = scene if effect.sees_truth else seen
            own = self._unspoken.get(effect.name) or params[effect.name]
            accel = effect.limit(accel, view, driver, own)  # type: ignore[arg-type]
        return accel, driver

    def acceleration(self, state: State, inputs: Inputs, params: Params) -> Tensor:
        """Return the acceleration of every vehicle in this state (m/s²), before any record is replayed."""
        return self._respond(state, inputs, params)[0]

    def step(self, state: State, inputs: Inputs, params: Params) -> State:
        """Return the state Δt later, nobody changing lanes. Pure: the same arguments give the same result.

        ``inputs`` maps effect names to what they take at this step; ``params`` maps effect and parameter names to
        tensors that broadcast against ``(..., vehicles)``.
        """
        accel, scene, driver = self._respond(state, inputs, params)
        displacement, speed, accel = INTEGRATORS[self.integration](state.speed, accel, self.dt)
        if state.present is not None:  # whoever is not there stands still, whatever he wants or is commanded
            on_road = state.present > 0
            displacement, speed, accel = (torch.where(on_road, x, 0.0) for x in (displacement, speed, accel))
        motion = Motion(displacement, state.position + displacement, speed, accel, state.present)
        for effect in self._hooks["place"]:
            motion = effect.place(motion, scene, params[effect.name])  # type: ignore[arg-type]
        memory = {
            e.name: e.remember(scene, driver, params[e.name])  # type: ignore[arg-type]
            for e in self.effects
            if e.name in state.memory
        }
        if scene.history is not None:
            memory[PAST] = scene.history.pushed(scene)
        memory |= merging.driven_on(state.memory, motion.displacement, self.dt)
        after = State(
            position=motion.position,
            speed=motion.speed,
            accel=motion.accel,
            gap=self._gaps(state, motion),
            length=state.length,
            step=state.step + 1,
            present=motion.present,
            memory=memory,
            lanes=state.lanes,
        )
        return after if motion.lane is None else self.road.view(state).placed(state, motion.lane, after)

    def _gaps(self, state: State, motion: Motion) -> Tensor:
        road = self.road.view(state)
        gap = road.advance(state.gap, motion.displacement)
        if motion.present is None:
            return gap
        now = road.leader_present(motion.present, motion.position) > 0
        if motion.present is not state.present:
            before = road.leader_present(state.present, state.position) > 0
            gap = torch.where(now & ~before, road.gaps(motion.position, state.length), gap)
        return torch.where(now, gap, FAR)


def ballistic(speed: Tensor, accel: Tensor, dt: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return displacement (m), new speed and realised acceleration: ``x += v Δt + a Δt²/2``, with an exact stop.

    A car whose speed would become negative stops inside the step, after ``v²/(2|a|)``.
    """
    after = speed + accel * dt
    stops = after < 0
    braking = torch.where(stops, -accel, 1.0)
    displacement = torch.where(stops, 0.5 * speed * speed / braking, 0.5 * dt * (speed + after))
    return displacement, after.clamp_min(0.0), torch.where(stops, -speed / dt, accel)


def euler(speed: Tensor, accel: Tensor, dt: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return displacement (m), new speed and acceleration of the paper's explicit Euler: ``x += v Δt``, old v."""
    return speed * dt, (speed + accel * dt).clamp_min(0.0), accel


def normals(what: str, seed: int, like: Tensor, *leading: int) -> Tensor:
    """Return standard normals (…leading, *like.shape), the same for the same seed and ``what`` they are for."""
    generator = torch.Generator().manual_seed(zlib.crc32(f"{seed} {what}".encode()))
    values = torch.randn((*leading, *like.shape), generator=generator, dtype=torch.float64)
    return values.to(device=like.device, dtype=like.dtype)


def half_ahead(scene: Scene) -> Scene:
    """Return speeds and gaps half a step later, at the accelerations of the step before; positions stay."""
    half = 0.5 * scene.dt

    def later(speed: Tensor, accel: Tensor) -> Tensor:
        return torch.relu(speed + half * accel)

    def moved(other: Neighbour | None, sign: float) -> Neighbour | None:
        if other is None:
            return None
        opening = (other.speed - scene.speed) + 0.5 * half * (other.accel - scene.accel)
        gap = other.gap + sign * half * opening * other.present
        return other._replace(gap=gap, speed=later(other.speed, other.accel))

    leader = moved(scene.leader, 1.0)
    assert leader is not None
    return scene._replace(
        speed=later(scene.speed, scene.accel),
        leader=leader,
        second_leader=moved(scene.second_leader, 1.0),
        behind=moved(scene.behind, -1.0),
        merger=moved(scene.merger, 1.0),
    )


INTEGRATORS: Mapping[Integration, Callable[[Tensor, Tensor, float], tuple[Tensor, Tensor, Tensor]]] = {
    "ballistic": ballistic,
    "euler": euler,
    "midpoint": ballistic,
}
