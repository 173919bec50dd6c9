"""The command ``idm-env``: thin, one function per verb, errors in one line."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Measured traffic in, a car-following model out: **fit** it, **explain** what it lacks, **simulate** it.\n\n"
    "Start with `idm-env demo`, then `idm-env explain my.csv --out result`. A file needs the columns vehicle_id, "
    "time_s and position_m (SI units, front bumper), or the official NGSIM or OpenACC layout; leader_id, lane, gap_m, "
    "speed_mps, length_m and run_id are used where present. Ctrl-C keeps what is done: add `--resume` to go on.",
)
console = Console(stderr=True)


def _version(wanted: bool) -> None:
    if wanted:
        import idm_env

        print(idm_env.__version__)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    pass


Data = Annotated[Path, typer.Argument(help="Trajectories: csv, csv.gz or parquet; tidy, NGSIM or OpenACC layout.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results; made if missing.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on where an interrupted run stopped.")]
Seed = Annotated[int, typer.Option(help="Seed of everything random.")]
RingLength = Annotated[float | None, typer.Option(help="Circumference (m), if the traffic runs on a ring.")]
Place = Annotated[str | None, typer.Option(help="Column that names places, such as track_s_m on a lap.")]
Layout = Annotated[str, typer.Option(help="auto, tidy, ngsim or openacc.")]
MaxGap = Annotated[float, typer.Option(help="Gaps above this (m) mean a lost leader and are left out.")]
MinSeconds = Annotated[float, typer.Option(help="Shorter stretches behind one leader are left out (s).")]
Where = Annotated[
    list[str] | None, typer.Option(help='Only runs or drivers with "column=value"; given twice, both must hold.')
]
Window = Annotated[float | None, typer.Option(help="Cut longer stretches into windows of so many seconds.")]
Corrected = Annotated[str | None, typer.Option(help="A model.yaml of explain: its effects stay, IDM is fitted.")]
Step = Annotated[float | None, typer.Option("--dt", help="Use every n-th sample, to this step (s).")]


@contextmanager
def progress() -> Iterator[Callable[[str, int, int, float | str], None]]:
    """Show a bar per phase on standard error."""
    columns = (TextColumn("{task.description:<22}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TextColumn("{task.fields[value]}"), console=console, transient=False) as bars:
        tasks: dict[str, Any] = {}

        def report(phase: str, done: int, total: int, value: float | str) -> None:
            if phase not in tasks:
                tasks[phase] = bars.add_task(phase, total=total, value="")
            words = value if isinstance(value, str) else f"residual {value:.3f}"
            bars.update(tasks[phase], completed=done, total=total, value=words)

        yield report
        for task in tasks.values():
            bars.update(task, total=bars.tasks[task].completed)


def _show(title: str, rows: list[dict[str, Any]]) -> None:
    table = Table(title=title, title_justify="left")
    for name in rows[0]:
        table.add_column(
            name.replace("_", " "), overflow="fold", justify="left" if isinstance(rows[0][name], str) else "right"
        )
    for row in rows:
        table.add_row(*(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()))
    Console().print(table)


@app.command()
def fit(
    data: Data,
    out: Out = Path("out/fit"),
    by: Annotated[str, typer.Option(help="driver, all, or a column such as vehicle_name.")] = "driver",
    held_out: Annotated[str | None, typer.Option(help='"column=value", or a share of the runs such as 0.25.')] = None,
    objective: Annotated[str, typer.Option(help="spacing, speed or both.")] = "spacing",
    relative: Annotated[bool, typer.Option(help="Divide residuals by each driver's mean.")] = False,
    loss: Annotated[str, typer.Option(help="rmse (mean over episodes) or mse (all samples alike).")] = "rmse",
    method: Annotated[str, typer.Option(help="lm (Levenberg-Marquardt) or adam (as in the paper).")] = "lm",
    integration: Annotated[str, typer.Option(help="ballistic, or euler as in the paper.")] = "ballistic",
    starts: Annotated[int, typer.Option(help="Starts per group.", min=1)] = 4,
    substeps: Annotated[
        int | None, typer.Option(help="Simulated steps per sample; default: steps of 25 ms.", min=1)
    ] = None,
    model: Corrected = None,
    seed: Seed = 0,
    ring_length: RingLength = None,
    place: Place = None,
    layout: Layout = "auto",
    max_gap: MaxGap = 80.0,
    min_seconds: MinSeconds = 5.0,
    window: Window = None,
    dt: Step = None,
    where: Where = None,
    resume: Resume = False,
) -> None:
    """Calibrate IDM by gradients through the simulator: parameters with standard errors, per driver, group or pooled.

    Writes parameters.parquet, model.yaml, report.json and report.html.
    """
    from idm_env.fitting.job import Options, Source, fit_file

    source = Source(data, ring_length, place, layout, max_gap, min_seconds, dt, window=window, where=where)
    share: str | float | None = held_out
    if held_out is not None and "=" not in held_out:
        share = _number("--held-out", held_out, 'neither "column=value" nor a share such as 0.25')
    options = Options(
        by, share, objective, relative, loss, method, integration, starts, seed, substeps, model,  # type: ignore[arg-type]
    )  # fmt: skip
    with progress() as report:
        result = fit_file(source, options, out, resume=resume, on_progress=report)
    rows = [{"": "fitted", **result["fit"]}]
    if result["held_out"] is not None:
        rows.append({"": "held out", **result["held_out"]})
    names = ("", "episodes", "gap_rmse_m", "gap_rmse_median_m", "gap_mae_m", "speed_rmse_mps", "collisions")
    _show("Errors in free simulation", [{n: row[n] for n in names} for row in rows])
    _done(out)


@app.command()
def explain(
    data: Data,
    out: Out = Path("out/explain"),
    by: Annotated[str, typer.Option(help="Who shares IDM parameters: driver, all, or a column.")] = "driver",
    effects: Annotated[
        str | None,
        typer.Option(help="Candidates, by comma: names, or my_file.py:MyEffect; default: the whole catalogue."),
    ] = None,
    known: Annotated[str | None, typer.Option(help="Effects whose values are in the file, such as grade.")] = None,
    seed: Seed = 0,
    ring_length: RingLength = None,
    place: Place = None,
    layout: Layout = "auto",
    where: Where = None,
    resume: Resume = False,
) -> None:
    """Fit IDM, find the residual, trace it to the effect that the model lacks, add it, and report before and after.

    Writes report.json, report.html and model.yaml, the corrected model. The errors are of runs held out of everything.
    """
    from idm_env.data import load

    trajectories = load(data, ring_length=ring_length, place=place, layout=layout)
    if where is not None:
        trajectories = trajectories.where(where)
    _explain(trajectories, out, by, _names(effects), _names(known) or (), seed, resume)


def _explain(
    trajectories: Any,
    out: Path,
    by: str = "driver",
    effects: tuple[str, ...] | None = None,
    known: tuple[str, ...] = (),
    seed: int = 0,
    resume: bool = False,
) -> None:
    import json

    from idm_env.discovery import discover, write_report
    from idm_env.discovery.words import ERRORS
    from idm_env.report import output_folder

    output_folder(out)
    with progress() as report:
        found = discover(
            trajectories,
            by=by,
            effects=effects,
            known=known,
            out=out,
            resume=resume,
            seed=seed,
            on_progress=lambda stage, candidate, done, total: report(stage, done, total, candidate),
        )
        write_report(found, out)
    result = json.loads((out / "report.json").read_text(encoding="utf-8"))
    console.print(f"Verdict: [bold]{result['verdict'].replace('_', ' ')}[/bold]. ", end="")
    console.print(result["sentence"], markup=False, highlight=False)
    before, after = result["error"]["before"], (result["partial"] or result["error"])["after"]
    if before is not None:
        _show("Errors on runs that neither fitted nor chose anything", [
            _error_row(name, unit, before[key], after[key], found.judgement.titles, result["helps"].get(key))
            for key, (name, unit) in ERRORS.items()
        ])  # fmt: skip
    if result["interval"]:
        console.print(result["interval"], style="dim", highlight=False)
    files = sorted(result["models"].items(), key=lambda item: item[0] != "model.yaml")
    best = ", which predicts best" if len(files) > 1 else ""
    console.print(
        "; ".join(f"{file} is {name}{best if not i else ''}" for i, (file, name) in enumerate(files)), highlight=False
    )
    _done(out)


def _error_row(
    name: str, unit: str, before: float, after: float, models: tuple[str, ...], compared: dict[str, Any] | None
) -> dict[str, Any]:
    """Return one error of explain: that of every model, and whether the second's is better, the same or worse."""
    from idm_env.discovery.words import percent

    row: dict[str, Any] = {"error": f"{name} ({unit})"} | dict(zip(models, (before, after), strict=False))
    if len(models) > 1:
        known = compared is not None and compared["high"] is not None
        row["change"] = percent(after / before) if before else ""
        row["95 % interval"] = (
            f"{percent(compared['low'])} to {percent(compared['high'])}" if compared and known else ""
        )
        row["verdict"] = compared["verdict"] if compared else ""
    return row


