"""Task ``replay``: a recorded road replayed, with any chosen vehicles handed over to agents or to the model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from idm_env import metrics
from idm_env.effects import IDM, Brakes, Control, Effect, Replay
from idm_env.roads import Lane, Road
from idm_env.tasks.base import Ended, EnvState, Task
from idm_env.tasks.checks import Range, count_of, in_ranges
from idm_env.tasks.crash import floored
from idm_env.tasks.features import Feature
from idm_env.tasks.follow import HIGHEST, KNEE, LOWEST, SEEN
from idm_env.tasks.random import Draw
from idm_env.tasks.reward_terms import RewardTerm, Transition, headway_penalty
from idm_env.tasks.scenes import Scene, made_up_scene, recorded_scene
from idm_env.tasks.types import NOBODY, Maybe, Normals
from idm_env.types import Inputs, Params, Record
from idm_env.validation import nearest, shown

HORIZON = 300
_START_STREAM = 31
_FARTHEST = -10.0


@dataclass(frozen=True, eq=False, kw_only=True)
class ReplayTask(Task):
    """Every vehicle of every lane of a file, where its smoothed record says; some are simulated instead.

    An episode begins at a drawn time at which all agents are there, behind recorded leaders. Recorded vehicles do not
    react to those that are handed over. A vehicle that is handed over and comes later begins from its record.

    Observation, per agent: ``v/40, v_lead/40, gap/100`` (m/s and m; raw: without the scales; a missing leader: the own
    speed, gap 1000 m).
    Reward, per agent: ``1/(1 + |x − x_record|/10 m)``. ``reward="imitation"`` pays ``−|x − x_record|/10``, saturated
    from −5 towards −10; ``reward="source"`` that of ``follow``, ``1 − fuel/10 − 0.002 u² − 2 p``, with the agent's own
    fuel. An agent whose vehicle is not there observes and gets zeros.
    Each agent for itself: terminated where it touches its leader, truncated where its record ends. All are truncated
    after ``max_episode_steps``: 300, or for as long as the record of any agent goes on.

    Args:
        data: A trajectory file; None is a made-up scene of the project's own.
        runs: Some of its runs; None takes all, on one clock.
        controlled: Which vehicles agents control: a number (those that follow longest), ``"all"`` that follow at one
            time, a fraction of these, or ids, as ``["vehicle"]`` or ``["run/vehicle"]``.
        model: Which vehicles the drivers' model takes over: ids as for ``controlled``, or ``"all"`` with a recorded
            leader.
    """

    name: ClassVar[str] = "replay"
    road: ClassVar[Road] = Lane()
    own_effects: ClassVar[tuple[Effect, ...]] = (IDM(), Brakes())
    own_parameters: ClassVar = {}
    machinery: ClassVar[tuple[Effect, ...]] = (Control(), Replay())
    own_features: ClassVar[tuple[Feature, ...]] = SEEN  # type: ignore[override]
    ranges: ClassVar[Mapping[str, Range]] = {"vehicles": Range(0, 100_000, whole=True)}

    vehicles: int = 0
    controlled: Any = 1
    max_command: float | Sequence[float] = 3.0
    data: str | None = None
    runs: Sequence[str] | None = None
    model: str | Sequence[str] = ()

    def __post_init__(self) -> None:
        in_ranges(self)
        if self.vehicles:
            raise ValueError(f"vehicles = {self.vehicles}, but the file of task 'replay' decides. Leave it out.")
        if self.runs is not None and (self.data is None or not isinstance(self.runs, list | tuple)):
            raise ValueError(f"runs = {shown(self.runs)} must be a list of runs of a file. Give data, too, or no runs.")
        if self.warmup:
            raise ValueError(f"warmup = {self.warmup}, but a replay begins from its record. Leave it out.")
        # The simulator needs no number of vehicles; everything that does comes after this line.
        object.__setattr__(self, "vehicles", len(self.scene.ids))
        self._check_episode()
        self.params(torch.float64, "cpu")
        _ = self.agents, self._simulated, self._starts
        if (self.max_episode_steps or 0) * self.held > self._longest:
            most = self._longest // self.held
            raise ValueError(
                f"max_episode_steps = {self.max_episode_steps} exceeds the {most} steps that the agents' "
                f"records go on. Take at most {most}, or control others."
            )

    @property
    def usual_steps(self) -> int:
        """300 steps, or what the agents' records have."""
        return min(HORIZON, self._longest)

    @property
    def _wanted(self) -> int:
        """Steps for which agents should be there: those asked for, else 300."""
        return HORIZON if self.max_episode_steps in (None, -1) else int(self.max_episode_steps or 0) * self.held

    @cached_property
    def _longest(self) -> int:
        """Most steps from any beginning until the last of the agents has left."""
        remaining = _remaining(self.scene.present[:, list(self.agents)])
        return max(1, int(remaining[self._together].max(initial=0)) - 1)

    @cached_property
    def _together(self) -> np.ndarray:
        """Time steps at which all agents follow recorded leaders, bool."""
        return np.asarray(np.all(self.scene.led[:, list(self.agents)], axis=1))

    @property
    def lanes(self) -> tuple[int, ...]:
        """The recorded lane of each slot."""
        return self.scene.lane

    @property
    def vehicle_ids(self) -> tuple[str, ...]:  # type: ignore[override]
        """The recorded id of each slot."""
        return self.scene.ids

    @property
    def own_rewards(self) -> Mapping[str, Mapping[RewardTerm, float]]:
        """``unit``; minus the distance; and the source's of ``follow``."""
        record = RewardTerm("record", "1/(1 + |x − x_record|/10 m)", "", 0.0, 1.0, self._record)
        imitation = RewardTerm("imitation", "−|x − x_record|/10 m", "", _FARTHEST, 0.0, self._imitation)
        source = RewardTerm("source", "", "", LOWEST, HIGHEST, self._source)
        return {"unit": {record: 1.0}, "imitation": {imitation: 1.0}, "source": {source: 1.0}}

    @property
    def shares(self) -> int:  # type: ignore[override]
        """The number of agents: one of them ends the episode of a single environment, which pays their mean."""
        return len(self.agents)

    @cached_property
    def scene(self) -> Scene:
        """The recorded road."""
        dt = self.simulator.dt
        if self.data is None:
            return made_up_scene(dt)
        return recorded_scene(str(self.data), dt, None if self.runs is None else tuple(self.runs))

    @cached_property
    def agents(self) -> tuple[int, ...]:
        """Slots of the controlled vehicles.

        ValueError for none, and for more than follow recorded leaders at one time.
        """
        if isinstance(self.controlled, Sequence) and not isinstance(self.controlled, str):
            chosen = tuple(sorted({self._slot(i) for i in self.controlled}))
            if not chosen:
                raise ValueError("controlled = [] must name at least one vehicle.")
            return chosen
        most = count_of(self.controlled, self.vehicles)
        # "all" and fractions are of those that follow at one time.
        picked = self._following(most if isinstance(self.controlled, int) else self.vehicles)
        count = count_of(self.controlled, len(picked))
        if len(picked) < count:
            raise ValueError(
                f"controlled = {count}, but only {len(picked)} vehicles follow recorded leaders at one time. "
                f"Control fewer."
            )
        return tuple(sorted(picked[:count]))

    def _following(self, most: int) -> list[int]:
        """Return up to ``most`` slots that follow recorded leaders at one time, those that follow longest first."""
        led = self.scene.led
        order = [int(i) for i in np.argsort(-led.sum(0), kind="stable") if self.scene.ids[i] != NOBODY]
        picked: list[int] = []
        together = np.ones(len(led), bool)
        enough = min(self._wanted, _remaining(led[:, order[0]]).max())
        for slot in order:
            if len(picked) < most and _remaining(together & led[:, slot]).max() >= enough:
                picked.append(slot)
                together &= led[:, slot]
        return picked

    def _slot(self, vehicle: Any) -> int:
        by_id = {key: i for i, key in enumerate(self.scene.ids) if key != NOBODY}
        slots = [i for key, i in by_id.items() if str(vehicle) in (key, key.rsplit("/", 1)[-1])]
        if not slots:
            raise ValueError(f"vehicle '{vehicle}' is not recorded.{nearest(str(vehicle), list(by_id)[:200])[:160]}")
        if len(slots) > 1:
            raise ValueError(f"vehicle '{vehicle}' is in {len(slots)} runs. Name one: '{self.scene.ids[slots[0]]}'.")
        return slots[0]

    @cached_property
    def _simulated(self) -> np.ndarray:
        """Slots that are not replayed, bool."""
        mine = np.zeros(self.vehicles, bool)
        if self.model == "all":
            mine |= self.scene.led.any(0) & (np.array(self.scene.ids) != NOBODY)
        elif isinstance(self.model, str) or not isinstance(self.model, Sequence):
            raise ValueError(f"model = {shown(self.model)} must be 'all' or a list of vehicles.")
        else:
            mine[[self._slot(vehicle) for vehicle in self.model]] = True
        mine[list(self.agents)] = True
        return mine

    @cached_property
    def _starts(self) -> np.ndarray:
        """Time steps at which an episode may begin: all agents follow for the horizon, or for as long as any do."""
        remaining = _remaining(self._together)
        longest = int(remaining.max())
        if longest < 2:
            ids = [self.scene.ids[i] for i in self.agents[:4]]
            raise ValueError(f"vehicles {ids} never follow recorded leaders at one time. Control others or fewer.")
        return np.flatnonzero(remaining >= min(self._wanted + 1, longest))

    def begin(self, draw: Draw, params: Params) -> EnvState:
        """Return the recorded road at a drawn time."""
        like = self.like(params)
        starts = self.constant("starts", self._starts, draw.key.device, torch.int64)
        start = starts[(draw.uniforms(_START_STREAM, 1, torch.float64).squeeze(-1) * len(starts)).long()]
        motion, present = self._recorded(start, like.dtype)
        length = self.constant("length", self.scene.length, start.device, like.dtype)
        position, speed, accel = motion.unbind(-1)
        more: dict[str, Any] = {"length": length, "present": present, "lane": self.lane_at(start)}
        state = self.simulator.state(position, speed, params, accel=accel, step=torch.zeros_like(start), **more)
        return EnvState(state, {"start": start})

    def lane_at(self, time: Tensor) -> Tensor | None:
        """Return the recorded lanes at time steps of the record; None where vehicles keep theirs."""
        return None

    def _recorded(self, time: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Return motion ``(n, slots, 3)`` and presence ``(n, slots)`` at time steps of the record."""
        motion = self.constant("motion", self.scene.motion, time.device, dtype)
        present = self.constant("present", self.scene.present, time.device, dtype)
        inside = time.clamp(0, len(motion) - 1)
        return motion[inside], present[inside]

    def inputs(self, world: EnvState, command: Maybe, normals: Normals, live: Maybe = None) -> Inputs:
        """Return the inputs of one step, with the record at its end; who is not there yet is placed by it."""
        inputs = dict(super().inputs(world, command, normals, live))
        state = world.state
        motion, present = self._recorded(world.episode["start"] + state.step + 1, state.speed.dtype)
        replayed = self.constant("replayed", ~self._simulated, state.speed.device, torch.bool)
        assert state.present is not None
        position, speed, accel = motion.unbind(-1)
        inputs["replay"] = Record(position, speed, accel, replayed | (state.present <= 0), present)
        return inputs

    def _record(self, step: Transition) -> Tensor:
        """Return ``1/(1 + |x − x_record|/10 m)``."""
        return 1.0 / (1.0 + 0.1 * self.distance(step.after))

    def _imitation(self, step: Transition) -> Tensor:
        """Return minus the distance to the record (10 m), saturated from −5 towards −10."""
        return floored(-0.1 * self.distance(step.after), 0.5 * _FARTHEST, _FARTHEST)

    def _source(self, step: Transition) -> Tensor:
        """Return ``1 − fuel/10 − 0.002 u² − 2 p`` with the agent's own fuel, saturated below −2."""
        state, command = step.after.state, step.command
        speed, gap = self.pick(state.speed), self.pick(state.gap)
        fuel = 0.951 * metrics.fuel(speed, self.pick(state.accel))
        far = torch.where(gap < 1e3, headway_penalty(gap, speed), 0.0)
        return floored(1.0 - 0.1 * fuel - 0.002 * command * command - 2.0 * far, KNEE, LOWEST)

    def distance(self, world: EnvState) -> Tensor:
        """Return how far the agents are from their records (m), 0 where these have ended, shape ``(…, agents)``."""
        state = world.state
        motion, present = self._recorded(world.episode["start"] + state.step, state.speed.dtype)
        return self.pick((state.position - motion[..., 0]).abs() * present)

    def crashed(self, world: EnvState) -> Tensor:
        """Return which agents touch their leaders."""
        return self.pick(world.state.gap) <= 0.0

    def crash_reason(self, world: EnvState, row: int, agent: int | None = None) -> str:
        """Return which agent touched its leader: recorded vehicles may overlap, and nobody minds."""
        own = int(self.pick(world.state.gap[row].detach()).argmin()) if agent is None else agent
        return super().crash_reason(world, row, own)

    def ended(self, world: EnvState) -> Ended:
        """Return, for each agent, whether it touches its leader, and whether its record has ended."""
        state = world.state
        assert state.present is not None
        over = world.episode["start"] + state.step + 1 >= len(self.scene.present)
        return Ended(self.crashed(world), (self.pick(state.present) <= 0) | over.unsqueeze(-1))


def _remaining(mask: np.ndarray) -> np.ndarray:
    """Return for how many steps from each on a mask [T, …] goes on being True."""
    step = np.arange(len(mask)).reshape(-1, *(1,) * (mask.ndim - 1))
    return np.minimum.accumulate(np.where(mask, len(mask), step)[::-1])[::-1] - step
