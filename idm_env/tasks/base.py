"""What a task is: pure functions reset, step, observe, reward and ended over frozen static choices, batched.

A task knows nothing of Gymnasium, of automatic resets or of where gradients are cut; agents that differentiate
through a rollout call it directly. Everything random comes in: as keys (``Draw``) at reset and as normals at every
step. A crash ends an episode, and with it what was in store: see ``idm_env.tasks.crash``.
"""

import abc
import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from idm_env.effects import Control, Effect, Noise
from idm_env.parameters import catalogue, replaced
from idm_env.roads import Road
from idm_env.simulator import Simulator, stacked
from idm_env.tasks.behaviour import Behaviour, behaviour
from idm_env.tasks.checks import Range, agents_of, in_ranges, limits_of, one_declared, ranges, ranges_of, two_ends
from idm_env.tasks.counters import Counters
from idm_env.tasks.crash import contact, lawful_cost
from idm_env.tasks.failsafe import safe_accel
from idm_env.tasks.features import FEATURES, AgentView, Feature, ObservedFeature, chosen
from idm_env.tasks.random import Draw
from idm_env.tasks.reward_terms import REWARD_TERMS, RewardTerm, Transition, Weighted, weighted
from idm_env.tasks.types import Bounds, Ended, EnvState, Maybe, Normals, RewardRange
from idm_env.types import Command, Inputs, Params, State, mapped
from idm_env.validation import nearest, whole

_NORMALS_AT_ONCE = 1 << 16
_AS_MANY = " Task 'highway' draws vehicles; elsewhere draw inflow, or give a ring length=[186, 268]."


