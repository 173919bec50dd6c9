"""From trajectories to a verdict: what does the Intelligent Driver Model lack on these roads, how sure is that, and how
much better is the corrected model on runs that had no part in it.
"""  # noqa: D205

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from idm_env.data import Trajectories, episodes
from idm_env.data.fingerprint import fitted_on
from idm_env.discovery import (
    bases,
    calibrate,
    ceilings,
    crossed,
    found,
    free,
    judge,
    places,
    records,
    search,
    shared,
    summary,
    words,
)
from idm_env.discovery import march as twin
from idm_env.discovery import model as terms
from idm_env.discovery.model import Hypothesis, Term
from idm_env.discovery.noise import Noise
from idm_env.discovery.records import Records
from idm_env.discovery.search import Search
from idm_env.discovery.selection import Decided, Round, decide
from idm_env.discovery.solve import Solution, Task
from idm_env.discovery.verdict import Reason, Refusal, Verdict
from idm_env.effects import (
    ALL,
    CANDIDATES,
    PACKAGED,
    Brakes,
    CarFollowing,
    Effect,
    base_named,
    candidates,
    make,
    named,
    register,
)  # fmt: skip
from idm_env.jobs import storage
from idm_env.jobs.progress import OnProgress, silent
from idm_env.model_file import Model as SavedModel
from idm_env.validation import nearest


@dataclass(eq=False)
class Discovery:
    """Result: the report's content, models by the name of their file, and what the pictures are drawn from.

    ``final`` has what was added or, where nothing was, what came nearest; ``judgement`` compares it with ``null``.
    """

    report: dict[str, Any]
    models: dict[str, SavedModel]
    records: Records
    null: Solution
    final: Solution
    task: Task
    rounds: list[Round]
    judgement: summary.Judgement
    responses: places.Responses

    @property
    def verdict(self) -> Verdict:
        """What is concluded."""
        return Verdict(self.report["verdict"])

    @property
    def found_effect(self) -> str:
        """What was found in a state of the driver and has no name, as the text of a file with effects; "" for none."""
        told = {f["label"]: f["parameters"] for f in self.report["found"]}
        added = [(term, told[term.label]) for term in self.judgement.terms if term.label in told]
        return found.source(added, self.report["sentence"])

    @property
    def model(self) -> SavedModel:
        """The model that predicts best of those compared on runs kept back."""
        return self.models["model.yaml"]


