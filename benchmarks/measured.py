"""What discovery says of measured traffic: ZalaZone per car model and pooled, with and without the grade, and the rest.

    python -m benchmarks.measured --data ../shared/data --out measured.jsonl [--only zalazone] [--executor processes]

One line of JSON per case is kept, so that a run goes on where it stopped; at the end the table. The columns grade and
altitude_m are taken out of ZalaZone unless the case says that the grade is known.
"""

from __future__ import annotations

import dataclasses
import os
import time
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402 (threads are set before numpy starts)
import polars as pl  # noqa: E402

from benchmarks import DATA, command, rows_of, table  # noqa: E402
from idm_env.data import load  # noqa: E402
from idm_env.discovery import Discovery, discover  # noqa: E402
from idm_env.jobs.progress import OnProgress, silent  # noqa: E402
from idm_env.jobs.workers import HERE, Workers  # noqa: E402

FEWEST_RUNS = 7


def cases(folder: Path) -> dict[str, dict[str, Any]]:
    """Return all cases: file, conditions, and what discovery is told."""
    zalazone = {"file": "openacc_zalazone.parquet", "where": ["layout=handling"], "place": "track_s_m"}
    table = pl.read_parquet(folder / zalazone["file"]).filter(pl.col("layout") == "handling")
    followers = table.filter(pl.col("leader_id").is_not_null())
    runs = followers.group_by("vehicle_name").agg(pl.col("run_id").n_unique()).sort("vehicle_name")
    models = [name for name, number in runs.rows() if number >= FEWEST_RUNS]
    by_name: dict[str, dict[str, Any]] = {
        "I-80 pairs": {"file": "ngsim_i80_pairs.parquet"},
        "ZalaZone, all": zalazone,
        "ZalaZone, all, grade known": {**zalazone, "known": ("grade",)},
    }
    for name in models:
        part = {**zalazone, "where": [*zalazone["where"], f"vehicle_name={name}"]}
        by_name[f"ZalaZone, {name}"] = part
        by_name[f"ZalaZone, {name}, grade known"] = {**part, "known": ("grade",)}
    by_name["TGSIM"] = {"file": "tgsim_pairs.parquet"}
    by_name["AstaZero, ACC"] = {"file": "openacc_astazero.parquet", "where": ["acc_run=ACC"]}
    by_name["AstaZero, all"] = {"file": "openacc_astazero.parquet"}
    by_name["I-80 lanes"] = {"file": "ngsim_i80_lanes.parquet"}
    return by_name


def run(folder: Path, case: dict[str, Any]) -> Discovery:
    trajectories = load(folder / case["file"])
    if not case.get("known"):
        hidden = [c for c in ("grade", "altitude_m") if c in trajectories.table.columns]
        trajectories = dataclasses.replace(trajectories, table=trajectories.table.drop(hidden))
    return discover(trajectories.where(case.get("where", ())), place=case.get("place"), known=case.get("known", ()))


def timed(part: tuple[str, Path, dict[str, Any]], _: OnProgress = silent) -> dict[str, Any]:
    """Return the row of a case (name, folder of the data, case)."""
    name, folder, case = part
    begin = time.process_time()
    discovery = run(folder, case)
    return row(name, discovery, time.process_time() - begin)


