"""What every task teaches, by one measure: ``python -m benchmarks.tasks [ring follow …]``.

*Skill* is (return − human)/(best known − human), human being ``step(None)``, and best known the best row of the table;
there is none where nobody does better than human drivers. Rows, all on the same fresh episodes of the task with the
keywords of ``GIVEN``, 64 of them, on the roads of ``NOISY`` 640 under drivers' noise:

* *random*, *zero*, and the *constant* that is best of 13 accelerations on other episodes;
* *rule*: IDM's formula as commands, where they are added less a human's, its six numbers the best of a cross-entropy
  search that sees only returns;
* *PPO*: Stable-Baselines3's, ten lines as in README, its steps chosen by task, several seeds, each its last policy;
* *tuned PPO*: the same with ``TUNED``, twice the steps;
* *APG*, on one lane: gradients through 60 decisions of 32 environments, 200 times, each seed's last policy;
* *oracle*: that rule with the six numbers that are best in each of these episodes, found on it: what foresight
  is worth;
* *planner*, in its place on open roads, in the first 64 episodes: every 20 s it drives copies of the world, with the
  arrivals to come and other noise, 200 s on under each of ``PLANS``, held for 20 s, and commands the best.

Beside each its CPU seconds of one thread, crashes, on the roads of ``NOISY`` the share of episodes in which traffic
breaks down (``SLOW``), and the 95 % interval of the paired difference over episodes. A
*first task* has zero, constants and random at most at 0.3, and PPO at least at 0.7 with 4 of 5 seeds in 120 CPU s.
Rows are kept in ``--out``; ``docs/skill.csv`` has them all.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
import tyro

import idm_env  # noqa: F401 (registers the environments)
from benchmarks import command, named_rows, table
from benchmarks.bench.search import cross_entropy
from idm_env.envs.batch import Batch
from idm_env.envs.settings import settings
from idm_env.jobs.progress import OnProgress
from idm_env.jobs.workers import HERE, Workers
from idm_env.tasks import TASKS
from idm_env.types import mapped

ROOT = Path(__file__).resolve().parents[1]
EPISODES, FRESH, OTHERS = 64, 1 << 20, 1 << 19
"""Episodes that judge, their first seed, and that of episodes which choose constants and rules."""
CONSTANTS = (-0.3, -0.1, -0.03, -0.01, -0.003, 0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 1.0)
OPEN = ("open_highway", "merge", "bottleneck", "approach")
"""Roads that vehicles enter and leave."""
NOISY = OPEN[:3]
"""Those judged under drivers' noise on many episodes, since whether traffic breaks down is chance there."""
SLOW = 0.75
"""Share of human drivers' upper quartile below which an episode of these has broken down."""
GIVEN: dict[str, dict[str, Any]] = {
    "ring": {"hold": 1.0}, "follow": {"hold": 0.5}, "platoon": {"hold": 1.0}, "highway": {"hold": 1.0},
    "replay": {"hold": 0.5}, "replay_lanes": {"hold": 0.5}, **{name: {"noise": 0.2} for name in NOISY},
}  # fmt: skip
"""Keywords of each task here: agents decide at most twice a second."""
TRAINING: dict[str, dict[str, Any]] = {"ring": {"warmup_pool": 256}, "highway": {"warmup_pool": 256}}
"""Keywords of training alone: episodes begin in one of so many worlds."""
STEPS = {
    "ring": 250_000,
    "follow": 200_000,
    "platoon": 150_000,
    "highway": 250_000,
    "replay": 200_000,
    "approach": 50_000,
}
"""Steps of PPO; of others 100 000."""
TUNED: dict[str, Any] = {
    "batch_size": 1024,
    "gamma": 0.98,
    "gae_lambda": 0.95,
    "policy_kwargs": {"net_arch": [128, 128], "log_std_init": -1.0},
}
"""Of tuned PPO, beside 64 environments and a learning rate that falls from 1e-3: it looks less far ahead, and begins
with commands that are drawn less widely, than the ten lines do."""
TUNED_ON = ("follow", "replay")
"""Tasks that have a row of it."""
WINDOWS = (60, 1e-2, 200)
"""Of APG: decisions in a window, Adam's first step, which falls to 0, and windows."""
GRADIENTS = ("follow", "platoon", "replay")
"""Tasks that have a row of APG."""
SEEN = {"features": ["speed", "lead_speed", "gap"], "scaling": "raw"}
GENERATIONS, RULES = 8, 16
RANGES = ((2.5, 40.0), (0.1, 3.0), (0.3, 6.0), (0.3, 3.0), (0.5, 4.0), (0.005, 1.0))
"""Where rules are looked for: v0 (m/s), T (s), s0 (m), a, b (m/s²), and the share of IDM's acceleration."""
IDM = ("desired_speed", "time_gap", "min_gap", "max_accel", "comfort_decel")