def discover(
    trajectories: Trajectories,
    *,
    by: str = "driver",
    effects: Sequence[str | Effect | type[Effect]] | None = None,
    known: Sequence[str] = (),
    place: str | None = None,
    out: Path | None = None,
    resume: bool = False,
    on_progress: OnProgress | None = None,
    seed: int = 0,
    located: bool = True,
    lockbox: float = 0.25,
    base: str | CarFollowing = "idm",
) -> Discovery:
    """Find the effect that IDM lacks on ``trajectories``, or say that there is none or that the data cannot tell.

    Args:
        trajectories: Checked trajectories; at least 7 runs for a decision.
        by: Who shares IDM parameters: ``driver``, ``all``, or a column that is constant for a driver.
        effects: Candidates: names, ``my_file.py:MyEffect``, classes, or effects with their static choices, which need
            not be registered. None is the whole catalogue and everything that can only be located.
        known: Effects that are given in the data and belong to the null: ``grade`` (column ``grade``, rise over run).
        place: Column with the coordinate of places, if not that of ``trajectories``; a lap's wraps are noticed.
        out: Folder in which an interrupted search keeps what is done, or None.
        resume: Go on from there.
        on_progress: Called with phase, done, total and the candidate; see ``idm_env.jobs.progress``.
        seed: Of the draw of the lockbox and of sign flips.
        located: Whether effects without a name are looked for too.
        lockbox: Share of the runs that neither fit nor choose.
        base: The car-following law that is to be completed, if not IDM.

    Raises:
        ValueError: For unknown effects, or a folder left by other data.
        DataError: For data that cannot be used.
    """
    progress = on_progress or silent
    law = base_named(base) if isinstance(base, str) else base
    chosen = _chosen(effects, known)
    prepared = prepare(trajectories, by, place)
    refused = terms.testable(prepared, chosen)
    tried = [_measured(prepared, e) for e in chosen if e.name not in refused and e.name not in known]
    names = [e.name for e in tried]
    if not names:
        why = "; ".join(f"{name}: {reason}" for name, reason in refused.items()) or "all of them are known"
        raise ValueError(f"no candidate can be tried on these data ({why}). Name others, or leave out --effects.")
    fit_runs, kept_runs = _split(prepared, lockbox, seed)
    rows = records.windows(prepared.of_runs(fit_runs))
    options = (list(map(repr, tried)), tuple(known), seed, located, lockbox, repr(law))
    mark = storage.fingerprint(prepared.groups, prepared.runs, options, prepared.signals)
    saved = storage.Store(None if out is None else out / storage.UNFINISHED / "explain", mark, resume)
    task = Task(rows, search.first_noise(rows), calibrate.first_prior(law.declared))
    told = tuple(_known_term(prepared, name) for name in known)
    own = [e for e in tried if e.kind not in PACKAGED or not _plain(e)]
    given = [*own, *(terms.known_effect(term) for term in told)]
    bare = Hypothesis(told, twin.Catalogue.of(given, prepared.period, law))
    searching = Search(task, names, located and effects is None, saved, progress, bare)
    progress("null", 0, 0, law.name)
    values = search.starting_values(bare)
    null = searching.null(bare, judge.unweighed(rows.records, bare, values, task.prior)[1], values)
    decided = decide(searching, null, seed)
    saved.remove()
    progress("final check", 0, 0, "runs kept for the end")

    def on_law(*state: Any) -> None:
        progress("other laws", *state)

    return _finish(
        trajectories, prepared, fit_runs, kept_runs, searching, decided, refused | searching.unplaced, by, seed, on_law
    )


# -- before the search -----------------------------------------------------------------------------------------------


def _chosen(effects: Sequence[str | Effect | type[Effect]] | None, known: Sequence[str]) -> list[Effect]:
    """Return the candidates as effects, those of the user's own registered."""
    chosen: list[Effect] = []
    for given in candidates() if effects is None else effects:
        if isinstance(given, str):
            name = named(given)
        else:
            name = register(given if isinstance(given, type) else type(given)).kind
        if name not in candidates():
            raise ValueError(f"effect '{name}' is no candidate.{nearest(name, candidates())}")
        chosen.append(given if isinstance(given, Effect) else make(name))
        if chosen[-1].name != name:
            raise ValueError(f"effect '{name}' calls itself '{chosen[-1].name}': a candidate needs its class's name.")
    for name in known:
        if name not in CANDIDATES:
            raise ValueError(f"effect '{name}' is no candidate.{nearest(name, CANDIDATES)}")
        if not ALL[name].column:
            able = ", ".join(f"'{n}' (column {ALL[n].column})" for n in CANDIDATES if ALL[n].column)
            raise ValueError(f"known effect '{name}' cannot be read from data; only these can: {able}.")
    return list({e.name: e for e in chosen}.values())


def _plain(effect: Effect) -> bool:
    """Tell whether an effect is as its name makes it."""
    return effect == make(effect.kind)


def prepare(trajectories: Trajectories, by: str, place: str | None = None) -> Records:
    """Return the flat records of smoothed episodes, thinned where there are more than can be rolled out in time.

    ValueError for a place column that is missing.
    """
    if place is not None:
        if place not in trajectories.table.columns:
            raise ValueError(f"place column '{place}' is missing.{nearest(place, trajectories.table.columns)}")
        trajectories = replace(trajectories, place=place)
    found = episodes(trajectories, smooth=True, min_seconds=12.0)
    column = trajectories.table[trajectories.place]
    period = 0.0
    if trajectories.place != "position_m":
        steps = column.diff().abs().drop_nulls().to_numpy()
        reach = float(np.nanmax(column.to_numpy()) - np.nanmin(column.to_numpy()))
        if np.mean(steps > 0.7 * reach) > 1e-5:
            period = reach
    if "ring_length_m" in trajectories.table.columns:
        rings = trajectories.table["ring_length_m"].drop_nulls()
        period = float(rings[0]) if len(rings) and rings.n_unique() == 1 else period
    return records.gather(list(found), by, period, trajectories)


