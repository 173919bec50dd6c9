"""Sentences, made from a verdict and the figures behind it; an effect's own words stand in its class."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from idm_env.discovery.bases import LEAST, Law
from idm_env.discovery.compare import Comparison, ErrorChange, percent
from idm_env.discovery.fleet import Kinds
from idm_env.discovery.ladder import Ladder
from idm_env.discovery.model import Term
from idm_env.discovery.result import Ceilings, TermFinding, Weight
from idm_env.discovery.rolled import FOLLOWERS, Rolled
from idm_env.discovery.score import Contrast
from idm_env.discovery.selection import NAMED_GAIN
from idm_env.discovery.shared import Shared
from idm_env.discovery.solve import Solution
from idm_env.discovery.tails import WORST
from idm_env.discovery.verdict import HOLDS, Reason, Refusal, Verdict
from idm_env.effects import ALL
from idm_env.effects.free import FEATURES, PER
from idm_env.parameters import Parameter

ERRORS = {
    "gap_rmse_m": ("gap in free simulation", "m"),
    "gap_rmse_median_driver_m": ("the same, median follower", "m"),
    "horizon_rmse_m": ("gap 5 s ahead", "m"),
    "speed_rmse_mps": ("speed in free simulation", "m/s"),
}
"""Plain name and unit of every error."""
CHANGES = {
    "acceleration": ("vehicles accelerate less", "vehicles accelerate more", "acceleration", "+ c"),
    "time_gap": ("drivers keep shorter time gaps", "drivers keep longer time gaps", "time gap", "T → T (1 + k)"),
    "desired_speed": ("drivers want to go slower", "drivers want to go faster", "desired speed", "v0 → v0 (1 + k)"),
    "accel_and_decel": (
        "drivers accelerate and brake softer",
        "drivers accelerate and brake harder",
        "acceleration and braking",
        "a → a (1 + k), b → b (1 + k)",
    ),
}
"""Of what can be located without a name: what drivers do with less and more of it, its noun, and its equation."""
ALONG = {
    "position": "place", "time": "time", "speed": "speed", "gap": "gap", "closing_speed": "closing speed",
    "lead_accel": "leader's acceleration", "relative_gap": "gap relative to the desired one",
    "time_since_stop": "time since the last stop", "mean_speed_20s": "mean speed of the last 20 s",
    "mean_speed_90s": "mean speed of the last 90 s", "braking_15s": "hardest recent braking",
    "lead_braking_15s": "leader's hardest recent braking", "own_accel": "driver's acceleration in the last second",
    "lead_trend": "leader's recent change of speed", "lead_change_3s": "leader's change of speed in 3 s",
    "headway_behind": "time gap of the follower", "gap_behind": "gap of the follower",
    "second_opening": "speed of the second leader over the leader's",
}  # fmt: skip
MOST = 0.75
"""Share of drivers on one side of a null from which their strengths are told as what drivers do."""
MANY = 4
"""A term with more parameters than this is a curve: its range is told instead."""


def number(x: float, digits: int = 3) -> str:
    """Return a number with so many significant digits and a true minus."""
    return f"{x:.{digits}g}".replace("-", "−")


def amount(x: float, unit: str) -> str:
    """Return a number with its unit."""
    return number(x) if unit == "1" else f"{number(x)} {unit}"


def capital(text: str) -> str:
    """Return a text that begins with a capital."""
    return text[:1].upper() + text[1:]


def plain(name: str) -> str:
    """Return a candidate's plain name, or the label of what is only located, without underscores."""
    return (name in ALL and ALL[name].title) or name.replace("_", " ")


def told(p: Parameter, estimate: float, low: float, high: float) -> str:
    """Return a parameter with its unit and interval: ``k = −0.31 [−0.38, −0.25]``."""
    unit = "" if p.unit == "1" else f" {p.unit}"
    if p.role == "place":
        return f"{p.symbol or p.name} = {estimate:,.0f}{unit}".replace(",", " ")
    # An interval is cut at the bounds of the search, beyond which nothing was tried.
    ends = [number(x) for x, at_bound in ((low, low <= p.low), (high, high >= p.high)) if at_bound]
    bound = f"; {' and '.join(ends)} the search's bound" if ends else ""
    return f"{p.symbol or p.name} = {number(estimate)}{unit} [{number(low)}, {number(high)}{bound}]"