PLANS, EVERY, AHEAD = (-0.3, 0.0, 0.3, 1.0), 20, 200
"""Of planners: actions, the second being human driving, and decisions between choices and up to the horizon."""

IDLE, LEARNT, FORESEES = ("random", "zero", "constant"), ("PPO", "tuned PPO", "APG"), ("oracle", "planner")
"""Rows of what learns nothing, those that have seeds, and those that foresee: the latter on open roads."""

Act = Callable[[np.ndarray], np.ndarray]
Watch = Callable[[Act], None]
"""Is shown a policy in training, now and then."""


def episodes_of(task: str) -> int:
    """Return how many episodes judge a task: ten times as many where traffic may break down."""
    return EPISODES * (10 if task in NOISY else 1)


def unwatched(act: Act) -> None:
    """Watch nothing."""


def returns(task: str, act: Act | None, seeds: Sequence[int], **more: Any) -> tuple[np.ndarray, int]:
    """Return what one episode of each seed returns, and how many of them crash; ``act`` None is human driving."""
    env = gymnasium.make_vec("DiffIDM-v0", num_envs=len(seeds), task=task, info="none", **GIVEN.get(task, {}), **more)
    seen, _ = env.reset(seed=list(seeds))
    total, going, crashes = np.zeros(len(seeds)), np.ones(len(seeds), bool), 0
    while going.any():
        seen, reward, terminated, truncated, _ = env.step(None if act is None else act(seen))
        total += np.where(going, reward, 0.0)
        crashes += int((going & terminated).sum())
        going &= ~(terminated | truncated)
    return total, crashes


def constant(task: str) -> Act:
    """Return the best of ``CONSTANTS``."""
    seeds = range(OTHERS, OTHERS + 16)
    best = max(CONSTANTS, key=lambda x: returns(task, held(task, x), seeds)[0].mean())
    return held(task, best)


def held(task: str, value: float) -> Act:
    """Return actions that are always the same."""
    shape = gymnasium.make("DiffIDM-v0", task=task).action_space.shape
    assert shape is not None
    return lambda seen: np.full((len(seen), *shape), value, np.float32)


def random(task: str) -> Act:
    """Return actions drawn evenly."""
    shape, drawing = held(task, 0.0)(np.zeros((1, 1))).shape[1:], np.random.default_rng(0)
    return lambda seen: drawing.uniform(-1.0, 1.0, (len(seen), *shape)).astype(np.float32)


def rule(task: str, values: np.ndarray) -> Act:
    """Return actions of IDM's formula, a row of ``values`` for each environment or one for all, times a share."""
    *numbers, share = np.atleast_2d(values)[:, None].transpose(2, 0, 1)
    env: Any = gymnasium.make("DiffIDM-v0", task=task).unwrapped
    low, high = env.task.command_limits
    human = [env.task.own_parameters["idm"][name] for name in IDM] if task in OPEN else None

    def accel_of(seen: np.ndarray, v0: Any, headway: Any, s0: Any, a: Any, b: Any) -> np.ndarray:
        speed, lead, gap = np.moveaxis(seen.reshape(len(seen), -1, 3), -1, 0)
        wish = s0 + (speed * headway + speed * (speed - lead) / (2.0 * np.sqrt(a * b))).clip(0.0)
        return np.asarray(a * (1.0 - (speed / v0) ** 4 - (wish / gap.clip(0.5)) ** 2))

    def act(seen: np.ndarray) -> np.ndarray:
        accel = share * (accel_of(seen, *numbers) - (0.0 if human is None else accel_of(seen, *human)))
        return np.asarray(np.where(accel < 0.0, accel / -low, accel / high).clip(-1.0, 1.0), np.float32)

    return act


