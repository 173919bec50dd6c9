"""The command ``idm-env``: thin, one function per verb, in the order of the help; errors in one line."""

import dataclasses
import inspect
import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import idm_env
from idm_env import validation
from idm_env.cli import answers, end_at_once, options, refusals
from idm_env.cli.answers import console
from idm_env.extras import needed
from idm_env.jobs import storage
from idm_env.jobs.progress import OnProgress, shown
from idm_env.reports import page

with needed("the command line"):
    import typer
    import typer.core


class _Refusing(typer.core.TyperCommand):
    """A command whose refusals come before its function imports anything slow."""

    def invoke(self, ctx: Any) -> Any:
        from idm_env.data import plain

        page.ASKED.set(_typed_words(str(ctx.info_name), ctx.params))
        with shown(console) as report:  # a large file of XML takes seconds
            plain.ON_PART.set(
                lambda done, total: report("reading", done, total, "") if total >= refusals.LARGE_BYTES else None
            )
            refusals.refuse(ctx.params)
            for name in options.FILES:
                if isinstance(ctx.params.get(name), list) and not ctx.params.get("each"):
                    _join(ctx.params, name)
            refusals.refuse_whole(ctx.params)
        super().invoke(ctx)
        if following := page.next_command(ctx.params.get("out", options.OUT)):
            console.print(f"Next: {following}", soft_wrap=True, highlight=False)


def _typed_words(command: str, params: dict[str, Any]) -> page.Asked:
    """Return the command, its files and options of reading as a user typed them."""
    files: Any = next((params[name] for name in options.FILES if params.get(name)), [])
    how = ("layout", "columns", "ring_length", "place", "where")
    values_of = {name: params[name] for name in how if params.get(name) not in (None, "auto")}
    values = [(name, each) for name, value in values_of.items() for each in (value if name == "where" else [value])]
    words = [(f"--{name.replace('_', '-')}", str(value)) for name, value in values]
    command = "each" if params.get("each") else command
    return page.Asked(command, tuple(map(str, files if isinstance(files, list) else [files])), tuple(words))


def _join(params: dict[str, Any], name: str) -> None:
    """Replace several files among a command's parameters by the path of one, with tidy columns in SI units."""
    paths, folders = params[name], "recipe" in params or "held_out" in params  # filter, reconstruct and fit take them
    if len(paths) > 1 or paths[0].is_dir() or not paths[0].exists():
        from idm_env.data.joined import joined

        layout, columns = params.get("layout", "auto"), params.get("columns")
        out = Path(os.path.realpath(params["out"]))  # resolve() raises for a link to itself
        inside = (p for p in paths if Path(os.path.realpath(p)).parent == out)
        if (out / storage.MARK).exists() and (old := next(inside, None)):
            raise ValueError(f"{old} lies in --out, whose results are replaced. Give --out another folder.")
        params[name] = [joined(paths, layout=layout, columns=columns, whole=not folders)]
        if params[name][0] not in paths:
            params |= {key: value for key, value in (("layout", "auto"), ("columns", None)) if key in params}


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
PICTURES = (".png", ".svg", ".pdf")


def _version(is_asked: bool) -> None:
    if is_asked:
        print(idm_env.__version__)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    pass


_stopped: list[int] = []
"""Signals that have ended the work."""


def _work_begins() -> None:
    """Make Ctrl-C an exception, so that finished work is kept; while modules are imported it could crash them."""
    if signal.getsignal(signal.SIGINT) is end_at_once:
        signal.signal(signal.SIGINT, _stop)


def _stop(number: int, frame: object) -> NoReturn:
    _stopped.append(number)
    raise KeyboardInterrupt