def clause(term: Term, values: Sequence[Sequence[float]], contrast: Contrast | None = None, law: str = "IDM") -> str:
    """Return what drivers do with a term in the model, then its equation and parameters [(estimate, low, high)].

    These are two sentences, the first without its capital and the second without its end. Of a curve without a name its
    ``contrast`` is told. ``law`` is the title of what the term was added to.
    """
    estimates, strength = [v[0] for v in values], term.parameters[0]
    if len(values) <= MANY:
        shown = [p.role != "place" or term.effect is not None for p in term.parameters]
        numbers = ", ".join(told(p, *v) for p, v, show in zip(term.parameters, values, shown, strict=True) if show)
    else:
        highest = amount(max(estimates), strength.unit)
        numbers = f"a curve of {len(values)} knots from {number(min(estimates))} to {highest}"
    if term.effect is not None:
        effect = ALL[term.effect]
        (below, above), noun, equation = effect.wording, plain(term.effect), effect.equation
        text = (below if len(values) <= MANY and estimates[0] < (strength.null or 0.0) else above) or below
        text = text.replace("{law}", law) or f"an effect is missing that {noun} describes"
    else:
        below, above, noun, equation = CHANGES[term.what]
        if contrast is not None:
            text = f"the {noun} {_contrast(term, estimates, contrast)}"
        elif len(values) > MANY or term.knots[2] > 2:
            text = f"the {noun} depends on the {noun_of(term)}"
        elif len(values) == 2:
            text = f"the {noun} drifts over {ALONG[term.coordinate]}"
        else:
            text = f"{below if estimates[0] < 0 else above} {_interval(term, estimates)} than elsewhere"
    return f"{text}. {capital(f'{noun}: {equation}' if equation else noun)}, with {numbers}"


def _contrast(term: Term, estimates: Sequence[float], c: Contrast) -> str:
    """Say where a curve's two surely most different knots lie, and by how much the higher one is above the lower."""
    first, distance, _ = term.knots
    high, low = (first + distance * knot for knot in (c.high_knot, c.low_knot))
    unit = "s" if term.coordinate == "time" else "m" if term.coordinate == "position" else FEATURES[term.coordinate]
    if term.what == "acceleration":
        difference = f"{number(c.estimate, 2)} m/s² [{number(c.low, 2)}, {number(c.high, 2)}] higher"
    else:  # of relative changes c: (1 + c at the higher knot) / (1 + c at the lower one)
        below = 1.0 + estimates[c.low_knot]
        difference = f"{100 * c.estimate / below:.0f} % [{100 * c.low / below:.0f}, {100 * c.high / below:.0f}] higher"
    where = f"{amount(high, unit)} than at {amount(low, unit)}"
    if term.cycles:
        where += f" of a cycle of {term.period:.0f} s"
    prefix = f"a {ALONG[term.coordinate]} of " if term.fades else ""
    if term.by:
        where += f", per {amount(PER[term.by], FEATURES[term.by])} of {ALONG[term.by]}"
    return f"is {difference} at {prefix}{where}".replace("[-", "[−")


def noun_of(term: Term) -> str:
    """Return the noun of what a curve runs over."""
    return f"phase of a cycle of {term.period:.0f} s" if term.cycles else ALONG[term.coordinate]


def _interval(term: Term, estimates: Sequence[float]) -> str:
    unit = term.parameters[1].unit
    if len(estimates) < 3 or estimates[2] > 9e5:
        return f"from {estimates[1]:.0f} {unit} on"
    return f"between {estimates[1]:.0f} and {estimates[2]:.0f} {unit}"


def reason(refusal: Refusal | None, tried: str = "") -> str:
    """Say why nothing (more) was added; ``tried`` is the plain name of what came nearest."""
    if refusal is None:
        return ""
    figure = refusal.figure
    return {
        Reason.FEW_RUNS: f"only {figure:.0f} run{' is' if figure == 1 else 's are'} left for model selection",
        Reason.NO_POWER: f"the {figure:.0f} runs left for model selection would not have shown most effects at their "
        "usual strengths",
        Reason.NO_GAIN: f"no candidate gains {NAMED_GAIN:.0%} on held-out runs beyond noise",
        Reason.SMALL_SIZE: f"{tried or 'what candidates gain'} moves predictions 5 s ahead by less than "
        f"{number(figure, 2)} m or half a step",
        Reason.SMALL_SHARE: f"{tried} explains only {figure:.0%} of what can be explained",
        Reason.CLOSED_LOOP: f"{tried} makes free simulation worse",
        Reason.TEST_SET: f"the test set does not confirm {tried}",
        Reason.HELD_OUT: f"predictions of held-out runs get no better with {tried}",
        Reason.STRUCTURE: (
            f"a smooth function of the scene takes {refusal.figure:.0%} off the squared error 5 s ahead, "
            "and no candidate does"
        ),
        Reason.TAILS: "the worst predictions lie together",
    }[refusal.reason]


