"""Signals as agents: ``python -m benchmarks.signals [--inflow 300]``, rules beside PPO on a grid of 5 × 5.

Delay is the time that vehicles lose, those who wait to enter included, per vehicle that was due (s), over 64 fresh
episodes of 900 s; ± is 95 % of the paired difference to *max pressure 10*, and to *searched*. Rows:

* *fixed*: the plan of the network, 42 s green; *random* phases; *constant*, the first phase for ever;
* *greedy*: the phase whose lanes hold most vehicles that stand;
* *max pressure*: the phase with the most vehicles before it, less those behind (Varaiya 2013), a least green of 5, 10
  or 15 s;
* *searched*: vehicles, those that stand, those behind and a bonus for the present phase, weighed by four numbers that a
  cross-entropy search finds on other episodes in ``--search-seconds`` of CPU time;
* *PPO*: Stable-Baselines3's with ``VecNormalize``, one policy for all signals, paid by ``"delay"``; several seeds, each
  its last policy.

``--sumo 4`` drives the first four of these episodes inside SUMO, too (of PPO the first seed): netgenerate's grid, the
same vehicles, the same code that observes and judges. Those columns are SUMO's delay, and that less ours.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import gymnasium
import numpy as np
import torch
from scipy.stats import t as student

import idm_env  # noqa: F401 (registers the environments)
from benchmarks import command, table
from benchmarks.bench.measure import machine
from benchmarks.bench.peers import started
from benchmarks.bench.search import cross_entropy
from benchmarks.networks import GRID, generated, network_of, routes_xml
from idm_env.envs.network_faces import NetworkVectorEnv
from idm_env.multilane.junctions import by_link, journeys_of
from idm_env.roads.network_demand import Demand
from idm_env.tasks.signals import SignalsTask, World

EPISODES, FRESH, OTHERS = 64, 1 << 20, 1 << 19
"""Episodes that judge, their first seed, and that of episodes on which a rule is searched."""
PPO: dict[str, Any] = {
    "n_steps": 45, "batch_size": 450, "n_epochs": 5, "gamma": 0.95, "gae_lambda": 0.9, "ent_coef": 0.002,
}  # fmt: skip
"""What PPO is given beside SB3's defaults; its learning rate falls from 1e-3. A step is 5 s: γ looks 100 s ahead."""
Policy = Callable[[NetworkVectorEnv, np.ndarray], Any]
Row = tuple[str, Policy, float, dict[str, Any]]
"""A name, a policy, the CPU time that it took to find (s), and keywords of its own."""


def made(count: int, **keywords: Any) -> NetworkVectorEnv:
    """Return that many worlds."""
    return gymnasium.make_vec("DiffIDM-v0", count, **{"task": "signals", **keywords})  # type: ignore[return-value]


def delays(env: NetworkVectorEnv, policy: Policy, seed: int) -> np.ndarray:
    """Return the delay per vehicle of an episode in each world (s)."""
    seen, _ = env.reset(seed=seed)
    lost: Any = 0.0
    for _ in range(env.task.horizon):
        seen, _, _, _, info = env.step(policy(env, seen))
        figures = info.get("final_info", info)
        lost = lost + figures["lost"]
    return lost / np.maximum(figures["inside"] + figures["waiting"] + figures["arrived"], 1)


def served(env: NetworkVectorEnv) -> tuple[np.ndarray, np.ndarray]:
    """Return which links lead to green, and from it, in each phase of each agent ``(S, P, L)``."""
    task, net = env.task, env.task.road
    shape = len(task.agents), int(task.counts.max()), len(net.names)
    before, behind = np.zeros(shape), np.zeros(shape)
    for k, s in enumerate(task.agents):
        for p, state in enumerate(task.phases[s]):
            moves = [m for m in np.flatnonzero(net.signal == s) if state[net.index[m]] in "Gg"]
            before[k, p, net.start[moves]], behind[k, p, net.end[moves]] = 1.0, 1.0
    return before, behind


def weighed(weights: Any) -> Policy:
    """Return the rule that takes the phase of the highest score.

    Weights ``(4,)`` or one row for each world: of vehicles before, of those that stand, of those behind, of the present
    phase.
    """
    weights = np.atleast_2d(weights)
    masks: list[Any] = []

    def choose(env: NetworkVectorEnv, seen: np.ndarray) -> np.ndarray:
        if not masks:
            masks.extend(served(env))
        world = env.worlds.world
        assert world is not None
        on = by_link(env.task.road, world.state)
        near, stand, behind = (
            np.einsum("bl,spl->bsp", x.numpy(), mask)
            for x, mask in ((on.vehicles, masks[0]), (on.halting, masks[0]), (on.vehicles, masks[1]))
        )
        present = np.eye(near.shape[2])[world.phase]
        parts = np.stack((near, stand, -behind, present), -1)
        scores = np.einsum("bspw,bw->bsp", parts, np.broadcast_to(weights, (len(near), 4)))
        scores[:, np.arange(near.shape[2])[None] >= env.task.counts[:, None]] = -np.inf
        return scores.argmax(-1)

    return choose