@app.command()
def demo(data: Path | None = None, columns: str | None = None, out: Path = options.OUT, seed: options.Seed = 7) -> None:
    """Generate platoons with a hidden effect, and find it: the whole of `explain` in half a minute.

    The data are written to OUT/platoon.csv first; nothing in them names the effect.

    Args:
        data: Your own file; default: generated data with a hidden effect.
    """
    from idm_env.reports.undecided import EXPLAINED

    names = (*EXPLAINED, *(("platoon.csv",) if data is None else ()))
    with storage.results(out, names, [data]) as folder, shown(console) as report:
        from idm_env.data import synthetic
        from idm_env.discovery.sets import Question, explain as explain_one

        _work_begins()
        path = data
        if path is None:
            report("generating", 0, 0, "platoon.csv")
            path = folder / "platoon.csv"
            trajectories, _ = synthetic.generate(seed, runs=10, followers=3, seconds=180.0, effect="delay", noise=0.1)
            measured = ("run_id", "vehicle_id", "leader_id", "time_s", "position_m", "speed_mps", "length_m")
            storage.write_csv(path, trajectories.table.select(measured))
            console.print(f"Ten runs of a leader and three followers: {path}", soft_wrap=True)
        result, models = explain_one(path, out, Question(columns=columns if data else None), on_progress=report)
    answers.explained(result, models, out)


@app.command()
def plot(
    source: Path,
    out: Path = options.OUT / "space-time.png",
    html: bool = False,
    panels: Annotated[int, options.Limits(1, 1000)] = 6,
    ring_length: options.RingLength = None,
    layout: str = "auto",
    columns: str | None = None,
    where: list[str] | None = None,
    seconds: Annotated[float, options.Limits(0.1, 1e5, "s")] = 300.0,
    seed: options.Seed = 0,
    trust: bool = False,
) -> None:
    """Draw a space-time diagram, position over time coloured by speed, of a file or of a rollout.

    One panel per run and lane, of a rollout the left lane first; controlled vehicles (of a rollout, or a column
    "controlled") are underlined in blue.

    Args:
        source: A trajectory file, or a YAML file of configs/ to roll out.
        out: The picture: png, svg or pdf.
        html: Write an interactive page too, beside the picture: zoom, and point.
        panels: Panels at most, one per run and lane, the largest first.
        seconds: Length of a rollout, all vehicles left to their drivers (s).
    """
    from idm_env.reports.page import account

    if out.is_dir() or out.suffix.lower() not in PICTURES:
        fault = "is a folder" if out.is_dir() else "names no kind of picture"
        raise ValueError(f"--out = {out} {fault}. Give a file that ends in {', '.join(PICTURES)}.")
    written = [out, *([out.with_suffix(".html")] if html else [])]
    for path in written:
        storage.not_an_input(path, [source])
        storage.refuse_unwritable(path, "--out")
    if html and written[1].exists() and 'id="diagram"' not in written[1].read_text(errors="replace"):
        raise ValueError(f"{written[1]} was not written by idm-env plot. Move it, or give --out another name.")
    repairs: tuple[Any, ...] = ()
    with shown(console) as report:
        from idm_env.reports import diagrams

        if source.suffix in (".yaml", ".yml"):
            drawings = _rollout_panels(source, seconds, seed, report)
        else:
            from idm_env.data import load

            _work_begins()
            report("reading", 0, 0, source.name)
            trajectories = load(source, ring_length=ring_length, layout=layout, columns=columns)
            if where is not None:
                trajectories = trajectories.where(where)
            drawings, repairs = diagrams.panels(trajectories), trajectories.repairs
        report("drawing", 0, 0, out.name)
        largest = drawings[:panels]
        more = f", the largest {len(largest)} of {len(drawings)} panels" if len(drawings) > len(largest) else ""
        title = f"{source.name}{more}" if len(largest) > 1 else f"{source.name}: {largest[0].title}{more}"
        out.parent.mkdir(parents=True, exist_ok=True)
        figure = diagrams.figure_of(largest, title)
        page.legible(figure)
        storage.write(out, figure.savefig)
        if html:
            diagrams.write_html(out.with_suffix(".html"), largest, title)
    if more:
        console.print(f"Drawn: {more[2:]}; more with --panels.", highlight=False)
    if source.suffix not in (".yaml", ".yml"):
        console.print(account(repairs), soft_wrap=True, highlight=False)
    for path in written:
        answers.show_path("Picture", path)