def headline(
    verdict: Verdict, clauses: Sequence[str], refusal: Refusal | None, tried: str, errors: Mapping[str, Comparison],
    shared: Shared | None = None, others: Sequence[str] = (), law: str = "IDM",
) -> str:  # fmt: skip
    """Return the sentences of a verdict, of which the first has neither equation nor estimates.

    Args:
        verdict: What is concluded.
        clauses: Of every term that was added.
        refusal: Why nothing was added.
        tried: Plain names of what came nearest, "" for nothing.
        errors: How errors on held-out runs changed with what was added or came nearest.
        shared: What vehicles of one run do alike, told where nothing was added.
        others: Effects that these data do not tell from what was added.
        law: Title of the law that was to be completed.
    """
    if refusal is not None and refusal.reason is Reason.LAW:
        nearest = f" The nearest was {tried}." if tried else ""
        return f"No effect added to {law} predicts as well.{nearest}"
    if shared is not None and not clauses:
        return common(shared)
    if verdict in (Verdict.NAMED, Verdict.ONE_OF, Verdict.SHAPE, Verdict.LOCATED):
        parts = [f"{capital(text)}." for text in clauses]
        if verdict is Verdict.ONE_OF:
            parts.append(f"These data do not tell it from {' or '.join(plain(x) for x in others)}.")
        elif verdict is not Verdict.NAMED:
            parts.append("The catalogue has no name for it.")
        return " ".join([*parts, *_but(errors)])
    if verdict is Verdict.NONE and refusal is not None and refusal.reason is Reason.SMALL_SIZE:
        return f"Nothing of practical size is missing: {reason(refusal, tried)}."
    if verdict is Verdict.NONE:
        return f"Nothing is missing that these data could show: {reason(Refusal(Reason.NO_GAIN))}."
    if verdict is Verdict.CANNOT_TELL:
        powerless = refusal is not None and refusal.reason is Reason.NO_POWER
        needed = "More runs, ten or more," if powerless else "Four runs of three followers or seven runs, better ten,"
        return f"These data cannot tell: {reason(refusal, tried)}. {needed} are needed (a quarter is the test set)."
    if refusal is not None and refusal.reason is Reason.HELD_OUT:
        against = f"{capital(tried)} was selected, and {_rises(errors)} on held-out runs."
        return f"Something is missing, but no candidate predicts better. {against}"
    return f"Something is missing that no candidate explains: {reason(refusal, tried)}."


def beside_noise(verdict: Verdict, law: str, left_m: float, floor_m: float, ladder: Ladder | None) -> str:
    """Say of errors 5 s ahead far above the sensors' ``floor_m`` whether noise of drivers may be all that they are."""
    error = f"{law} leaves {number(left_m, 2)} m 5 s ahead, where sensors' noise is {number(floor_m, 2)} m"
    drivers = "unsteady drivers"
    if ladder is not None and ladder.unsteady is not None and ladder.unsteady[0] > 0.0:
        drivers += f" of σ = {number(ladder.unsteady[0], 2)} m/s² (memory {number(ladder.unsteady[1], 2)} s)"
    if verdict is Verdict.NONE:
        return f"{error}: {drivers} do so. Nothing is missing that these data could show."
    if verdict is Verdict.UNDECIDED and ladder is not None and ladder.few:
        who = ", ".join(ladder.few[:MANY]) + (" and others" if len(ladder.few) > MANY else "")
        few = f"Half of its square lies with {len(ladder.few)} of the drivers ({who}), where noise of all would not"
        return f"{error}. {few}. An effect of a form that was not tried, which few meet, would explain it."
    if verdict is Verdict.UNDECIDED:
        return f"{error}. {capital(drivers)} would explain it, and so would an effect of a form that was not tried."
    return f"{error}. No candidate explains it. {' '.join(tails(ladder))}"


