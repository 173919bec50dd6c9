"""The page for people: what is missing, how sure that is, and everything that was tried."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from idm_env import report as pages
from idm_env.discovery import pictures
from idm_env.discovery.decide import ALPHA, LEAST_GAIN, LEAST_SHARE
from idm_env.discovery.discover import Discovery
from idm_env.report import Block

ERRORS = {
    "gap_rmse_m": "gap RMSE, free simulation, pooled (m)",
    "gap_rmse_median_driver_m": "gap RMSE, median driver (m)",
    "horizon_rmse_m": "gap RMSE 5 s ahead (m)",
    "speed_rmse_mps": "speed RMSE (m/s)",
}
DATA = {
    "rows": "rows",
    "runs": "runs",
    "drivers": "drivers (groups of parameters)",
    "vehicle_seconds": "vehicle seconds",
    "windows": "5 s windows that were fitted",
    "runs_to_choose_on": "runs to choose on",
    "smallest_p_value": "smallest possible p-value",
    "gap_noise_m": "white noise of the gap (m)",
    "residual_autocorrelation": "autocorrelation of the whitened residual",
    "share_following": "share of time following",
    "share_approaching": "share of time approaching",
    "share_free": "share of time free",
    "share_standing": "share of time standing",
    "lap_m": "lap (m)",
}


def number(x: object, digits: int = 3) -> str:
    """Return a number with so many significant digits, a dash for what is not there."""
    if x is None:
        return "–"
    return f"{x:.{digits}g}" if isinstance(x, float) else str(x)


def percent(x: float | None, digits: int = 0) -> str:
    """Return a share in percent."""
    return "–" if x is None else f"{100 * x:.{digits}f} %"


def _between(low: float | None, high: float | None) -> str:
    return "–" if low is None or high is None else f"{number(low)} … {number(high)}"


def blocks(d: Discovery) -> Iterator[Block]:
    """Return the pieces of the page."""
    r = d.report
    yield pages.note(
        f"{r['data']['source']} · {r['data']['drivers']} drivers in {r['data']['runs']} runs · "
        f"{len(r['error']['held_out_runs'])} runs kept for the final check · seed {r['seed']}"
    )
    yield pages.lead(r["sentence"])
    yield from _errors(r)
    yield from _added(r)
    yield from _moved(r)
    for title, figure in pictures.all_of(d):
        yield pages.heading(title)
        yield figure
    yield from _data(r)
    yield from _tried(r)
    yield pages.note(" · ".join(f"{k} {v}" for k, v in r["versions"].items()))


def _errors(r: dict[str, Any]) -> Iterator[Block]:
    yield pages.heading("Error on runs that neither fitted nor chose anything")
    before, after, floor = (r["error"][k] for k in ("before", "after", "floor"))
    if before is None:
        yield pages.text("No run could be kept for a final check.")
        return
    yield pages.table(
        [
            {
                "": text,
                "before": number(before[key]),
                "after": number(after[key]),
                "after / before": number(after[key] / before[key]) if before[key] and after[key] else "–",
                "noise of measurement": number(floor[key]),
            }
            for key, text in ERRORS.items()
        ]
    )
    yield pages.note(
        "Every driver is simulated alone behind its measured leader. Before: the Intelligent Driver Model; after: with "
        "what was added below; both calibrated the same way. Held-out runs: "
        + ", ".join(pages.shortened(r["error"]["held_out_runs"], 20))
    )
    partial = r["partial"]
    if partial:
        values = ", ".join(f"{k} {number(v)}" for k, v in partial["parameters"].items())
        moves = ", ".join(
            f"{ERRORS[k]}: {number(before[k])} → {number(partial['after'][k])}"
            for k in ("gap_rmse_m", "gap_rmse_median_driver_m", "horizon_rmse_m")
        )
        yield pages.note(
            f"Best partial explanation, not added: {partial['effect']} ({values}). {moves}. "
            f"{percent(partial['share_of_drivers_improved'])} of held-out drivers improve."
        )


def _added(r: dict[str, Any]) -> Iterator[Block]:
    if r["found"]:
        yield pages.heading("What was added")
        rows = []
        for f in r["found"]:
            shown = list(f["parameters"].items())
            for i, (name, p) in enumerate(shown if len(shown) <= 6 else shown[:3]):
                unit = "" if p["unit"] == "1" else f" {p['unit']}"
                rows.append({
                    "effect": (f["effect"] or f["label"]) if i == 0 else "",
                    "parameter": name,
                    "estimate": number(p["estimate"]) + unit,
                    "95 % interval": _between(p["low"], p["high"]),
                    "p": number(f["p_value"], 2) if i == 0 else "",
                    "held-out gain": percent(f["held_out_gain"], 1) if i == 0 else "",
                    "explained share": percent(f["explained_share"]) if i == 0 else "",
                })  # fmt: skip
        yield pages.table(rows)
        yield pages.note("Of a curve only the first knots are listed; all are in report.json and in the picture below.")
    if r["known"]:
        yield pages.note(
            "Part of the null (given, or a latency below one step of the data): "
            + "; ".join(
                f"{k['effect']}.{k['parameter']} = {number(k['estimate'])} ({_between(k['low'], k['high'])})"
                for k in r["known"]
            )
        )


def _moved(r: dict[str, Any]) -> Iterator[Block]:
    yield pages.heading("How calibrated parameters moved")
    start = r.get("calibration")
    if start:
        yield pages.note(
            "The search starts from IDM calibrated in free simulation behind the measured leaders, by exact gradients "
            f"through the simulator: {start['episodes']} windows of the fitting runs, mean gap RMSE "
            f"{number(start['gap_rmse_m'])} m, {start['converged']} of {start['groups']} groups converged."
        )
    rows = []
    for p in r["parameters"]:
        row = {"parameter": p["parameter"]}
        for when in ("before", "after"):
            row |= {
                f"{when}: median": number(p[when]["median"]),
                f"{when}: 10 … 90 % of drivers": _between(p[when]["low"], p[when]["high"]),
                f"{when}: standard error": number(p[when]["standard_error"], 2),
            }
        rows.append(row)
    yield pages.table(rows)


def _data(r: dict[str, Any]) -> Iterator[Block]:
    yield pages.heading("The data")
    rows = [{"": text, " ": number(r["data"][key])} for key, text in DATA.items()]
    bounds = ", ".join(f"{k} {n}" for k, n in r["data"]["at_bounds"].items())
    yield pages.table([*rows, {"": "groups with a parameter at its bound", " ": bounds}])
    if r["data"]["repairs"]:
        yield pages.note("Repaired or left out on loading: " + " ".join(x["text"] for x in r["data"]["repairs"]))


def _tried(r: dict[str, Any]) -> Iterator[Block]:
    yield pages.heading("Everything that was tried")
    yield pages.table([
        {
            "candidate": c["effect"],
            "round": str(c["round"]),
            "held-out gain": percent(c["held_out_gain"], 2),
            "95 % interval": "–" if None in c["interval"] else " … ".join(percent(x, 2) for x in c["interval"]),
            "p (whole list)": number(c["p_value"], 2),
            "absorbed": percent(c["absorbed_share"]),
            "parameters": ", ".join(f"{k} {number(v)}" for k, v in c["parameters"].items()),
            " ": c["note"],
        }
        for c in r["candidates"]
    ])  # fmt: skip
    yield pages.heading("How this was decided")
    yield pages.text(
        f"The drivers' own parameters and every candidate are fitted to predictions {number(r['data']['horizon_s'])} s "
        "ahead, all judged by one model of noise (correlated within and between windows, so that drivers' own noise is "
        "not taken for an effect). Every trial of a candidate lets all drivers re-adjust. Its gain is measured on runs "
        "that its parameters have not seen, and tested by sign flips of whole runs with the maximum over the whole "
        f"list (Westfall and Young). It must be significant at {percent(ALPHA)}, gain at least "
        f"{percent(LEAST_GAIN, 1)}, explain at least {percent(LEAST_SHARE)} of what any smooth function of the state "
        "explains, not make free simulation worse, and hold on the runs kept for the end."
    )
