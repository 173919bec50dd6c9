"""From trajectories to a verdict: what does the Intelligent Driver Model lack on these roads, how sure is that, and how
much better is the corrected model on runs that had no part in it.
"""  # noqa: D205

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from idm_env.data import Trajectories, episodes
from idm_env.data.recorders import on_one_clock
from idm_env.discovery import calibrate, judge, march, model as terms, noise, records, search
from idm_env.discovery.finish import Discovery, finished
from idm_env.discovery.judge import Judged
from idm_env.discovery.judgement import Evaluation
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.records import Records
from idm_env.discovery.search import Search
from idm_env.discovery.selection import Decided, decide
from idm_env.discovery.solve import Problem
from idm_env.discovery.write import write_search
from idm_env.effects import ALL, CANDIDATES, PACKAGED, base_named, candidates, make, named, register
from idm_env.effects.base import CarFollowing, Effect
from idm_env.fitting.fit import refuse_nan
from idm_env.jobs import storage
from idm_env.jobs.progress import OnProgress, silent
from idm_env.parameters import nearest


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
        seed: Of the draw of the test set and of sign flips.
        located: Whether effects without a name are looked for too.
        lockbox: Share of the runs in the test set, which neither fit nor choose.
        base: The car-following law that is to be completed, if not IDM.

    Raises:
        ValueError: For unknown effects, or a folder left by other data.
        DataError: For data that cannot be used.
    """
    progress = on_progress or silent
    law = base_named(base) if isinstance(base, str) else base
    chosen = _chosen(effects, known)
    trajectories = on_one_clock(trajectories)
    prepared = prepare(trajectories, by, place)
    refused = terms.testable(prepared, chosen)
    tried = [_measured(prepared, e) for e in chosen if e.name not in refused and e.name not in known]
    names = [e.name for e in tried]
    if not names:
        why = "; ".join(f"{name}: {reason}" for name, reason in refused.items()) or "all of them are known"
        raise ValueError(f"no candidate can be tried on these data ({why}). Name others, or leave out --effects.")
    refuse_nan(prepared.episodes, law, tried)
    fit_runs, test_runs = _split(prepared, lockbox, seed)
    if out is not None:
        options = (list(map(repr, tried)), tuple(known), seed, located, lockbox, repr(law))
        mark = storage.fingerprint(prepared.groups, prepared.runs, options, prepared.signals)
        prepared = replace(prepared, kept=storage.Store(out / storage.UNFINISHED / "explain", mark, resume))
    rows = records.windows(prepared.of_runs(fit_runs))
    # Profiles over places as the file gives them.
    known_terms = tuple(terms.known_profile(n, *_profile(prepared, ALL[n].column), prepared.period) for n in known)
    own = [e for e in tried if e.kind not in PACKAGED or e != make(e.kind)]
    extra = [*own, *(terms.known_effect(term) for term in known_terms)]
    test = prepared.of_runs(test_runs) if test_runs else None

    def searched(bare: Hypothesis, errors: Judged | None = None) -> tuple[Evaluation, Decided]:
        """Return what is found beyond a model, which is calibrated and judged as the null: ``errors``, where it is."""
        problem = Problem(rows, noise.first_noise(rows), calibrate.first_prior(bare.catalogue.own))
        others = [name for name in names if name not in bare.catalogue.personal]
        searching = Search(problem, others, located and effects is None, progress, bare)
        progress("null", 0, 0, bare.catalogue.base.title)
        values = search.starting_values(bare)
        null = searching.null(bare, judge.unweighed(rows.records, bare, values, problem.prior)[1], values)
        decided = decide(searching, null, seed)
        progress("final check", 0, 0, "test set")
        return Evaluation(searching, decided.null, prepared, test, by == "driver", seed, errors), decided

    evaluation, decided = searched(Hypothesis(known_terms, march.Catalogue.of(extra, prepared.period, law)))
    try:
        discovery = finished(trajectories, evaluation, decided, refused, by, partial(progress, "other laws"), searched)
    except Exception as error:
        if out is not None:
            path = write_search(out, decided, prepared, by)
            error.add_note(f"What the search saw is in {path}; with --resume it need not search again.")
        raise
    if prepared.kept is not None:
        prepared.kept.remove()
    return discovery


# -- before the search -----------------------------------------------------------------------------------------------


def _chosen(effects: Sequence[str | Effect | type[Effect]] | None, null_effects: Sequence[str]) -> list[Effect]:
    """Return the candidates as effects, those of the user's own registered."""
    chosen: list[Effect] = []
    for candidate in candidates() if effects is None else effects:
        if isinstance(candidate, str):
            name = named(candidate)
        else:
            name = register(candidate if isinstance(candidate, type) else type(candidate)).kind
        if name not in candidates():
            raise ValueError(f"effect '{name}' is no candidate.{nearest(name, candidates())}")
        chosen.append(candidate if isinstance(candidate, Effect) else make(name))
        if chosen[-1].name != name:
            raise ValueError(f"effect '{name}' calls itself '{chosen[-1].name}': a candidate needs its class's name.")
    for name in null_effects:
        if name not in CANDIDATES:
            raise ValueError(f"effect '{name}' is no candidate.{nearest(name, CANDIDATES)}")
        if not ALL[name].column:
            able = ", ".join(f"'{n}' (column {ALL[n].column})" for n in CANDIDATES if ALL[n].column)
            raise ValueError(f"known effect '{name}' cannot be read from data; only these can: {able}.")
    return list({e.name: e for e in chosen}.values())