def _rollout_panels(config: Path, seconds: float, seed: int, report: OnProgress) -> list[Any]:
    """Return the panel of a rollout, or one for each of several lanes."""
    from idm_env.envs.gym import DiffIDMEnv
    from idm_env.envs.render import panels_of
    from idm_env.model_file import load_environment

    _work_begins()
    # The picture is as long as it was asked for, whatever the limit of an episode.
    env: Any = DiffIDMEnv(**{**load_environment(config), "max_episode_steps": -1})
    env.reset(seed=seed)
    dt = env.task.step_time  # of a step of the environment, for which an action is held
    states, steps = [], max(1, round(seconds / dt))
    for step in range(steps):
        _, _, terminated, truncated, _ = env.step(None)
        states.append(env.state)
        report("rollout", step + 1, steps, f"{(step + 1) * dt:.0f} s")
        if terminated or truncated:
            break
    return panels_of(env.task, states)


@app.command("filter")
def filter_(*, data: Path, job: options.JobOptions, tracks: options.TrackOptions, trust: bool = False) -> None:
    """Filter noisy trajectories into physical ones: position, speed, acceleration, gap, and driver parameters.

    Args:
        data: Trajectories: csv, parquet and others; several files or a folder: each is a run, but of parquet files.
    """
    _filtered(data, job, tracks)


def _filtered(data: Path, job: options.JobOptions, tracks: options.TrackOptions, **task: Any) -> None:
    with shown(console) as report:
        from idm_env.trajectories.files import filter_file

        _work_begins()
        with job.running(report) as run:
            result = filter_file(data, job.out, **dataclasses.asdict(tracks), **task, **run)
    answers.filtered(result)
    answers.finished(job.out, result["account"])


@app.command()
def reconstruct(
    *,
    data: Path,
    job: options.JobOptions,
    dt: Annotated[float, options.Limits(0.01, 2.0, "s")] = 0.1,
    tracks: options.TrackOptions,
    trust: bool = False,
) -> None:
    """Reconstruct dense trajectories from sparse ones, a second or more between points.

    Args:
        data: Trajectories: csv, parquet and others; several files or a folder: each is a run, but of parquet files.
        dt: Step of the dense trajectories (s).
    """
    _filtered(data, job, tracks, task="reconstruct", dt=dt)


