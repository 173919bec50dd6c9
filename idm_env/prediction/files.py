"""Scenario files in, predictions with metrics, pictures and a report out."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from jinja2 import Environment, PackageLoader, select_autoescape

from idm_env.data import DataError
from idm_env.data.womd import Scenario, scenarios
from idm_env.prediction.metrics import HORIZONS, Case, shape_of, summary
from idm_env.prediction.pictures import scene_picture
from idm_env.prediction.predict import METHODS, Prediction
from idm_env.prediction.scene import Scene
from idm_env.trajectories.report import embedded, finite, shown_number

OnProgress = Callable[[int, int], None]
"""Called with files done and files in all."""
OURS = "drivers on routes"
MOST_PICTURES = 24
SCHEMA = {
    "scenario_id": pl.String, "agent_id": pl.Int64, "kind": pl.String, "source": pl.String, "future": pl.Int32,
    "confidence": pl.Float64, "time_s": pl.Float64, "x_m": pl.Float64, "y_m": pl.Float64,
}  # fmt: skip


def predict_files(
    paths: Sequence[str | Path], out: str | Path, *, baselines: bool = True, on_progress: OnProgress | None = None
) -> dict[str, Any]:
    """Predict the agents of scenario files (JSON or TFRecord) and return the report, also written to ``out``.

    Writes ``predictions.parquet`` (one row per future and step), ``parameters.parquet`` (mean and deviation of each
    driver's five), ``report.json`` and ``report.html`` with the benchmark's metrics where the future is known, over
    all agents, per scene and per kind, against the single futures of ``METHODS``. A file or an agent that cannot be
    used is left out and counted; the others are done.

    Raises:
        DataError: If no file holds a scenario that can be used.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    left_out: list[dict[str, str]] = []
    notes: list[dict[str, str]] = []
    cases: dict[str, list[tuple[str, Case]]] = {name: [] for name in METHODS if baselines or name == OURS}
    tables: list[pl.DataFrame] = []
    parameters: list[dict[str, Any]] = []
    pictures: list[str] = []
    found = 0
    for number, path in enumerate(paths):
        for scenario in _readable(path, left_out):
            found += 1
            scene = Scene(scenario)
            notes += [{"scenario": scenario.id, "note": note} for note in _notes(scenario)]
            for index in scenario.to_predict:
                done = _agent(scene, index, cases, left_out)
                if done is not None:
                    tables.append(_rows(scenario, done))
                    parameters.append(_parameters(scenario, done))
                    if len(pictures) < MOST_PICTURES:
                        pictures.append(embedded(scene_picture(scenario, done, f"{scenario.id}: ")))
        if on_progress is not None:
            on_progress(number + 1, len(paths))
    if not found:
        first = left_out[0]["reason"] if left_out else "no file was given"
        raise DataError(f"no scenario can be used: {first}")
    pl.concat(tables or [pl.DataFrame(schema=SCHEMA)]).write_parquet(out / "predictions.parquet")
    pl.DataFrame(parameters, infer_schema_length=None).write_parquet(out / "parameters.parquet")
    report = _report(found, len(tables), cases, left_out, notes)
    (out / "report.json").write_text(json.dumps(finite(report), indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    environment = Environment(loader=PackageLoader("idm_env.prediction", "."), autoescape=select_autoescape())
    page = environment.get_template("report.html").render(
        report=report, horizons=HORIZONS, pictures=pictures, number=shown_number
    )
    (out / "report.html").write_text(page)
    return report


def _readable(path: str | Path, left_out: list[dict[str, str]]) -> Iterator[Scenario]:
    """Yield the scenarios of a file up to where it cannot be read, and count that."""
    try:
        yield from scenarios(path)
    except DataError as error:
        left_out.append({"what": str(path), "reason": str(error)})


def _notes(scenario: Scenario) -> list[str]:
    notes = list(scenario.notes)
    if not scenario.lanes:
        notes.append("the scene has no lanes: everybody is predicted by the fallback")
    if not scenario.to_predict:
        notes.append("no agent is to be predicted")
    return notes


def _agent(
    scene: Scene, index: int, cases: dict[str, list[tuple[str, Case]]], left_out: list[dict[str, str]]
) -> Prediction | None:
    """Predict one agent by every method and keep the cases; None, and counted, where it cannot be."""
    scenario = scene.scenario
    predictions = {}
    try:
        for name in cases:
            predictions[name] = METHODS[name](scene, index)
    except ValueError as error:
        left_out.append({"what": f"{scenario.id}, track {index}", "reason": str(error)})
        return None
    for name, prediction in predictions.items():
        case = case_of(scenario, prediction)
        if case.valid.any():
            cases[name].append((scenario.id, case))
    return predictions[OURS]


def case_of(scenario: Scenario, prediction: Prediction) -> Case:
    """Return a prediction with the truth of the scenario; no truth is valid where the future is not known."""
    agent, now = scenario.agents[prediction.agent], scenario.present
    steps = prediction.futures.shape[1]
    known = min(steps, len(agent.valid) - now - 1)
    later = slice(now + 1, now + 1 + known)
    truth, heading, valid = np.zeros((steps, 2)), np.zeros(steps), np.zeros(steps, bool)
    truth[:known], heading[:known], valid[:known] = agent.position[later], agent.heading[later], agent.valid[later]
    speed = np.hypot(*agent.velocity[now:].T)
    shape = shape_of(agent.position[now:], agent.heading[now:], speed, agent.valid[now:])
    return Case(
        prediction.futures, prediction.confidence, truth, heading, valid, float(speed[0]), shape, agent.kind
    )  # fmt: skip


def _rows(scenario: Scenario, prediction: Prediction) -> pl.DataFrame:
    count, steps = prediction.futures.shape[:2]
    agent = scenario.agents[prediction.agent]
    time = 0.1 * np.arange(1, steps + 1)
    columns: dict[str, Any] = {
        "scenario_id": [scenario.id] * (count * steps), "agent_id": np.full(count * steps, agent.id),
        "kind": [agent.kind] * (count * steps), "source": [prediction.source] * (count * steps),
        "future": np.repeat(np.arange(count), steps), "confidence": np.repeat(prediction.confidence, steps),
        "time_s": np.tile(time, count), "x_m": prediction.futures[..., 0].ravel(),
        "y_m": prediction.futures[..., 1].ravel(),
    }  # fmt: skip
    return pl.DataFrame(columns, schema=SCHEMA)


def _parameters(scenario: Scenario, prediction: Prediction) -> dict[str, Any]:
    agent = scenario.agents[prediction.agent]
    row: dict[str, Any] = {"scenario_id": scenario.id, "agent_id": agent.id, "source": prediction.source}
    for name, (mean, deviation) in prediction.parameters.items():
        row |= {name: mean, f"{name}_deviation": deviation}
    return row


def _report(
    found: int,
    predicted: int,
    cases: dict[str, list[tuple[str, Case]]],
    left_out: list[dict[str, str]],
    notes: list[dict[str, str]],
) -> dict[str, Any]:
    def rows(scene: str | None = None, kind: str | None = None) -> list[dict[str, Any]]:
        chosen = {
            name: [case for where, case in items if scene in (None, where) and kind in (None, case.kind)]
            for name, items in cases.items()
        }
        return [{"method": name, **summary(items)} for name, items in chosen.items()]

    ours = cases[OURS]
    return {
        "scenarios": found,
        "agents": predicted,
        "agents_with_known_future": len(ours),
        "methods": rows(),
        "scenes": {name: rows(scene=name) for name in sorted({s for s, _ in ours})},
        "kinds": {kind: rows(kind=kind) for kind in sorted({c.kind for _, c in ours})},
        "left_out": left_out,
        "notes": notes,
    }
