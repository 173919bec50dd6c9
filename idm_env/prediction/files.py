"""Scenario files in, predictions with metrics, pictures and a report out."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from idm_env.data import DataError
from idm_env.data.errors import repaired
from idm_env.data.scenario import Scenario
from idm_env.data.womd import count, scenarios
from idm_env.jobs import storage
from idm_env.jobs.executor import Executor, Serial
from idm_env.jobs.progress import OnProgress, silent
from idm_env.jobs.shards import Parts
from idm_env.prediction import report as written
from idm_env.prediction.drivers import NAMES
from idm_env.prediction.metrics import Case, Score, intervals, score, shape_of, summary
from idm_env.prediction.pictures import scene_picture
from idm_env.prediction.predict import METHODS, Prediction
from idm_env.prediction.scene import MapScene
from idm_env.reports import page

OURS = "drivers on routes"
OUTPUT = ("predictions.parquet", "parameters.parquet", "report.json", "report.html")
MOST_PICTURES = 24
SCHEMA: dict[str, Any] = {"scenario_id": pl.String, "agent_id": pl.Int64, "kind": pl.String, "source": pl.String}
SCHEMA |= {"future": pl.Int32, **dict.fromkeys(("confidence", "time_s", "x_m", "y_m"), pl.Float64)}
PARAMETERS: dict[str, Any] = {"scenario_id": pl.String, "agent_id": pl.Int64, "source": pl.String}
PARAMETERS |= {f"{name}{end}": pl.Float64 for name in NAMES for end in ("", "_deviation")}


def predict_files(
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    resume: bool = False,
    executor: Executor | None = None,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Predict the agents of scenario files (JSON or TFRecord) and return the report, also written to ``out``.

    Writes ``predictions.parquet`` (one row per future and step), ``parameters.parquet`` (mean and deviation of each
    driver's five), ``report.json`` and ``report.html`` with the benchmark's metrics where the future is known, over
    all agents, per scene and per kind, against the single futures of ``METHODS``. A file or an agent that cannot be
    used is left out and counted; the others are done. ``resume`` goes on after the last finished file. Files are done
    by ``executor`` (None: here), on which no prediction depends.

    Raises:
        DataError: If no file holds a scenario that can be used, or ``resume`` finds a run on other files or settings.
    """
    files = [Path(path) for path in paths]
    with storage.results(out, OUTPUT, files) as folder:
        return _predict_files(files, folder.absolute(), resume, executor or Serial(), on_progress or silent)


def _predict_files(
    files: Sequence[Path], out: Path, resume: bool, executor: Executor, progress: OnProgress
) -> dict[str, Any]:
    parts = Parts(out / storage.UNFINISHED / "predict", _fingerprint(files), resume)
    progress("counting", 0, 0, "scenarios")
    counts = [count(path) for path in files]
    everything = sum(counts)
    numbers = [number for number in range(len(files)) if not parts.done(number)]
    before_each = [sum(counts[:number]) for number in range(len(files))]
    jobs = [_Job(parts, n, files[n].absolute(), before_each[n], everything) for n in numbers]
    before = everything - sum(counts[job.number] for job in jobs)
    if before:
        progress("predict", before, everything, "")
    for index, _ in executor.map(_predict_file, jobs, progress):
        before += counts[jobs[index].number]
        progress("predict", before, everything, jobs[index].path.name)
    progress("writing", 0, 0, "the report")
    report, pictures = _report(parts.summaries())
    if not report["scenarios"]:
        left = report["left_out"]
        first = left[0]["reason"] if left else "no file was given"
        if len(left) > 1:
            first = f"{first} And {len(left) - 1} more: {'; '.join(str(each['reason']) for each in left[1:])}"
        parts.remove()
        raise DataError(f"no scenario can be used: {first}")
    parts.join("predictions", out / "predictions.parquet")
    parts.join("parameters", out / "parameters.parquet")
    report = written.write(out, report, pictures)
    parts.remove()
    return report


class _Job(NamedTuple):
    """One file to predict: where its part is kept, and how many scenarios there are before it."""

    parts: Parts
    number: int
    path: Path
    before: int
    everything: int

    def __str__(self) -> str:
        return self.path.name


def _fingerprint(files: Sequence[Path]) -> str:
    """Return a digest of names, sizes and times of the files, as they are now."""
    stats = [(p.name, p.stat().st_size, p.stat().st_mtime_ns) if p.exists() else p.name for p in files]
    return storage.fingerprint(stats, True)


def _predict_file(job: _Job, progress: OnProgress) -> None:
    """Predict one file's scenarios and write its part, which also says where pictures are drawn."""
    left_out: list[dict[str, str]] = []
    notes: list[dict[str, str]] = []
    scores: list[dict[str, Any]] = []
    tables: list[pl.DataFrame] = []
    rows: list[dict[str, Any]] = []
    pictures: list[page.Block] = []
    scenario_count = 0
    for scenario in _readable(job.path, left_out):
        progress("predict", job.before + scenario_count, job.everything, job.path.name)
        scenario_count += 1
        scene = MapScene(scenario)
        notes += [{"scenario": scenario.id, "note": note} for note in _notes(scenario)]
        for index in scenario.to_predict:
            if (done := _agent(scene, index, left_out)) is None:
                continue
            ours = done[OURS]
            tables.append(_rows(scenario, ours))
            rows.append(_parameters(scenario, ours))
            cases = {name: case_of(scenario, prediction) for name, prediction in done.items()}
            if cases[OURS].valid.any():
                by_method = {name: asdict(score(case)) for name, case in cases.items()}
                scores.append({"scene": scenario.id, "methods": by_method})
            if len(pictures) < MOST_PICTURES:
                pictures.append(page.picture(*scene_picture(scenario, ours)))
    job.parts.write(job.number, "predictions", pl.concat(tables or [pl.DataFrame(schema=SCHEMA)]))
    job.parts.write(job.number, "parameters", pl.DataFrame(rows, schema=PARAMETERS))
    counts = {"scenarios": scenario_count, "agents": len(tables), "scores": scores, "left_out": left_out}
    job.parts.finish(job.number, {**counts, "notes": notes, "pictures": pictures})


