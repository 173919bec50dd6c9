"""Options of commands: every one stands here once, those that go together as fields of one dataclass."""

import dataclasses
import functools
import inspect
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from idm_env import validation
from idm_env.extras import needed
from idm_env.jobs import trust
from idm_env.jobs.progress import OnProgress
from idm_env.jobs.workers import HERE, Workers

with needed("the command line"):
    import typer

OUT = Path("out")
"""Folder of results where none is named: a command has its own in it."""
FILES = ("data", "source")
"""Files of traffic: one, or several that are one data set, which a command gets as one path."""
POSITIONAL = "positional"
"""Marks an option that is written without its name, and may be left out."""


class Limits(NamedTuple):
    """Where an option's number may lie, ends included, in its unit: all flags' numbers are checked here."""

    low: float
    high: float
    unit: str = ""

    def check(self, param: typer.CallbackParam, value: float | None) -> float | None:
        """Return the value; ValueError for one outside."""
        if value is not None:
            validation.in_interval(param.opts[0], value, *self)
        return value


class SharedOptions:
    """Options of several commands: what a command or a group of options does not describe itself means this.

    Args:
        data: Trajectories: csv, parquet and others; several files, a folder, 'drives/*.csv': each file is a run.
        out: Folder for the results; made if missing.
        seed: Seed of everything random.
        model: A model.yaml of explain: its effects stay, IDM is fitted.
        base: Car-following law: idm (the default), idm_plus, iidm, fvdm, gipps, constant_time_gap, my_file.py:MyLaw.
        layout: auto, tidy, ngsim, openacc, ultra_av, highd, exid, pneuma or i24.
        columns: Your names and units: time_s=t,vehicle_id=car,position_m=x[ft],speed_mps=v[km/h]. Leader and follower
            in one row, --pair: time_s=t,follower.position_m=x_f,leader.position_m=x_l, or gap_m and range_rate_mps.
        where: Only runs or drivers with "column=value"; given twice, both must hold.
        ring_length: Circumference (m), if the traffic runs on a ring.
        max_gap: Gaps above this (m) mean a lost leader and are left out.
        min_seconds: Shorter stretches behind one leader are left out (s).
        dt: Use every n-th sample, to this step (s).
        trust: Run Python code that YAML files name, as my_file.py:MyEffect.
    """


Seed = Annotated[int, Limits(0, 1e9)]
RingLength = Annotated[float | None, Limits(1.0, 1e6, "m")]
MaxGap = Annotated[float, Limits(0.1, math.inf, "m")]
MinSeconds = Annotated[float, Limits(0.0, 1e6, "s")]
Step = Annotated[float | None, Limits(0.001, 100.0, "s")]


def _trust(is_given: bool) -> None:
    if is_given:
        trust.always()


@dataclasses.dataclass(frozen=True)
class FileOptions:
    """How a file of traffic is read: whole or in part, on a ring or not, with which columns.

    Args:
        place: Column that names places, such as track_s_m on a lap.
    """

    ring_length: RingLength = None
    place: str | None = None
    layout: str = "auto"
    columns: str | None = None
    where: list[str] | None = None


@dataclasses.dataclass(frozen=True)
class SourceOptions(FileOptions):
    """How stretches behind one leader are taken from a file of traffic.

    Args:
        window: Cut longer stretches into windows of so many seconds.
    """

    max_gap: MaxGap = 80.0
    min_seconds: MinSeconds = 5.0
    window: Annotated[float | None, Limits(1.0, 1e6, "s")] = None
    dt: Step = None


@dataclasses.dataclass(frozen=True)
class TrackOptions:
    """How trajectories are filtered or reconstructed.

    Args:
        recipe: default, or paper: the published recipe, to compare with.
        fixed_parameters: Keep the driver parameters fixed.
    """

    recipe: str = "default"
    fixed_parameters: bool = False
    model: str | None = None
    layout: str = "auto"
    columns: str | None = None
    ring_length: RingLength = None