def paid(task: str, rules: np.ndarray, seeds: Sequence[int]) -> np.ndarray:
    """Return what rules, ``(…, rules, 6)`` in logarithms, return in episodes of these seeds, one for each row."""
    return returns(task, rule(task, np.exp(rules.reshape(-1, rules.shape[-1]))), seeds, observation=SEEN)[0]


def searched(task: str) -> np.ndarray:
    """Return the rule with the best mean return, by the cross-entropy method over the logarithms of its numbers."""
    low, high = np.log(RANGES).T
    count, each = (RULES // 2, 16) if task in OPEN else (RULES, 4)

    def mean(rules: np.ndarray, first: int, episodes: int) -> np.ndarray:
        pays = paid(task, rules.repeat(episodes, 0), [*range(first, first + episodes)] * len(rules))
        return pays.reshape(len(rules), -1).mean(1)

    middle, best, _ = cross_entropy(
        lambda rules, generation: -mean(rules, OTHERS + 100 + each * generation, each), (low + high) / 2.0,
        (high - low) / 2.0, rows=count, keep=count // 4, floor=0.05 * (high - low), ends=(low, high), with_mean=True,
        generations=GENERATIONS,
    )  # fmt: skip
    best = np.concatenate((best, middle[None]))
    return np.exp(best[int(mean(best, OTHERS + 200, 4 * each).argmax())])


def oracle(task: str, known: np.ndarray) -> np.ndarray:
    """Return the best rule found in each of the episodes that judge, ``(episodes, 6)``, beginning with ``known``."""
    drawing, each = np.random.default_rng(0), range(FRESH, FRESH + EPISODES)
    low, high = np.log(RANGES).T
    best, spread = np.tile(np.log(known), (EPISODES, 1)), 0.3 * (high - low)
    for _ in range(GENERATIONS // 2):
        steps = spread * drawing.standard_normal((EPISODES, RULES // 2, len(RANGES)))
        steps[:, 0] = 0.0
        rules = (best[:, None] + steps).clip(low, high)
        pays = paid(task, rules, np.repeat(each, RULES // 2).tolist()).reshape(EPISODES, -1)
        best, spread = rules[np.arange(EPISODES), pays.argmax(1)], 0.6 * spread
    return np.exp(best)


def batch_of(seeds: Sequence[int], **keywords: Any) -> Batch:
    """Return episodes of a task with ``keywords`` as they begin, one for each seed."""
    batch = Batch(settings(**keywords, info="none"), len(seeds))
    batch.seed(range(len(seeds)), seeds)
    batch.reset()
    return batch


def drive(batch: Batch, actions: np.ndarray, decisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Drive on under an action for each row; return what episodes pay and which have crashed, ``(n,)``."""
    paid, crashed = np.zeros(batch.count), np.zeros(batch.count, bool)
    for _ in range(decisions):
        whole = batch.step(actions.astype(np.float32)[:, None]).whole
        paid += np.where(crashed, 0.0, whole.reward)
        crashed |= whole.terminated
    return paid, crashed


def planner(task: str, seeds: Sequence[int]) -> tuple[np.ndarray, int]:
    """Return what episodes of these seeds return under the planner, and how many crash."""
    keywords, actions = {"task": task, **GIVEN.get(task, {})}, np.tile(PLANS, len(seeds))
    world, copies = (batch_of(x, **keywords) for x in (seeds, np.repeat(seeds, len(PLANS)).tolist()))
    total, crashed = np.zeros(len(seeds)), np.zeros(len(seeds), bool)
    for _ in range(world.task.horizon or 0, 0, -EVERY):
        copies.reset()  # another episode: the noise to come is not known
        copies.world = mapped(lambda x: x.repeat_interleave(len(PLANS), 0), world.world)
        first, over = drive(copies, actions, EVERY)
        then = np.where(over, 0.0, drive(copies, np.zeros_like(actions), AHEAD - EVERY)[0])
        best = (first + then).reshape(len(seeds), -1).argmax(1)
        paid, now = drive(world, np.array(PLANS)[best], EVERY)
        total, crashed = total + np.where(crashed, 0.0, paid), crashed | now
    return total, int(crashed.sum())


def apg(task: str, seed: int, watch: Watch = unwatched) -> Act:
    """Return the last policy of ascending gradients through windows of traffic."""
    torch.manual_seed(seed)
    keywords = {**GIVEN.get(task, {}), **TRAINING.get(task, {})}
    env = gymnasium.make_vec("DiffIDM-v0", num_envs=32, task=task, output="torch", **keywords)
    seen, _ = env.reset(seed=seed)
    layers = [torch.nn.Linear(seen.shape[1], 64), torch.nn.Linear(64, 64), torch.nn.Linear(64, 1)]
    policy = torch.nn.Sequential(*(part for layer in layers for part in (layer, torch.nn.Tanh())))
    layers[-1].weight.data *= 0.01
    ascent = torch.optim.Adam(policy.parameters(), WINDOWS[1], maximize=True)

    def act(seen: np.ndarray) -> np.ndarray:
        return np.asarray(policy(torch.as_tensor(seen)).detach())

    for update in range(WINDOWS[2]):
        ascent.param_groups[0]["lr"] = WINDOWS[1] * (1.0 - update / WINDOWS[2])
        env.unwrapped.detach()  # type: ignore[attr-defined]
        ascent.zero_grad()
        env.unwrapped.unroll(policy, steps=WINDOWS[0]).reward.mean().backward()  # type: ignore[attr-defined]
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        ascent.step()
        if update % 10 == 9:
            watch(act)
    return act


def ppo(task: str, seed: int, watch: Watch = unwatched, tuned: bool = False) -> Act:
    """Return the last policy of Stable-Baselines3's PPO, by the lines of README or ``TUNED``."""
    from stable_baselines3 import PPO

    from idm_env.envs.sb3 import SB3VecEnv

    keywords = {**GIVEN.get(task, {}), **TRAINING.get(task, {})}
    count, rate, more = (64, 1e-3, TUNED) if tuned else (32, 6e-4, {"batch_size": 512})
    env = SB3VecEnv(gymnasium.make_vec("DiffIDM-v0", num_envs=count, task=task, **keywords))
    model = PPO("MlpPolicy", env, n_steps=128, learning_rate=lambda left: rate * left, seed=seed, **more)

    def act(seen: np.ndarray) -> np.ndarray:
        return np.asarray(model.predict(seen, deterministic=True)[0])

    def after(*_: Any) -> bool:
        if model.num_timesteps % 16_384 == 0:  # four updates, two of the tuned
            watch(act)
        return True

    model.learn(STEPS.get(task, 100_000) * (1 + tuned), callback=after)
    return act


def curve(task: str, learn: Callable[[str, int, Watch], Act]) -> np.ndarray:
    """Return a training's CPU seconds, and the mean return of its policy then in 16 fresh episodes, ``(points, 2)``."""
    points, begin, away = list[tuple[float, float]](), time.process_time(), 0.0

    def watch(act: Act) -> None:
        nonlocal away
        now = time.process_time()
        points.append((now - begin - away, float(returns(task, act, range(FRESH, FRESH + 16))[0].mean())))
        away += time.process_time() - now

    learn(task, 0, watch)
    return np.array(points)


@dataclass(frozen=True)
class Part:
    """A row of the table of a task."""

    task: str
    row: str
    seed: int = 0

    def __str__(self) -> str:
        return f"{self.task}, {self.row}, {self.seed}"

    def __repr__(self) -> str:
        what = {name: x.get(self.task) for name, x in (("given", GIVEN), ("training", TRAINING), ("steps", STEPS))}
        return f"{self}, {episodes_of(self.task)} episodes, {what}"


def row_of(part: Part, on_progress: OnProgress) -> dict[str, Any]:
    """Return the returns of a row, its crashes, and the CPU seconds that it took to find."""
    torch.set_num_threads(1)
    begin = time.process_time()
    if part.row == "planner":
        totals, crashes = planner(part.task, range(FRESH, FRESH + EPISODES))
        return {"seconds": time.process_time() - begin, "returns": totals.tolist(), "crashes": crashes}
    makers: dict[str, Callable[[], Act | None]] = {
        "human": lambda: None, "zero": lambda: held(part.task, 0.0), "random": lambda: random(part.task),
        "constant": lambda: constant(part.task), "rule": lambda: rule(part.task, searched(part.task)),
        "oracle": lambda: rule(part.task, oracle(part.task, searched(part.task))),
        "PPO": lambda: ppo(part.task, part.seed), "APG": lambda: apg(part.task, part.seed),
        "tuned PPO": lambda: ppo(part.task, part.seed, tuned=True),
    }  # fmt: skip
    act = makers[part.row]()
    spent = time.process_time() - begin
    more = {"observation": SEEN} if part.row in ("rule", "oracle") else {}
    totals, crashes = returns(part.task, act, range(FRESH, FRESH + episodes_of(part.task)), **more)
    return {"seconds": spent, "returns": totals.tolist(), "crashes": crashes}


def skills(rows: dict[Part, dict[str, Any]]) -> list[list[str]]:
    """Return the lines of one task's table.

    Row, seed, return, skill and its interval, crashes, the share of broken episodes, CPU seconds.
    """
    human = np.array(next(x["returns"] for part, x in rows.items() if part.row == "human"))
    gains = {part: np.array(row["returns"]) - human[: len(row["returns"])] for part, row in rows.items()}
    best = max(more.mean() for more in gains.values())
    lines = []
    for part, row in rows.items():
        more = gains[part]
        half = 1.96 * float(more.std(ddof=1)) / len(more) ** 0.5
        skill = (f"{more.mean() / best:.2f}", f"{half / best:.2f}") if best > 0.0 else ("–", "–")
        crashes, spent = f"{row['crashes']}/{len(more)}", f"{row['seconds']:.0f}"
        numbers = f"{np.mean(row['returns']):.1f}", *skill
        slow = float(np.mean(np.array(row["returns"]) < SLOW * np.quantile(human, 0.75)))
        broken = f"{slow:.0%}".replace("%", " %") if part.task in NOISY else "–"
        lines.append([part.task, part.row, str(part.seed), *numbers, crashes, broken, spent])
    return lines


def teaches(lines: list[list[str]]) -> bool:
    """Return whether the lines of a task's table are those of a first task."""
    skill = {
        name: [float(line[4].replace("–", "-inf")) for line in lines if line[1] == name] for name in (*IDLE, "PPO")
    }
    idle = max(x for name in IDLE for x in skill[name])
    fast = all(float(line[-1]) <= 120.0 for line in lines if line[1] == "PPO")
    return idle <= 0.3 and fast and len(skill["PPO"]) >= 5 and sorted(skill["PPO"])[-4] >= 0.7


def main(
    tasks: tyro.conf.Positional[Sequence[str]] = (), rows: Sequence[str] = ("rule", *FORESEES, *LEARNT),
    seeds: int = 5,
    out: Path = Path("runs/tasks.jsonl"), place: Workers = HERE,
) -> None:  # fmt: skip
    """Print the table of each task, and keep it in docs/skill.csv.

    Args:
        tasks: All if none is named.
        rows: Beside those that cost nothing: rule, oracle or planner, PPO, tuned PPO, APG.
        seeds: Of PPO, tuned PPO and APG.
        out: File of rows.
        place: Where rows are worked out.
    """
    file = ROOT / "docs" / "skill.csv"
    head = ["task", "row", "seed", "return", "skill", "±", "crashes", "broken down", "CPU s"]
    for task in tasks or TASKS:
        without = {*LEARNT, FORESEES[task not in OPEN]}
        parts = [Part(task, row) for row in ("human", *IDLE, *(x for x in rows if x not in without))]
        learns = [x for x in LEARNT if x in rows and task in {"APG": GRADIENTS, "tuned PPO": TUNED_ON}.get(x, TASKS)]
        parts += [Part(task, row, seed) for row in learns for seed in range(seeds)]
        done = named_rows(row_of, {str(part): part for part in parts}, out, place)
        lines = skills({part: done[str(part)] for part in parts})
        print(table(head, lines), f"\n{task}: a {'first task' if teaches(lines) else 'task that is no first one'}\n")
        old = list(csv.reader(file.open(encoding="utf-8")))[1:] if file.exists() else []
        every = sorted([x for x in old if x[0] != task] + lines, key=lambda x: list(TASKS).index(x[0]))
        with file.open("w", encoding="utf-8", newline="") as out_file:
            csv.writer(out_file, lineterminator="\n").writerows([head, *every])


if __name__ == "__main__":
    command(main)