@app.command()
def fit(
    context: typer.Context,
    *,
    data: Path,
    job: options.JobOptions,
    by: str = "driver",
    held_out: str | None = None,
    objective: str = "spacing",
    relative: bool = False,
    loss: str = "rmse",
    method: str = "lm",
    integration: str = "ballistic",
    starts: Annotated[int, options.Limits(1, 1000)] = 4,
    substeps: Annotated[int | None, options.Limits(1, 1000)] = None,
    model: str | None = None,
    base: str | None = None,
    seed: options.Seed = 0,
    file: options.SourceOptions,
    sumo: Path | None = None,
    lane_changes: bool = False,
    every: Annotated[float, options.Limits(0.1, 60.0, "s")] = 1.0,
    ahead: Annotated[float, options.Limits(0.0, 10.0)] = 0.0,
    first_lane: str = "left",
    trust: bool = False,
) -> None:
    """Calibrate IDM, or another law, by gradients through the simulator, per driver, group or pooled.

    Writes parameters.parquet, model.yaml, report.json and report.html. With --lane-changes MOBIL's are fitted,
    and judged on drivers held out; hypothetical accelerations are those of --model or --base.

    Args:
        data: Trajectories: csv, parquet and others; several files or a folder: each is a run, but of parquet files.
        by: driver, all, or a column such as vehicle_name.
        held_out: "column=value", or a share of the runs such as 0.25.
        objective: spacing, speed or both.
        relative: Divide residuals by each driver's mean.
        loss: rmse (mean over episodes) or mse (all samples alike).
        method: lm (Levenberg-Marquardt) or adam (as in the paper).
        integration: ballistic, or euler as in the paper.
        starts: Starts per group.
        substeps: Simulated steps per sample; default: steps of 25 ms.
        sumo: Also write the drivers as SUMO's vTypes, an additional file: vtypes.add.xml.
        lane_changes: Fit MOBIL to the lane changes of the file, by their likelihood.
        every: --lane-changes: seconds between decisions.
        ahead: --lane-changes: seconds from a decision to the new lane number.
        first_lane: --lane-changes: where the lowest lane is, left or right.
    """
    if lane_changes:
        reading = {"data", "out", "model", "base", "seed", "ring_length", "layout", "columns", "where", "trust"}
        _only(context, "--lane-changes", reading | {"lane_changes", "every", "ahead", "first_lane"})
        _fit_lane_changes(data, job.out, file, (model, base, every, ahead, first_lane, None, int(seed)))
        return
    _only(context, "", set(context.params) - {"every", "ahead", "first_lane"})
    share: str | float | None = held_out
    if held_out is not None and "=" not in held_out:
        share = _number("--held-out", held_out, 'neither "column=value" nor a share such as 0.25')
        validation.in_interval("--held-out", share, 0.001, 0.999)
    with shown(console) as report:
        from idm_env.fitting import sumo as vtypes
        from idm_env.fitting.job import fit_file, in_words
        from idm_env.fitting.options import Options, Source
        from idm_env.model_file import load_model

        if sumo is not None:
            storage.not_an_input(sumo, [data])
            vtypes.refuse(sumo, base or "idm")
        _work_begins()
        source = Source(data, **dataclasses.asdict(file))
        cost = by, share, objective, relative, loss, method, integration
        options = Options(*cost, starts, seed, substeps, model, base)  # type: ignore[arg-type]
        with job.running(report) as run:
            result = fit_file(source, options, job.out, **run)
        if sumo is not None and not result["failed"]:
            vtypes.write(sumo, load_model(job.out / "model.yaml"))
    for words in (result["data"].get("noise"), result["over_fitting"]):
        if words:
            console.print(words, soft_wrap=True, highlight=False)
    rows = [{"": "fitted", **result["fit"]}]
    if result["held_out"] is not None:
        rows.append({"": f"held-out {result['held_out']['parts']}", **result["held_out"]})
    answers.show("Errors in free simulation", in_words(rows))
    console.print(result["at_bounds"], soft_wrap=True, highlight=False)
    answers.finished(job.out, result["data"]["account"])
    answers.end_failed(result["failed"])


def _only(context: typer.Context, mode: str, accepted: set[str]) -> None:
    """Raise ValueError for an option on the command line that says nothing here."""
    for name in context.params:
        source = context.get_parameter_source(name)
        if name not in accepted and source is not None and source.name == "COMMANDLINE":
            flag = f"--{name.replace('_', '-')}"
            rule = f"says nothing with {mode}" if mode else "is for --lane-changes"
            raise ValueError(f"{flag} {rule}. Leave it out.")


def _fit_lane_changes(data: Path, out: Path, file: options.FileOptions, changes: tuple[Any, ...]) -> None:
    with shown(console) as report:
        from idm_env.fitting.lane_changes import ChangeOptions, fit_lane_changes
        from idm_env.fitting.options import Source

        _work_begins()
        source = Source(data, **dataclasses.asdict(file))
        result = fit_lane_changes(source, ChangeOptions(*changes), out, on_progress=report)
    shown_of = ("parameter", "symbol", "unit", "estimate", "standard_error", "identified")
    rows = [{n: row[n] for n in shown_of} for row in result["parameters"]]
    answers.show("MOBIL by the likelihood of lane changes", rows)
    names = ("model", "parameters", "fitted", "held_out", "mobil_gains", "standard_error")
    rows = [{n: row[n] for n in names} for row in result["models"]]
    answers.show("Log-likelihood, of all drivers and of those held out", rows)
    console.print(result["sentence"], soft_wrap=True, highlight=False)
    answers.finished(out, result["data"]["account"])


