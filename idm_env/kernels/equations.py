"""IDM + Brakes for one vehicle and one step, compiled: values as ``Simulator.step`` computes them, and derivatives.

The second source of the mathematics, so every function here has a parity test. ``follow``, ``brake`` and
``integrate`` do the same operations in the same order as the effects do in torch, without fused multiply-adds, save
that divisions by parameters are products with ``inverses``: results differ by rounding only. ``linearise`` gives every
first derivative of one step, which the tangent and the adjoint sweeps share.

Everything is scalar code that LLVM vectorises over the vehicles of a tile: no branches, only selections, and constants
of the state's own precision (a Python literal would promote float32 to float64). The loops around it run over rows of
one flat workspace at distances that the compiler knows, so it need not test two dozen arrays for overlap, which it
refuses to do and then emits scalar code. Every loop reads all that it needs before it selects: with loads inside a
selection, LLVM has been seen to move one past the store that follows it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from idm_env.effects.idm import SMALLEST_GAP
from idm_env.kernels.tiles import Array, compiler
from idm_env.types import FAR

exact = compiler()
"""Compiler for whatever yields values: IEEE arithmetic as written, so values do not depend on the loop around them."""

swift = compiler(fastmath={"contract"})
"""Compiler for derivatives: may contract a product and a sum into one rounding. Nothing that assumes away NaN."""

exact_inlined = compiler(forceinline=True)
"""As ``exact``, for the body of a loop: a call that is not inlined cannot be vectorised."""

swift_inlined = compiler(fastmath={"contract"}, forceinline=True)
"""As ``swift``, for the body of a loop."""


class Constants(NamedTuple):
    """Numbers of one simulator, all in the precision of the state."""

    dt: float
    half_dt: float
    inverse_dt: float
    zero: float
    half: float
    one: float
    two: float
    three: float
    four: float
    smallest_gap: float
    tangent: float
    far: float
    width: float
    double_width: float
    inverse_square_width: float


COUNT = len(Constants._fields)


def constants(dt: float, width: float, dtype: np.dtype[Any]) -> Array:
    """Return the constants as one array, rounded as torch rounds a Python number that meets a tensor."""
    values = Constants(
        dt=dt,
        half_dt=0.5 * dt,
        inverse_dt=1.0 / dt,
        zero=0.0,
        half=0.5,
        one=1.0,
        two=2.0,
        three=3.0,
        four=4.0,
        smallest_gap=SMALLEST_GAP,
        tangent=2.0 / SMALLEST_GAP**3,
        far=FAR,
        width=width,
        double_width=2.0 * width,
        inverse_square_width=1.0 / width**2,
    )
    return np.array(values, dtype=dtype)


@exact_inlined
def unpack(c: Array) -> Constants:
    """Return the constants by name."""
    return Constants(
        c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9], c[10], c[11], c[12], c[13], c[14]
    )  # fmt: skip


@exact_inlined
def inverses(a, b, v0, k):  # type: ignore[no-untyped-def]
    """Return ``1 / (2 √(a b))`` and ``1 / v0``: a division costs ten products, and parameters hold for many steps."""
    return k.half / np.sqrt(a * b), k.one / v0


@exact_inlined
def follow(gap, speed, lead_speed, led, a, inverse_brake, time_gap, min_gap, inverse_v0, k):  # type: ignore[no-untyped-def]
    """Return ``a [1 − (v/v0)⁴ − (s*/s)²]``, as ``effects.idm.IDM`` with δ = 4 and no sharpness (m/s²)."""
    ratio = speed * inverse_v0
    square = ratio * ratio
    dynamic = speed * (time_gap + (speed - lead_speed) * inverse_brake)
    wanted = min_gap + (k.zero if dynamic < k.zero else dynamic)
    safe = k.smallest_gap if gap < k.smallest_gap else gap
    below = k.smallest_gap - gap
    below = k.zero if below < k.zero else below
    term = wanted * wanted * (k.one / (safe * safe) + below * k.tangent)
    return a * (k.one - square * square - term * led)


@exact_inlined
def brake(accel, speed, max_decel, is_euler, k):  # type: ignore[no-untyped-def]
    """Apply the exact, C¹ floor of ``effects.limits.Brakes`` without sharpness (m/s²)."""
    floor = -max_decel
    if is_euler:
        stop = -speed / k.dt
        floor = stop if stop > floor else floor
    above = accel - floor
    above = k.zero if above < k.zero else above
    part = k.width if above > k.width else above
    return floor + part * part * (k.double_width - part) * k.inverse_square_width + (above - part)


@exact_inlined
def integrate(speed, accel, is_euler, k):  # type: ignore[no-untyped-def]
    """Return displacement (m), new speed (m/s) and realised acceleration, as ``simulator.ballistic`` or ``euler``."""
    after = speed + accel * k.dt
    if is_euler:
        return speed * k.dt, (k.zero if after < k.zero else after), accel
    stops = after < k.zero
    braking = -accel if stops else k.one
    stopped = k.half * speed * speed / braking
    moved = k.half_dt * (speed + after)
    return (
        stopped if stops else moved,
        k.zero if stops else after,
        -speed * k.inverse_dt if stops else accel,
    )


class Slopes(NamedTuple):
    """First derivatives of one step.

    ``accel_*``: of the braked acceleration, by what it depends on (``raw`` is the acceleration before the brakes: an
    agent's command or noise). ``speed_*``, ``moved_*``, ``felt_*``: of the new speed, the displacement and the realised
    acceleration, by the old speed and by the braked acceleration.
    """

    accel_raw: float
    accel_gap: float
    accel_speed: float
    accel_lead_speed: float
    accel_max_accel: float
    accel_comfort_decel: float
    accel_time_gap: float
    accel_min_gap: float
    accel_desired_speed: float
    accel_max_decel: float
    accel_floor_speed: float
    speed_speed: float
    speed_accel: float
    moved_speed: float
    moved_accel: float
    felt_speed: float
    felt_accel: float


@swift_inlined
def linearise(  # type: ignore[no-untyped-def]
    gap, speed, lead_speed, led, raw, a, b, inverse_brake, time_gap, min_gap, inverse_v0, max_decel, is_euler, k
):
    """Return ``Slopes`` at one state; ``raw`` is the acceleration before the brakes (m/s²).

    At kinks the one-sided derivative that torch's autograd takes (``relu`` 0, ``clamp`` 1, ``maximum`` one half).
    """
    # Brakes: f'(x) = x (4w − 3x)/w² up to w, then 1; whatever f does not pass on, the floor does.
    floor = -max_decel
    by_speed = k.zero
    if is_euler:
        stop = -speed * k.inverse_dt
        by_speed = k.one if stop > floor else (k.half if stop == floor else k.zero)
        floor = stop if stop > floor else floor
    above = raw - floor
    above = k.zero if above < k.zero else above
    part = k.width if above > k.width else above
    g = part * (k.four * k.width - k.three * part) * k.inverse_square_width
    rest = k.one - g
    x = above - part
    accel = floor + part * part * (k.double_width - part) * k.inverse_square_width + x
    # IDM
    ratio = speed * inverse_v0
    cube = ratio * ratio * ratio
    closing = speed - lead_speed
    rate = time_gap + closing * inverse_brake
    dynamic = speed * rate
    wanted = min_gap + (k.zero if dynamic < k.zero else dynamic)
    safe = k.smallest_gap if gap < k.smallest_gap else gap
    inside = gap < k.smallest_gap
    inverse_gap = k.one / safe
    inverse_square = inverse_gap * inverse_gap
    steep = k.tangent if inside else k.two * inverse_square * inverse_gap
    inverse_square = inverse_square + (k.smallest_gap - gap) * k.tangent if inside else inverse_square
    by_term = -a * led * g
    by_wanted = k.two * wanted * inverse_square * by_term
    by_dynamic = by_wanted if dynamic > k.zero else k.zero
    by_closing = by_dynamic * speed * inverse_brake
    by_free = k.four * a * g * cube * inverse_v0
    root = -by_closing * closing * inverse_brake * inverse_brake * k.two
    # Integration
    stops = speed + accel * k.dt < k.zero
    safe_accel = accel if stops else -k.one
    share = -speed / safe_accel
    if is_euler:
        moved_speed, moved_accel = k.dt, k.zero
        felt_speed, felt_accel = k.zero, k.one
        speed_speed, speed_accel = (k.zero, k.zero) if stops else (k.one, k.dt)
    else:
        moved_speed = share if stops else k.dt
        moved_accel = k.half * share * share if stops else k.half_dt * k.dt
        felt_speed = -k.inverse_dt if stops else k.zero
        felt_accel = k.zero if stops else k.one
        speed_speed = k.zero if stops else k.one
        speed_accel = k.zero if stops else k.dt
    return Slopes(
        g,
        -wanted * wanted * steep * by_term,
        by_dynamic * rate + by_closing - by_free,
        -by_closing,
        g * (k.one - cube * ratio - wanted * wanted * inverse_square * led) + root * b,
        root * a,
        by_dynamic * speed,
        by_wanted,
        by_free * ratio,
        -(k.one - by_speed) * rest,
        -by_speed * rest * k.inverse_dt,
        speed_speed,
        speed_accel,
        moved_speed,
        moved_accel,
        felt_speed,
        felt_accel,
    )
