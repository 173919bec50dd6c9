"""What all agents share: arguments from YAML and command line, the policy, checkpoints, and the guard of updates."""

from __future__ import annotations

import dataclasses
import io
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import torch
import tyro
from torch import Tensor, nn

import idm_env
from agents.environments import first_seed, human_driving, task_of
from agents.policy import Policy
from idm_env.jobs import storage, trust
from idm_env.model_file import check_places, load_environment, number, read_yaml
from idm_env.tasks import Task
from idm_env.validation import finite, nearest, shown

SCHEMA = 2
"""Version of the layout of checkpoints."""

MAY_BE_ZERO = {"recurrent", "seed", "clone", "critic_first", "learning_starts"}
POSITIVE = {"learning_rate", "clip"}
KEPT = ("last.pt", "best.pt", "learner.pt")
"""What trainings keep in ``out``, beside their logs."""
LOGS = ("csv", "tensorboard", "stdout", "json")
MAY_CHANGE = {
    "out", "resume", "seed", "updates", "cpu_seconds", "evaluate_every", "log", "clone", "learning_rate", "window",
    "data",
}  # fmt: skip
"""Arguments that a resumed training may give anew; the others are part of what it is."""

# -- arguments -------------------------------------------------------------------------------------------------------


@dataclass
class Arguments:
    """What every agent takes; a key of the YAML file and an option of the command line have the same name.

    Args:
        environment: Keywords of ``gym.make_vec("DiffIDM-v0", …)``; only in YAML. ``config`` names an environment's
            file beside that YAML file.
        judged_in: Keywords of the environment that differ where the policy is judged (``agents.evaluate.as_judged``);
            only in YAML.
        out: Folder of checkpoints and logs.
        seed: Of everything random.
        updates: Updates of the policy; the learning rate falls with their count.
        cpu_seconds: Training also ends after that many CPU seconds, evaluations not counted; 0 is no limit.
        evaluate_every: Updates between evaluations, so that no machine's speed decides; one comes after the last.
        log: Where figures go: csv, tensorboard, or both with a comma.
        resume: Go on from the last checkpoint in ``out``.
        hidden: Widths of the policy's hidden layers.
        learning_rate: Of Adam, at the first update.
        clip: Largest global norm of a gradient.
        clone: Steps of behaviour cloning of the human drivers before training; 0 begins with no command.
    """

    environment: Annotated[dict[str, Any], tyro.conf.Suppress] = field(default_factory=lambda: {"task": "ring"})
    judged_in: Annotated[dict[str, Any], tyro.conf.Suppress] = field(default_factory=dict)
    out: Path = Path("runs/agent")
    seed: int = 0
    updates: int = 60
    cpu_seconds: float = 0.0
    evaluate_every: int = 2
    log: str = "csv"
    resume: bool = False
    hidden: tuple[int, ...] = (32, 32)
    learning_rate: float = 3e-3
    clip: float = 1.0
    clone: int = 0

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            low = 0 if f.name in MAY_BE_ZERO else 1
            whole = value if isinstance(value, tuple) else (value,)
            if any(isinstance(x, int) and not isinstance(x, bool) and x < low for x in whole):
                raise ValueError(f"{f.name} = {value} must be at least {low}.")
            if isinstance(value, float):
                finite(f.name, value)
            if f.name in POSITIVE and not value > 0.0:
                raise ValueError(f"{f.name} = {value:g} must be above 0.")
        if self.environment.get("dtype", "float32") != "float32":
            raise ValueError(f"dtype = '{self.environment['dtype']}': agents learn in float32. Leave dtype out.")
        unknown = [name for name in self.log.split(",") if name not in LOGS]
        if unknown:
            raise ValueError(f"log = '{unknown[0]}' is unknown.{nearest(unknown[0], LOGS)}")

    @property
    def trained_in(self) -> dict[str, Any]:
        """The environment, where it has a warm-up pool with one of this seed's own."""
        own = {"warmup_pool_seed": self.seed + 1} if self.environment.get("warmup_pool") else {}
        return {**own, **self.environment}


@dataclass
class File:
    """What is read before the other options, whose defaults the file gives."""

    config: str | None = None
    trust: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False


A = TypeVar("A", bound=Arguments)
R = TypeVar("R")


