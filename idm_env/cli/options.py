"""Options of commands: every one stands here once, those that go together as fields of one dataclass."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

from idm_env import validation
from idm_env.extras import needed
from idm_env.jobs import trust

with needed("the command line"):
    import typer

if TYPE_CHECKING:
    from idm_env.jobs.executor import Executor


def ranged(*names: str, help: str, low: float, high: float, unit: str = "") -> Any:
    """Return an option whose number must lie in ``[low, high]``: all flags' numbers are checked here."""

    def check(param: typer.CallbackParam, value: float | None) -> float | None:
        if value is not None:
            validation.within(param.opts[0], value, low, high, unit)
        return value

    return typer.Option(*names, help=help, callback=check)


Data = Annotated[Path, typer.Argument(help="Trajectories: csv, csv.gz or parquet; tidy, NGSIM or OpenACC layout.")]
DataOrFolder = Annotated[
    Path, typer.Argument(help="Trajectories: csv, csv.gz or parquet, or a folder of parquet files larger than memory.")
]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results; made if missing.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on where an interrupted run stopped.")]
Seed = Annotated[int, ranged(help="Seed of everything random.", low=0, high=1e9)]
RingLength = Annotated[
    float | None, ranged(help="Circumference (m), if the traffic runs on a ring.", low=1.0, high=1e6, unit="m")
]
Place = Annotated[str | None, typer.Option(help="Column that names places, such as track_s_m on a lap.")]
Layout = Annotated[str, typer.Option(help="auto, tidy, ngsim, openacc, ultra_av, highd, exid, pneuma or i24.")]
Columns = Annotated[
    str | None, typer.Option(help="Your names and units: time_s=t,vehicle_id=car,position_m=x[ft],speed_mps=v[km/h].")
]
MaxGap = Annotated[
    float,
    ranged(help="Gaps above this (m) mean a lost leader and are left out.", low=0.1, high=math.inf, unit="m"),
]
MinSeconds = Annotated[
    float, ranged(help="Shorter stretches behind one leader are left out (s).", low=0.0, high=1e6, unit="s")
]
Where = Annotated[
    list[str] | None, typer.Option(help='Only runs or drivers with "column=value"; given twice, both must hold.')
]
Window = Annotated[
    float | None, ranged(help="Cut longer stretches into windows of so many seconds.", low=1.0, high=1e6, unit="s")
]
Corrected = Annotated[str | None, typer.Option(help="A model.yaml of explain: its effects stay, IDM is fitted.")]
Base = Annotated[
    str | None,
    typer.Option(
        help="Car-following law: idm (the default), idm_plus, iidm, fvdm, gipps, constant_time_gap, my_file.py:MyLaw."
    ),
]


def _trust(is_given: bool) -> None:
    if is_given:
        trust.always()


Trust = Annotated[
    bool, typer.Option("--trust", callback=_trust, help="Run Python code that YAML files name, as my_file.py:MyEffect.")
]
Step = Annotated[
    float | None, ranged("--dt", help="Use every n-th sample, to this step (s).", low=0.001, high=100.0, unit="s")
]

Workers = Annotated[
    str, typer.Option("--executor", help="Where parts of the work run: serial, processes or ray. Results are the same.")
]
Jobs = Annotated[
    int | None, ranged(help="Parts that run at a time, one thread each; default: one per processor.", low=1, high=1e5)
]
RayAddress = Annotated[
    str | None, typer.Option(help="Address of a Ray cluster, host:port or auto; default: Ray on this machine.")
]
Recipe = Annotated[str, typer.Option(help="default, or paper: the published recipe, to compare with.")]
FixedParameters = Annotated[bool, typer.Option("--fixed-parameters", help="Keep the driver parameters fixed.")]


@dataclasses.dataclass(frozen=True)
class FileOptions:
    """How a file of traffic is read: whole or in part, on a ring or not, with which columns."""

    ring_length: RingLength = None
    place: Place = None
    layout: Layout = "auto"
    columns: Columns = None
    where: Where = None


@dataclasses.dataclass(frozen=True)
class SourceOptions(FileOptions):
    """How stretches behind one leader are taken from a file of traffic."""

    max_gap: MaxGap = 80.0
    min_seconds: MinSeconds = 5.0
    window: Window = None
    dt: Step = None


@dataclasses.dataclass(frozen=True)
class TrackOptions:
    """How trajectories are filtered or reconstructed."""

    recipe: Recipe = "default"
    fixed_parameters: FixedParameters = False
    model: Corrected = None
    layout: Layout = "auto"
    columns: Columns = None
    ring_length: RingLength = None


@dataclasses.dataclass(frozen=True)
class JobOptions:
    """Work that takes long: where its parts run, and whether an interrupted run goes on."""

    resume: Resume = False
    executor: Workers = "serial"
    jobs: Jobs = None
    ray_address: RayAddress = None

    def workers(self) -> AbstractContextManager[Executor]:
        """Return whoever does the parts, for a ``with``."""
        from idm_env.jobs.executor import opened

        return opened(self.executor, self.jobs, self.ray_address)


def spread(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command in which every parameter that is a dataclass stands for the options that are its fields."""
    hints = get_type_hints(command, include_extras=True)
    groups = {name: kind for name, kind in hints.items() if dataclasses.is_dataclass(kind)}
    options: list[inspect.Parameter] = []
    for parameter in inspect.signature(command).parameters.values():
        kind = hints[parameter.name]
        if parameter.name not in groups:
            options.append(parameter.replace(annotation=kind))
            continue
        types = get_type_hints(kind, include_extras=True)
        for field in dataclasses.fields(kind):
            options.append(parameter.replace(name=field.name, annotation=types[field.name], default=field.default))

    @functools.wraps(command)
    def spreading(**values: Any) -> None:
        for name, kind in groups.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in dataclasses.fields(kind)})  # type: ignore[operator]
        command(**values)

    spreading.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    spreading.__annotations__ = {option.name: option.annotation for option in options}
    return spreading