def row(name: str, found: Discovery, cpu_s: float) -> dict[str, Any]:
    report = found.report
    drivers, law = report["error"]["held_out_drivers"], found.judgement.fleet or found.judgement.law
    helps = found.judgement.errors if law is None else law.against
    kinds = report["fleet"] or {"kinds": []}
    by_kind = ", ".join(f"{kind['title']} of {len(kind['drivers'])}" for kind in kinds["kinds"])
    return {
        "case": name,
        "drivers": report["data"]["drivers"],
        "runs_to_choose_on": report["data"]["runs_to_choose_on"],
        "verdict": report["verdict"],
        "found": [
            {
                "name": f["effect"] or f["label"],
                "equivalent": f["equivalent"],
                "p": f["p_value"],
                "gain": f["held_out_gain"],
                "parameters": dict(list(f["parameters"].items())[:3]) if len(f["parameters"]) < 6 else "curve",
            }
            for f in report["found"]
        ],
        "known": report["known"],
        "why": report["reason"],
        "partial": report["partial"],
        "law": by_kind or (None if law is None else law.title),
        "helps": {key: (c.outcome.value, c.ratio, c.low, c.high) for key, c in helps.items()},
        "ceilings": report["ceilings"],
        "before": report["error"]["before"],
        "after": report["error"]["after"],
        "held_out_drivers": len(drivers),
        "improved": float(np.mean([d["after_m"] < d["before_m"] for d in drivers])) if report["found"] else None,
        "best_places": [
            (c["effect"], c["p_value"], c["held_out_gain"])
            for c in report["candidates"]
            if c["round"] == 1 and ("position" in c["effect"] or c["effect"] in ("grade", "speed_zone"))
        ][:2],
        "cpu_s": cpu_s,
    }


def said(r: dict[str, Any]) -> str:
    """Return verdict, what was found or came nearest, and how a known grade acts."""
    names = []
    for f in r["found"]:
        first = "" if f["parameters"] == "curve" else next(iter(f["parameters"].values()))
        number = f" {first['estimate']:.2f} ({first['low']:.2f} … {first['high']:.2f})" if first else ""
        names.append(" or ".join([f["name"] + number, *f["equivalent"]]))
    words = r["verdict"].replace("_", " ") + (f" ({r['why']})" if r["why"] else "")
    words += f"; {r['law']}" if r.get("law") else ""
    words += f": {', '.join(names)}" if names else f"; nearest {r['partial']['effect']}" if r["partial"] else ""
    for k in r["known"]:
        if k["effect"] == "grade":
            gain, low, high = (-9.81 * k[name] for name in ("estimate", "high", "low"))
            words += f"; grade acts by {gain:.1f} ({low:.1f} … {high:.1f}) m/s²"
    return words


def shown(rows: list[dict[str, Any]]) -> str:
    """Return all cases: what is said, what IDM leaves, after / before with intervals, and ceilings."""
    head = (
        "case", "drivers", "verdict", "IDM: gap m pooled, median driver; 5 s ahead m; speed m/s",
        "after / before: gap", "gap 5 s ahead", "speed", "repeats", "refitted", "CPU s",
    )  # fmt: skip
    lines = []
    for r in rows:
        b, c = r["before"], r["ceilings"] or {}
        errors = "–"
        if b:
            errors = f"{b['gap_rmse_m']:.2f}, {b['gap_rmse_median_driver_m']:.2f}; {b['horizon_rmse_m']:.2f}"
            errors += f"; {b['speed_rmse_mps']:.2f}"
        ratios = ["–"] * 3
        for i, key in enumerate(("gap_rmse_m", "horizon_rmse_m", "speed_rmse_mps")):
            if key in r["helps"]:
                verdict, ratio, low, high = r["helps"][key]
                ratios[i] = f"{ratio:.2f} ({low:.2f} … {high:.2f}), {verdict}"
        repeats, refitted = c.get("repeats_share"), c.get("refitted_gap_rmse_m")
        ends = ["–" if repeats is None else f"{100 * repeats:.0f} %", "–" if refitted is None else f"{refitted:.2f} m"]
        lines.append([r["case"], str(r["drivers"]), said(r), errors, *ratios, *ends, f"{r['cpu_s']:.0f}"])
    return table(head, lines)


def main(
    data: Path = DATA, out: Path = Path("measured.jsonl"),
    only: str = "", place: Workers = HERE,
) -> None:  # fmt: skip
    """Do the cases that are not done yet, and print the table.

    Args:
        data: Folder of the measured files.
        out: File of rows; those that are there are not done again.
        only: Part of the names of the cases to run.
        place: Where cases run.
    """
    parts = {name: (name, data, case) for name, case in cases(data).items() if only in name}
    print(shown(rows_of(timed, parts, out, place, "case", lambda row: row["verdict"])))


if __name__ == "__main__":
    command(main)
