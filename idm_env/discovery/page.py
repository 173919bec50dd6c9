"""The page for people: what is missing, what it does for predictions, how sure that is, and everything tried."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from idm_env.discovery import pictures, words
from idm_env.discovery.discover import Discovery
from idm_env.discovery.score import ALPHA, FREE_SHARE
from idm_env.discovery.selection import LEAST_GAIN, LEAST_SHARE
from idm_env.discovery.units import ENOUGH_RUNS, MANY_RUNS
from idm_env.discovery.verdict import HOLDS, Verdict
from idm_env.discovery.words import percent as change
from idm_env.reports import page as pages
from idm_env.reports.page import Block

TITLES = {
    Verdict.NAMED: "What IDM lacks here has a name",
    Verdict.ONE_OF: "What IDM lacks here is one of several effects",
    Verdict.SHAPE: "What IDM lacks here has a shape, but no name",
    Verdict.LOCATED: "What IDM lacks here has a place, but no name",
    Verdict.UNEXPLAINED: "IDM lacks something here that nothing tried explains",
    Verdict.NONE: "Nothing was found that IDM lacks here",
    Verdict.CANNOT_TELL: "These data cannot tell what IDM lacks",
}
MEANING_OF_ERRORS = {
    "gap in free simulation": "every follower is simulated alone from its first measured sample on, behind its "
    "measured leader; root mean square of simulated less measured gap over all samples of all followers",
    "the same, median follower": "half of the followers err by less",
    "gap 5 s ahead": "the simulation starts anew on the measured state every 5 s; root mean square of the gap's error "
    "at the end of the 5 s",
    "speed in free simulation": "as the first, of the speed",
    "the driver's own parameters": "in every stretch of time (up to 30 s) those fitted to the stretches beside it, "
    "to every second one of the record; what is scored has never fitted them",
    "noise of measurement": "what the noise in the file alone would leave of a perfect model",
}
DATA = {
    "rows": ("rows", "lines of the file that were used"),
    "runs": ("runs", "recordings that share nothing but the road"),
    "drivers": ("groups of parameters", "drivers, or what --by names, with IDM parameters of their own"),
    "vehicle_seconds": ("vehicle seconds", "time behind a leader, all followers added"),
    "windows": ("5 s windows", "predictions that candidates were fitted to"),
    "runs_to_choose_on": ("runs for model selection", "all but the test set"),
    "smallest_p_value": ("smallest possible p-value", "0.5 to the power of the runs for model selection"),
    "gap_noise_m": ("white noise of the gap (m)", "from third differences: slow drift does not show in it"),
    "residual_autocorrelation": ("autocorrelation of the whitened residual", "0: the model of noise is right"),
    "share_following": ("share of time following", "behind a leader, closing by at most 1 m/s"),
    "share_approaching": ("share of time approaching", "closing by more than 1 m/s"),
    "share_free": ("share of time free", "gap above three seconds"),
    "share_standing": ("share of time standing", "below 0.3 m/s"),
    "lap_m": ("lap (m)", "length after which places repeat"),
}
"""Name and meaning of every figure of the data's card."""


def title(d: Discovery) -> str:
    """Return the headline."""
    told: str = words.of_law(TITLES[d.verdict], d.null.model.catalogue.base.title)
    return told


def number(x: object, digits: int = 3) -> str:
    """Return a number with so many significant digits, a dash for what is not there."""
    if x is None:
        return "–"
    return words.number(x, digits) if isinstance(x, float) else str(x)


def percent(x: float | None, digits: int = 0) -> str:
    """Return a share in percent."""
    return "–" if x is None else f"{100 * x:.{digits}f} %".replace("-", "−")


def _between(low: float | None, high: float | None) -> str:
    return "–" if low is None or high is None else f"{number(low)} … {number(high)}"


def blocks(d: Discovery) -> Iterator[Block]:
    """Return the pieces of the page: what fits on a first screen, then everything else."""
    r = d.report
    law = d.null.model.catalogue.base.title
    yield pages.lead(r["sentence"])
    yield from _lights(r, law)
    yield from _bar(r)
    yield from _first_picture(d)
    yield pages.heading("How sure is that")
    yield pages.bullets(r["details"])
    yield pages.note(
        f"{r['data']['source']} · {r['data']['drivers']} groups of parameters in {r['data']['runs']} runs · "
        f"{len(r['error']['held_out_runs'])} runs in the test set · seed {r['seed']}"
    )
    yield from _errors(d)
    yield from _rungs(r)
    yield from _laws(r)
    yield from _added(r)
    yield from _moved(d)
    for title, figure in pictures.all_of(d):
        yield pages.heading(title)
        yield figure
    yield from _data(r)
    yield from _tried(r)
    yield pages.note(" · ".join(f"{k} {v}" for k, v in r["versions"].items()))