def _names(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else tuple(name.strip() for name in text.split(",") if name.strip())


@app.command()
def demo(
    data: Annotated[
        Path | None, typer.Option(help="Your own file; default: generated data with a hidden effect.")
    ] = None,
    out: Out = Path("out/demo"),
    seed: Annotated[int, typer.Option(help="Seed of the generated data.")] = 7,
) -> None:
    """Show the main job: a platoon whose generator has an effect that the fitted model is not told of.

    The data are written to OUT/platoon.csv first, without a word on the effect; `explain` then has to find it.
    """
    from idm_env.data import load, synthetic
    from idm_env.report import output_folder

    path = data
    if path is None:
        path = output_folder(out) / "platoon.csv"
        made, _ = synthetic.generate(seed, runs=10, followers=3, seconds=180.0, effect="delay", noise=0.1)
        columns = ("run_id", "vehicle_id", "leader_id", "time_s", "position_m", "speed_mps", "length_m")
        made.table.select(columns).write_csv(path)
        console.print(f"Ten runs of a leader and three followers: {path}")
    _explain(load(path), out)


@app.command()
def simulate(
    data: Data,
    model: Annotated[Path, typer.Option(help="A model.yaml of fit or explain, or one of your own.")],
    out: Out = Path("out/simulate"),
    seed: Seed = 0,
    ring_length: RingLength = None,
    place: Place = None,
    layout: Layout = "auto",
    max_gap: MaxGap = 80.0,
    min_seconds: MinSeconds = 5.0,
    window: Window = None,
    dt: Step = None,
    where: Where = None,
) -> None:
    """Roll a saved model out behind the measured leaders. Writes simulated.parquet, report.json and report.html."""
    from idm_env.fitting.job import Source, simulate_file

    source = Source(data, ring_length, place, layout, max_gap, min_seconds, dt, window=window, where=where)
    result = simulate_file(source, model, out, seed=seed)
    _show("Errors in free simulation", [result["error"]])
    _done(out)


@app.command()
def effects() -> None:
    """List the catalogue of effects with their parameters."""
    from idm_env.effects import ALL
    from idm_env.parameters import table

    rows = []
    for name, cls in ALL.items():
        effect = cls()
        summary = (cls.__doc__ or "").strip().splitlines()[0]
        for row in table([effect]) or [{"parameter": name, "symbol": "", "unit": "", "default": "", "null": ""}]:
            keep = {
                k: str(row[k] if row[k] is not None else "") for k in ("parameter", "symbol", "unit", "default", "null")
            }
            rows.append({**keep, "what": summary})
            summary = ""
    _show("Effects", rows)


@app.command()
def plot(
    source: Annotated[Path, typer.Argument(help="A trajectory file, or a YAML file of configs/ to roll out.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture: png, svg or pdf.")] = Path(
        "out/space-time.png"
    ),
    where: Where = None,
    seconds: Annotated[
        float, typer.Option(help="Length of a rollout, all vehicles left to their drivers (s).", min=0.1)
    ] = 300.0,
    seed: Seed = 0,
) -> None:
    """Draw a space-time diagram, position over time coloured by speed, of a file or of a rollout."""
    from idm_env.diagrams import space_time

    if source.suffix in (".yaml", ".yml"):
        figure = _rollout_figure(source, seconds, seed)
    else:
        from idm_env.data import load

        trajectories = load(source)
        if where is not None:
            trajectories = trajectories.where(where)
        runs = len(trajectories.runs())
        overlaid = f", {runs} runs on one axis (choose one with --where)" if runs > 1 else ""
        figure = space_time(trajectories, title=f"{source.name}{overlaid}")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)
    console.print(f"Picture: [bold]{out.resolve()}[/bold]", soft_wrap=True)