@dataclass(frozen=True, eq=False, kw_only=True)
class Task(abc.ABC):
    """Static choices that every task has; all are plain values that JSON can hold.

    Args:
        vehicles: Number of vehicles, recorded ones included.
        controlled: How many vehicles agents control, spread evenly: a number, a fraction such as 0.1, or ``"all"``; or
            which ones (indices, front first).
        vehicle_length: Length of every vehicle (m).
        dt: Time step (s); None is the one of ``effects`` if that is a model file, else 0.1.
        integration: ``"ballistic"`` or ``"euler"``; None as for ``dt``.
        effects: Effects to add to the task's own or to replace those of the same name: names or
            ``{"effect": name, choice: value}``; or the path of a ``model.yaml``, whose effects then are all of the
            drivers'.
        parameters: What differs from the task's parameters: ``{"idm": {"time_gap": 1.2}}`` or ``{"idm.time_gap":
            1.2}``; a number, one number per vehicle, or a tensor (which may require grad).
        drivers: Path of a ``model.yaml`` with single drivers, such as ``idm-env fit --by driver`` writes; it is used as
            in ``effects``, and in every episode every vehicle drives as one of them, drawn anew. What ``parameters``
            names is everybody's.
        randomise: Ranges from which every episode draws anew, evenly: parameters, for all its drivers alike (domain
            randomisation), ``{"idm": {"time_gap": [0.8, 1.2]}}`` or ``{"idm.time_gap": [0.8, 1.2]}``, over
            ``parameters`` and ``drivers``; the demand of open roads, ``{"inflow": [1500, 2500]}``; and how many drive
            on ``highway``, ``{"vehicles": [18, 26]}``.
        noise: Standard deviation of the drivers' noise N, added as ``accel += √Δt N(0, noise²)`` (m/s² per √s); 0 is
            none.
        warmup: Steps before an episode begins, in which nobody is controlled.
        warmup_pool: If above 0, episodes begin in one of that many warmed-up worlds, which are made once.
        warmup_pool_seed: Number of the pool; those of two numbers have no world in common.
        max_command: Acceleration that an action of 1 commands (m/s²), and an action of −1 its negative; or
            ``[hardest braking, strongest acceleration]``, such as ``[-4.5, 2.6]``: actions below 0 are then in parts of
            the former, those above in parts of the latter, and an action of 0 commands 0 in any case.
        failsafe: Deceleration (m/s²) of a failsafe: commands that leave a vehicle no room to stop at it behind a leader
            who brakes as hard, or where its lane ends, are cut, and may then brake beyond ``max_command``; 0 is none.
            Rewards are for the command as it was given. See ``idm_env.tasks.failsafe.safe_accel``.
        failsafe_time: Time (s) that the failsafe allows for before braking begins, as SUMO's tau.
        hold: Time (s) for which an action is held: a step of the environment is so long, and its reward the mean over
            it; a whole number of Δt. None is the task's own: one Δt, or 1 s where vehicles enter and leave.
        max_episode_steps: Steps of the environment after which an episode is cut off; None is the task's own number, −1
            is no limit.
        observation: ``"scaled"``: each entry over a fixed scale that the task documents, about unit size; ``"raw"``: in
            SI units (m, m/s). Both are clipped to ``bounds``. ``{"features": ["speed", "gap"], "vehicles": 3}`` takes
            these of ``idm_env.tasks.FEATURES``, of the agent and of the two vehicles ahead of it; ``"scaling": "raw"``
            may stand beside. A feature of one's own is a ``Feature``, or ``"my_file.py:my_feature"``.
        reward: Name of one of the task's rewards; None is the first, ``"unit"``, which pays 0 to 1 a step. Or weights
            of ``idm_env.tasks.REWARD_TERMS``: ``{"speed": 0.2, "effort": -4.0}``, where a term of one's own is
            ``"my_file.py:my_term"``, or a ``RewardTerm`` as a key. All are means over the time of a step.
        crash_cost: Price of a crash; None is 0, or for rewards that can be negative the smallest that makes a crash
            worse than any survival (``idm_env.tasks.crash``).

    Raises:
        ValueError: In one line, with value, rule and cure.
    """

    vehicles: int = 22
    controlled: int | float | str | Sequence[int] = 1
    vehicle_length: float = 5.0
    dt: float | None = None
    integration: str | None = None
    effects: str | Sequence[str | Mapping[str, Any] | Effect] = ()
    parameters: Mapping[str, Any] | None = None
    drivers: str | None = None
    randomise: Mapping[str, Any] | None = None
    noise: float = 0.0
    warmup: int = 0
    warmup_pool: int = 0
    warmup_pool_seed: int = 0
    max_command: float | Sequence[float] = 1.0
    failsafe: float = 0.0
    failsafe_time: float = 1.0
    hold: float | None = None
    max_episode_steps: int | None = None
    observation: str | Mapping[str, Any] = "scaled"
    reward: str | Mapping[Any, float] | None = None
    crash_cost: float | None = None

    name: ClassVar[str]
    road: ClassVar[Road]
    own_effects: ClassVar[tuple[Effect, ...]]
    own_parameters: ClassVar[Mapping[str, Mapping[str, float]]]
    machinery: ClassVar[tuple[Effect, ...]] = (Control(),)
    """Effects through which the task itself acts; they are always there, and take inputs that the task gives."""
    ranges: ClassVar[Mapping[str, Range]] = {
        "vehicles": Range(1, 100_000, whole=True),
        "vehicle_length": Range(0.1, 100.0, "m"),
        "dt": Range(1e-3, 5.0, "s"),
        "noise": Range(0.0, 10.0, "m/s²"),
        "warmup": Range(0, 100_000, whole=True),
        "warmup_pool": Range(0, 100_000, whole=True),
        "warmup_pool_seed": Range(0, 1e9, whole=True),
        "failsafe": Range(0.0, 100.0, "m/s²"),
        "failsafe_time": Range(0.0, 60.0, "s"),
        "hold": Range(1e-3, 60.0, "s"),
        "crash_cost": Range(0.0, 1e12),
        "max_episode_steps": Range(-1, 1e9, whole=True),
    }
    """Where numbers may lie: of a kind of task its own, beside those that it inherits."""
    usual_hold: ClassVar[float | None] = None
    """Time (s) for which an action is held where nothing is said; None: one Δt."""
    ego: ClassVar[bool] = False
    """Whether the only agent's vehicle leaves, and enters again."""
    first_free: ClassVar[int] = 0
    """Vehicles before this one cannot be controlled: they are recorded."""
    can_draw: ClassVar[tuple[str, ...]] = ()
    """Keywords beside parameters that ``randomise`` takes."""
    begins_with: ClassVar[tuple[str, ...]] = ()
    """Keywords that only the beginning of an episode looks at: ``reset(options={…})`` takes them."""
    shares: ClassVar[int] = 1
    """Number of agents that share the cost of a crash by the mean of their rewards: 1 if all crash together."""
    journeys: ClassVar[int] = 0
    """Most trips of an agent's slot in an episode; 0 for agents that are on the road from the start."""
    as_driver: ClassVar[float] = 0.0
    """Action by which a vehicle does as its driver would; 0 where there is none, and 0 commands 0 m/s²."""
    commands: ClassVar[tuple[str, ...]] = ("accel",)
    """What an agent commands: an action holds the first of all agents, then the second of all, and so on."""
    levels: ClassVar[tuple[int, ...] | None] = None
    """How many values each command of an agent may have, evenly from −1 to 1; None: any number in between."""
    pairs: ClassVar[int] = 0
    """How many pairs of vehicles an observation looks at, for which it takes memory."""
    vehicle_ids: ClassVar[tuple[str, ...] | None] = None
    """Recorded ids of all vehicles, or None where nothing is recorded but leaders."""

    def __post_init__(self) -> None:
        in_ranges(self)
        whole("vehicles", self.vehicles, self.first_free + 1)
        agents_of(self.controlled, self.vehicles, self.first_free)
        if self.warmup_pool and not self.warmup:
            raise ValueError(f"warmup_pool = {self.warmup_pool} has no use without warm-up. Give warmup=750 as well.")
        self._check_episode()
        self.params(torch.float64, "cpu")
        _ = self.held

    def _check_episode(self) -> None:
        """Check what every task says of its commands, episodes and observations."""
        limits_of(self.max_command)
        if self.max_episode_steps == 0:
            raise ValueError("max_episode_steps = 0 must be at least 1, or -1 for no limit.")
        _ = self.scaling, self.weighted, self._demands, self._ranges

    # -- static facts --------------------------------------------------------------------------------------------

    @cached_property
    def agents(self) -> tuple[int, ...]:
        """Indices of the controlled vehicles, front first."""
        return agents_of(self.controlled, self.vehicles, self.first_free)

    @cached_property
    def command_limits(self) -> tuple[float, float]:
        """The accelerations (m/s²) that actions of −1 and 1 command."""
        return limits_of(self.max_command)

    @cached_property
    def held(self) -> int:
        """Steps of Δt for which an action is held; ValueError where ``hold`` is no whole number of them."""
        hold, dt = self.usual_hold if self.hold is None else self.hold, self._behaviour.dt
        steps = 1 if hold is None else max(1, round(hold / dt))
        if self.hold is not None and abs(self.hold - steps * dt) > 1e-6 * dt:
            raise ValueError(f"hold = {self.hold:g} s must be a whole number of Δt = {dt:g} s, such as {steps * dt:g}.")
        return steps

    @property
    def step_time(self) -> float:
        """Time (s) of a step of the environment, for which an action is held."""
        return self.held * self._behaviour.dt

    @property
    def usual_steps(self) -> int:
        """Steps of Δt of an episode where nothing else is said."""
        return 3000

    @property
    def horizon(self) -> int | None:
        """Steps of the environment, ``held`` Δt each, after which an episode is cut off, or None."""
        if self.max_episode_steps is None:
            return max(1, self.usual_steps // self.held)
        return None if self.max_episode_steps == -1 else self.max_episode_steps

    @property
    def steps(self) -> int:
        """The most steps of Δt of an episode; without a limit those of a usual one."""
        return self.usual_steps if self.horizon is None else self.horizon * self.held

    @property
    @abc.abstractmethod
    def own_rewards(self) -> Mapping[str, Mapping[RewardTerm, float]]:
        """The task's rewards by name, each as weights of terms; the first, ``"unit"``, lies in [0, 1]."""

    @cached_property
    def weighted(self) -> Weighted:
        """The reward of an agent."""
        return weighted(
            self.reward, self.own_rewards, lambda x, where: one_declared(x, RewardTerm, REWARD_TERMS, where), self.held
        )

    @property
    def reward_names(self) -> tuple[str, ...]:
        """Names of the terms of the reward, as ``info["rewards"]`` has them."""
        names = tuple(term.name for term, _ in self.weighted.terms)
        return (*names, "crash") if self.cost_of_crash else names

    @property
    def reward_range(self) -> RewardRange:
        """The lowest (at most 0) and the highest (at least 0) reward of a step without a crash."""
        return self.weighted.reward_range

    @cached_property
    def cost_of_crash(self) -> float:
        """Price of a crash: ``crash_cost``, or what makes it worse than any survival (``idm_env.tasks.crash``)."""
        if self.crash_cost is not None:
            return self.crash_cost
        return self.shares * lawful_cost(self.reward_range, -(-self.steps // self.held))

    @property
    def lanes(self) -> tuple[int, ...]:
        """The lane of each vehicle, counted from 0: for pictures."""
        return (0,) * self.vehicles

    @property
    @abc.abstractmethod
    def own_features(self) -> tuple[Feature, ...]:
        """What one agent observes unless ``observation`` names features."""

    @cached_property
    def _observation(self) -> tuple[str, tuple[ObservedFeature, ...] | None]:
        return chosen(self.observation, lambda x, where: one_declared(x, Feature, FEATURES, where))

    @property
    def scaling(self) -> str:
        """``"scaled"`` or ``"raw"``."""
        return self._observation[0]

    @cached_property
    def observed(self) -> tuple[ObservedFeature, ...]:
        """What one agent observes, entry by entry."""
        return self._observation[1] or tuple(ObservedFeature(each) for each in self.own_features)

    @cached_property
    def scales(self) -> tuple[float, ...]:
        """What each entry of an observation is divided by: 1 for raw ones."""
        return tuple(x.feature.scale if self.scaling == "scaled" else 1.0 for x in self.observed)

    @cached_property
    def bounds(self) -> Bounds:
        """The space of observations: they are clipped to it, and what is clipped has no gradient."""
        each = zip(self.observed, self.scales, strict=True)
        entries = ((x.name, x.feature.low / scale, x.feature.high / scale) for x, scale in each)
        return Bounds(*zip(*entries, strict=True))

    def by_name(self, observation: Tensor) -> dict[str, Tensor]:
        """Return an observation ``(…, agents · features)`` by the name of each feature: ``(…, agents)`` in SI units."""
        each = observation.unflatten(-1, (-1, len(self.scales))).unbind(-1)
        return {name: x * scale for name, scale, x in zip(self.bounds.names, self.scales, each, strict=True)}

    @cached_property
    def _behaviour(self) -> Behaviour:
        extra, own = self.machinery, self.own_parameters
        if self.noise:
            extra += (Noise(),)
        model = behaviour(
            self.own_effects, extra, own, self.effects, self.parameters, self.dt, self.integration, self.drivers
        )
        ranges(type(self))["dt"].check("dt", model.dt)
        if self.noise:
            model.parameters.setdefault("noise", {}).setdefault("sigma", self.noise * math.sqrt(model.dt))
        names = {effect.name for effect in self.machinery}
        for effect in model.effects:
            if effect.takes is not None and effect.name not in names:
                raise ValueError(
                    f"effect '{effect.name}' takes an input that task '{self.name}' does not give. Leave it out here."
                )
        return model

    @cached_property
    def simulator(self) -> Simulator:
        """The simulator of this task."""
        model = self._behaviour
        return Simulator(self.road, model.effects, model.dt, model.integration)

    @cached_property
    def _tensors(self) -> dict[tuple[str, torch.device, torch.dtype], Tensor]:
        return {}

    def constant(self, name: str, values: Any, device: torch.device, dtype: torch.dtype) -> Tensor:
        """Return a static tensor, made once per device and dtype; ``values`` may be a function that gives them."""
        key = (name, device, dtype)
        tensor = self._tensors.get(key)
        if tensor is None:
            data = values() if callable(values) else values
            tensor = self._tensors[key] = torch.as_tensor(data, device=device).to(dtype)
        return tensor

    def params(self, dtype: torch.dtype, device: torch.device | str) -> dict[str, dict[str, Tensor]]:
        """Return checked parameters as tensors (a number: scalar; a list: one per vehicle; a tensor: as it is)."""
        values = self._behaviour.params(self.vehicles, dtype, device)
        self.simulator.check(values)
        return values

    def like(self, params: Params) -> Tensor:
        """Return a tensor of the precision and on the device of parameters."""
        return next(iter(params[self.simulator.base.name].values()))

    @cached_property
    def _ranges(self) -> dict[str, tuple[float, float]]:
        """What is drawn for every episode, by its full name, and the ends of its range."""
        drivers = self.randomise
        if isinstance(drivers, Mapping):
            drivers = {name: value for name, value in drivers.items() if name not in self.can_draw}
        spans = ranges_of(drivers)
        below = {full for full, p in catalogue(self._behaviour.effects).items() if p.most}
        for end in ("lowest", "highest", "nearest") if spans else ():  # the last: what another bounds, against it
            ends = {full: x[end == "highest" or (end == "nearest" and full in below)] for full, x in spans.items()}
            model = replace(self._behaviour, parameters=replaced(self._behaviour.parameters, ends))
            self.simulator.check(model.params(self.vehicles, torch.float64, "cpu"))
        return spans

    @cached_property
    def _demands(self) -> dict[str, tuple[float, float]]:
        """What else is drawn for every episode, and the ends of its range."""
        choices = self.randomise if isinstance(self.randomise, Mapping) else {}
        for name, value in choices.items():
            if isinstance(value, Sequence) and "." not in str(name) and name not in self.can_draw:
                like = nearest(str(name), (*self.can_draw, *catalogue(self._behaviour.effects)))
                like = _AS_MANY if name == "vehicles" else like
                own = ", ".join((*self.can_draw, "")) + "and " * bool(self.can_draw)
                raise ValueError(
                    f"randomise.{name} cannot be drawn in task '{self.name}', where {own}parameters of drivers such as "
                    f"idm.time_gap can.{like}"
                )
        spans = {k: two_ends(f"randomise.{k}", v) for k, v in choices.items() if k in self.can_draw}
        for name in spans:
            for end in choices[name]:
                ranges(type(self))[name].check(f"randomise.{name}", end)
        return spans

    def _is_agent(self) -> list[bool]:
        own = set(self.agents)
        return [i in own for i in range(self.vehicles)]

    def _agent_slots(self) -> list[int]:
        own = {vehicle: slot for slot, vehicle in enumerate(self.agents)}
        return [own.get(i, 0) for i in range(self.vehicles)]

    def pick(self, x: Tensor) -> Tensor:
        """Return what belongs to the controlled vehicles, shape ``(…, agents)``."""
        if len(self.agents) == 1:
            return x[..., self.agents[0] : self.agents[0] + 1]
        return x.index_select(-1, self.constant("agents", self.agents, x.device, torch.int64))

    # -- pure functions ------------------------------------------------------------------------------------------

    @abc.abstractmethod
    def begin(self, draw: Draw, params: Params) -> EnvState:
        """Return the worlds before the warm-up, with ``state.step = −warmup``."""

    def reset(self, draw: Draw, params: Params) -> EnvState:
        """Return the worlds at the beginning of an episode: ``begin`` and the warm-up, without any control."""
        who = self.who(draw)
        params = self.episode_params(who, params)
        world = self.begin(draw, params)
        world = begun = self._unsteady(world._replace(episode={**world.episode, **who}), draw)
        speed = world.state.speed
        block = max(16, _NORMALS_AT_ONCE // max(speed.numel(), 1))
        for first in range(0, self.warmup, block):
            steps = min(block, self.warmup - first)
            inputs = {**self._idle(world, steps), **self.normals(draw, world.state.step, steps, speed.dtype)}
            world = world._replace(state=self.simulator.rollout(world.state, inputs, params, steps, keep=None)[0])
        if not self.warmup:
            return world
        touched = world.state.gap <= 0
        if world.state.present is not None:
            touched = touched & (world.state.present > 0)
        return self._without_warm_up(world, begun, touched.any(-1)) if bool(touched.any()) else world

    def _without_warm_up(self, world: EnvState, begun: EnvState, rows: Tensor) -> EnvState:
        """Return the worlds, those rows as they begin (bool, ``(environments,)``); warn, because drivers collided."""
        warnings.warn(
            f"drivers of task '{self.name}' ran into each other in its warm-up of {self.warmup} steps: such episodes "
            "begin without it. Take calmer drivers, more room for each, or warmup=0.",
            stacklevel=2,
        )
        begun = begun._replace(state=begun.state._replace(step=torch.zeros_like(begun.state.step)))
        return mapped(lambda x, y: torch.where(rows.view(-1, *[1] * (x.dim() - 1)), y, x), world, begun)

    def who(self, draw: Draw) -> dict[str, Tensor]:
        """Return each vehicle's driver (index) in these episodes, and drawn places of parameters in their ranges."""
        episode = {}
        if self._behaviour.drivers:
            count = len(next(iter(self._behaviour.drivers.values())))
            share = draw.stream("drivers").uniforms(0, self.vehicles, torch.float64)
            episode["driver"] = (share * count).long()
        if self._ranges:
            episode["randomised"] = draw.stream("randomise").uniforms(0, len(self._ranges), torch.float64)
        return episode

    def episode_params(self, episode: Mapping[str, Tensor], params: Params) -> Params:
        """Return the parameters of a step in these episodes: each vehicle's driver's, and what episodes have drawn."""
        who, where = episode.get("driver"), episode.get("randomised")
        if who is None and where is None:
            return params
        changes, dtype = dict[str, Tensor](), self.like(params).dtype
        if who is not None:
            for full, values in self._behaviour.drivers.items():
                changes[full] = self.constant(f"drivers' {full}", np.array(values), who.device, dtype)[who]
        if where is not None:
            for i, (full, (low, high)) in enumerate(self._ranges.items()):
                number = (low + (high - low) * where[:, i : i + 1]).to(dtype)
                changes[full] = number.expand(-1, self.vehicles)
        return replaced(params, changes)

    def _unsteady(self, world: EnvState, draw: Draw) -> EnvState:
        """Return the worlds with drivers who drift as they are in the long run, rather than all at their mean."""
        state, names = world.state, [name for name in self.simulator.draws if name in world.state.memory]
        first = torch.zeros_like(draw.key)
        levels = {
            name: draw.stream(f"{name} at the start").normals(first, 1, self.vehicles, state.speed.dtype)[0]
            for name in names
        }
        return world._replace(state=state._replace(memory={**state.memory, **levels})) if names else world

    def normals(self, draw: Draw, step: Tensor, steps: int, dtype: torch.dtype) -> dict[str, Tensor]:
        """Return standard normals ``(steps, environments, vehicles)`` from ``step`` on, of every effect that draws.

        Each effect's are its own, whatever others there are.
        """
        return {
            name: (draw if name == Noise.kind else draw.stream(name)).normals(step, steps, self.vehicles, dtype)
            for name in self.simulator.draws
        }

    def _idle(self, world: EnvState, steps: int) -> dict[str, Any]:
        """Return the inputs of some steps without any command, time first."""
        state = world.state
        if len(self.machinery) == 1:
            still = torch.zeros(steps, self.vehicles, dtype=torch.bool, device=state.speed.device)
            return {"control": Command(state.speed.new_zeros(steps, 1), still)}
        every = [
            self.inputs(world._replace(state=state._replace(step=state.step + t)), None, None) for t in range(steps)
        ]
        return {name: stacked([inputs[name] for inputs in every]) for name in every[0]}

    def command(self, action: Tensor) -> Tensor:
        """Return the commanded accelerations (m/s²) of actions, which are clipped to [−1, 1] (no gradient beyond)."""
        low, high = self.command_limits
        action = action.clamp(-1.0, 1.0)
        return action * high if low == -high else torch.where(action < 0.0, action * -low, action * high)

    def action(self, accel: Tensor) -> Tensor:
        """Return the actions in [−1, 1] that command accelerations (m/s²), as far as they can."""
        low, high = self.command_limits
        return torch.where(accel < 0.0, accel / -low, accel / high).clamp(-1.0, 1.0)

    def lead_speed(self, state: State) -> Tensor:
        """Return the speed of each agent's leader (m/s), the agent's own where there is none, shape ``(…, agents)``."""
        return self.pick_leader(state, state.speed)

    def pick_leader(self, state: State, x: Tensor, nobody: float | None = None) -> Tensor:
        """Return each agent's leader's entry of ``x``, where there is no leader its own or ``nobody``."""
        road = self.road.view(state)
        ahead = road.ahead(x)
        if state.present is not None or nobody is not None:
            is_led = road.leader_present(state.present, x) > 0
            ahead = torch.where(is_led, ahead, x if nobody is None else nobody)
        return self.pick(ahead)

    def safe_command(self, world: EnvState) -> Tensor:
        """Return the highest acceleration (m/s²) that the failsafe allows each agent, shape ``(…, agents)``.

        That of ``safe_accel``, with ``failsafe`` and ``failsafe_time``.
        """
        state = world.state
        return self._safe_behind(state, self.lead_speed(state), self.pick(state.gap))

    def _safe_behind(self, state: State, lead_speed: Tensor, gap: Tensor) -> Tensor:
        """Return what the failsafe allows behind a leader at these speeds (m/s) and gaps (m), ``(…, agents)``."""
        euler = self.simulator.integration == "euler"
        return safe_accel(
            self.pick(state.speed), lead_speed, gap, self.failsafe, self.failsafe_time, self.simulator.dt, euler
        )

    def limit(self, world: EnvState, command: Tensor) -> Tensor:
        """Return commands (m/s²) as far as the failsafe lets them pass."""
        return torch.minimum(command, self.safe_command(world)) if self.failsafe else command

    def inputs(self, world: EnvState, command: Maybe, normals: Normals, live: Maybe = None) -> Inputs:
        """Return the inputs of one step: the command (m/s², None for nobody) and the normals of effects that draw.

        ``live`` (bool, ``(…, agents)``) says which agents still command; the others' vehicles go back to their drivers.
        """
        speed = world.state.speed
        if command is None:
            idle = self.constant("idle", [False] * self.vehicles, speed.device, torch.bool)
            inputs: dict[str, Any] = {"control": Command(speed.new_zeros(()), idle)}
        else:
            active = self.constant("active", self._is_agent, speed.device, torch.bool)
            if len(self.agents) > 1:
                slot = self.constant("slots", self._agent_slots, speed.device, torch.int64)
                command = command.index_select(-1, slot)
                live = None if live is None else live.index_select(-1, slot)
            active = active if live is None else active & live
            inputs = {"control": Command(command, active)}
        return {**inputs, **(normals or {})}

    def with_lane_commands(self, inputs: Inputs, action: Maybe, live: Maybe = None) -> Inputs:
        """Return the inputs of a step with the agents' lane commands, if they have any."""
        return inputs

    def step(self, world: EnvState, command: Maybe, normals: Normals, params: Params) -> EnvState:
        """Return the world Δt later. ``command`` (m/s²) is ``(…, agents)``, each of ``normals`` ``(…, vehicles)``."""
        if command is not None:
            command = self.limit(world, command)
        params = self.episode_params(world.episode, params)
        state = self.simulator.step(world.state, self.inputs(world, command, normals), params)
        return world._replace(state=state)

    def observe(self, world: EnvState) -> Tensor:
        """Return what the agents observe, shape ``(…, agents, features)``, within ``bounds``."""
        views = {k: AgentView(self, world, k) for k in {x.ahead for x in self.observed}}
        seen = [x.feature.read(views[x.ahead]) for x in self.observed]
        return self.clip(seen if self._observation[1] is None else [self.there(world.state, x) for x in seen])

    def there(self, state: State, x: Tensor) -> Tensor:
        """Return what belongs to the agents, shape ``(…, agents)``, 0 for those who are not on the road."""
        return x if state.present is None else torch.where(self.pick(state.present) > 0, x, torch.zeros_like(x))

    def reward_parts(
        self, before: EnvState, command: Tensor, after: EnvState, crashed: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return what each term of the reward pays for a Δt, ``(…, agents)``, and the price of a crash as ``crash``.

        ``command`` in m/s², which costs nothing where an agent is not on the road; ``crashed``, where the caller has it
        already, is ``self.crashed(after)``. A crash pays nothing but its price.
        """
        command = self.there(after.state, command)
        crashed = self.crashed(after) if crashed is None else crashed
        parts = self.weighted.parts(Transition(self, before, command, after))
        parts = {name: torch.where(crashed, 0.0, x) for name, x in parts.items()}
        return parts | {"crash": -self.cost_of_crash * crashed.to(command.dtype)} if self.cost_of_crash else parts

    def rewards(self, before: EnvState, command: Tensor, after: EnvState) -> Tensor:
        """Return the rewards of a Δt: the sum of ``reward_parts``, ``(…, agents)``."""
        return reduce(torch.add, self.reward_parts(before, command, after).values())

    def crashed(self, world: EnvState) -> Tensor:
        """Return whose episodes end in a crash: those of all, where any two vehicles have touched (a gap ≤ 0)."""
        crashed = world.state.gap.amin(-1, keepdim=True) <= 0.0
        return crashed.expand(-1, len(self.agents)) if len(self.agents) > 1 else crashed

    def counters(self, rows: int, device: torch.device, info: Collection[str]) -> Counters | None:
        """Return the counters of stops and detectors for so many rows, None where there are none."""
        return None

    def info(self, world: EnvState) -> dict[str, Tensor]:
        """Return what infos tell beyond what every task does (``idm_env.envs.info``), ``(environments, agents)``."""
        return {}

    def ended(self, world: EnvState) -> Ended:
        """Return whether it is over: terminated by a crash, truncated where records end (never, without any)."""
        crashed = self.crashed(world)
        return Ended(crashed, torch.zeros_like(crashed))

    # -- words -----------------------------------------------------------------------------------------------------

    def crash_reason(self, world: EnvState, row: int, agent: int | None = None) -> str:
        """Return who touched whom in one environment that has crashed, when and how deep; ``agent`` asks for its own.

        Of several contacts the deepest one is named.
        """
        gap = world.state.gap[row].detach()
        vehicle = int(gap.argmin()) if agent is None else self.agents[agent]
        ids = self.vehicle_ids or tuple(str(i) for i in range(self.vehicles))
        seconds = float(world.state.step[row]) * self.simulator.dt
        lanes = world.state.lanes
        leader = None if lanes is None else int(lanes.leader[row, vehicle])
        return contact(ids, self.agents, vehicle, float(gap[vehicle]), seconds, leader)

    def clip(self, features: list[Tensor]) -> Tensor:
        """Stack features of shape ``(…, agents)`` in SI units, over their ``scales`` and clipped to ``bounds``."""
        seen = torch.stack(features, dim=-1)
        device, dtype = seen.device, seen.dtype
        low = self.constant("low", lambda: self.bounds.low, device, dtype)
        high = self.constant("high", lambda: self.bounds.high, device, dtype)
        return (seen / self.constant("scales", lambda: self.scales, device, dtype)).clamp(low, high)


__all__ = ["Bounds", "Draw", "Ended", "EnvState", "RewardRange", "Task"]
