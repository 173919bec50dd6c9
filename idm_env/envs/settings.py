"""Keyword arguments of every face: what is the environment's own, what is the task's, and what a YAML file says."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from inspect import signature
from typing import Any, Literal, cast

import torch
from gymnasium.vector import AutoresetMode

from idm_env.jobs import trust
from idm_env.model_file import load_environment
from idm_env.tasks import KeywordError, Task, task_with
from idm_env.validation import nearest, one_of, shown

OUTPUTS = ("numpy", "torch")
DTYPES = {"float32": torch.float32, "float64": torch.float64}
RENDER_MODES = ("rgb_array", "human", "rgb_array_list")
PICTURES = {"render_modes": list(RENDER_MODES), "render_fps": 10}
"""What ``metadata`` of an environment says of pictures."""
INFO: tuple[str, ...] = ("accel", "command", "failsafe", "crash", "rewards", "vehicle_id", "lane_changes")
INFO += ("lane_refusals", "present", "queued", "inside", "outflow", "ramp", "standing", "co2", "travel", "stops")
TENSORS, SPACES, ROW_BYTES = 25, 8, 400
"""Memory of one environment: tensors per vehicle, arrays per observed feature, and bytes besides, as measured."""
_MODES = {"NextStep": AutoresetMode.NEXT_STEP, "SameStep": AutoresetMode.SAME_STEP, "Disabled": AutoresetMode.DISABLED}


@dataclass(frozen=True)
class Settings:
    """What an environment is made of, checked.

    ``output`` decides between numpy arrays and torch tensors, ``dtype`` and ``device`` are those of the simulation
    and of the observations; ``autoreset_mode`` belongs to vectors; ``limit`` is the number of steps of an episode, or
    None; ``info`` names what infos tell (``idm_env.envs.info``).
    """

    task: Task
    output: Literal["numpy", "torch"]
    device: torch.device
    dtype: torch.dtype
    autoreset_mode: AutoresetMode
    render_mode: str | None
    limit: int | None
    info: tuple[str, ...]


def settings(
    *,
    task: str | Task | None = None,
    config: str | None = None,
    output: str | None = None,
    device: str | None = None,
    dtype: str | None = None,
    autoreset_mode: str | AutoresetMode | None = None,
    render_mode: str | None = None,
    max_episode_steps: int | None = None,
    info: str | Sequence[str] | None = None,
    trusted: bool = False,
    **choices: Any,
) -> Settings:
    """Return checked settings.

    ``config`` is a YAML file that says ``configures: environment`` and gives any of these keywords; a keyword that is
    given here as well wins. ``max_episode_steps`` None leaves the limit to the task, −1 is no limit. ``info`` is one or
    several of ``INFO``, ``"all"`` (which None is) or ``"none"``. ``trusted``: code that YAML files name is run; without
    it that is an error.

    Raises:
        KeywordError: A TypeError in one line, with a suggestion, for a keyword that does not exist.
        ValueError: In one line, with a suggestion, for a value that cannot be.
    """
    own = {name: value for name, value in locals().items() if name not in ("config", "trusted", "choices")}
    if config is not None:
        read = load_environment(config, trusted=trusted)
        in_file = {key: read.pop(key, None) for key in own}
        own = {key: in_file[key] if value is None else value for key, value in own.items()}
        choices = {**read, **choices}
    chosen = "ring" if own["task"] is None else own["task"]
    limit = own["max_episode_steps"]
    if isinstance(chosen, Task):  # what Gymnasium makes again from a spec tells the limit once more
        chosen = chosen if limit is None or limit == chosen.horizon else replace(chosen, max_episode_steps=limit)
    elif limit is not None:
        choices["max_episode_steps"] = limit
    if isinstance(chosen, Task) and choices:
        raise KeywordError(
            f"unexpected keyword argument '{next(iter(choices))}' beside a task that is already made. "
            "Give it to the task."
        )
    with trust.trusting(trusted):
        own_task = chosen if isinstance(chosen, Task) else task_with(cast(str, chosen), choices, KEYWORDS)
    usual = {"output": "numpy", "device": "cpu", "dtype": "float32", "autoreset_mode": AutoresetMode.SAME_STEP}
    own |= {name: value for name, value in usual.items() if own[name] is None}
    result = Settings(
        task=own_task,
        output=cast(Any, one_of("output", own["output"], OUTPUTS)),
        device=_device(own["device"]),
        dtype=DTYPES[one_of("dtype", own["dtype"], DTYPES)],
        autoreset_mode=_mode(own["autoreset_mode"]),
        render_mode=None if own["render_mode"] is None else one_of("render_mode", own["render_mode"], RENDER_MODES),
        limit=own_task.horizon,
        info=_info(own["info"]),
    )
    affordable(result, 1)
    return result


KEYWORDS = (*(name for name in signature(settings).parameters if name != "choices"), "num_envs")
"""Keywords of environments that are none of their tasks'."""


def _mode(value: Any) -> AutoresetMode:
    if isinstance(value, AutoresetMode):
        return value
    spelled = {**_MODES, **{mode.value: mode for mode in AutoresetMode}, **{mode.name: mode for mode in AutoresetMode}}
    if not isinstance(value, str) or value not in spelled:
        raise ValueError(f"autoreset_mode = {shown(value)} is unknown.{nearest(shown(value), _MODES)}")
    return spelled[value]


def _device(value: Any) -> torch.device:
    try:
        device = torch.device(value)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, TypeError):
        names = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
        raise ValueError(f"device = {shown(value)} is unknown or not there. Available: {', '.join(names)}.") from None
    return device


def _info(value: Any) -> tuple[str, ...]:
    names = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    if value is None or (isinstance(value, str) and value in ("all", "none")):
        return () if value == "none" else INFO
    return tuple(one_of("info", name, INFO) for name in names)


def reset_options(options: Any, known: tuple[str, ...]) -> dict[str, Any]:
    """Return the options of a reset; ValueError for one that does not exist."""
    if options is None:
        return {}
    if not isinstance(options, dict):
        raise ValueError(f"options = {shown(options)} must be a mapping, such as {{'state': state}}.")
    for name in options:
        if name not in known:
            raise ValueError(f"unknown reset option {shown(name)}.{nearest(str(name), known)}")
    return options


def affordable(made: Settings, count: int, steps: int = 0) -> None:
    """Raise ValueError where environments, or a window of steps that keeps their worlds, exceed the device's memory."""
    task, size = made.task, made.dtype.itemsize
    features = len(task.bounds.names) * len(task.agents)
    worlds = TENSORS * task.vehicles + SPACES * (features + task.pairs) + steps * (4 * task.vehicles + 3 * features)
    needed = count * (size * worlds + ROW_BYTES)
    if made.device.type == "cuda":
        memory = torch.cuda.get_device_properties(made.device).total_memory
    else:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else sys.maxsize
    if needed > memory:
        what = f"num_envs = {count}" if count > 1 else f"vehicles = {task.vehicles} with {len(task.agents)} agents"
        what = f"steps = {steps}" if steps else what
        most = int((steps or count) * memory / needed / 2)
        raise ValueError(
            f"{what} would take about {needed / 1e9:,.0f} GB, and {made.device} has {memory / 1e9:,.0f} GB. "
            f"Take {f'at most {most}' if most else 'fewer vehicles or agents'}."
        )