def _rollout_figure(config: Path, seconds: float, seed: int) -> Any:
    import torch

    from idm_env.config import load_environment
    from idm_env.diagrams import space_time
    from idm_env.envs.gym import DiffIDMEnv
    from idm_env.roads import Ring
    from idm_env.simulator import Trajectory

    # The picture is as long as it was asked for, whatever the limit of an episode.
    keywords = {key: value for key, value in load_environment(config).items() if key != "max_episode_steps"}
    env: Any = DiffIDMEnv(**keywords)
    env.reset(seed=seed)
    dt = env.task.simulator.dt
    kept = []
    for _ in range(max(1, round(seconds / dt))):
        _, _, terminated, truncated, _ = env.step(None)
        state = env.batch.world.state
        kept.append((state.position[0], state.speed[0], state.accel[0], state.gap[0]))
        if terminated or truncated:
            break
    # On a ring gaps and lengths add up to the circumference.
    length = float((state.gap[0] + state.length[0]).sum()) if isinstance(env.task.simulator.road, Ring) else None
    states = Trajectory(*(torch.stack(column) for column in zip(*kept, strict=True)))
    return space_time(states, dt=dt, ring_length=length, title=config.name)


Recipe = Annotated[str, typer.Option(help="default, or paper: the published recipe, to compare with.")]
FixedParameters = Annotated[bool, typer.Option("--fixed-parameters", help="Keep the driver parameters fixed.")]


