"""The page for people: what is missing, what it does for predictions, how sure that is, and everything tried.

Its words stand in ``report.html``.
"""

import math
from pathlib import Path
from typing import Any

from idm_env.discovery import pictures, words
from idm_env.discovery.compare import percent as change
from idm_env.discovery.finish import Discovery
from idm_env.discovery.result import Change, Result
from idm_env.discovery.score import ALPHA, CLOSED_LOOP_SHARE
from idm_env.discovery.selection import LEAST_SHARE, NAMED_GAIN
from idm_env.discovery.units import ENOUGH_RUNS, MANY_RUNS
from idm_env.discovery.verdict import HOLDS, Reason, Verdict
from idm_env.reports import page as pages

TITLES = {
    Verdict.NAMED: "What {law} lacks here has a name",
    Verdict.ONE_OF: "What {law} lacks here is one of several effects",
    Verdict.SHAPE: "What {law} lacks here has a shape, but no name",
    Verdict.LOCATED: "What {law} lacks here has a place, but no name",
    Verdict.UNEXPLAINED: "{law} lacks something here that nothing tried explains",
    Verdict.UNDECIDED: "What {law} leaves here is drivers' noise, or an effect of a form not tried",
    Verdict.NONE: "Nothing was found that {law} lacks here",
    Verdict.CANNOT_TELL: "These data cannot tell what {law} lacks",
}


def write(path: Path, d: Discovery) -> None:
    """Write the page."""
    r, judgement, law = d.result, d.judgement, d.null.model.catalogue.base.title
    before = r.error.before
    filters: dict[str, Any] = {"number": number, "percent": percent, "change": change}
    filters |= {"ends": _ends, "plain": words.plain, "amount": words.amount}
    filters["shares"] = lambda parts: " · ".join(f"{name} {percent(share)}" for name, share in parts.items())
    rules = {"enough_runs": ENOUGH_RUNS, "many_runs": MANY_RUNS, "free_share": f"{CLOSED_LOOP_SHARE:.0%}"}
    rules |= {"level": percent(ALPHA), "least_gain": percent(NAMED_GAIN, 1), "least_share": percent(LEAST_SHARE)}
    names: dict[str, Any] = {"r": r, "d": d, "law": law, "rules": rules | {"holds": f"{HOLDS - 1.0:.0%}"}}
    names |= {"titles": judgement.titles, "cards": cards(r, law) + words.rolled(r.rolled)}
    names |= {"draw": pictures, "picture": pages.picture}
    names |= {"error_names": words.ERRORS, "most": words.MANY, "shortened": pages.shortened}
    names |= {"rows": words.error_rows(d.report, list(judgement.results)), "weight": words.weight(r.prior)}
    names["declared"] = {p.name: p for p in d.null.model.catalogue.own}
    floor = r.error.floor["gap_rmse_m"]
    names["ceilings"] = "" if before is None else words.ceilings(r.ceilings, before["gap_rmse_m"], floor)
    template = Path(__file__).with_name("report.html")
    pages.write_page(path, _title(r).format(law=law), template=template, filters=filters, **names)


def _title(r: Result) -> str:
    if r.fleet is not None:
        return "Drivers follow several laws here"
    if _better(r) is None:
        return TITLES[Verdict(r.verdict)]
    own = any(base.own for base in r.bases if base.title == r.models["model.yaml"])
    return "Every driver differs from {law} here" if own else "Another law predicts better than {law} here"


def _better(r: Result) -> dict[str, Change] | None:
    """Return how the errors of what goes before every effect compare: of laws by kind of driver, or of a better law."""
    if r.fleet is not None:
        return r.fleet.against
    if r.reason != Reason.LAW.value:
        return None
    return next((base.against for base in r.bases if base.title == r.models["model.yaml"]), None)


def number(x: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits, a dash for what is not there."""
    if x is None or not math.isfinite(x):
        return "–"
    return words.number(x, digits) if isinstance(x, float) else str(x)


def percent(x: float | None, digits: int = 0) -> str:
    """Return a share in percent."""
    return "–" if x is None or not math.isfinite(x) else f"{100 * x:.{digits}f} %".replace("-", "−")


def _ends(interval: tuple[float | None, float | None]) -> str:
    return "–" if None in interval else " … ".join(percent(x, 2) for x in interval)


def _later(r: Result) -> list[tuple[str, str, str]]:
    """Return a card of predictions 10 s ahead, where what was chosen makes them worse: it was not chosen by them."""
    rungs = [] if r.ladder is None else list(r.ladder.ten_s_m.values())
    ratio = rungs[2] / rungs[1] if len(rungs) > 2 else 1.0
    return [("Gap 10 s ahead", "worse", change(ratio))] if ratio > 1.0 else []


def cards(r: Result, law: str) -> list[tuple[str, str, str]]:
    """Return the first screen's cards: how each error changed or, where nothing is compared, what is known instead."""
    if changes := _better(r) or r.helps:
        rows = _later(r)
        for key, c in changes.items():
            size = f"{number(c.before)} → {number(c.after)} {c.unit}, {change(c.ratio)} ({c.interval})"
            rows.append((words.ERRORS[key][0].capitalize(), c.verdict, size))
        return rows
    facts = [("Runs", f"{r.data.runs}, of them {r.data.runs_to_choose_on} for model selection")]
    if r.verdict == Verdict.CANNOT_TELL.value:
        facts.append(("What to do", "record more runs: seven decide, ten are better"))
    if (spot := r.shared) is not None:
        facts.append(("Where", f"run {spot.run}, {spot.begin_s:.0f} to {spot.end_s:.0f} s, {spot.vehicles} followers"))
        facts.append(("How much", f"{number(spot.accel_mps2, 2)} m/s² beside {law}"))
    if (before := r.error.before) is not None:
        gap, noise = number(before["gap_rmse_m"]), number(r.error.floor["gap_rmse_m"])
        size = f"{gap} m on held-out runs; sensor noise alone leaves {noise} m"
        facts.append((f"Gap in free simulation, {law}", size))
    return [(name, "", text) for name, text in facts]