@app.command()
def explain(
    *,
    data: Path | list[Path],
    job: options.JobOptions,
    by: str = "driver",
    effects: str | None = None,
    known: str | None = None,
    base: str | None = None,
    seed: options.Seed = 0,
    file: options.FileOptions,
    split_runs: str | None = None,
    each: bool = False,
) -> None:
    """Find the effect that a calibrated car-following model lacks, add it, and report the errors before and after.

    Writes report.json, report.html and model.yaml, the corrected model. Errors are of held-out runs; the test
    set, a quarter of the runs, confirms the choice.

    Args:
        by: Who shares IDM parameters: driver, all, or a column.
        effects: Candidates, by comma: names, or my_file.py:MyEffect; default: the whole catalogue.
        known: Effects whose values are in the file, such as grade.
        split_runs: Cut recordings into runs of so many seconds, 60s; each driver counts in one of them.
        each: Several files are several data sets, explained one by one: a report each, and a table.
    """
    out = job.out
    with shown(console) as report:
        from idm_env.data import pieces
        from idm_env.data.load import files_of
        from idm_env.reports import undecided

        files = files_of(data if isinstance(data, list) else [data])
        seconds = pieces.seconds_of(split_runs)
        candidates, inputs = _names("--effects", effects), _names("--known", known) or ()
        read = None
        if len(files) == 1:  # what one recording cannot tell is said before anything slow is imported
            report("reading", 0, 0, files[0].name)
            read = pieces.recordings(files[0], **dataclasses.asdict(file), seconds=seconds)
            cure = pieces.cure(read)
            if cure is not None:
                answers.undecided(undecided.write(read, cure, out, files), out)
                return
        from idm_env.discovery.sets import Question, explain as explain_one, explain_sets

        where = None if file.where is None else tuple(file.where)
        request = by, candidates, inputs, seed, file.ring_length, file.place, file.layout
        question = Question(*request, where, base or "idm", file.columns, seconds)
        _work_begins()
        rows: list[dict[str, Any]] = []
        if read is not None:
            how: dict[str, Any] = {"resume": job.resume, "on_progress": report, "trajectories": read}
            result, models = explain_one(files[0], out, question, **how)
        else:
            with job.running(report) as run:
                rows = explain_sets(files, out, question, **run)
    if not rows:
        answers.explained(result, models, out)
        return
    answers.show(
        f"{len(rows)} data sets",
        [{"set": row["set"], "verdict": row["verdict"].replace("_", " "), "effects": row["effects"]} for row in rows],
    )
    answers.finished(out, f"Every set's own report is in {out}/NAME; sets.csv has them all.")


def _names(option: str, text: str | None) -> tuple[str, ...] | None:
    names = None if text is None else tuple(name.strip() for name in text.split(",") if name.strip())
    if names == ():
        raise ValueError(f"{option} = {validation.shown(text)} names nothing. Give names, or leave {option} out.")
    return names


@app.command()
def simulate(
    *,
    data: Path,
    model: Path | None = None,
    base: str | None = None,
    out: Path = options.OUT,
    seed: options.Seed = 0,
    file: options.SourceOptions,
    trust: bool = False,
) -> None:
    """Roll a saved model out behind the measured leaders. Writes simulated.parquet, report.json and report.html.

    Args:
        model: A model.yaml of fit or explain, or one of your own.
    """
    if (model is None) == (base is None):
        raise ValueError("simulate takes either a model (--model) or a car-following law (--base). Give one of them.")
    with shown(console) as report:
        from idm_env.fitting.job import in_words, simulate_file
        from idm_env.fitting.options import Source

        _work_begins()
        source = Source(data, **dataclasses.asdict(file))
        result = simulate_file(source, model, out, base=base, seed=seed, on_progress=report)
    answers.show("Errors in free simulation", in_words([result["error"]]))
    console.print(f"Gap RMSE {result['error']['gap_rmse_m']:.2f} m, {result['fitted_on']['words']}", soft_wrap=True)
    console.print(result["drivers"], soft_wrap=True, highlight=False)
    answers.finished(out, result["data"]["account"])