def _lights(r: dict[str, Any], law: str) -> Iterator[Block]:
    """Return the first screen's cards: how each error changed or, where nothing is compared, what is known instead."""
    if not r["helps"]:
        yield pages.lights((name, "", told) for name, told in known_instead(r, law))
        return
    yield pages.lights(
        (
            words.ERRORS[key][0].capitalize(),
            h["verdict"],
            f"{number(h['before'])} → {number(h['after'])} {h['unit']}, {change(h['ratio'])}"
            + ("" if h["high"] is None else f" ({change(h['low'])} to {change(h['high'])})"),
        )
        for key, h in r["helps"].items()
    )


def _bar(r: dict[str, Any]) -> Iterator[Block]:
    """Return the parts of the squared error 5 s ahead as one bar."""
    ladder = r["ladder"]
    if ladder is None:
        return
    parts = ladder["parts"]
    colours = ("#bbbbbb", "#8fb8de", "#7bc47f", "#e39b6f", "#e8e8e8")
    bar = "".join(
        f'<span style="display:inline-block;overflow:hidden;white-space:nowrap;height:1.6em;width:{100 * share:.2f}%;'
        f'background:{colour}" title="{name} {share:.0%}">&nbsp;{name if share > 0.15 else ""}</span>'
        for (name, share), colour in zip(parts.items(), colours, strict=True)
    )
    told = " · ".join(f"{name} {percent(share)}" for name, share in parts.items())
    yield pages.html(f'<div role="img" aria-label="{told}" style="line-height:1.6em">{bar}</div>')
    yield pages.note(f"Squared error of the gap 5 s ahead, every run held out once: {told}.")


def _rungs(r: dict[str, Any]) -> Iterator[Block]:
    """Return the ladder's errors, rung by rung."""
    if (ladder := r["ladder"]) is None:
        return
    yield pages.heading("From one set of parameters to sensors alone")
    columns = {"5 s ahead (m)": "rungs_m", "10 s ahead (m)": "ten_s_m", "free simulation (m)": "free_m",
               "CRPS 5 s ahead (m)": "crps_m"}  # fmt: skip
    rungs = ladder["rungs_m"]
    yield pages.table([{"rung": name} | {c: number(ladder[k].get(name)) for c, k in columns.items()} for name in rungs])
    yield pages.note(
        "Root mean square errors of the gap, and CRPS of normal forecasts as wide as the driver's errors in his other "
        "blocks. Every run is held out once. Drift and smooth functions correct predictions 5 s ahead only."
    )


def known_instead(r: dict[str, Any], law: str) -> list[tuple[str, str]]:
    """Return names and words of the cards of a report in which no second model is compared with the law."""
    cards = [("Runs", f"{r['data']['runs']}, of them {r['data']['runs_to_choose_on']} for model selection")]
    if r["verdict"] == Verdict.CANNOT_TELL.value:
        cards.append(("What to do", "record more runs: seven decide, ten are better"))
    if r["shared"] is not None:
        at = r["shared"]
        cards.append(
            ("Where", f"run {at['run']}, {at['begin_s']:.0f} to {at['end_s']:.0f} s, {at['vehicles']} followers")
        )
        cards.append(("How much", f"{number(at['accel_mps2'], 2)} m/s² beside {law}"))
    before = r["error"]["before"]
    if before is not None:
        floor = r["error"]["floor"]["gap_rmse_m"]
        cards.append((f"Gap in free simulation, {law}", f"{number(before['gap_rmse_m'])} m on the test set; "
                      f"sensor noise alone leaves {number(floor)} m"))  # fmt: skip
    return cards


def _first_picture(d: Discovery) -> Iterator[Block]:
    figure = pictures.first_screen(d)
    if figure is None:
        yield pages.note("Too few runs for a test set.")
        return
    follower = pictures.typical(d)
    assert follower is not None and d.judgement.before is not None
    run, vehicle = d.judgement.before.followers[follower]
    yield pages.picture(
        figure,
        f"The follower of the test set with the median error by {d.judgement.titles[0]}: run {run}, vehicle "
        f"{vehicle}. Below: simulated less measured gap.",
        pictures.first_screen(d, (4.2, 4.6)),
    )