def _readable(path: str | Path, left_out: list[dict[str, str]]) -> Iterator[Scenario]:
    """Yield the scenarios of a file up to where it cannot be read, and count that."""
    try:
        yield from scenarios(path)
    except DataError as error:
        left_out.append({"what": str(path), "reason": str(error), "file": Path(path).name})


def _notes(scenario: Scenario) -> list[str]:
    notes = list(scenario.notes)
    if not scenario.lanes:
        notes.append("the scene has no lanes: everybody is predicted by the fallback")
    if not scenario.to_predict:
        notes.append("no agent is to be predicted")
    return notes


def _agent(scene: MapScene, index: int, left_out: list[dict[str, str]]) -> dict[str, Prediction] | None:
    """Predict one agent by every method; None, and counted, where it cannot be."""
    try:
        return {name: method(scene, index) for name, method in METHODS.items()}
    except ValueError as error:
        left_out.append({"what": f"{scene.scenario.id}, track {index}", "reason": str(error)})
        return None


def case_of(scenario: Scenario, prediction: Prediction) -> Case:
    """Return a prediction with the truth of the scenario; no truth is valid where the future is not known."""
    agent, now = scenario.agents[prediction.agent], scenario.present
    steps = prediction.futures.shape[1]
    ahead = min(steps, len(agent.valid) - now - 1)
    later = slice(now + 1, now + 1 + ahead)
    truth, heading, valid = np.zeros((steps, 2)), np.zeros(steps), np.zeros(steps, bool)
    truth[:ahead], heading[:ahead], valid[:ahead] = agent.position[later], agent.heading[later], agent.valid[later]
    speed = np.hypot(*agent.velocity[now:].T)
    shape = shape_of(agent.position[now:], agent.heading[now:], speed, agent.valid[now:])
    return Case(prediction.futures, prediction.confidence, truth, heading, valid, float(speed[0]), shape, agent.kind)


def _rows(scenario: Scenario, prediction: Prediction) -> pl.DataFrame:
    count, steps = prediction.futures.shape[:2]
    agent = scenario.agents[prediction.agent]
    time = 0.1 * np.arange(1, steps + 1)
    names = {"scenario_id": scenario.id, "agent_id": agent.id, "kind": agent.kind, "source": prediction.source}
    columns: dict[str, Any] = {name: [value] * (count * steps) for name, value in names.items()}
    columns |= {"future": np.repeat(np.arange(count), steps), "confidence": np.repeat(prediction.confidence, steps)}
    columns |= {"time_s": np.tile(time, count), "x_m": prediction.futures[..., 0].ravel()}
    return pl.DataFrame(columns | {"y_m": prediction.futures[..., 1].ravel()}, schema=SCHEMA)


def _parameters(scenario: Scenario, prediction: Prediction) -> dict[str, Any]:
    agent = scenario.agents[prediction.agent]
    row: dict[str, Any] = {"scenario_id": scenario.id, "agent_id": agent.id, "source": prediction.source}
    for name, (mean, deviation) in prediction.parameters.items():
        row |= {name: mean, f"{name}_deviation": deviation}
    return row


def _report(parts: Sequence[dict[str, Any]]) -> tuple[dict[str, Any], list[page.Block]]:
    """Return the report of all parts, and the pictures."""
    scored = [item for part in parts for item in part["scores"]]
    scores = [(item["scene"], {name: Score(**x) for name, x in item["methods"].items()}) for item in scored]
    names = list(scores[0][1]) if scores else [OURS]

    def rows(scene: str | None = None, kind: str | None = None) -> list[dict[str, Any]]:
        chosen = [item for where, item in scores if scene in (None, where) and kind in (None, item[OURS].kind)]
        return [{"method": name, **summary([item[name] for item in chosen])} for name in names]

    def with_intervals() -> list[dict[str, Any]]:
        scenes = [where for where, _ in scores]
        between = {name: intervals([item[name] for _, item in scores], scenes) for name in names}
        return [{**row, "intervals": between[row["method"]]} for row in rows()]

    left_out = [item for part in parts for item in part["left_out"]]
    bad = [item["file"] for item in left_out if "file" in item]
    pictures = [page.Block(**item) for part in parts for item in part["pictures"]]
    return {
        "scenarios": sum(part["scenarios"] for part in parts),
        "agents": sum(part["agents"] for part in parts),
        "agents_with_known_future": len(scores),
        "methods": with_intervals(),
        "scenes": {name: rows(scene=name) for name in sorted({where for where, _ in scores})},
        "kinds": {kind: rows(kind=kind) for kind in sorted({item[OURS].kind for _, item in scores})},
        "left_out": left_out,
        "account": page.account((), repaired("agents", len(left_out) - len(bad), ""), bad),
        "notes": [item for part in parts for item in part["notes"]],
    }, pictures[:MOST_PICTURES]