def prepare(trajectories: Trajectories, by: str, place: str | None = None) -> Records:
    """Return the flat records of smoothed episodes, thinned where there are more than can be rolled out in time.

    ValueError for a place column that is missing.
    """
    if place is not None:
        if place not in trajectories.table.columns:
            raise ValueError(f"place column '{place}' is missing.{nearest(place, trajectories.table.columns)}")
        trajectories = replace(trajectories, place=place)
    measured = episodes(trajectories, smooth=True, min_seconds=12.0)
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
    return records.gather(list(measured), by, period, trajectories)


def _split(prepared: Records, share: float, seed: int) -> tuple[list[str], list[str]]:
    runs = [r for i, r in enumerate(prepared.runs) if np.any(prepared.run == i)]
    if len(runs) < 2:
        return runs, []
    count = min(max(1, round(share * len(runs))), len(runs) - 1)
    test = {runs[i] for i in np.random.default_rng(seed).permutation(len(runs))[:count]}
    return [r for r in runs if r not in test], [r for r in runs if r in test]


def _measured(prepared: Records, effect: Effect) -> Effect:
    """Return an effect whose profile a column gives with that profile, any other as it is."""
    if effect.sought != "given":
        return effect
    first, distance, profile = _profile(prepared, effect.column)
    knots = tuple(first + distance * i for i in range(len(profile)))
    return replace(effect, knots=knots, profile=tuple(profile), period=prepared.period or None)  # type: ignore[call-arg]


def _profile(prepared: Records, column: str) -> tuple[float, float, list[float]]:
    """Return first place, distance and values of a column over places; DataError where no record tells."""
    # Where a record does not tell, the profile of the others is taken for the same place.
    recorded = [e for e in prepared.episodes if column in e.columns]
    if not recorded:
        raise ValueError(f"a profile over places needs the column {column} without holes, and none has it. Fill it in.")
    place = np.concatenate([e.place_m for e in recorded])
    value = np.concatenate([e.columns[column] for e in recorded])
    period = prepared.period
    place = np.mod(place, period) if period else place
    low, high = (0.0, period) if period else (float(place.min()), float(place.max()))
    count = int(np.clip((high - low) / 30.0, 3, 60))
    distance = (high - low) / (count if period else count - 1)
    index = np.round((place - low) / distance).astype(int) % count
    total, number = (np.bincount(index, weights, count) for weights in (value, None))
    profile = np.interp(np.arange(count), np.flatnonzero(number), total[number > 0] / number[number > 0])
    return low, distance, profile.tolist()
