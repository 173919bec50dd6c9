"""How good a policy is: the same deterministic test for every agent, and pictures of it.

``python -m agents.evaluate runs/ring-apg/last.pt [--video ring.gif]``. On the ring: six lengths 220–270 m, 300 s of
human driving, in which a wave grows, then 300 s with the policy; 120 s after it has taken over, the human opposite
brakes with 4 m/s² for 2 s. Judged are the last 100 s. Without that shock any vehicle that leans gently on a failsafe
passes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor

from agents.common import load, one_line
from agents.environments import task_of
from agents.policy import Policy
from agents.rollout import (
    LENGTHS,
    SEED,
    UNSEEN,
    WARMUP,
    Act,
    Driven,
    Start,
    drive,
    episodes_start,
    held_moments,
    ring_start,
    uniform_speed,
)
from idm_env import metrics
from idm_env.envs.gym import DiffIDMEnv
from idm_env.jobs import trust
from idm_env.model_file import nested
from idm_env.tasks import TASKS, FollowTask, RingTask, Task
from idm_env.tasks.open_lanes import OpenLanesTask

STEPS = 3000
STEPS_OF_LANES = 6000
JUDGED = 1000
SPEED_RATIO, SPEED_STD, TIME_GAP, IN_A_ROW = 0.97, 0.15, 0.8, 5
FOLLOW_REWARD = 0.88


def judge_ring(start: Start, driven: Driven) -> dict[str, Any]:
    """Return the figures of the ring: per length, and the worst of them.

    ``speed_ratio``: mean speed of all vehicles in the last 100 s over the uniform speed; ``speed_std``: standard
    deviation over vehicles and time there (m/s); ``time_gap``: smallest of the controlled vehicles in the whole 300 s
    (s); ``collisions``: rings in which any two vehicles have touched; ``passed``: ratio ≥ 0.97, deviation < 0.15 m/s,
    time gap ≥ 0.8 s, no collision; ``cut``: share of the judged steps in which
    controlled vehicles accelerate less than commanded, as a failsafe makes them.
    """
    judged = JUDGED // start.task.held
    last = driven.speed[-judged:]
    ratio = last.mean((0, 2)) / uniform_speed(start)
    std = last.std((0, 2), correction=0)
    gap = metrics.time_gap(start.task.pick(driven.gap), start.task.pick(driven.speed)).amin((0, 2))
    crashed = driven.gap.amin((0, 2)) <= 0.0
    commanded = start.task.command(driven.action[-judged:])
    return {
        "cut": float((start.task.pick(driven.accel[-judged:]) < commanded - 1e-3).float().mean()),
        "speed_ratio": float(ratio.min()),
        "speed_std": float(std.max()),
        "time_gap": float(gap.min()),
        "collisions": int(crashed.sum()),
        "passed": bool(
            ratio.min() >= SPEED_RATIO and std.max() < SPEED_STD and gap.min() >= TIME_GAP and not crashed.any()
        ),
        "ratios": ratio.tolist(),
        "stds": std.tolist(),
    }


def judged_rings(
    environment: Mapping[str, Any],
    lengths: Sequence[float] = LENGTHS,
    warmup: int = WARMUP,
    draws: Sequence[int] = (0,),
) -> Start:
    """Return the rings of the test. Lengths are those of 22 vehicles; with more of them rings are as much longer."""
    share = task_of(environment).vehicles / 22
    return ring_start(environment, [length * share for length in lengths], warmup, draws)


def evaluate_ring(
    act: Act | None,
    environment: Mapping[str, Any],
    lengths: Sequence[float] = LENGTHS,
    warmup: int = WARMUP,
    draws: Sequence[int] = (0,),
) -> dict[str, Any]:
    """Return the figures of a policy on ``judged_rings``, from a take-over after ``warmup`` steps on."""
    start = judged_rings(environment, lengths, warmup, draws)
    return judge_ring(start, drive(start, act, STEPS // task_of(environment).held))


def solved_at(history: Sequence[Mapping[str, Any]]) -> int | None:
    """Return the index of the evaluation from which on all pass, to the end of training; None if those are too few.

    Those are the last five evaluations or more. Solved is a training with them whose last policy passes on the thirty
    fresh rings too.
    """
    failed = [i for i, row in enumerate(history) if not row["passed"]]
    first = failed[-1] + 1 if failed else 0
    return first if len(history) - first >= IN_A_ROW else None


def drivers_of(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the IDM parameters of the human drivers of a task: a number, or one for each vehicle."""
    return {**task_of(environment).own_parameters["idm"], **nested(environment.get("parameters") or {}).get("idm", {})}


def among(environment: Mapping[str, Any], drivers: Mapping[str, Any]) -> dict[str, Any]:
    """Return the environment with these IDM parameters of its drivers; those of other effects stay."""
    return {**environment, "parameters": {**nested(environment.get("parameters") or {}), "idm": dict(drivers)}}