@dataclasses.dataclass(frozen=True)
class JobOptions:
    """Work that takes long: where its results go and its parts run, and whether an interrupted run goes on.

    Args:
        resume: Go on where an interrupted run stopped.
    """

    out: Path = OUT
    resume: bool = False
    place: Workers = HERE

    @contextmanager
    def running(self, report: OnProgress) -> Iterator[dict[str, Any]]:
        """Yield the keywords that all long work takes: ``resume``, ``executor`` and ``on_progress``."""
        with self.place.opened() as workers:
            yield {"resume": self.resume, "executor": workers, "on_progress": report}


def args_of(thing: Any) -> dict[str, str]:
    """Return by name what the section ``Args`` of a docstring says; of a class, what those of its bases say too."""
    entries: dict[str, str] = {}
    for each in reversed(getattr(thing, "__mro__", (thing,))):
        section = inspect.cleandoc(each.__doc__ or "").partition("\nArgs:\n")[2]
        entries |= dict(re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, re.MULTILINE))
    return {name: " ".join(text.split()) for name, text in entries.items()}


def _options(declared: Any, name: str) -> Iterator[inspect.Parameter]:
    """Yield the options of a function or of a dataclass, the fields of dataclasses among them one by one."""
    hints, helps = get_type_hints(declared, include_extras=True), args_of(SharedOptions) | args_of(declared)
    for parameter in inspect.signature(declared).parameters.values():
        kind = hints[parameter.name]
        if dataclasses.is_dataclass(kind):
            yield from _options(kind, name)
        else:
            default = OUT / name if parameter.default is OUT else parameter.default
            kind = _for_typer(parameter.name, kind, default, helps.get(parameter.name, ""))
            yield inspect.Parameter(parameter.name, parameter.KEYWORD_ONLY, default=default, annotation=kind)


def _for_typer(name: str, kind: Any, default: Any, meaning: str) -> Any:
    """Return the annotation of one option: its type, what its docstring says, and the limits of its number."""
    base, *marks = get_args(kind) if get_origin(kind) is Annotated else (kind,)
    if base is typer.Context:
        return base
    base = list[Path] if name in FILES and default is inspect.Parameter.empty else base
    base = str if get_origin(base) is Literal else base  # the words are checked, and named, in ``refusals``
    if default is inspect.Parameter.empty or POSITIONAL in marks:
        return Annotated[base, typer.Argument(help=meaning)]
    flag = f"--{name.replace('_', '-')}"
    others = {"out": ("-o",), "columns": ("--pair",)}.get(name, ())
    flags = (flag, *others) if default is not True else ()  # True has a flag for no, too
    check = _trust if name == "trust" else next((Limits(*m).check for m in marks if isinstance(m, tuple)), None)
    return Annotated[base, typer.Option(*flags, help=meaning, callback=check)]


def _gathered(kind: Any, values: dict[str, Any]) -> Any:
    """Return a dataclass of the options that are its fields, which are taken out of ``values``."""
    hints, options = get_type_hints(kind), {}
    for name in (field.name for field in dataclasses.fields(kind)):
        group = hints[name] if dataclasses.is_dataclass(hints[name]) else None
        options[name] = values.pop(name) if group is None else _gathered(group, values)
    return kind(**options)


def spread(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command in which every parameter that is a dataclass stands for the options that are its fields.

    What an option means is said in the section ``Args`` of the docstring of the command, or of the dataclass.
    """
    hints = get_type_hints(command)
    groups = {name: kind for name, kind in hints.items() if dataclasses.is_dataclass(kind)}
    options = list(_options(command, command.__name__.rstrip("_")))

    @functools.wraps(command)
    def spreading(**values: Any) -> None:
        values |= {n: one[0] for n in FILES if isinstance(one := values.get(n), list) and len(one) == 1}
        command(**{name: _gathered(kind, values) for name, kind in groups.items()}, **values)

    spreading.__doc__ = inspect.cleandoc(command.__doc__ or "").partition("\nArgs:\n")[0]
    spreading.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    spreading.__annotations__ = {option.name: option.annotation for option in options}
    return spreading