def searched(seconds: float, **keywords: Any) -> tuple[np.ndarray, float]:
    """Return the weights of a cross-entropy search, which judges each by a world's delay, and its CPU time (s)."""
    env = made(48, **keywords)

    def costs(weights: np.ndarray, turn: int) -> np.ndarray:
        # Two worlds of one seed would not differ: every candidate has an episode of its own.
        return delays(env, weighed(weights), OTHERS + turn * len(weights))

    mean, width = np.array([0.5, 0.5, 0.5, 1.0]), np.array([0.5, 0.5, 0.5, 2.0])
    weights, _, spent = cross_entropy(costs, mean, width, rows=48, keep=8, floor=0.05, seconds=seconds)
    return weights, spent


@dataclass(frozen=True, eq=False, kw_only=True)
class InSumo(SignalsTask):
    """The task in one world whose vehicles SUMO drives: what is observed and judged is its state, by the same code."""

    opened: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)
    places: dict[str, tuple[int, float]] = field(default_factory=dict)
    text: str = field(default_factory=lambda: generated(GRID))

    def __post_init__(self) -> None:
        """Find our link, and the way to it on that, of each lane of SUMO's; signals' letters are the same."""
        super().__post_init__()
        net, theirs = self.road, network_of(self.text)
        moves = {theirs.move_name(m): m for m in range(len(theirs.start))}
        self.places.update({name: (k, 0.0) for k, name in enumerate(net.names) if not net.inner[k]})
        for m in range(len(net.start)):
            other = moves[net.move_name(m)]
            path = theirs.path[other][theirs.path[other] >= 0]
            ways = np.cumsum([0.0, *theirs.length[path]])
            self.places.update({theirs.names[k]: (int(net.path[m, 0]), w) for k, w in zip(path, ways, strict=False)})

    def begin(self, draw: Any) -> World:
        """Begin SUMO with the episode's vehicles; ``i`` is who has slot i."""
        world = super().begin(draw)
        ways, dt = journeys_of(world.state), self.simulator.dt
        come = (ways.due[0] * dt < self.duration).numpy()
        demand = Demand(ways.routes.numpy(), ways.route[0].numpy()[come], ways.due[0].numpy()[come] * dt)
        self.opened.close()
        options = "--step-method.ballistic", "--collision.action", "none"
        self.opened.enter_context(started(self.text, routes_xml(self.road, demand), *options, step=dt))
        return world

    def _drive(self, world: World, phases: np.ndarray, steps: int) -> World:
        sumo: Any = import_module("libsumo")
        state, ways, dt = world.state, journeys_of(world.state), self.simulator.dt
        links = state.lanes
        assert links is not None
        lane, hop, left, position, speed = (
            x[0].numpy().copy() for x in (links.lane, ways.hop, ways.left, state.position, state.speed)
        )
        begin, second = int(state.step.reshape(-1)[0]), round(1.0 / dt)
        for step in range(begin, begin + steps):
            if step % second == 0 or step == begin:
                self._show(sumo, phases[0], step * dt)
            sumo.simulationStep()
            left[[int(name) for name in sumo.simulation.getArrivedIDList()]] = step + 1
        on = np.zeros(len(lane), bool)
        for name in sumo.vehicle.getIDList():
            link, way = self.places[sumo.vehicle.getLaneID(name)]
            i = int(name)
            hop[i] += int(np.argmax(ways.routes[ways.route[0, i], hop[i] :].numpy() == link))
            on[i], lane[i] = True, link
            position[i], speed[i] = way + sumo.vehicle.getLanePosition(name), sumo.vehicle.getSpeed(name)
        entered = np.where((on | (left >= 0)) & (ways.entered[0].numpy() < 0), begin + steps, ways.entered[0].numpy())
        rows = {k: torch.from_numpy(x)[None] for k, x in (("hop", hop), ("left", left), ("entered", entered))}
        links = links._replace(lane=torch.from_numpy(lane)[None], journeys=ways._replace(**rows))
        moved = {k: torch.from_numpy(x)[None] for k, x in (("position", position), ("speed", speed))}
        present = torch.from_numpy(on)[None].to(state.speed.dtype)
        return world._replace(state=state._replace(**moved, present=present, lanes=links, step=state.step + steps))

    def _show(self, sumo: Any, phases: np.ndarray, now: float) -> None:
        """Show SUMO's signals the states of these rows of their plans, −1 for what the plan says now (s)."""
        for s, phase in zip(self.agents, phases, strict=True):
            plan = self.road.plans[s]
            if phase < 0:
                ends = np.cumsum(plan.durations)
                phase = np.searchsorted(ends, (now - plan.offset) % ends[-1], side="right")
            sumo.trafficlight.setRedYellowGreenState(plan.name, plan.states[phase])


def in_sumo(episodes: int, policy: Policy, keywords: dict[str, Any]) -> np.ndarray:
    """Return the delay per vehicle of that many episodes inside SUMO (s)."""
    env, task = made(1, **keywords), InSumo(**keywords)
    env.task = env.worlds.task = task
    with task.opened:
        return np.concatenate([delays(env, policy, FRESH + i) for i in range(episodes)])