@app.command()
def drift(
    *,
    data: Path,
    job: options.JobOptions,
    drivers: Annotated[int, options.Limits(2, 10000)] = 60,
    file: options.FileOptions,
    max_gap: options.MaxGap = 80.0,
    min_seconds: options.MinSeconds = 20.0,
    dt: options.Step = None,
) -> None:
    """Estimate how unsteady drivers are: which quantity wanders, by how much (sigma), with which memory time (tau).

    Writes report.html, and model.yaml for simulate --model and as `effects` of environments: the likeliest model,
    unless another forecasts drivers kept back better beyond chance.

    Args:
        drivers: Drivers at most, evenly spread over the file.
    """
    with shown(console) as report:
        from idm_env.drift.job import drift_file, tables
        from idm_env.fitting.options import Source

        _work_begins()
        source = Source(data, max_gap=max_gap, min_seconds=min_seconds, dt=dt, **dataclasses.asdict(file))
        with job.running(report) as run:
            result = drift_file(source, job.out, drivers=drivers, **run)
    console.print(result["sentence"], soft_wrap=True, highlight=False)
    for title, rows in tables(result).items():
        answers.show(title, rows)
    answers.finished(job.out, result["data"]["account"])


@app.command()
def predict(*, scenarios: list[Path], job: options.JobOptions) -> None:
    """Predict up to six futures of eight seconds per agent, from one second of history and the lanes of the map.

    Args:
        scenarios: Waymo Open Motion scenarios: JSON, json.gz or TFRecord.
    """
    with shown(console) as report:
        from idm_env.prediction.files import predict_files

        _work_begins()
        with job.running(report) as run:
            result = predict_files(scenarios, job.out, **run)
    names = {"minADE_8s": "minADE (m)", "minFDE_8s": "minFDE (m)", "miss_rate_8s": "miss rate", "mAP_8s": "mAP"}
    rows = [{"method": r["method"], **{title: r[key] for key, title in names.items()}} for r in result["methods"]]
    answers.show(f"8 s ahead, {result['agents_with_known_future']} agents", rows)
    answers.finished(job.out, result["account"])


@app.command()
def network(
    *,
    net: Path,
    routes: list[Path],
    out: Path = options.OUT,
    seconds: Annotated[float | None, options.Limits(1.0, 1e6, "s")] = None,
    seed: options.Seed = 0,
    resume: bool = False,
) -> None:
    """Simulate traffic on a network of SUMO: travel times, throughput, queues, a map of speeds and an animation.

    Writes report.html, map.png, animation.gif, and links.csv, trips.csv and over_time.csv.

    Args:
        net: A network: .net.xml of netconvert or netgenerate, with internal links.
        routes: Demand: .rou.xml files of vehicles, trips, flows and vTypes.
        seconds: Length of the run (s); default: until all have arrived, or an hour after the last departure.
        resume: Go on where an interrupted run stopped.
    """
    with shown(console) as report:
        from idm_env.fitting.network_job import simulate_network

        _work_begins()
        result = simulate_network(net, routes, out, seconds=seconds, seed=int(seed), resume=resume, on_progress=report)
    console.print(result["sentence"], soft_wrap=True, highlight=False)
    answers.finished(out, result["account"])


@app.command()
def effects(model: Annotated[Path | None, options.POSITIONAL] = None, cite: bool = False, trust: bool = False) -> None:
    """List the catalogue of effects, or the effects of a model, with their parameters or their publications.

    Args:
        model: A model.yaml: only the effects in it.
        cite: Print the publications that they are taken from.
    """
    from idm_env.effects import ALL
    from idm_env.parameters import table

    if model is not None:
        from idm_env.model_file import load_model

        chosen = {effect.name: effect for effect in load_model(model).effects}
    else:
        chosen = {name: cls() for name, cls in ALL.items()}
    if cite:
        for line in answers.citations({name: type(effect) for name, effect in chosen.items()}):
            print(line)
        return
    rows = []
    columns = ("parameter", "symbol", "unit", "default", "null")
    for name, effect in chosen.items():
        summary = (type(effect).__doc__ or "").strip().splitlines()[0]
        for row in table([effect]) or [{"parameter": name, "symbol": "", "unit": "", "default": "", "null": ""}]:
            keep = {k: "" if row[k] is None else str(row[k]) for k in columns}
            rows.append({**keep, "what": summary})
            summary = ""
    answers.show("Effects", rows)


