"""Task ``signals``: an agent at every signal of a network chooses which phase is green.

Every ``hold`` seconds an agent names a phase. Where it is another one than now, and may be so yet, whoever loses his
green is shown amber, then the new phase begins. An agent observes what those of sumo-rl do (Alegre 2019,
github.com/LucasAlegre/sumo-rl): its phase (one of P), whether it may change, and of each lane that leads to it how
densely it is filled and how much of it stands.

Shapes: B worlds, N vehicles, L links, S agents, F features of the widest agent; what an agent has less is 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
import torch

from idm_env.multilane.junctions import showing
from idm_env.roads.network import Array, Network
from idm_env.tasks.checks import Range
from idm_env.tasks.network_task import Here, NetworkStep, NetworkTask, present_in
from idm_env.tasks.random import Draw
from idm_env.types import State
from idm_env.validation import shown


class World(NamedTuple):
    """Traffic, and of each agent the phase and for how long (s) since the change to it began ``(B, S)``."""

    state: State
    phase: Array
    since: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class SignalsTask(NetworkTask):
    """Signals of a network as agents.

    Args:
        network: ``"grid 5x5"`` (rows × columns), ``"grid 5x5x2"`` of two lanes, a SUMO ``.net.xml``, or a ``Network``.
        trips: A SUMO ``.rou.xml`` of that network's edges, the same demand in every episode and world, or None:
            vehicles arrive at random where links begin.
        inflow: Vehicles per hour and entry where there are no ``trips``.
        turns: Shares of those who turn left, go on and turn right. On one lane few who wait for a gap to turn left stop
            all behind them.
        duration: Length of an episode (s).
        hold: Time for which a phase is kept at least, and between two decisions (s).
        least_green: Least time of green (s).
        amber: Time of amber before another phase begins (s).
        effects: Effects to add to the drivers' own, as for every task.
        parameters: What differs from the drivers' parameters, as for every task.
        dt: Time step (s); None: 0.1, or a model's own.
        randomise: What every episode draws anew: ``{"inflow": [300, 700]}``.
        reward: ``"unit"``: the share of their time that vehicles on the links before an agent did not lose, 0 to 1;
            ``"delay"``: minus the time that they lost (s); ``"queue"``: minus how many stand; ``"pressure"``: how many
            are on the links behind, less those before.

    Raises:
        ValueError: In one line, with value, rule and cure.
    """

    least_green: float = 10.0
    amber: float = 3.0

    name: ClassVar[str] = "signals"
    rewards: ClassVar[tuple[str, ...]] = ("unit", "delay", "queue", "pressure")
    control: ClassVar[str] = "signals"
    actions: ClassVar[str] = "phases: whole numbers from 0 on"
    ranges: ClassVar[Mapping[str, Range]] = {"least_green": Range(0.0, 600.0, "s"), "amber": Range(0.0, 60.0, "s")}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.amber > self.hold:
            raise ValueError(f"amber = {self.amber:g} s must be at most hold = {self.hold:g} s.")
        if not self.agents:
            raise ValueError(f"network = {shown(self.network)} has no signal with two phases. Give one that has.")
        if self.is_closed:
            raise ValueError(f"network = {shown(self.network)} has no open end: others lead to each edge. Give trips.")
        _ = self.params

    # -- static facts ------------------------------------------------------------------------------------------------

    @cached_property
    def phases(self) -> tuple[tuple[str, ...], ...]:
        """Of each signal the states of its plan among which an agent chooses: green for somebody, amber for nobody."""
        return tuple(
            tuple(dict.fromkeys(x for x in plan.states if {*x} & {*"Gg"} and not {*x} & {*"yY"}))
            for plan in self._read[0].plans
        )

    @cached_property
    def agents(self) -> tuple[int, ...]:
        """The signals that are agents: those with two phases at least."""
        return tuple(s for s, phases in enumerate(self.phases) if len(phases) > 1)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The agents' names."""
        return tuple(self._read[0].plans[s].name for s in self.agents)

    @cached_property
    def counts(self) -> Array:  # type: ignore[override]
        """Number of phases of each agent (S)."""
        return np.array([len(self.phases[s]) for s in self.agents])

    @cached_property
    def road(self) -> Network:
        """The network, whose plans have the agents' phases and the ambers between them beside their own."""
        plans = list(self._read[0].plans)
        for s in self.agents:
            more = (*self.phases[s], *(_amber(a, b) for a in self.phases[s] for b in self.phases[s]))
            # Of no duration: the plan itself never shows them.
            states, durations = (*plans[s].states, *more), (*plans[s].durations, *[0.0] * len(more))
            plans[s] = plans[s]._replace(states=states, durations=durations)
        return replace(self._read[0], plans=tuple(plans))

    @cached_property
    def _first(self) -> Array:
        """Row of each agent's first phase among the states of its plan (S)."""
        return np.array([len(self._read[0].plans[s].states) for s in self.agents])

    @cached_property
    def lanes(self) -> tuple[Array, ...]:
        """The links that lead to each agent, in the order of their letters: a phase's string says which of them go."""
        net, moves = self.road, (np.flatnonzero(self.road.signal == s) for s in self.agents)
        return tuple(np.array(list(dict.fromkeys(net.start[m[np.argsort(net.index[m])]].tolist()))) for m in moves)

    @cached_property
    def _of_link(self) -> tuple[Array, Array]:
        """The agent before which, and behind which, a link lies (L); S for none."""
        net, before, behind = self.road, *(np.full(len(self.road.names), len(self.agents)) for _ in range(2))
        for k, s in enumerate(self.agents):
            moves = net.signal == s
            inner = net.path[moves]
            before[np.concatenate((net.start[moves], inner[inner >= 0]))] = k
            behind[net.end[moves]] = k
        return before, behind

    @property
    def features(self) -> int:
        """Length of the widest agent's observation."""
        return int(self.counts.max()) + 1 + 2 * max(map(len, self.lanes))

    # -- pure functions ----------------------------------------------------------------------------------------------

    def begin(self, draw: Draw) -> World:
        """Return worlds at the beginning of an episode: empty, with everybody's departure drawn."""
        shape = len(draw.key), len(self.agents)
        return World(self.begin_state(draw), np.zeros(shape, np.int64), np.full(shape, np.inf))

    def are_actions(self, array: Array) -> bool:
        """Return whether all are phases."""
        return array.dtype.kind in "iu" and bool((array >= 0).all())

    def step(self, world: World, actions: Array | None) -> tuple[World, NetworkStep]:
        """Return worlds ``hold`` seconds later, and the outcome; ``actions`` (B, S) are phases.

        None leaves signals to their plans. A phase that an agent has not, or may not change to yet, keeps the present.
        """
        first, dt = world, self.simulator.dt
        held, yellow = round(self.hold / dt), round(self.amber / dt)
        if actions is None:
            world = self._drive(world, np.full_like(world.phase, -1), held)
            return world, self._outcome(first, world)
        changes = (actions != world.phase) & (actions < self.counts) & self.may_change(world)
        then = np.where(changes, actions, world.phase)
        if changes.any():
            between = self._first + np.where(changes, self.counts * (1 + world.phase) + then, then)
            world = self._drive(world, between, yellow)
            held -= yellow
        world = self._drive(world, self._first + then, held)
        world = world._replace(phase=then, since=np.where(changes, 0.0, world.since) + self.hold)
        return world, self._outcome(first, world)

    def may_change(self, world: World) -> Array:
        """Return whether each agent's phase has been green for long enough ``(B, S)``."""
        return world.since >= self.least_green + self.amber

    def _drive(self, world: World, phases: Array, steps: int) -> World:
        """Return worlds some Δt later, in which agents show these phases of their plans (−1: what the plan says)."""
        if steps == 0:
            return world
        every = torch.full((len(phases), len(self.road.plans)), -1)
        every[:, list(self.agents)] = torch.as_tensor(phases)
        state, _ = self.simulator.rollout(showing(world.state, every), {}, self.params, steps, keep=None)
        return world._replace(state=state)

    def observe(self, world: World) -> Array:
        """Return observations ``(B, S, F)``: phase, leave to change it, then density and queue of lanes (0 to 1).

        A lane is full at a vehicle for every 7 m, its length and the room to the next.
        """
        rows, agents = world.phase.shape
        seen = np.zeros((rows, agents, self.features), np.float32)
        most, full = int(self.counts.max()), np.maximum(self.road.length / 7.0, 1.0)
        here = Here(world.state, np.flatnonzero(present_in(world.state).numpy()))
        links = np.arange(n := len(full))
        density, queue = (np.minimum(here.sums(x, links, n) / full, 1.0) for x in (here.inside, here.halting))
        seen[np.arange(rows)[:, None], np.arange(agents), world.phase] = 1.0
        seen[:, :, most] = self.may_change(world)
        widest = (self.features - most - 1) // 2
        for k, lanes in enumerate(self.lanes):
            seen[:, k, most + 1 : most + 1 + len(lanes)] = density[:, lanes]
            seen[:, k, most + 1 + widest : most + 1 + widest + len(lanes)] = queue[:, lanes]
        return seen

    def _outcome(self, first: World, last: World) -> NetworkStep:
        """Return the outcome of a step; a vehicle's lost time counts for the agent before which it was at first."""
        then, now, taken, lost, step = self.tally(first.state, last.state)
        agents, (before, behind) = len(self.agents), self._of_link
        delays = then.sums(lost, before, agents + 1)[:, :agents]
        if self.reward == "unit":
            time = then.sums(taken, before, agents + 1)[:, :agents]
            reward = np.clip(1.0 - delays / np.maximum(time, 1e-9), 0.0, 1.0)
        elif self.reward == "delay":
            reward = -delays
        elif self.reward == "queue":
            reward = -now.sums(now.halting, before, agents + 1)[:, :agents]
        else:
            reward = (now.sums(now.inside, behind, agents + 1) - now.sums(now.inside, before, agents + 1))[:, :agents]
        return step._replace(reward=reward)


def _amber(now: str, then: str) -> str:
    """Return the state between two phases: amber in place of a green that ends, else the present letters."""
    return "".join("y" if a in "Gg" and b not in "Gg" else a for a, b in zip(now, then, strict=True))