def _split(prepared: Records, share: float, seed: int) -> tuple[list[str], list[str]]:
    runs = [r for i, r in enumerate(prepared.runs) if np.any(prepared.run == i)]
    if len(runs) < 2:
        return runs, []
    count = min(max(1, round(share * len(runs))), len(runs) - 1)
    order = np.random.default_rng(seed).permutation(len(runs))
    kept = {runs[i] for i in order[:count]}
    return [r for r in runs if r not in kept], [r for r in runs if r in kept]


def _measured(prepared: Records, effect: Effect) -> Effect:
    """Return an effect whose profile a column gives with that profile, any other as it is."""
    if effect.sought != "given":
        return effect
    first, distance, profile = _profile(prepared, effect.column)
    knots = tuple(first + distance * i for i in range(len(profile)))
    return replace(effect, knots=knots, profile=tuple(profile), period=prepared.period or None)  # type: ignore[call-arg]


def _known_term(prepared: Records, name: str) -> Term:
    """Return the effect with its profile over places as the file gives it."""
    return terms.known_profile(name, *_profile(prepared, ALL[name].column), prepared.period)


def _profile(prepared: Records, column: str) -> tuple[float, float, list[float]]:
    """Return first place, distance and values of a column over places; DataError where no record tells."""
    # Where a record does not tell, the profile of the others is taken for the same place.
    told = [e for e in prepared.episodes if column in e.columns]
    if not told:
        raise ValueError(
            f"a profile over places needs the column {column} without holes, and no record has it. Fill it in."
        )
    place = np.concatenate([e.place_m for e in told])
    value = np.concatenate([e.columns[column] for e in told])
    period = prepared.period
    place = np.mod(place, period) if period else place
    low, high = (0.0, period) if period else (float(place.min()), float(place.max()))
    count = int(np.clip((high - low) / 30.0, 3, 60))
    distance = (high - low) / (count if period else count - 1)
    index = np.round((place - low) / distance).astype(int) % count
    total = np.bincount(index, value, minlength=count)
    number = np.bincount(index, minlength=count)
    profile = np.interp(np.arange(count), np.flatnonzero(number), total[number > 0] / number[number > 0])
    return low, distance, profile.tolist()


# -- after the search ------------------------------------------------------------------------------------------------


