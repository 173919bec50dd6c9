"""What a command refuses before anything slow is imported: words of its options, and the heads of its files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from idm_env.validation import one_of

CHOICES = {
    "base": ("idm", "idm_plus", "iidm", "fvdm", "gipps", "constant_time_gap"),
    "executor": ("serial", "processes", "ray"),
    "first_lane": ("left", "right"),
    "integration": ("ballistic", "euler", "midpoint"),
    "loss": ("mse", "rmse"),
    "method": ("lm", "adam"),
    "objective": ("spacing", "speed", "both"),
    "recipe": ("default", "paper"),
}
"""Options of few words, and the words. Those who use them declare them; a test holds both together."""


def refuse(given: Mapping[str, Any]) -> None:
    """Raise ValueError, in one line, for what a command's parameters refuse by themselves and by their files' heads."""
    for name, words in CHOICES.items():
        value = given.get(name)
        if value is not None and ":" not in str(value):  # my_file.py:MyLaw
            one_of(f"--{name.replace('_', '-')}", value, words)
    model = given.get("model")
    if model is not None and not Path(model).is_file():
        raise ValueError(f"{model} is not a file. Give the path of a YAML file.")
    if given.get("scenarios"):
        _scenarios([Path(path) for path in given["scenarios"]])
    data = given.get("data", given.get("source"))
    if data is None or str(data[0] if isinstance(data, (list, tuple)) else data).endswith((".yaml", ".yml")):
        return
    from idm_env.data import folder
    from idm_env.data.load import LAYOUTS, files_of, refuse_head

    layout = one_of("--layout", given.get("layout", "auto"), LAYOUTS)
    paths = [Path(path) for path in (data if isinstance(data, (list, tuple)) else [data])]
    if len(paths) == 1 and folder.is_partitioned(paths[0]):
        files = [Path(name) for name in folder.files_of(paths[0])]
        files = files if len(files) == 1 else []  # columns may be in the names of folders
    else:
        files = files_of(paths)
    by, held = given.get("by"), str(given.get("held_out") or "")
    names = [*(given.get("where") or ()), *([held] if "=" in held else [])]
    group = None if by in ("driver", "all") else by
    for file in [] if given.get("each") else files:  # with --each those that cannot be used are left out
        refuse_head(file, layout, names, given.get("place"), group, given.get("columns"))


def _scenarios(paths: list[Path]) -> None:
    from idm_env.data import womd

    if len(paths) == 1:
        next(womd.scenarios(paths[0]), None)