def tails(ladder: Ladder | None) -> list[str]:
    """Say how much of the squared error the worst predictions hold, and where these are."""
    if ladder is None or ladder.tails is None:
        return []
    where, p = ladder.worst, number(ladder.tails.p_value, 2)
    lies = f", {where.share:.0%} of it {where.where} ({where.of_all:.0%} of the time)" if where is not None else ""
    share = f"The worst {WORST:.0%} of predictions hold {ladder.tails.share:.0%} of the squared error{lies}"
    usual = f"by drivers' noise it would be {ladder.tails.usual:.0%}"
    return [f"{share}; {usual} (as much with p = {p}, from {ladder.tails.replicas} simulations)."]


def common(shared: Shared) -> str:
    """Say what vehicles of one run do alike."""
    more = "more" if shared.accel_mps2 > 0 else "less"
    return (
        f"The {shared.vehicles} followers of run {shared.run} all accelerate {more} than the model between "
        f"{shared.begin_s:.0f} and {shared.end_s:.0f} s, by {number(abs(shared.accel_mps2), 2)} m/s² on average. "
        "They share it, so it is no driver's own noise. The catalogue has no name for it."
    )


def _rises(errors: Mapping[str, Comparison]) -> str:
    """Say what the errors on held-out runs have against an addition."""
    worse = [ERRORS[k][0] for k, c in errors.items() if c.outcome is ErrorChange.WORSE]
    if not any(c.ratio < 1.0 for c in errors.values()):
        return "no error falls"
    if worse:
        return f"the error of the {' and the '.join(worse)} gets worse"
    if errors["gap_rmse_m"].ratio > HOLDS:
        return f"the error of the gap in free simulation rises by {percent(errors['gap_rmse_m'].ratio)}"
    if errors["gap_rmse_m"].most_worse:
        return f"the gap in free simulation errs more for {1.0 - errors['gap_rmse_m'].improved:.0%} of followers"
    if not any(c.outcome is ErrorChange.BETTER for c in errors.values()):
        return "no error falls beyond chance"
    return "errors rise on the whole"


def _but(errors: Mapping[str, Comparison]) -> list[str]:
    """Say what the errors on held-out runs take from a finding."""
    worse = [ERRORS[k][0] for k, c in errors.items() if c.outcome is ErrorChange.WORSE]
    if worse:
        return [f"On held-out runs the error of the {' and the '.join(worse)} is larger with it."]
    if errors and not any(c.outcome is ErrorChange.BETTER for c in errors.values()):
        return ["No error on held-out runs is significantly lower with it."]
    gap = errors.get("gap_rmse_m")
    if gap is not None and gap.driver[0] > 1.0 + LEAST:
        return [f"The mean driver's error of the gap in free simulation changes by {percent(gap.driver[0])}."]
    return []


def details(found: Sequence[TermFinding], nearest: Sequence[TermFinding]) -> list[str]:
    """Say how sure it is, what it is confused with and what data would tell.

    ``nearest`` are the terms that came nearest where nothing was added.
    """
    parts = []
    for f in found:
        parts.append(
            f"{capital(f.title)}: p = {number(f.p_value, 2)} over the whole list of candidates; first "
            f"of it in {f.chosen_in_folds:.0%} of choices without a fold of the runs."
        )
        if f.equivalent:
            parts.append(f"These data cannot tell it from {', '.join(plain(x) for x in f.equivalent)}.")
        rivals = [plain(x) for x in f.rivals if x not in f.equivalent]
        if rivals:
            parts.append(f"Rivals, whose gain is not lower beyond chance: {', '.join(rivals)}.")
        if f.looks_like and not f.equivalent and not rivals:
            parts.append(f"It is most easily confused with {', '.join(spoken(x) for x in f.looks_like[:3])}.")
        if f.told_by:
            parts.append(f"What would tell: {f.told_by}.")
    if nearest:
        parts += [f"{'With' if i else 'Nearest came, without being added'}: {f.clause}." for i, f in enumerate(nearest)]
    return parts


