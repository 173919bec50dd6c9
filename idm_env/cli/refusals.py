"""Refusals of a command before anything slow is imported: words of its options, and the heads of its files."""

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
SMALL_BYTES, LARGE_BYTES = 1 << 20, 1 << 26
"""Files up to the first are spooled, up to the second read as a whole before anything slow is imported; XML from
the second on shows its progress."""


def refuse(given: Mapping[str, Any]) -> None:
    """Raise ValueError, in one line, for impossible parameters of a command, and for the heads of its files."""
    for name, words in CHOICES.items():
        value = given.get(name)
        if value is not None and ":" not in str(value):  # my_file.py:MyLaw
            one_of(f"--{name.replace('_', '-')}", value, words)
    model = given.get("model")
    if model is not None and not Path(model).is_file():
        raise ValueError(f"{model} is not a file. Give the path of a YAML file.")
    scenes: list[Path] = given.get("scenarios") or []
    if len(scenes) == 1:
        from idm_env.data import womd

        next(womd.scenarios(scenes[0]), None)
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


def refuse_whole(given: Mapping[str, Any]) -> None:
    """Read the one file of traffic of a command, or the copy of several; large ones are left to the command.

    DataError for a file that it refuses as a whole. The trajectories are kept for the command.
    """
    data = given.get("data", given.get("source"))
    path = Path(data[0] if isinstance(data, list) else data or "")
    if given.get("each") or not path.is_file() or path.suffix in (".yaml", ".yml"):
        return
    options: dict[str, Any] = {name: given.get(name) for name in ("columns", "ring_length")}
    options["layout"] = given.get("layout", "auto")
    is_filter = "recipe" in given
    if path.stat().st_size > (SMALL_BYTES if is_filter else LARGE_BYTES):
        return
    if not is_filter:
        from idm_env.data.load import hold

        hold(path, place=given.get("place"), **options)
        return
    from tempfile import TemporaryDirectory

    from idm_env.trajectories.spool import Reading, Spool

    with TemporaryDirectory() as folder:
        Spool(path, Path(folder) / "spool", 200, Reading(**options))