@app.command("filter")
def filter_(
    data: Data,
    out: Out = Path("out/filter"),
    recipe: Recipe = "default",
    fixed_parameters: FixedParameters = False,
    model: Corrected = None,
    layout: Layout = "auto",
    resume: Resume = False,
) -> None:
    """Filter noisy trajectories into physical ones: position, speed, acceleration, gap, and driver parameters."""
    from idm_env.trajectories.files import filter_file

    with progress() as report:
        filter_file(
            data, out, recipe=recipe, fixed_parameters=fixed_parameters, layout=layout, resume=resume,  # type: ignore[arg-type]
            model=model, on_progress=lambda done, total: report("filter", done, total, ""),
        )  # fmt: skip
    _done(out)


@app.command()
def reconstruct(
    data: Data,
    out: Out = Path("out/reconstruct"),
    dt: Annotated[float, typer.Option(help="Step of the dense trajectories (s).")] = 0.1,
    recipe: Recipe = "default",
    fixed_parameters: FixedParameters = False,
    model: Corrected = None,
    layout: Layout = "auto",
    resume: Resume = False,
) -> None:
    """Reconstruct dense trajectories from sparse ones, a second or more between points."""
    from idm_env.trajectories.files import reconstruct_file

    with progress() as report:
        reconstruct_file(
            data, out, dt=dt, recipe=recipe, fixed_parameters=fixed_parameters, layout=layout, resume=resume,  # type: ignore[arg-type]
            model=model, on_progress=lambda done, total: report("reconstruct", done, total, ""),
        )  # fmt: skip
    _done(out)


@app.command()
def predict(
    scenarios: Annotated[list[Path], typer.Argument(help="Waymo Open Motion scenarios: JSON, json.gz or TFRecord.")],
    out: Out = Path("out/predict"),
    resume: Resume = False,
) -> None:
    """Predict up to six futures of eight seconds per agent, from one second of history and the lanes of the map."""
    from idm_env.prediction.files import predict_files

    with progress() as report:
        predict_files(scenarios, out, resume=resume, on_progress=lambda done, total: report("predict", done, total, ""))
    _done(out)


@app.command()
def bench(
    out: Out = Path("out/bench"),
    sizes: Annotated[str, typer.Option(help="Numbers of vehicles, by comma.")] = "2000,20000,200000,2000000",
    rounds: Annotated[int, typer.Option(help="Interleaved rounds; minimum and median are reported.", min=1)] = 5,
    compiled: Annotated[bool, typer.Option(help="Include the step compiled by inductor.")] = True,
    peers: Annotated[bool, typer.Option(help="Include SUMO and HighwayEnv.")] = True,
    verbose: Annotated[bool, typer.Option("--verbose", help="Say which path ran, and why.")] = False,
) -> None:
    """Measure speed beside diffidm, SUMO, HighwayEnv and the memory's limit, in one run on this machine."""
    from idm_env.bench import run as measure

    numbers = [int(_number("--sizes", size, "no number of vehicles")) for size in sizes.split(",")]
    measure(out, sizes=numbers, rounds=rounds, compiled=compiled, others=peers, verbose=verbose)


def _number(option: str, text: str, wrong: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{option} = {text!r} is {wrong}.") from None


def _done(out: Path) -> None:
    console.print(f"Report: [bold]{(out / 'report.html').resolve()}[/bold]", soft_wrap=True)


def run() -> None:
    """Run the command line: bad input ends with one line and exit code 1, Ctrl-C with 130."""
    try:
        code = app(standalone_mode=False)  # an exit code where typer has dealt with the end itself
        if code == 130:
            _interrupted()
        sys.exit(code if isinstance(code, int) else 0)
    except (KeyboardInterrupt, typer.Abort):
        _interrupted()
    except (ValueError, ImportError, OSError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(1)
    except Exception as error:
        if not hasattr(error, "show"):
            raise
        error.show()  # a usage error: typer's own message, with the usage line
        sys.exit(getattr(error, "exit_code", 2))


def _interrupted() -> None:
    """End after Ctrl-C; only some commands are long enough to go on with."""
    commands = {c.name or c.callback.__name__: c.callback for c in app.registered_commands if c.callback}
    command = commands.get(sys.argv[1]) if len(sys.argv) > 1 else None
    resumable = command is not None and "resume" in inspect.signature(command).parameters
    advice = ": what is done was kept. Run the same command with --resume to go on." if resumable else "."
    print(f"interrupted{advice}", file=sys.stderr)
    sys.exit(130)