def cautions(at_bounds: Mapping[str, int], groups: int) -> list[str]:
    """Say what else speaks against the figures: parameters at their bounds."""
    often = {name.replace("_", " "): n for name, n in at_bounds.items() if n > 0.2 * groups}
    return [f"The fitted {name} is at its bound for {n} of {groups} groups of drivers." for name, n in often.items()]


def agreement(ladder: Ladder | None, leading: Term | None) -> list[str]:
    """Say whether what is left, and what the ``leading`` candidate gains, looks like noise, where nothing was added."""
    if ladder is None:
        return []
    agreements = {"a smooth function of the scene": ladder.agreement}
    if leading is not None:
        agreements[plain(leading.name)] = ladder.leading
    return [
        f"How often {who} takes as much off the squared error where drivers' and sensors' noise is all there is: "
        f"p = {number(one.p_value, 2)}, from {one.replicas} simulations."
        for who, one in agreements.items() if one is not None
    ] + tails(ladder)  # fmt: skip


def fleet_first(fleet: Kinds) -> str:
    """Return the drivers of every law, three laws at most, the classes, and an error's change against one model."""
    titles = [law.title for law in fleet.laws]
    counts = [f"{fleet.counts[0]} of {len(fleet.group)} drivers are predicted best by {titles[0]}"]
    counts += [f"{count} by {title}" for count, title in zip(fleet.counts[1:3], titles[1:3], strict=True)]
    counts += [f"{sum(fleet.counts[3:])} by others"] if titles[3:] else []
    classes = [f"{' or '.join(x)} by {title}" for x, title in zip(fleet.classes, titles, strict=bool(fleet.column))]
    which = f" Of {fleet.column}, {'; '.join(classes)}." if fleet.column else ""
    return f"{', '.join(counts)}.{which} Against one model for all, {change_of(fleet.against)}."


def fleet_details(fleet: Kinds) -> list[str]:
    """Say how kinds of drivers were told, and where to go on."""
    if fleet.column:
        return [f"What a kind lacks: explain --where {fleet.column}={fleet.classes[0][0]}."]
    return [f"Kinds are told by half of each driver's time, judged on the other; {fleet.agreed} drivers' halves agree."]


def change_of(against: Mapping[str, Comparison]) -> str:
    """Say of one error by how much it changes: that 5 s ahead, or else the first that falls beyond chance."""
    better = [key for key, c in against.items() if c.outcome is ErrorChange.BETTER]
    key = "horizon_rmse_m" if "horizon_rmse_m" in better or not better else better[0]
    return f"{ERRORS[key][0]} {percent(against[key].ratio)} (95 %: {against[key].interval})"


def law_first(law: Law, null: str, drivers: Solution | None = None) -> str:
    """Say that another law predicts better than the null, and one error; ``drivers`` are its parameters.

    Of strengths that are each driver's own, the one that lies on one side of the null for most drivers comes first.
    """
    better = change_of(law.against)
    if not (law.own and drivers is not None):
        return f"{capital(law.title)} predicts better than {null} calibrated alike. Against {null}, {better}."
    share, finding = max(_of_drivers(drivers, null))
    first = finding if share >= MOST else "Drivers differ from each other in what IDM has in common for all."
    return f"{first} With strengths of each driver's own, {better}."


def law_details(law: Law, on: bool) -> list[str]:
    """Return a better law's title and number of parameters, and where to go on; ``on`` it effects were found."""
    more = [] if law.own or on else [f"What it lacks: explain --base {law.law.kind}."]
    more += [f"Each driver has strengths of his own: {', '.join(map(plain, law.own))}."] if law.own else []
    return [f"The law is {law.title}, with {law.parameters} parameters a driver, calibrated as all others.", *more]


def _of_drivers(drivers: Solution, law: str) -> list[tuple[float, str]]:
    """Return of every strength of the drivers' own the share of drivers on one side of its null, and a sentence."""
    catalogue, theta = drivers.model.catalogue, np.exp(drivers.theta[np.unique(drivers.row_group)])
    strengths = []
    for i, (name, p) in enumerate(catalogue.of_driver):
        if name in catalogue.personal and p.role == "strength":
            null = p.null or 0.0
            low, middle, high = np.quantile(theta[:, i], [0.1, 0.5, 0.9])
            share = float(np.mean(theta[:, i] > null if middle > null else theta[:, i] < null))
            text = ALL[name].wording[int(middle > null)].replace("{law}", law) or plain(name)
            values = f"{p.symbol} = {number(middle, 2)}, 80 % of drivers {number(low, 2)} to {number(high, 2)}"
            strengths.append((share, f"{capital(text)}. The median driver has {values}, and {law} {number(null)}."))
    return strengths