def _errors(d: Discovery) -> Iterator[Block]:
    r, judgement = d.report, d.judgement
    yield pages.heading("Errors on the test set")
    if judgement.before is None:
        yield pages.text("Too few runs for a test set.")
        return
    results = {name: judged.summary() for name, judged, *_ in pictures.named(d)}
    rows = []
    for key, (name, unit) in words.ERRORS.items():
        row = {"error": f"{name} ({unit})"} | {model: number(values[key]) for model, values in results.items()}
        help_of = r["helps"].get(key)
        if r["helps"]:
            row["change"] = change(help_of["ratio"]) if help_of else _change([v[key] for v in results.values()])
            known = help_of is not None and help_of["high"] is not None
            row["95 % interval"] = f"{change(help_of['low'])} … {change(help_of['high'])}" if known else "–"
            row["verdict"] = help_of["verdict"] if help_of else "–"
        rows.append(row | {"noise of measurement": number(r["error"]["floor"].get(key))})
    yield pages.table(rows)
    yield pages.terms(MEANING_OF_ERRORS | ({"interval": r["interval"]} if r["interval"] else {}))
    files = "; ".join(f"{file} is {name}" for file, name in r["models"].items())
    best = " model.yaml predicts best: the smaller geometric mean of the three errors." if r["helps"] else ""
    yield pages.note(
        f"Models: {files}.{best} All are calibrated the same way. Runs of the test set: "
        + ", ".join(pages.shortened(r["error"]["held_out_runs"], 20))
    )
    told = words.ceilings(r["ceilings"], r["error"]["before"]["gap_rmse_m"], r["error"]["floor"]["gap_rmse_m"])
    drift = r["error"]["floor"]["drift_m_per_sqrt_s"]
    if drift > 0.0:
        told += (
            f" The measured gap wanders by {number(drift, 2)} m per √s against integrated speeds: part of the noise."
        )
    yield pages.note(f"What could be explained at all: {told}")
    partial = r["partial"]
    if partial:
        yield pages.note(
            f"{percent(partial['share_of_drivers_improved'])} of the followers of the test set improve with "
            f"{partial['effect']}, which was not added."
        )


def _laws(r: dict[str, Any]) -> Iterator[Block]:
    if not r["bases"]:
        return
    yield pages.heading("Other laws on the same runs")
    rows = []
    for law in r["bases"]:
        row = {"law": law["title"]} | {f"{n} ({u})": number(law[key]) for key, (n, u) in words.ERRORS.items()}
        gap = law["against"].get("gap_rmse_m")
        row["change of the gap's error"] = "–" if gap is None else change(gap["ratio"])
        known = gap is not None and gap["high"] is not None
        row["95 % interval"] = f"{change(gap['low'])} … {change(gap['high'])}" if known else "–"
        row["verdict"] = "–" if gap is None else gap["verdict"]
        if law["fitted_to_what_is_judged"]:
            row["verdict"] = "worse, even fitted to these very data"
        rows.append(row)
    yield pages.table(rows)
    yield pages.note(
        "Each alone, without what was added, calibrated and judged alike; changes are against "
        f"{r['bases'][0]['title']}. Another law is completed by explain --base."
    )


def _change(values: list[float]) -> str:
    return change(values[1] / values[0]) if len(values) == 2 and values[0] else "–"


def _added(r: dict[str, Any]) -> Iterator[Block]:
    if r["found"]:
        yield pages.heading("What was added")
        rows = []
        for f in r["found"]:
            shown = list(f["parameters"].items())
            for i, (name, p) in enumerate(shown if len(shown) <= words.MANY else shown[:3]):
                unit = "" if p["unit"] == "1" else f" {p['unit']}"
                rows.append({
                    "effect": f["title"] if i == 0 else "",
                    "equation": f["equation"] if i == 0 else "",
                    "parameter": f"{name.replace('_', ' ')} {p['symbol']}",
                    "estimate": number(p["estimate"]) + unit,
                    "95 % interval": _between(p["low"], p["high"]) + unit,
                    "p": number(f["p_value"], 2) if i == 0 else "",
                    "held-out gain": percent(f["held_out_gain"], 1) if i == 0 else "",
                    "explained share": percent(f["explained_share"]) if i == 0 else "",
                })  # fmt: skip
        yield pages.table(rows)
        yield pages.terms(TERMS_OF_TESTS | {
            "explained share": "of what any smooth function of the state explains, how much this effect explains",
            "estimate": "shared by all drivers; of a curve only the first knots are listed, all are in report.json and "
            "in the picture below",
        })  # fmt: skip
    if r["known"]:
        yield pages.note(
            "Part of both models (given, or a latency below one step of the data): "
            + "; ".join(
                f"{words.plain(k['effect'])}, {k['parameter']} = {number(k['estimate'])} "
                f"({_between(k['low'], k['high'])})"
                for k in r["known"]
            )
        )


