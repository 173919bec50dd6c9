"""Distillation: a policy learns to do by itself what it does behind a failsafe, so that the failsafe can go.

A failsafe cuts commands, and what it cuts has no gradient: a policy trained behind one never learns to brake. But the
two together are a teacher, which nobody has written for this task. Dataset aggregation (DAgger; Ross, Gordon, Bagnell
2011, AISTATS, arXiv 1011.0686) fits the policy by least squares to what both would command: first where they drive,
then, round by round, where it drives by itself.

``python -m agents.distil --config configs/ring-brakes-distil.yaml`` trains the teacher first; ``--teacher
runs/ring-apg/last.pt`` takes one that is there.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from agents import apg, common, environments
from agents.common import DivergedError
from agents.monitor import Monitor
from agents.policy import Policy
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.tasks import Task


@dataclass
class Arguments(common.Arguments):
    """Arguments of distillation; ``updates`` are rounds. The policy has the teacher's layout.

    Args:
        teacher: Checkpoint of a policy that was trained behind a failsafe; or a file of APG, such as
            configs/ring-apg.yaml: its training comes first, with the same seed, in the folder teacher of ``out``. Its
            CPU seconds count; ``cpu_seconds`` ends the rounds and not that training.
        count: Environments that run together; all begin an episode with each round.
        steps: Steps of a round: the braking after the take-over, and calm driving after that.
        fits: Steps of regression in a round, on the data of all rounds so far.
    """

    out: Path = Path("runs/distil")
    updates: int = 8
    evaluate_every: int = 1
    teacher: Path = Path("configs/ring-apg.yaml")
    count: int = 64
    steps: int = 900
    fits: int = 1500


def taught(arguments: Arguments) -> tuple[Policy, dict[str, Any]]:
    """Return the teacher and its checkpoint; it is trained, or trained to its end, if a file says how.

    ValueError, in one line, for a teacher of another task or observation, or without a failsafe.
    """
    path = arguments.teacher
    if path.suffix != ".pt":
        path = arguments.out / "teacher" / "last.pt"
        chosen = common.load_agent(arguments.teacher, apg.Arguments, "apg")
        chosen = replace(chosen, seed=arguments.seed, out=path.parent)
        before = common.load(path)[1]["training"].get("arguments", {}) if path.exists() else {}
        now = common.choices(chosen)
        if any(before.get(name) != now[name] for name in now.keys() - {"out", "resume", "updates"}):
            apg.train(chosen)  # none is there, or that of another seed or file
        else:
            common.completed(apg.train, chosen)
    policy, content = common.load_for(path, environments.task_of(arguments.environment))
    if not environments.task_of(content["environment"]).failsafe:
        raise ValueError(f"{path} was trained without a failsafe: there is nothing to distil. Give another --teacher.")
    if policy.remembers:
        raise ValueError(f"{path} has a memory, and what is fitted has none. Give another --teacher.")
    return policy, content


def watch(
    policy: Policy | None, teacher: Policy, guarded: Task, env: DiffIDMVectorEnv, steps: int
) -> tuple[Tensor, Tensor]:
    """Return what agents observe in ``steps`` steps, and the actions that teacher and failsafe would take there.

    The policy drives; None leaves it to the teacher behind the failsafe. ``guarded`` is the task with that failsafe,
    whose actions may have other limits than those of ``env``. Shapes ``(samples, features)`` and ``(samples,)``.
    """
    task, seen, actions = env.task, [], []
    with torch.no_grad():
        for _ in range(steps):
            world = env.batch.world
            assert world is not None
            observation = task.observe(world).flatten(1)
            action = task.action(guarded.limit(world, guarded.command(teacher(observation))))
            seen.append(observation.reshape(-1, len(task.bounds.names)))
            actions.append(action.flatten())
            env.step(action if policy is None else policy(observation))
    return torch.cat(seen), torch.cat(actions)


def train(arguments: Arguments) -> list[dict[str, Any]]:
    """Fit a policy to its teacher and the failsafe; return the evaluations, CPU seconds with those of the teacher.

    ValueError and DivergedError say what went wrong, in one line.
    """
    teacher, content = taught(arguments)
    began = time.process_time()
    torch.manual_seed(arguments.seed)
    policy, saved = copy.deepcopy(teacher), {k: content["training"][k] for k in ("steps", "cpu_seconds")}
    guarded = environments.task_of(content["environment"])
    seen: list[Tensor] = []
    actions: list[Tensor] = []
    if arguments.resume:
        policy, saved = common.begin(arguments, "distil")
        seen.append(saved["seen"])
        actions.append(saved["wanted"])
    done = saved.get("update", -1) + 1
    env = environments.make_env(arguments.trained_in, arguments.count, output="torch")
    with Monitor("distil", arguments, began, saved) as monitor:
        if not done:
            monitor.untrained(policy)
        for update in range(done, arguments.updates):
            # Seeded by the round, so that a resumed training repeats it.
            first = environments.first_seed(arguments.seed, update * arguments.count)
            torch.manual_seed(first)
            env.reset(seed=first)
            new = watch(policy if update else None, teacher, guarded, env, arguments.steps)
            seen.append(new[0])
            actions.append(new[1])
            data = {"seen": torch.cat(seen), "wanted": torch.cat(actions)}
            error = common.clone(policy, data["seen"], data["wanted"], arguments.fits)
            if not math.isfinite(error):
                advice = common.last_good(monitor.last, update)
                raise DivergedError(f"update {update}: the error {error:g} must be finite. {advice}.")
            if not monitor.after(update, arguments.steps * arguments.count, policy, data, {"error": error}):
                break
    return monitor.history


def main(argv: Sequence[str] | None = None) -> None:
    """Train as the command line says."""
    common.command_line(train, Arguments, "distil", argv)


if __name__ == "__main__":
    main()