@app.command()
def doctor() -> None:
    """Say what works on this machine and what does not, with the cure. Ends with code 1 if something is broken."""
    from idm_env.cli.doctor import findings

    results = findings()
    answers.show("This machine", [{"what": f.what, "state": f.state, "found": f.told, "cure": f.cure} for f in results])
    if any(finding.state == "broken" for finding in results):
        raise typer.Exit(1)


def _number(option: str, text: str, wrong: str) -> float:
    try:
        return validation.finite(option, float(text))
    except ValueError:
        raise ValueError(f"{option} = {validation.shown(text)} is {wrong}.") from None


# Each command takes a file of the one before, in the help and on the site.
for _command in app.registered_commands:
    assert _command.callback is not None
    _command.cls, _command.callback = _Refusing, options.spread(_command.callback)


def run() -> None:
    """Run the command line: bad input ends with one line and exit code 1, Ctrl-C with 130."""
    try:
        for option, mark, value in (word.partition("=") for word in sys.argv[1:]):
            if not (value if mark and option.startswith("--") else option + mark + value).strip():
                raise ValueError(f"{option if mark else 'a value'} = '' is empty, as an unset variable is. Give one.")
        code = app(standalone_mode=False)  # an exit code where typer has dealt with the end itself
    except Exception as error:
        # A library may turn an interruption into an error of another kind; typer makes EOFError an Abort.
        cause = error.__cause__ if isinstance(error, typer.Abort) else error
        if _stopped or not isinstance(cause, Exception):
            _interrupted()
        clear = isinstance(cause, (ValueError, ImportError, OSError, EOFError))
        if clear or storage.lacks_memory(cause) or storage.full(cause):
            _failed(cause)
        if not hasattr(error, "show"):
            raise
        names = getattr(getattr(error, "param", None), "opts", [])
        pairs = (word.partition("=") for word in [*sys.argv, ""])
        for value in (value if mark else next(pairs)[0] for name, mark, value in pairs if name in names):
            _failed(ValueError(f"{names[0]} = {validation.shown(value)}: {error.message}"), 2)  # type: ignore[attr-defined]
        error.show()  # another usage error: typer's own message, with the usage line
        sys.exit(getattr(error, "exit_code", 2))
    except KeyboardInterrupt:
        _interrupted()
    except BaseException as error:  # nothing of ours, unless a shell completes a command line
        if "_IDM_ENV_COMPLETE" in os.environ or {"--show-completion", "--install-completion"} & set(sys.argv):
            raise
        if isinstance(error.__context__, BrokenPipeError):
            raise  # rich and click end so where nobody reads on, as of "… | head"
        words = f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")
        _failed(ValueError(f"the command was ended from within ({words}), as by a file of effects. Mend that file."))
    if code == 130:
        _interrupted()
    sys.exit(code if isinstance(code, int) else 0)


def _failed(error: Exception, code: int = 1) -> NoReturn:
    """End with one line that names the error, never longer than a terminal can take."""
    reason = storage.full(error) or str(error) or type(error).__name__
    if storage.lacks_memory(error):
        reason = "this needs more memory than there is. Take fewer vehicles, runs or draws at a time, or free memory."
    text = " ".join(" ".join([reason, *getattr(error, "__notes__", ())]).split())
    print(f"error: {text if len(text) <= 1000 else text[:1000] + ' …'}", file=sys.stderr)
    sys.exit(code)


def _interrupted() -> NoReturn:
    """End after Ctrl-C; only some commands are long enough to go on with."""
    commands = {c.name or c.callback.__name__: c.callback for c in app.registered_commands if c.callback}
    command = commands.get(sys.argv[1]) if len(sys.argv) > 1 else None
    resumable = command is not None and "resume" in inspect.signature(command).parameters
    advice = ": what is done was kept. Run the same command with --resume to go on." if resumable else "."
    print(f"interrupted{advice}", file=sys.stderr)
    sys.exit(130)