def parse(kind: type[A], agent: str, argv: Sequence[str] | None = None) -> A:
    """Return the arguments of ``--config FILE`` and of the other options, which win."""
    file, rest = tyro.cli(File, args=argv, return_unknown_args=True, add_help=False)
    if file.trust:
        trust.always()
    default = kind() if file.config is None else load_agent(file.config, kind, agent)
    text = f"{kind.__doc__}\n\n--config FILE reads a YAML file first, such as configs/ring-apg.yaml. "
    text += "--trust runs Python code that YAML files and checkpoints name, such as my_file.py:MyEffect."
    arguments = tyro.cli(kind, default=default, args=rest, description=text)
    for path in (arguments.out / name for name in KEPT):
        storage.not_an_input(
            path, (file.config, *(getattr(arguments, name, None) for name in ("data", "start", "teacher")))
        )
        if path.suffix == ".pt" and path.exists() and not arguments.resume and _content(path) is None:
            raise ValueError(
                f"{path} is not a checkpoint of an agent, or is broken. Move or delete it, or give another --out."
            )
    return arguments


def command_line(train: Callable[[A], R], kind: type[A], agent: str, argv: Sequence[str] | None = None) -> R:
    """Train as the command line says, on one thread; what is wrong is told in one line."""
    torch.set_num_threads(1)
    with one_line():
        arguments = parse(kind, agent, argv)
        with storage.hold_folder(arguments.out):
            return train(arguments)


@contextmanager
def one_line() -> Iterator[None]:
    """End with one line and exit code 1 for what is wrong, with 130 for Ctrl-C."""
    try:
        yield
    except KeyboardInterrupt:
        print("interrupted: the last checkpoint was kept. Add --resume to go on.", file=sys.stderr)
        raise SystemExit(130) from None
    except (ValueError, OSError, DivergedError) as error:
        raise SystemExit(f"error: {' '.join(str(error).split())}") from None


def load_agent(path: str | Path, kind: type[A], agent: str) -> A:
    """Return the arguments of an agent's YAML file; ValueError, in one line, for what does not belong in it."""
    file = Path(path)
    content = read_yaml(file)
    if content.pop("configures", None) != "agent":
        raise ValueError(f"{path}: no agent is configured here. Write 'configures: agent' in its first line.")
    if content.pop("agent", None) != agent:
        raise ValueError(f"{path}: this is not a file for {agent}. Write 'agent: {agent}', or run the agent it names.")
    fields = {f.name: f for f in dataclasses.fields(kind)}
    default = kind()
    values: dict[str, Any] = {}
    for key, value in content.items():
        if key not in fields:
            raise ValueError(f"{path}: unknown key {shown(key)}.{nearest(str(key), fields)}")
        values[key] = _as(f"{path}: {key}", value, getattr(default, key))
    if "config" in values.get("environment", {}):
        own = dict(values["environment"])
        file_name = own.pop("config")
        if not isinstance(file_name, str):
            raise ValueError(f"{path}: environment.config = {shown(file_name)} must be the name of a file.")
        values["environment"] = {**load_environment(file.parent / file_name), **own}
    return kind(**values)


def _as(name: str, value: Any, like: Any) -> Any:
    """Return a value of YAML in the type of the default, a path where that is None; YAML reads 3e-3 as text."""
    like = Path() if like is None else like
    if isinstance(like, bool) or isinstance(value, bool):
        if not (isinstance(value, bool) and isinstance(like, bool)):
            rule = "true or false" if isinstance(like, bool) else "no bool"
            raise ValueError(f"{name} = {shown(value)} must be {rule}.")
        return value
    if isinstance(like, (int, float)):
        parsed = number(name, value)
        if isinstance(like, int) and parsed != int(parsed):
            raise ValueError(f"{name} = {shown(value)} must be a whole number.")
        return type(like)(parsed)
    if isinstance(like, dict) and not isinstance(value, dict):
        raise ValueError(f"{name} = {shown(value)} must be a mapping, such as {{task: ring}}.")
    if isinstance(like, tuple):
        if not isinstance(value, list):
            raise ValueError(f"{name} = {shown(value)} must be a list, such as {list(like)}.")
        return tuple(_as(f"{name}[{i}]", x, like[0] if like else 0.0) for i, x in enumerate(value))
    if isinstance(like, str) and not isinstance(value, (str, int, float)):
        raise ValueError(f"{name} = {shown(value)} must be a text.")
    if isinstance(like, Path) and not isinstance(value, str):
        raise ValueError(f"{name} = {shown(value)} must be a path.")
    return value if isinstance(like, dict) else type(like)(value)


