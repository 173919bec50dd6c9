"""Task ``junction``: some vehicles of a network are agents, which may hold back where junctions are shared.

Every ``hold`` seconds an agent names a part of ``max_command``, from −1 to 1, that is added to what its driver does.
Only what is below 0 counts: gates, lines and leaders hold for agents as for everybody, nobody crosses before a foe
or touches anybody, and 0 is human driving. What can be gained is to let others go first, and to arrive when the
junction is free. Agents are slots: the vehicle that has left hands its slot to the next one that enters.

Shapes: B worlds, N vehicles, S agents, F features.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import torch

from idm_env.effects import Control, Effect
from idm_env.multilane.junctions import journeys_of
from idm_env.roads.network import Array, Network
from idm_env.roads.network_demand import Demand
from idm_env.tasks.checks import Range
from idm_env.tasks.network_task import Here, NetworkStep, NetworkTask, present_in
from idm_env.tasks.random import Draw
from idm_env.types import Command, State
from idm_env.validation import shown

FEATURES = (
    "present", "speed", "gap", "lead_speed", "line", "told", "reserved", "yields",
    "foe_arrives", "foes_waiting", "foes_inside", "behind",
)  # fmt: skip
"""What an agent observes, 0 to 1.

Whether the slot has a vehicle; its speed over the limit; gap over 100 m; its leader's speed over the limit; way to the
next line over 100 m; whether it has been told to stop there; whether it has reserved the junction; whether others go
first; time until the first foe arrives over 10 s; foes who stand before their lines over 5; whether a foe has reserved;
vehicles that stand on its own link over 5.
"""


class DrivenWorld(NamedTuple):
    """Traffic, and which vehicle each agent drives ``(B, S)``, −1 for none."""

    state: State
    slot: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class JunctionTask(NetworkTask):
    """Vehicles of a network as agents.

    Args:
        network: ``"crossing"``, ``"roundabout"``, ``"figure eight"``, ``"grid 2x2"``, a SUMO ``.net.xml``, or a
            ``Network``. Those by name have priorities and no signals.
        agents: Most vehicles that are agents at once.
        circling: Number of vehicles of a network without entries, such as the figure eight, which enter at first.
        max_command: Deceleration that an action of −1 adds (m/s²).
        trips: A SUMO ``.rou.xml`` of that network's edges, the same demand in every episode and world, or None:
            vehicles arrive at random where links begin.
        inflow: Vehicles per hour and entry where there are no ``trips``.
        turns: Shares of those who turn left, go on and turn right.
        duration: Length of an episode (s).
        hold: Time for which an action is held (s).
        effects: Effects to add to the drivers' own, as for every task.
        parameters: What differs from the drivers' parameters, as for every task.
        dt: Time step (s); None: 0.1, or a model's own.
        randomise: What every episode draws anew: ``{"inflow": [300, 500]}``.
        reward: ``"unit"``: the share of their time that vehicles did not lose, half of it that of all and half its own,
            0 to 1; ``"delay"``: minus the time that all lost (s).

    Raises:
        ValueError: In one line, with value, rule and cure.
    """

    network: str | Path | Network = "crossing"
    agents: int = 8
    circling: int = 14
    max_command: float = 3.0
    inflow: float = 300.0
    turns: tuple[float, float, float] = (0.2, 0.6, 0.2)
    duration: float = 300.0
    hold: float = 1.0

    name: ClassVar[str] = "junction"
    rewards: ClassVar[tuple[str, ...]] = ("unit", "delay")
    control: ClassVar[str] = "priority"
    actions: ClassVar[str] = "numbers from −1 to 1"
    machinery: ClassVar[tuple[Effect, ...]] = (Control(careful=True, added=True),)
    ranges: ClassVar[Mapping[str, Range]] = {
        "agents": Range(1, 1000, whole=True),
        "circling": Range(1, 10_000, whole=True),
        "max_command": Range(0.1, 9.0, "m/s²"),
    }
    features: ClassVar[int] = len(FEATURES)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not len(self.road.start):
            raise ValueError(f"network = {shown(self.network)} has no junction. Give one that has.")
        if self.is_closed:
            self.leave_out(f"nobody arrives on network = {shown(self.network)}", "inflow", "turns", "randomise")
        else:
            self.leave_out(f"inflow or trips arrive on network = {shown(self.network)}", "circling")
        if self.agents > self.vehicles:
            raise ValueError(f"agents = {self.agents} must be at most the vehicles, {self.vehicles}.")
        _ = self.params

    # -- static facts ------------------------------------------------------------------------------------------------

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The agents' names."""
        return tuple(f"agent_{k}" for k in range(self.agents))

    @cached_property
    def vehicles(self) -> int:
        """Slots of vehicles."""
        return self.circling if self.is_closed else super().vehicles

    @cached_property
    def _demand(self) -> Demand:
        """The demand; on a closed network everybody takes the first move, for longer than an episode lasts."""
        if not self.is_closed:
            return super()._demand
        net, route, way = self.road, [int(np.flatnonzero(~self.road.inner)[0])], 0.0
        while way < self.duration * net.limit.max() and (moves := self._ways.moves[route[-1]]):
            end, path, _ = moves[0]
            route, way = [*route, *path, end], way + net.length[end]
        return Demand(np.array([route]), np.zeros(self.circling), np.zeros(self.circling))

    @cached_property
    def _gates(self) -> tuple[Array, Array]:
        """The next move of each link of a route, −1 for none, and the way from the link's beginning to its line (m)."""
        routes, net = self._demand.routes, self.road
        move, way, own = np.full(routes.shape, -1), np.full(routes.shape, 1e3), net.times(routes) * net.limit[routes]
        for h in range(routes.shape[1] - 2, -1, -1):
            then = net.move_of[routes[:, h + 1]]
            opens = (routes[:, h + 1] >= 0) & (then >= 0) & (net.path[then, 0] == routes[:, h + 1])
            move[:, h] = np.where(opens, then, move[:, h + 1])
            way[:, h] = own[:, h] + np.where(opens, 0.0, way[:, h + 1])
        return move, way

    # -- pure functions ----------------------------------------------------------------------------------------------

    def begin(self, draw: Draw) -> DrivenWorld:
        """Return worlds at the beginning of an episode: empty, with everybody's departure drawn."""
        return DrivenWorld(self.begin_state(draw), np.full((len(draw.key), self.agents), -1))

    def are_actions(self, array: Array) -> bool:
        """Return whether all are numbers."""
        return array.dtype.kind in "iuf" and bool(np.isfinite(array).all())

    def step(self, world: DrivenWorld, actions: Array | None) -> tuple[DrivenWorld, NetworkStep]:
        """Return worlds ``hold`` seconds later, and the outcome; ``actions`` (B, S) in [−1, 1], None for none."""
        rows, steps = len(world.slot), round(self.hold / self.simulator.dt)
        accel = np.zeros(rows * self.vehicles + 1, np.float32)
        if actions is not None:
            accel[self._cells(world)] = self.max_command * np.clip(actions, -1.0, 1.0)
        command = torch.from_numpy(accel[:-1].reshape(rows, -1)).expand(steps, -1, -1)
        inputs = {"control": Command(command, torch.ones_like(command, dtype=torch.bool))}
        state, _ = self.simulator.rollout(world.state, inputs, self.params, steps, keep=None)
        then, _, taken, lost, step = self.tally(world.state, state)
        if self.reward == "delay":
            return self._hand_on(world, state), step._replace(reward=-np.repeat(step.lost[:, None], self.agents, 1))
        own = np.zeros(rows * self.vehicles + 1)  # the last one is nobody's
        own[then.some] = lost / np.maximum(taken, 1e-9)
        spent = np.bincount(then.row, taken, rows)
        mine = own[self._cells(world)]
        reward = 1.0 - 0.5 * (step.lost / np.maximum(spent, 1e-9))[:, None] - 0.5 * mine
        return self._hand_on(world, state), step._replace(reward=np.clip(reward, 0.0, 1.0))

    def _cells(self, world: DrivenWorld) -> Array:
        """Return the places of agents' vehicles among those of all worlds ``(B, S)``, B N for none."""
        rows = len(world.slot)
        return np.where(world.slot >= 0, world.slot + self.vehicles * np.arange(rows)[:, None], rows * self.vehicles)

    def _hand_on(self, world: DrivenWorld, state: State) -> DrivenWorld:
        """Return worlds in which who has left has handed his slot to one who has entered since."""
        ways, begin, slot = journeys_of(state), int(world.state.step.reshape(-1)[0]), world.slot.copy()
        here = (ways.entered >= 0) & (ways.left < 0)
        slot[~np.pad(here.numpy(), ((0, 0), (0, 1)))[np.arange(len(slot))[:, None], slot]] = -1
        fresh = (here & (ways.entered >= begin)).numpy()
        for row in np.flatnonzero(fresh.any(1) & (slot < 0).any(1)):
            free, new = np.flatnonzero(slot[row] < 0), np.setdiff1d(np.flatnonzero(fresh[row]), slot[row])
            count = min(len(free), len(new))
            slot[row, free[:count]] = new[:count]
        return DrivenWorld(state, slot)

    def observe(self, world: DrivenWorld) -> Array:
        """Return observations ``(B, S, F)``: ``FEATURES``, zeros for an agent without a vehicle."""
        state, net, ways = world.state, self.road, journeys_of(world.state)
        rows, moves, links = len(world.slot), len(net.start), np.arange(len(net.names))
        assert state.lanes is not None
        here = Here(state, np.flatnonzero(present_in(state).numpy()))

        def own(x: torch.Tensor) -> Array:
            return x.reshape(-1).numpy()[here.some]

        move, line = (x[here.route, here.hop] for x in self._gates)
        room, speed, limit = line - here.position, own(state.speed), net.limit[here.link]
        leader = own(state.lanes.leader) + self.vehicles * here.row
        # By world and move; the last move is that of nobody.
        cell, shape = here.row * (moves + 1), (rows * (moves + 1),)
        arrives, waits, inside = np.full(shape, 10.0), np.zeros(shape), np.zeros(shape)
        gated, crosses = move >= 0, net.move_of[here.link]
        np.minimum.at(arrives, (cell + move)[gated], (room / np.maximum(speed, 0.1))[gated])
        np.add.at(waits, (cell + move)[gated & here.halting & (room < 20.0)], 1.0)
        for held, some in ((move, own(ways.reserved) & gated), (crosses, crosses >= 0)):
            np.add.at(inside, (cell + held)[some], 1.0)
        foes = np.where(gated[:, None] & (net.foes[move] >= 0), net.foes[move], moves) + cell[:, None]
        stand = here.sums(here.halting, links, len(links))[here.row, here.link]
        columns = (
            np.ones(len(speed)), speed / limit, own(state.gap) / 100.0, state.speed.reshape(-1).numpy()[leader] / limit,
            room / 100.0, own(ways.told) > 0, own(ways.reserved), gated & (net.yields[move, 0] >= 0),
            arrives[foes].min(1) / 10.0, waits[foes].sum(1) / 5.0, inside[foes].sum(1), stand / 5.0,
        )  # fmt: skip
        seen = np.zeros((rows * self.vehicles + 1, len(FEATURES)), np.float32)
        seen[here.some] = np.clip(np.stack(columns, 1), 0.0, 1.0)
        return seen[self._cells(world)]