TERMS_OF_TESTS = {
    "held-out gain": "fall of the 5 s prediction error (in units of its noise) on runs that the candidate's parameters "
    "have not seen",
    "p": "chance of such a gain of any candidate of the whole list, were there none (sign flips of runs)",
}


def _moved(d: Discovery) -> Iterator[Block]:
    r = d.report
    yield pages.heading("How the drivers' own parameters moved")
    yield pages.note(words.weight(r["prior"]))
    declared = {p.name: p for p in d.null.model.catalogue.own}
    rows = []
    for p in r["parameters"]:
        own = declared[p["parameter"]]
        row = {"parameter": f"{own.name.replace('_', ' ')} {own.symbol} ({own.unit})"}
        for when, model in zip(("before", "after"), d.judgement.titles, strict=False):
            row |= {
                f"{model}: median": number(p[when]["median"]),
                "10 … 90 % of drivers" if when == "before" else "10 … 90 % ": _between(p[when]["low"], p[when]["high"]),
                "standard error" if when == "before" else "standard error ": number(p[when]["standard_error"], 2),
            }
        rows.append(row)
    yield pages.table(rows)
    yield pages.terms({
        "median": "of the drivers' own values",
        "10 … 90 % of drivers": "how much drivers differ",
        "standard error": "how well one driver's value is known, median over drivers",
    })  # fmt: skip


def _data(r: dict[str, Any]) -> Iterator[Block]:
    yield pages.heading("The data")
    rows = [{"figure": name, "value": number(r["data"][key]), "meaning": text} for key, (name, text) in DATA.items()]
    bounds = ", ".join(f"{k.replace('_', ' ')} {n}" for k, n in r["data"]["at_bounds"].items())
    at_bounds = {
        "figure": "groups with a parameter at its bound", "value": bounds,
        "meaning": f"of {r['data']['drivers']}: many mean that the data do not tell it, or that IDM lacks something",
    }  # fmt: skip
    yield pages.table([*rows, at_bounds])
    if r["data"]["repairs"]:
        yield pages.note("Repaired or left out on loading: " + " ".join(x["text"] for x in r["data"]["repairs"]))


def _tried(r: dict[str, Any]) -> Iterator[Block]:
    yield pages.heading("Everything that was tried")
    yield pages.table([
        {
            "candidate": words.plain(c["effect"]),
            "round": str(c["round"]),
            "errors of": c["errors"] or "–",
            "held-out gain": percent(c["held_out_gain"], 2),
            "95 % interval": "–" if None in c["interval"] else " … ".join(percent(x, 2) for x in c["interval"]),
            "p": number(c["p_value"], 2),
            "absorbed": percent(c["absorbed_share"]),
            "parameters": ", ".join(
                f"{k.replace('_', ' ')} {words.amount(v, c['units'][k])}" for k, v in c["parameters"].items()
            ),
            "note": c["note"],
        }
        for c in r["candidates"]
    ])  # fmt: skip
    yield pages.terms(TERMS_OF_TESTS | {
        "round": "0: could not be tested; every effect that was added begins a new round",
        "95 % interval": "of the gain, over runs",
        "absorbed": "share of the candidate's response that calibrated drivers' own parameters take up",
    })  # fmt: skip
    yield pages.heading("How this was decided")
    yield pages.text(
        f"The drivers' own parameters and every candidate are fitted to predictions {number(r['data']['horizon_s'])} s "
        "ahead, all judged by one model of noise (correlated within and between windows, so that drivers' own noise is "
        "not taken for an effect). Every trial of a candidate lets all drivers re-adjust. Its gain is measured on runs "
        "that its parameters have not seen, and tested by sign flips of whole runs (of followers within their runs, "
        f"where fewer than {ENOUGH_RUNS}, in free simulation {MANY_RUNS}, are left for model selection) with the "
        "maximum over the whole list (Westfall and Young). Gains in free simulation, of stretches that the drivers' "
        f"parameters have not seen, have a share of {FREE_SHARE:.0%} of the test's level. It must be significant at "
        f"{percent(ALPHA)}, gain at least {percent(LEAST_GAIN, 1)}, explain at least {percent(LEAST_SHARE)} of what "
        "any smooth function of the state explains, not make free simulation worse, and hold on the test set, where it "
        "is called an improvement only if an error falls, none is worse, and the gap in free simulation rises by "
        f"{HOLDS - 1.0:.0%} at most, or falls for most followers."
    )