def _finish(
    trajectories: Trajectories, prepared: Records, fit_runs: list[str], kept_runs: list[str], searching: Search,
    decided: Decided, refused: dict[str, str], by: str, seed: int, on_law: Callable[[int, int, str], None],
) -> Discovery:  # fmt: skip
    adapt = by == "driver"
    null, rounds = decided.null, decided.rounds
    fit_records = searching.task.rows.records
    kept = prepared.of_runs(kept_runs) if kept_runs else None

    fold = crossed.folds_of(prepared.runs, kept_runs, seed)

    def own(model: Hypothesis, values: np.ndarray, start: np.ndarray | None) -> tuple[Solution, judge.Judged | None]:
        found = searching.calibrated(model, values, start)
        return calibrate.judged(found, fit_records, None if adapt else kept, prepared, adapt)

    def noise() -> Noise:
        assert searching.task.noise is not None
        return searching.task.noise

    # The null, what is added and other laws go the same way: whatever is calibrated better looks better.
    def judged(
        s: Solution, task: Task, whitened: bool | None = None, pooled: bool = False
    ) -> tuple[Solution, judge.Judged | None]:
        theta, errors = own(s.model, s.values, s.theta)
        if adapt and kept is not None:
            values = crossed.values_of(task, s, prepared.runs, fold)
            errors = crossed.crossed(prepared, s.model, values, fold, noise(), theta.theta, pooled, whitened)
        return theta, errors

    first, before = judged(null, searching.task)
    whitened = before is not None and before.whitened

    def alike(s: Solution, task: Task) -> tuple[Solution, judge.Judged | None]:
        return judged(s, task, whitened)

    judgement, last = _judgement(searching, decided, kept, fit_records, alike, (first, before), seed)
    laws = []

    if before is not None:
        best = crossed.at_best(prepared, null.model, null.values, first.theta)[0] if adapt else before

        def alone(model: Hypothesis) -> tuple[judge.Judged, judge.Judged]:
            if not adapt:
                errors = own(model, null.values, None)[1]
                assert errors is not None
                return errors, before
            at_best, theta = crossed.at_best(prepared, model, null.values)
            if bases.is_far(at_best, best, bool(model.catalogue.personal)):
                return at_best, best
            values = crossed.values_of(searching.task, null, prepared.runs, fold)
            return crossed.crossed(prepared, model, values, fold, noise(), theta, whitened=whitened), before

        laws = bases.compared(null.model, before, alone, seed, on_law)
        judgement = judgement.beside(bases.best_of(laws))
    final = judgement.compared if judgement.added and judgement.compared is not None else null
    judgement = replace(judgement, shared=shared.find(judge.everywhere(prepared, searching.task, final), seed))
    scored = prepared if kept is None else kept
    floor = ceilings.floor(scored, ceilings.drift(trajectories))
    if adapt and before is not None:
        pooled = judged(null, searching.task, whitened, True)[1]
        judgement = replace(judgement, ladder=judgement.climbed(prepared, pooled, floor["horizon_rmse_m"]))
    report = summary.report(
        trajectories, prepared, fit_runs, kept_runs, searching.task, judgement, rounds, refused, [first, last], by
    )
    report["prior"] = {
        "alike_s": decided.stand.task.prior.alike_s, "tried_s": list(decided.stand.rmse_m),
        "gap_rmse_m": list(decided.stand.rmse_m.values()),
    }  # fmt: skip
    report["ceilings"] = ceilings.told(decided.stand, scored, decided.null, rounds[0].smooth_gain)
    report["error"]["floor"] = floor
    report["bases"] = bases.rows(laws)
    for key in ("sentence", "details", "found", "partial"):
        report[key] = words.of_law(report[key], null.model.catalogue.base.title)
    of_law = None
    if judgement.law is not None:
        of_law = own(judgement.law.model, null.values, None)[0]
        first_words = words.law_first(judgement.law, null.model.catalogue.base.title, of_law)
        report["sentence"] = f"{first_words} {report['sentence']}"
    report["details"] += words.by_use(laws, judgement.law)
    report["details"] += words.cautions(report["data"]["at_bounds"], len(np.unique(prepared.group)))
    # Drivers who adapt are calibrated on parts of the held-out runs too.
    seen = fitted_on(trajectories, [(e.run_id, e.vehicle_id) for e in (prepared if adapt else fit_records).episodes])
    shown = null if judgement.compared is None else judgement.compared
    pairs = [(null, first), (shown, last)][: len(judgement.titles)]
    if of_law is not None:
        pairs.append((of_law, of_law))
    saved = [replace(corrected(prepared, s, theta.theta, by), fitted_on=seen) for s, theta in pairs]
    models = dict(zip(judgement.names(), saved, strict=True))
    return Discovery(
        report, models, prepared, null, shown, searching.task, rounds, judgement, places.respond(searching.task, shown)
    )


Calibrates = Callable[[Solution, Task], tuple[Solution, judge.Judged | None]]
"""A model, and what its φ was fitted to → drivers' parameters, and errors by cross-fitting if there are runs for it."""


