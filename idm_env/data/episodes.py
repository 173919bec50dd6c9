"""Cuts trajectories into episodes: stretches in which one driver follows one leader that is measured all along."""

import numpy as np
import polars as pl

from idm_env.data import columns, records
from idm_env.data.episode import Episode, Episodes
from idm_env.data.errors import DataError, Repair
from idm_env.data.neighbours import Neighbours, find
from idm_env.data.schema import LEADER_LOST_GAP_M, SHORTEST_TRACK_S, spans, track_numbers
from idm_env.data.trajectories import Trajectories


def episodes(
    trajectories: Trajectories,
    *,
    min_seconds: float = SHORTEST_TRACK_S,
    max_gap: float | None = LEADER_LOST_GAP_M,
    smooth: bool = False,
    dt: float | None = None,
) -> Episodes:
    """Return every stretch in which a driver follows one leader that is measured all along.

    A stretch ends where the leader changes or is not measured, where time has a hole, and where the gap is missing, not
    positive, or above `max_gap`. Every row so left out is counted in ``left_out``.

    Args:
        trajectories: Checked trajectories.
        min_seconds: Shorter stretches are left out.
        max_gap: Gaps above this (m) mean a lost leader; None keeps them all.
        smooth: Smooth the records of the leader and the neighbours, and the driver's speed. What was measured of the
            driver stays the target: the gap where the file measures gaps, the position otherwise.
        dt: Time step in s; a multiple of the file's, of which then every n-th row is used.

    Raises:
        DataError: If no stretch is left, or `dt` is no multiple of the file's step.
    """
    table = columns.with_step(trajectories)
    around = find(table)
    valid, left_out = _valid(trajectories, table, around, table["gap_m"].to_numpy(), max_gap)
    stretches, changes, too_short = _spans(trajectories, table, valid, min_seconds)
    if changes:
        text = f"The leader changes at {changes} rows; the stretch was split there."
        left_out.append(Repair("leader changes", changes, text))
    if too_short:
        rows = sum(end - begin for begin, end in too_short)
        text = f"{len(too_short)} stretches ({rows} rows) shorter than {min_seconds:g} s were left out."
        left_out.append(Repair("too short", len(too_short), text))
    if not stretches:
        reasons = " ".join(repair.text for repair in left_out)
        if too_short:
            reasons += " Where samples are missing, idm-env reconstruct fills the holes."
        raise DataError(f"{trajectories.source}: no driver follows a leader for {min_seconds:g} s. {reasons}")
    source = records.RecordColumns.from_table(trajectories, table, around)
    numbers, texts = columns.extra(table)
    items = []
    count: dict[tuple[str, str], int] = {}
    for begin, end in stretches:
        run, vehicle = table["run_id"][begin], table["vehicle_id"][begin]
        count[run, vehicle] = count.get((run, vehicle), -1) + 1
        span = slice(begin, end, _stride(trajectories, run, dt))
        motions = source.motions(span, smooth)
        items.append(
            Episode(
                run_id=run,
                vehicle_id=vehicle,
                leader_id=table["leader_id"][begin],
                key=f"{run}/{vehicle}/{count[run, vehicle]}",
                dt=trajectories.steps[run] * (span.step or 1),
                time_s=table["time_s"].to_numpy()[span].copy(),
                length_m=float(table["length_m"][begin]),
                place_m=_place(trajectories, source.place[span], run),
                columns=columns.of_span(numbers, span),
                labels=columns.labels(table, texts, begin, end),
                **motions,
            )
        )
    return Episodes(tuple(items), tuple(left_out))


def _valid(
    trajectories: Trajectories, table: pl.DataFrame, around: Neighbours, gap: np.ndarray, max_gap: float | None
) -> tuple[np.ndarray, list[Repair]]:
    """Return which rows can be used, and the counted reasons why others cannot."""
    follows = table["leader_id"].is_not_null().to_numpy()
    if trajectories.drivers is not None:
        chosen = pl.DataFrame(sorted(trajectories.drivers), schema=["run_id", "vehicle_id"], orient="row")
        mine = table.select("run_id", "vehicle_id").join(
            chosen.with_columns(mine=True), on=["run_id", "vehicle_id"], how="left", maintain_order="left"
        )
        follows &= mine["mine"].fill_null(False).to_numpy()
    valid = follows.copy()
    repairs = []
    highest = np.inf if max_gap is None else max_gap
    with np.errstate(invalid="ignore"):
        rules = [
            ("leader not measured", around.leader < 0, "whose leader is not measured at that time"),
            ("no gap", np.isnan(gap), "without a gap"),
            ("gap not positive", gap <= 0, "with a gap of 0 m or less"),
            (f"gap above {highest:g} m", gap > highest, f"with a gap above {highest:g} m, taken as a lost leader,"),
        ]
    for kind, wrong, words in rules:
        out = valid & wrong
        if out.any():
            vehicles = table.filter(pl.Series(out)).select("run_id", "vehicle_id").n_unique()
            text = f"{out.sum()} rows of {vehicles} drivers {words} were left out."
            is_most = wrong is rules[-1][1] and out.sum() > valid.sum() / 2
            most = "most rows (is --max-gap too small?), " if is_most else ""
            repairs.append(Repair(most + kind, int(out.sum()), text))
            valid &= ~wrong
    return valid, repairs


def _spans(
    trajectories: Trajectories, table: pl.DataFrame, valid: np.ndarray, min_seconds: float
) -> tuple[list[tuple[int, int]], int, list[tuple[int, int]]]:
    """Return [begin, end) of the stretches, the number of changes of leader, and the stretches that are too short."""
    track, leader = track_numbers(table), track_numbers(table, ("run_id", "leader_id"))
    both = valid[1:] & valid[:-1] & (track[1:] == track[:-1]) & (np.diff(table["step"].to_numpy()) == 1)
    joined = both & (leader[1:] == leader[:-1])
    long: list[tuple[int, int]] = []
    short: list[tuple[int, int]] = []
    for begin, end in spans(joined, valid):
        step = trajectories.steps[table["run_id"][begin]]
        enough = (end - begin) * step >= min_seconds - 1e-9 and end - begin > 3
        (long if enough else short).append((begin, end))
    return long, int((both & ~joined).sum()), short


def _place(trajectories: Trajectories, values: np.ndarray, run: str) -> np.ndarray:
    filled = columns.filled(values)
    if filled is None:
        raise DataError(f"{trajectories.source}: column {trajectories.place!r} is empty in run {run}; name another.")
    return filled


def _stride(trajectories: Trajectories, run: str, dt: float | None) -> int:
    if dt is None:
        return 1
    stride = dt / trajectories.steps[run]
    if stride < 0.99 or abs(stride - round(stride)) > 0.01:
        step = trajectories.steps[run]
        raise DataError(f"dt = {dt:g} s is no multiple of the step of run {run}, {step:g} s. Give dt={step:g}.")
    return round(stride)
