"""Does the table mean metres, seconds and m/s? Feet, km/h, milliseconds and frames are named, never guessed away."""

import math

import polars as pl

from idm_env.data.errors import DataError, Repair
from idm_env.data.schema import (
    DEFAULT_LENGTH_M,
    HIGHEST_SPEED_MPS,
    LONGEST_LENGTH_M,
    LOWEST_SPEED_MPS,
    TRACK,
    taken_as_missing,
)

LONGEST_MEDIAN_LENGTH_M = 12.0
LONGEST_STEP_S = 2.0
MOVED_M, MOVED_S = 0.5, 1.0
"""A vehicle moves whose positions differ by more (m) over about so long (s): the noise of standing ones is less."""
SAME_M = 0.01
"""Gaps that differ by less from the distance of two fronts were taken from it (m)."""
FOOT = 3.281
# speed_mps divided by the change of position_m over the change of time_s, if one of the three is in another unit
_MISTAKES = (
    (3.6, "speed_mps looks like km/h; divide it by 3.6"),
    (3.281, "speed_mps looks like feet per second; multiply it by 0.3048"),
    (2.237, "speed_mps looks like miles per hour; multiply it by 0.44704"),
    (1 / 3.281, "position_m looks like feet; multiply it by 0.3048"),
    (10.0, "time_s looks like frames of 0.1 s; divide it by 10"),
    (1000.0, "time_s looks like milliseconds; divide it by 1000"),
)


def check(frame: pl.DataFrame, source: str, longest_step: float = LONGEST_STEP_S) -> None:
    """Raise DataError if lengths, speeds, steps of time or their ratio are not those of SI units.

    ``longest_step`` (s) is what samples may be apart: more for tracks that are meant to be sparse.

    Speeds are checked where the file gives them; a speed that is a fixed multiple of the change of position is the
    surest sign of a wrong unit, so that it is looked for first. Who moves is told by positions, never by the speed
    that is checked.
    """
    step = frame.select(pl.col("time_s").diff().over(TRACK).median()).item()
    if "speed_mps" in frame.columns:
        _check_ratio(frame, source, step)
    if step is not None and step > longest_step:
        raise DataError(f"{source}: time_s rises by {step:g} s a row; is it in milliseconds or frames? Use seconds.")
    if "length_m" in frame.columns:
        lengths = frame["length_m"].drop_nulls()
        median = lengths.median() if len(lengths) else None
        if isinstance(median, float) and median > LONGEST_MEDIAN_LENGTH_M:
            raise DataError(
                f"{source}: the median length_m is {median:.1f}, above {LONGEST_MEDIAN_LENGTH_M:g} m; the file looks "
                "like feet: multiply lengths, positions, gaps and speeds by 0.3048."
            )
    if "speed_mps" in frame.columns and frame["speed_mps"].null_count() < frame.height:
        high = frame["speed_mps"].quantile(0.99)
        if high is not None and high > HIGHEST_SPEED_MPS:
            raise DataError(
                f"{source}: 1 % of speeds exceed {high:.1f}, above {HIGHEST_SPEED_MPS:g} m/s; the file looks like km/h "
                "or feet per second: convert it to metres and m/s."
            )
        return
    change = (pl.col("position_m").diff() / pl.col("time_s").diff()).over(TRACK)
    moved = frame.select(change.alias("speed"))["speed"]
    high = moved.filter(moved.is_finite().fill_null(False)).quantile(0.75)
    if high is not None and high > HIGHEST_SPEED_MPS:
        raise DataError(
            f"{source}: position_m changes by more than {high:.1f} m/s in a quarter of the rows, and no car by more "
            f"than {HIGHEST_SPEED_MPS:g} m/s; are time_s in seconds and position_m in metres, and is vehicle_id of one "
            "vehicle each?"
        )