def _judgement(
    searching: Search, decided: Decided, kept: Records | None, fit_records: Records, calibrates: Calibrates,
    first: tuple[Solution, judge.Judged | None], seed: int,
) -> tuple[summary.Judgement, Solution]:  # fmt: skip
    """Return what the runs kept back say of what was found, and the drivers' parameters beside it."""
    null, rounds = decided.null, decided.rounds
    final, refusal = null, rounds[0].refusal
    confirmed: list[Solution] = []
    if kept is not None:
        # The lockbox is looked into once for every addition, and only to end there.
        for s in decided.steps:
            if judge.confirmed(kept, searching.task, final, s) <= 0:
                refusal = Refusal(Reason.LOCKBOX)
                break
            final = s
            confirmed.append(s)

    def judged(s: Solution) -> tuple[Solution, judge.Judged | None]:
        return calibrates(s, searching.task)

    # Where nothing was added, what came nearest is compared with the null and says what it would have done.
    added = final is not null
    nearest_one = None if kept is None or rounds[0].partial is None else rounds[0].scored[rounds[0].partial].solution
    compared = final if added else nearest_one
    before = first[1]
    last, after = first if compared is None else judged(compared)
    judgement = summary.Judgement(null, compared, added, refusal, before, after, seed)
    if added and judgement.errors and not judgement.improves:
        judgement = replace(judgement, added=False, refusal=Refusal(Reason.HELD_OUT))
        # What the last additions spoil does not speak against the first.
        for s in reversed(confirmed[:-1]):
            theta, there = judged(s)
            fewer = replace(judgement, compared=s, added=True, refusal=None, after=there)
            if fewer.improves:
                judgement, compared, last, after = fewer, s, theta, there
                break
    if compared is not None and judgement.errors and not judgement.added and added:
        # The right effect with a strength fitted in windows may be off over minutes: it is fitted by these once more.
        again, intervals = free.refitted(fit_records, compared)
        theta, there = calibrates(again, decided.stand.task)
        other = replace(
            judgement, compared=free.in_windows(searching.task, again), added=True, refusal=None, after=there,
            intervals=intervals,
        )  # fmt: skip
        if other.improves:
            judgement, last, after = other, theta, there
    if decided.joined is not None and before is not None:
        # What was found in free simulation takes the place of what windows found where it does better there.
        theta, there = calibrates(decided.joined.solution, decided.stand.task)
        assert there is not None
        now = after if judgement.added and after is not None else before
        if there.summary()["gap_rmse_m"] < now.summary()["gap_rmse_m"]:
            other = replace(
                judgement, compared=free.in_windows(searching.task, decided.joined.solution), added=True, refusal=None,
                after=there, intervals=decided.joined.intervals,
            )  # fmt: skip
            if other.improves:
                judgement, last = other, theta
    return judgement, last


def corrected(prepared: Records, final: Solution, theta: np.ndarray, by: str) -> SavedModel:
    """Return the corrected model as it is saved: effects, shared parameters, the median driver and every driver."""
    added, numbers = terms.effects_of(final.model, final.values)
    # Effects that adapt a driver are chained as in discovery's loop.
    added.sort(key=lambda e: e.rank if e.hook == "adapt" else 0)
    seen = np.unique(prepared.group)
    middle = np.exp(np.median(theta[seen], axis=0))
    law = final.model.catalogue.base

    def bounded(values: np.ndarray) -> dict[str, dict[str, float]]:
        told: dict[str, dict[str, float]] = {}
        for v, (name, p) in zip(values, final.model.catalogue.of_driver, strict=True):
            told.setdefault(name, {})[p.name] = float(np.clip(v, p.low, p.high))
        return told

    drivers = {prepared.groups[group]: bounded(np.exp(theta[group])) for group in seen}
    return SavedModel(
        effects=(law, *added, Brakes()),
        parameters={**numbers, **bounded(middle)},
        dt=prepared.dt,
        integration="midpoint",
        drivers=drivers if by != "all" else {},
        by=by,
    )