def _times(value: Any, factor: Any) -> Any:
    """Return a parameter, one number or one for each vehicle, times a factor or one for each vehicle."""
    dtype = factor.dtype if isinstance(factor, Tensor) else torch.float64
    return (torch.as_tensor(value, dtype=dtype) * factor).tolist()


def mixed(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return an environment in which every driver's every parameter is drawn from ±20 %."""
    generator, vehicles = torch.Generator().manual_seed(SEED), task_of(environment).vehicles
    drivers = {
        name: _times(value, 0.8 + 0.4 * torch.rand(vehicles, generator=generator))
        for name, value in drivers_of(environment).items()
    }
    return among(environment, drivers)


def kinds(environment: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return environments in which one IDM parameter of all human drivers is 20 % lower or higher, ten, by name."""
    idm = drivers_of(environment)
    return {
        f"{name} {sign}20 %": among(environment, {**idm, name: _times(value, factor)})
        for name, value in idm.items()
        for sign, factor in (("−", 0.8), ("+", 1.2))
    }


def held_out(act: Act | None, environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures on ring lengths and drivers that training has not seen, on a fresh draw, without any tuning.

    ``lengths``: 200–300 m in steps of 10. ``drivers``: the six lengths of the test among each of ``kinds``; the worst
    of each figure. ``mixed``: every driver's every parameter drawn from ±20 %. Ratios are to the uniform speed of those
    drivers.
    """
    cases = kinds(environment)
    result = {"lengths": evaluate_ring(act, environment, UNSEEN, draws=(1,))}
    for name, case in cases.items():
        result[name] = evaluate_ring(act, case, draws=(1,))
    result["mixed"] = evaluate_ring(act, mixed(environment), draws=(1,))
    result["drivers"] = worst([result[name] for name in cases])
    return result


def worst(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the worst of every figure of the ring."""
    return {
        "speed_ratio": min(r["speed_ratio"] for r in rows),
        "speed_std": max(r["speed_std"] for r in rows),
        "time_gap": min(r["time_gap"] for r in rows),
        "collisions": sum(r["collisions"] for r in rows),
        "passed": all(r["passed"] for r in rows),
    }


# -- following a record ----------------------------------------------------------------------------------------------


def evaluate_follow(
    act: Act | None, environment: Mapping[str, Any], count: int = 16, draws: Sequence[int] = (0,)
) -> dict[str, Any]:
    """Return the figures of a policy behind ``count`` stretches of the recorded leaders in each draw, 100 s each.

    ``reward``: mean per step; ``litres`` and ``litres_behind``: fuel per 100 km of the first controlled vehicle and of
    all vehicles from it to the last, by the model of Kamal et al., ``…_circles`` by that of CIRCLES; ``energy``: at its
    wheels (J/kg per metre); the same of the recorded leader as ``leader_…``; ``time_gap``: its smallest (s);
    ``collisions``: stretches with one; ``spacing``: its mean gap (m); ``passed``: reward ≥ 0.88, no collision.
    """
    start = episodes_start(environment, count, draws=draws)
    task = start.task
    driven = drive(start, act, task.steps // task.held)
    first = task.agents[0]
    speed, accel, gap = (x.double() for x in (driven.speed, driven.accel, driven.gap))
    fuel = {name: metrics.fuel(speed, accel, name) for name in metrics.FUELS}
    energy = metrics.traction_energy(speed, accel, task.step_time)
    way = (speed * task.step_time).sum(0)

    def litres(part: slice, model: str = "kamal") -> float:
        return float(100.0 * fuel[model][..., part].sum() / speed[..., part].sum())

    crashed = gap[..., 1:].amin((0, 2)) <= 0.0
    time_gap = metrics.time_gap(task.pick(gap), task.pick(speed)).amin((0, 2))
    reward = float(driven.reward.double().mean())
    return {
        "reward": reward,
        "litres": litres(slice(first, first + 1)),
        "litres_behind": litres(slice(first, None)),
        "leader_litres": litres(slice(0, 1)),
        "litres_circles": litres(slice(first, first + 1), "circles"),
        "litres_behind_circles": litres(slice(first, None), "circles"),
        "leader_litres_circles": litres(slice(0, 1), "circles"),
        "energy": float(energy[:, first].sum() / way[:, first].sum()),
        "leader_energy": float(energy[:, 0].sum() / way[:, 0].sum()),
        "time_gap": float(time_gap.min()),
        "spacing": float(gap[..., first].mean()),
        "collisions": int(crashed.sum()),
        "passed": reward >= FOLLOW_REWARD and not bool(crashed.any()),
    }


# -- traffic that flows in and out ------------------------------------------------------------------------------------


def evaluate_lanes(act: Act | None, environment: Mapping[str, Any], count: int = 8) -> dict[str, Any]:
    """Return the figures of a policy in ``count`` episodes of traffic that flows in and out: see ``judge_lanes``."""
    return judge_lanes(episodes_start(environment, count), act, 1)[0]


def judge_lanes(start: Start, act: Act | None, policies: int) -> list[dict[str, Any]]:
    """Return the figures of policies that drive together, each in its share of the episodes, one after the other.

    Whole episodes are judged. ``reward``: their return, minus the total delay (vehicle-seconds), as if nobody crashed;
    ``outflow``: vehicles that leave, an hour; ``ramp``: of those who enter on lane 0 those who leave it, an hour;
    ``queued``: vehicles waiting at the entries at the end; ``travel``: time on the road and in the queue per vehicle
    that leaves (s); ``standing``: share of vehicle-seconds below 0.5 m/s; ``co2``: g per vehicle that leaves; each the
    mean over episodes, return and outflow also of each in ``rewards`` and ``outflows``. ``collisions``: episodes with a
    crash; ``passed``: there are none.
    """
    task, like = start.task, start.world.state.speed
    assert isinstance(task, OpenLanesTask)
    steps = min(task.steps, STEPS_OF_LANES)
    rows, dt = len(like), task.simulator.dt
    crashed = torch.zeros(rows, dtype=torch.bool)
    lost, spent, waited, stood, burnt = (torch.zeros(rows, dtype=torch.float64) for _ in range(5))
    for _, _, world in held_moments(start, act, steps):
        state = world.state
        assert state.present is not None
        on_road = state.present > 0
        crashed |= task.crashed(world).any(-1)
        lost += dt * task.delay(world)
        spent += dt * on_road.sum(-1)
        stood += dt * (on_road & (state.speed < 0.5)).sum(-1)
        infos = task.info(world)
        burnt += dt * infos["co2"][:, 0]
        waited += dt * infos["queued"][:, 0]
    totals = task.info(world)
    hourly, left = 3600.0 / (steps * dt), totals["outflow"][:, 0].double()
    columns = {
        "reward": -lost, "outflow": left * hourly, "ramp": totals["ramp"][:, 0].double() * hourly,
        "queued": totals["queued"][:, 0].double(), "travel": (spent + waited) / left.clamp_min(1.0),
        "standing": stood / spent.clamp_min(1.0), "co2": burnt / left.clamp_min(1.0),
    }  # fmt: skip
    parts = {name: x.view(policies, -1) for name, x in columns.items()}
    crashes = crashed.view(policies, -1).sum(-1)
    return [
        {
            **{name: float(x[i].mean()) for name, x in parts.items()},
            "collisions": int(crashes[i]),
            "passed": not bool(crashes[i]),
            **{f"{name}s": parts[name][i].tolist() for name in ("reward", "outflow")},
        }
        for i in range(policies)
    ]


# -- any task --------------------------------------------------------------------------------------------------------


TESTS: tuple[tuple[type[Task], Callable[..., dict[str, Any]], dict[str, Any]], ...] = (
    (RingTask, evaluate_ring, {"shock": 4.0, "shock_after": 120.0}),
    (FollowTask, evaluate_follow, {"reward": "source"}),
    (OpenLanesTask, evaluate_lanes, {}),
)  # fmt: skip
"""Kinds of tasks, how policies are judged in them, and keywords of the environment besides those of training."""


def _test_of(environment: Mapping[str, Any]) -> tuple[Callable[..., dict[str, Any]], dict[str, Any]]:
    """Return how policies of an environment's task are judged; ValueError for a task without a test."""
    name = environment.get("task", "ring")
    for kind, judge, changes in TESTS:
        if name in TASKS and issubclass(TASKS[name], kind):
            return judge, changes
    tested = [task for task, own in TASKS.items() if any(issubclass(own, kind) for kind, *_ in TESTS)]
    raise ValueError(f"task '{name}' has no test of agents. Tests exist for {' and '.join(tested)}.")


def as_judged(environment: Mapping[str, Any], changes: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the environment in which a policy trained in ``environment`` is judged.

    ``changes`` are keywords of the test besides those of ``TESTS``: an agent's ``judged_in``. Episodes of the test are
    as long as the task's own. ValueError for a task without one.
    """
    trained = {name: value for name, value in environment.items() if name != "max_episode_steps"}
    return {**trained, **_test_of(environment)[1], **(changes or {})}


def evaluate(act: Act | None, environment: Mapping[str, Any], **options: Any) -> dict[str, Any]:
    """Return the figures of a policy in the environment of its test (``as_judged``); None is the human driver.

    ``options`` are those of the task's own function, such as ``draws``.
    """
    return _test_of(environment)[0](act, environment, **options)


def score(row: Mapping[str, Any]) -> float:
    """Return one number by which the best checkpoint is kept, from the figures of an evaluation."""
    if "reward" in row:
        return float(row["reward"])
    tailgating = max(0.0, TIME_GAP - row["time_gap"])
    return float(min(row["speed_ratio"], 1.0) - row["speed_std"] - tailgating - row["collisions"])


def shown(
    environment: Mapping[str, Any], policy: Policy, human: int, steps: int, seed: int = 0, **keywords: Any
) -> Iterator[DiffIDMEnv]:
    """Yield an environment after every step of one episode: ``human`` steps of human driving, then of the policy.

    ``keywords`` are more of the environment's own.
    """
    chosen: dict[str, Any] = {**environment, "warmup_pool": 0, "max_episode_steps": -1, **keywords}
    task = task_of(environment)
    if isinstance(task, RingTask):
        chosen["length"] = 250.0
        if task.shocks:  # they come as long after the policy has taken over as in the test
            chosen["shock_after"] = [x + human * task.step_time for x in task.shocks]
    env = DiffIDMEnv(**chosen)
    observation, _ = env.reset(seed=seed)
    past = None
    for step in range(human + steps):
        action, past = (None, None) if step < human else policy.predict(observation, past)
        observation, _, terminated, *_ = env.step(action)
        yield env
        if terminated:
            return


def film(path: Path, environment: Mapping[str, Any], policy: Policy, human: int, steps: int, seed: int = 0) -> None:
    """Write one episode as a GIF, from 20 s before the policy takes over: a picture a second, ten of them a second."""
    from PIL import Image

    from idm_env.envs.render import COLOURS_DRAWN, colour

    frames, every = [], max(1, round(1.0 / task_of(environment).step_time))
    first = max(human - 20 * every, 0)
    # One palette for all pictures, of the colours that are drawn: a palette by frequency would drop the agent's mark.
    colours = [*COLOURS_DRAWN, *(colour(x, 39.0) for x in range(40))]
    palette = Image.new("P", (1, 1))
    palette.putpalette([part for each in colours for part in each])
    for step, env in enumerate(shown(environment, policy, human, steps, seed, render_mode="rgb_array")):
        if step >= first and step % every == 0:
            pixels = env.render()
            assert pixels is not None
            picture = Image.fromarray(pixels)
            picture = picture.resize((picture.width // 2, picture.height // 2), Image.Resampling.LANCZOS)
            frames.append(picture.quantize(palette=palette, dither=Image.Dither.NONE))
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=100, loop=0, optimize=True)


def picture(path: Path, environment: Mapping[str, Any], policy: Policy, human: int, steps: int, seed: int = 0) -> None:
    """Draw the space-time diagram of one episode: ``human`` steps of human driving, then ``steps`` with the policy.

    Roads of several lanes get a panel for each.
    """
    from idm_env.envs.render import panels_of
    from idm_env.reports.diagrams import space_time

    states = [env.state for env in shown(environment, policy, human, steps, seed)]
    task = task_of(environment)
    first = f"human drivers; from {human * task.step_time:.0f} s on the" if human else "the"
    space_time(panels_of(task, states), title=f"{first} agent drives what is blue").savefig(path)


@dataclass
class Arguments:
    """Evaluate a saved policy.

    Args:
        checkpoint: Such as runs/ring-apg/last.pt.
        video: File of a moving picture, such as ring.gif.
        picture: File of a space-time diagram, such as ring.png.
        human: Steps of human driving before the policy, in video and diagram.
        steps: Steps with the policy, in video and diagram.
        seed: Of the episode that is shown.
        trust: Run Python code that the checkpoint names, such as my_file.py:MyEffect.
    """

    checkpoint: Annotated[Path, tyro.conf.Positional]
    video: Path | None = None
    picture: Path | None = None
    human: int = 1500
    steps: int = 1500
    seed: int = 0
    trust: bool = False


def main(argv: Sequence[str] | None = None) -> None:
    """Print the figures of a policy beside those of human drivers; what is wrong is told in one line."""
    arguments = tyro.cli(Arguments, args=argv)
    with one_line():
        if min(arguments.steps, arguments.human + 1) < 1:
            raise ValueError(f"steps = {arguments.steps} must be at least 1, human = {arguments.human} at least 0.")
        if arguments.trust:
            trust.always()
        policy, content = load(arguments.checkpoint)
        environment = as_judged(content["environment"], content["training"].get("arguments", {}).get("judged_in"))
        for name, act in (("human", None), (content["agent"], policy)):
            print(name, json.dumps(evaluate(act, environment)))
        for path in (arguments.video, arguments.picture):
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
        if arguments.video is not None:
            film(arguments.video, environment, policy, arguments.human, arguments.steps, arguments.seed)
        if arguments.picture is not None:
            picture(arguments.picture, environment, policy, arguments.human, arguments.steps, arguments.seed)


if __name__ == "__main__":
    main()