# -- checkpoints -----------------------------------------------------------------------------------------------------


def save(path: Path, policy: Policy, agent: str, environment: Mapping[str, Any], training: Mapping[str, Any]) -> None:
    """Write a checkpoint."""
    task = task_of(environment)
    content = {
        "schema": SCHEMA,
        "version": idm_env.__version__,
        "agent": agent,
        "task": task.name,
        "features": list(task.bounds.names),
        "scales": list(task.scales),
        "environment": dict(environment),
        "policy": {"made": policy.made, "state": policy.state_dict()},
        "training": dict(training),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    torch.save(content, buffer)
    storage.write(path, lambda target: target.write_bytes(buffer.getvalue()))


def load(path: str | Path, task: str | None = None, agent: str | None = None) -> tuple[Policy, dict[str, Any]]:
    """Return the policy and everything else of a checkpoint.

    ValueError, in one line, for a file that is none, or of another layout, task, observation or agent than asked for.
    """
    if not Path(path).is_file():
        raise ValueError(f"{path} is not a file. Give the path of a checkpoint, such as runs/ring-apg/last.pt.")
    content = _content(Path(path))
    if content is None:
        raise ValueError(
            f"{path} is not a checkpoint of an agent, or is broken. Give a file that an agent has written, or delete "
            "it and train anew, without --resume."
        )
    if content["schema"] != SCHEMA:
        raise ValueError(f"{path} has layout {content['schema']}; this version reads layout {SCHEMA}. Train it anew.")
    if not _whole(content):
        raise ValueError(
            f"{path} is broken (parts of a checkpoint are missing). Delete it and train anew, without --resume."
        )
    check_places(path, content)
    for name, expected in (("task", task), ("agent", agent)):
        if expected is not None and content[name] != expected:
            raise ValueError(
                f"{path} is of {name} '{content[name]}', and '{expected}' is wanted. Give a file of that {name}."
            )
    own_task = task_of(content["environment"])
    before, now = (
        [f"{name} / {scale:g}" for name, scale in zip(names, scales, strict=False)]
        for names, scales in ((content["features"], content["scales"]), (own_task.bounds.names, own_task.scales))
    )
    if before != now:
        raise ValueError(
            f"{path} was trained by version {content['version']} on observations {', '.join(before)}; "
            f"task '{content['task']}' now gives {', '.join(now)}. Train it anew."
        )
    policy = Policy(**content["policy"]["made"])
    policy.load_state_dict(content["policy"]["state"])
    return policy, content


def load_for(path: str | Path, task: Task) -> tuple[Policy, dict[str, Any]]:
    """Return what ``load`` does, of a policy that observes what ``task`` gives: its agents and roads may differ.

    ValueError, in one line, for a policy of another task or other observations.
    """
    policy, content = load(path, task.name)
    if (content["features"], content["scales"]) != (list(task.bounds.names), list(task.scales)):
        raise ValueError(f"{path} was trained on other observations than this environment's. Give another checkpoint.")
    return policy, content


def _content(path: Path) -> dict[str, Any] | None:
    """Return what a checkpoint holds, or None for a file that is none."""
    try:
        content = torch.load(path, weights_only=True)
    except Exception:
        return None
    return content if isinstance(content, dict) and "schema" in content else None


def _whole(content: Any) -> bool:
    """Tell whether a checkpoint has all that ``save`` writes, each of its kind."""
    kinds = {
        "version": str, "agent": str, "task": str, "features": list, "scales": list, "environment": dict,
        "policy": dict, "training": dict,
    }  # fmt: skip
    if not all(isinstance(content.get(name), kind) for name, kind in kinds.items()):
        return False
    try:
        policy = Policy(**content["policy"]["made"])
        policy.load_state_dict(content["policy"]["state"])
    except (LookupError, TypeError, ValueError, RuntimeError, AttributeError):
        return False
    return True


def begin(arguments: Arguments, agent: str, **made: Any) -> tuple[Policy, dict[str, Any]]:
    """Return a new policy and nothing, or those of the last checkpoint with what its training had kept.

    ``made`` are further choices of ``Policy``. ValueError where there is nothing to resume, or something else.
    """
    task = task_of(arguments.environment)
    if arguments.resume:
        policy, content = load(arguments.out / "last.pt", task.name, agent)
        before, now = content["training"].get("arguments", {}), choices(arguments)
        for name in before:
            if name not in now:
                raise ValueError(
                    f"{arguments.out} was begun with {name} = {before[name]}, an option that {agent} does not have any "
                    "more. Give another --out."
                )
            if name not in MAY_CHANGE and before[name] != now[name]:
                raise ValueError(
                    f"{name} = {now[name]} cannot be resumed: {arguments.out} was begun with {before[name]}. "
                    "Give that, or another --out."
                )
        return policy, content["training"]
    policy = Policy(len(task.bounds.names), arguments.hidden, **made)
    policy.starts_with(task.as_driver)
    observations, actions = human_driving(arguments.trained_in, first_seed(arguments.seed, 0))
    policy.mean.copy_(observations.mean(0))
    policy.scale.copy_(observations.std(0).clamp_min(1e-3))
    if arguments.clone:
        clone(policy, observations, actions, arguments.clone)
    return policy, {}


def completed(train: Callable[[A], Any], arguments: A) -> Path:
    """Return the last checkpoint of a training: done now, or to its end, as far as its updates are not there yet."""
    last = arguments.out / "last.pt"
    done = load(last)[1]["training"]["update"] + 1 if last.exists() else 0
    if done < arguments.updates:
        train(dataclasses.replace(arguments, resume=done > 0))
    return last


def choices(arguments: Arguments) -> dict[str, Any]:
    """Return the arguments as plain values, as a checkpoint keeps them."""
    return {k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(arguments).items()}


def clone(policy: Policy, observations: Tensor, actions: Tensor, steps: int) -> float:
    """Fit a policy to actions by least squares (behaviour cloning); return the last mean squared error."""
    optimiser = torch.optim.Adam(policy.parameters(), lr=1e-2)
    error = torch.zeros(())
    for step in range(steps):
        optimiser.param_groups[0]["lr"] = fall(1e-2, step, steps, 0.01)
        rows = torch.randint(len(actions), (min(2048, len(actions)),))
        error = (policy(observations[rows]).squeeze(-1) - actions[rows]).square().mean()
        optimiser.zero_grad()
        error.backward()
        optimiser.step()
    return float(error.detach())


# -- updates ---------------------------------------------------------------------------------------------------------


class DivergedError(RuntimeError):
    """A loss or a gradient that is not finite."""


def descend(
    loss: Tensor,
    parameters: Iterable[nn.Parameter],
    optimiser: torch.optim.Optimizer,
    clip: float,
    update: int,
    kept: Path,
) -> float:
    """Take one step down the gradient, its global norm clipped; return the norm.

    DivergedError where loss or norm is not finite: parameters and the checkpoint ``kept`` stay as they were.
    """
    parameters = list(parameters)
    optimiser.zero_grad()
    loss.backward()
    norm = float(nn.utils.clip_grad_norm_(parameters, clip))
    if not (math.isfinite(float(loss.detach())) and math.isfinite(norm)):
        raise DivergedError(
            f"update {update}: loss {float(loss.detach()):g} and gradient norm {norm:g} must be finite. "
            f"{last_good(kept, update)} with a lower learning_rate or a shorter window."
        )
    optimiser.step()
    return norm


def last_good(kept: Path, update: int) -> str:
    """Return which checkpoint is left after a failure, as the beginning of an advice."""
    return f"The last good checkpoint is {kept}; resume from it" if update > 0 else "None was kept yet; begin again"


def fall(learning_rate: float, update: int, updates: int, last: float = 0.1) -> float:
    """Return the learning rate of an update: a half cosine from 1 to ``last`` times the first one."""
    share = min(update / max(updates - 1, 1), 1.0)
    return learning_rate * (last + (1.0 - last) * 0.5 * (1.0 + math.cos(math.pi * share)))