def trained(seed: int, steps: int, more: dict[str, Any] = PPO, **keywords: Any) -> tuple[Policy, float]:
    """Return PPO's last policy, one for all agents, and the CPU time of its training (s)."""
    import stable_baselines3
    from stable_baselines3.common.vec_env import VecNormalize

    from idm_env.envs.sb3 import SB3VecEnv

    torch.set_num_threads(1)
    start = time.process_time()
    worlds = made(8, shared=True, **{"reward": "delay", **keywords})
    scaled = VecNormalize(SB3VecEnv(worlds), gamma=more["gamma"])
    settings = more | {"seed": seed, "device": "cpu", "learning_rate": lambda left: 1e-3 * left}
    agent = stable_baselines3.PPO("MlpPolicy", scaled, **settings)
    agent.learn(steps)
    scaled.training = False

    def choose(env: NetworkVectorEnv, seen: np.ndarray) -> np.ndarray:
        rows = scaled.normalize_obs(seen.reshape(-1, env.task.features))
        return agent.predict(rows, deterministic=True)[0].reshape(len(seen), -1)

    return choose, time.process_time() - start


def main(
    inflow: float = 300.0, network: str = "grid 5x5", search_seconds: float = 30.0, steps: int = 300_000,
    seeds: int = 5, episodes: int = EPISODES, sumo: int = 0,
) -> None:  # fmt: skip
    """Delay per vehicle of rules and of PPO, on the same fresh episodes."""
    keywords: dict[str, Any] = {"network": network, "inflow": inflow}
    if sumo and network != "grid 5x5":
        raise SystemExit(f"--sumo {sumo} drives netgenerate's grid, and not '{network}'. Use --network 'grid 5x5'.")
    random = np.random.default_rng(0)
    never: Policy = lambda env, seen: None  # noqa: E731
    chance: Policy = lambda env, seen: random.integers(0, env.task.counts, (env.worlds.count, len(env.task.agents)))  # noqa: E731
    first: Policy = lambda env, seen: np.zeros((env.worlds.count, len(env.task.agents)), int)  # noqa: E731
    pressure = weighed([1.0, 0.0, 1.0, 0.0])
    rows: list[Row] = [
        ("max pressure 10", pressure, 0.0, {}),
        ("fixed", never, 0.0, {}),
        ("random", chance, 0.0, {}),
        ("constant", first, 0.0, {}),
        ("greedy", weighed([0.0, 1.0, 0.0, 0.0]), 0.0, {}),
        ("max pressure 5", pressure, 0.0, {"least_green": 5.0}),
        ("max pressure 15", pressure, 0.0, {"least_green": 15.0}),
    ]
    search = (lambda: searched(search_seconds, **keywords)) if search_seconds > 0 else None
    rows += learners(search, weighed, seeds, lambda seed: trained(seed, steps, **keywords))
    print_delays(rows, episodes, keywords, sumo)


def learners(search: Any, rule: Callable[[Any], Policy], seeds: int, train: Callable[[int], Any]) -> Iterator[Row]:
    """Yield the rows of the rule that a ``search`` finds, if there is one, and of PPO with some seeds."""
    if search:
        weights, seconds = search()
        yield f"searched {np.round(weights, 2).tolist()}", rule(weights), seconds, {}
    for seed in range(seeds):
        yield f"PPO, seed {seed}", *train(seed), {}


def print_delays(rows: Sequence[Row], episodes: int, keywords: dict[str, Any], sumo: int = 0) -> None:
    """Print the delays of rows in fresh episodes, beside those of the first row and of a searched rule."""
    about, demand = machine(), f"{keywords['network']}, {keywords['inflow']:g} veh/h an entry"
    print(f"Delay per vehicle, {demand} ({about['processor']}, {about['date']})\n")
    cells, other, rule = [], None, None
    for name, policy, seconds, more in rows:
        env, start = made(episodes, **{**keywords, **more}), time.process_time()
        each = delays(env, policy, FRESH)
        speed = episodes * env.task.horizon / (time.process_time() - start)
        other = each if other is None else other
        rule = each if name.startswith("searched") else rule
        cells.append([name, f"{each.mean():.1f}", interval(each - other)])
        cells[-1] += ["" if rule is None else interval(each - rule), f"{seconds:.0f}", f"{speed:.0f}"]
        if sumo and ("PPO" not in name or name.endswith(" 0")):
            theirs = in_sumo(sumo, policy, {**keywords, **more})
            cells[-1] += [f"{theirs.mean():.1f}", interval(theirs - each[:sumo])]
        elif sumo:
            cells[-1] += ["", ""]
        print(*cells[-1], flush=True)
    print()
    head = ["", "delay (s)", f"beside {rows[0][0]}", "beside searched", "CPU s", "env steps per CPU s"]
    print(table(head + ["in SUMO", "less ours"] * bool(sumo), cells))


def interval(x: np.ndarray) -> str:
    """Return a mean of differences with its interval of 95 %."""
    return f"{x.mean():+.1f} ± {student.ppf(0.975, len(x) - 1) * x.std(ddof=1) / len(x) ** 0.5:.1f}"


if __name__ == "__main__":
    command(main)