def weight(prior: Weight) -> str:
    """Say how much the population weighs for one driver, and the gap's error in free simulation of validation runs."""
    error = dict(zip(prior.tried_s, prior.gap_rmse_m, strict=True)).get(prior.alike_s)
    chosen = f"{number(prior.alike_s)} s{'' if error is None else f' ({number(error)} m)'}"
    shrunk = "Drivers' parameters are shrunk towards the population mean (empirical Bayes)"
    return f"{shrunk}; strength chosen by validation, before any effect was tested: {chosen}."


def rolled(of: Mapping[str, Rolled]) -> list[tuple[str, str, str]]:
    """Return waves and collisions of some models: a title, "worse" where the first alone crashes, figures.

    A platoon is "worse", too, where waves grow along it with the first alone. The second, where there is one, is IDM.
    """
    if not of:
        return []
    first, *_, idm = *of.values(), *of.values()
    growth = [f"speed varies {number(x.amplification)} times as much at the last as at the first" for x in of.values()]
    crashes = [f"{x.crashed} run into their leader" if x.crashed else "no collision" for x in of.values()]
    rings = [
        f"no collision, speeds differ by {number(x.wave_mps, 2)} m/s after 2 min"
        if x.ring_s is None
        else f"collision after {number(x.ring_s)} s"
        for x in of.values()
    ]
    platoons = [f"{grows}, {crash}" for grows, crash in zip(growth, crashes, strict=True)]
    waves = first.amplification > 1.0 > idm.amplification
    bad = waves or first.crashed > idm.crashed, idm.ring_s is None is not first.ring_s
    titles = f"{FOLLOWERS} followers of one that brakes", f"Ring of {FOLLOWERS} drivers"
    return list(zip(titles, ("worse" if x else "" for x in bad), map("; IDM: ".join, (platoons, rings)), strict=True))


def ceilings(of: Ceilings, before_m: float | None, floor_m: float | None = None) -> str:
    """Say how much of the error could be explained at all, as far as these data tell; sensors leave ``floor_m``."""
    parts = []
    if (share := of.repeats_share) is not None:
        parts.append(f"{100 * share:.0f} % of the gap's squared error repeats in matched situations of other runs")
    if (refit := of.refitted_gap_rmse_m) is not None and before_m is not None:
        parts.append(f"drivers fitted to the test set itself leave {number(refit)} m ({number(before_m)} m held out)")
    if (smooth := of.smooth_function_gain) is not None:
        parts.append(f"the best smooth function of the state lowers the error 5 s ahead by {100 * smooth:.1f} %")
    if floor_m is not None:
        parts.append(f"sensor noise alone leaves {number(floor_m, 2)} m")
    text = "; ".join(parts)
    return f"{capital(text)}." if text else ""


def error_rows(report: Mapping[str, Any], titles: Sequence[str]) -> list[dict[str, Any]]:
    """Return the errors of ``report.json``, a row each: of the models ``titles``, and how the second's compare."""
    before, better = report["error"]["before"], better_law(report)
    after = better or (report["partial"] or report["error"])["after"]
    helps = better["against"] if better else report["helps"]
    rows = []
    for key, (name, unit) in ERRORS.items() if before is not None else ():
        row = {"error": f"{name} ({unit})", titles[0]: before[key]}
        if titles[1:]:
            outcome = helps.get(key, {"verdict": "–", "interval": "–"})
            change = percent(after[key] / before[key]) if before[key] else "–"
            row |= {titles[1]: after[key], "change": change}
            row |= {"95 % interval": outcome["interval"], "verdict": outcome["verdict"]}
        rows.append(row)
    return rows


def better_law(report: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the row of ``report.json`` for the law that is its ``model.yaml``, where that is another one."""
    best = report["models"].get("model.yaml")
    return next((row for row in report["bases"] if row["title"] == best and row["against"]), None)


def spoken(item: str) -> str:
    """Return an entry of ``looks_like`` in plain words: its first word may be a candidate or a parameter."""
    first, _, rest = item.partition(" ")
    return f"{plain(first)} {rest.replace('_', ' ')}".strip()