def _check_ratio(frame: pl.DataFrame, source: str, step: float | None) -> None:
    if not step:
        return
    lag = max(1, round(MOVED_S / step)) if step < MOVED_S else 1
    seconds = pl.col("time_s").diff(lag).over(TRACK)
    moved = pl.col("position_m").diff(lag).over(TRACK)
    speed = (pl.col("speed_mps") + pl.col("speed_mps").shift(lag).over(TRACK)) / 2
    moves = (moved.abs() > MOVED_M) & (seconds <= 2.5 * lag * step)
    pairs = frame.select((moved / seconds).alias("change"), speed.alias("speed"), moves.alias("moves"))
    pairs = pairs.filter(pl.col("moves") & pl.col("change").is_finite() & pl.col("speed").is_not_null())
    if pairs.height < 20:
        return
    low, ratio, high = (pairs.select((pl.col("speed") / pl.col("change")).quantile(q)).item() for q in (0.4, 0.5, 0.6))
    if 0.75 <= ratio <= 1.33:
        return
    if ratio < 0:
        raise DataError(f"{source}: speed_mps is negative while position_m rises; change its sign.")
    if ratio == 0:
        raise DataError(f"{source}: speed_mps is 0 while position_m rises; fill it, or remove the column.")
    factor, cure = min(_MISTAKES, key=lambda mistake: abs(math.log(ratio / mistake[0])))
    is_unit = abs(ratio / factor - 1) < 0.1
    if is_unit or low > 1.33 or high < 0.75:
        cure = cure if is_unit else "check their units"
        raise DataError(f"{source}: speed_mps is {ratio:.3g} times the change of position_m per second; {cure}.")


def check_gaps(joined: pl.DataFrame, source: str) -> None:
    """Raise DataError if measured gaps are in feet and positions in metres or the other way round, or hold a length.

    ``joined`` has gap_m, gap_measured, headway (front bumper to front bumper, from positions) and lead_length. Gaps of
    other origin than positions (radar, antennas) may differ from theirs by metres, but not by one factor.
    """
    pairs = joined.filter(pl.col("gap_measured")).select(
        "headway",
        "lead_length",
        pl.col("gap_m").alias("given"),
        (pl.col("headway") - pl.col("lead_length")).alias("derived"),
    )
    pairs = pairs.filter((pl.col("given") > 2.0) & (pl.col("derived") > 2.0))
    if pairs.height < 20:
        return
    fronts = pairs.filter(pl.col("lead_length") != DEFAULT_LENGTH_M)  # else leaders may stand for their rear bumpers
    if fronts.height >= 20 and fronts.select((pl.col("given") - pl.col("headway")).abs().quantile(0.9)).item() < SAME_M:
        raise DataError(
            f"{source}: gap_m is the distance from front to front, with the leader's length in it; subtract that, or "
            "leave the column out."
        )
    low, ratio, high = (pairs.select((pl.col("given") / pl.col("derived")).quantile(q)).item() for q in (0.2, 0.5, 0.8))
    for factor, wrong in ((FOOT, "gap_m looks like feet"), (1.0 / FOOT, "position_m looks like feet")):
        if 0.9 * factor < low <= high < 1.1 * factor:
            raise DataError(f"{source}: gap_m is {ratio:.3g} times the positions' gap; {wrong}: multiply it by 0.3048.")


def implausible(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair]]:
    """Empty single speeds and lengths that no vehicle has (the unit itself having been checked), counted."""
    repairs: list[Repair] = []
    bounds = {"speed_mps": (LOWEST_SPEED_MPS, HIGHEST_SPEED_MPS, "m/s"), "length_m": (0.1, LONGEST_LENGTH_M, "m")}
    for name, (low, high, unit) in bounds.items():
        if name not in frame.columns:
            continue
        good, words = frame[name].is_between(low, high).fill_null(True), f"outside [{low:g}, {high:g}] {unit} are"
        frame, done = taken_as_missing(frame, name, good, "implausible value", words)
        repairs += done
    return frame, repairs
