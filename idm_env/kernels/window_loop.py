"""Many steps of worlds with a policy between them, and their adjoint, in one call each.

A step is ``world_loop``'s, the policy ``policy_rows``'. What every step is given was laid out beforehand: tables of
addresses, one a step. A window goes on until the worlds of some row end: they begin anew outside. Worlds of a tile do
several steps before those of the next one do: what they read and write stays in the cache, and their parameters are
laid out once.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from idm_env.kernels.phases import call_rows
from idm_env.kernels.tiles import exact
from idm_env.kernels.world_loop import cut, retreat_worlds, step_worlds

AHEAD = 8
"""Steps that a tile does before the next one; where an episode ends in another tile they are done again."""


@exact
def window(
    policy, acts, before, asks, after, tells, clocks, later_clocks, places, strides, w, h, past, newest, measures,
    phases, looks, recalls, read, k, extent, at, groups, first, last, ends, cuts, seen, last_seen,
):  # fmt: skip
    """Do steps ``first`` to ``last``, or until one after which somebody's episode is over; return the next step.

    ``seen`` (steps + 1, …) is what the policy observes and ``last_seen`` (steps, …) what is observed after a step;
    ``ends`` and ``cuts`` (steps, rows) tell whose episode is over.
    """
    slots, wide, done = extent[0], seen.shape[1] // extent[1], first
    while done < last:
        stop, over = min(done + AHEAD, last), False
        for tile in range(groups):
            low, high, _, _ = cut(extent, tile, tile + 1)
            t = done
            while t < stop:
                call_rows(policy, low, high, acts[t])  # type: ignore[call-arg]
                step_worlds(
                    before, asks[t], after, tells[t], clocks[t], later_clocks[t], places[t], strides, w, h, past,
                    newest + (t - first if slots else 0), measures, phases, looks, recalls, read, k, extent,
                    at + t - first, t > done, tile, tile + 1,
                )  # fmt: skip
                for i in range(low * wide, high * wide):
                    seen[t + 1, i] = last_seen[t, i]
                t += 1
                for i in range(low, high):
                    if t < last:
                        clocks[t, i] = later_clocks[t - 1, i]
                    if ends[t - 1, i] or cuts[t - 1, i]:
                        # Later steps of tiles before this one are done again: they read what they read before.
                        stop, over = t, True
        done = stop
        if over:
            return done
    return last


@exact
def window_back(
    policy, acts, before, asks, after, tells, places, strides, w, h, ah, past, newest, on_ends, on_begins, on_pasts,
    on_parameters, on_inputs, measures, phases, looks, recalls, back, sends, again, k, extent, at, groups, odd, steps,
    ends, cuts, on_worlds, past_worlds, carried, on_seen, on_last, on_acted, acted, told, looked, total,
    recalled, on_later, remembers,
):  # fmt: skip
    """Do the adjoint of some steps, the last one first; ``odd`` says whether the first one's number is.

    ``on_worlds`` (2, blocks, vehicles) and ``past_worlds`` take turns as what falls on a world before and after a step,
    with addresses ``on_ends``, ``on_begins`` and ``on_pasts``. ``on_seen``, ``on_last`` and ``on_acted`` fall on what
    was observed and done; ``acted`` falls on actions in all, ``told`` on what was observed after a step. ``looked`` is
    what comes from the policy, and ``total`` all that falls on what it saw. ``recalled`` falls on what it remembered
    before a step (``remembers``: if anything does), ``on_later`` on that after it. Nothing flows into another episode.
    """
    rows, size, slots = extent[1], extent[2], extent[0]
    wide, many, deep = told.shape[0] // rows, acted.shape[1] // rows, on_later.shape[0] // rows
    for tile in range(groups):
        low, high, _, _ = cut(extent, tile, tile + 1)
        for t in range(steps - 1, -1, -1):
            now, later, since = (t + odd) % 2, (t + odd + 1) % 2, newest + (t if slots else 0)
            laid, more = t < steps - 1, t > 0
            for i in range(low, high):
                over = ends[t, i] or cuts[t, i]
                for j in range(i * wide, (i + 1) * wide):
                    told[j] = on_last[t, j] if over else on_last[t, j] + total[j]
                for j in range(i * deep, (i + 1) * deep):
                    on_later[j] = 0.0 if over else recalled[j]
                    if not remembers:
                        recalled[j] = 0.0
                if over:
                    on_worlds[later, :, i * size : (i + 1) * size] = 0
                    past_worlds[later, :, i * size : (i + 1) * size] = 0
            for i in carried:
                for j in range(low * size, high * size):
                    on_worlds[now, i, j] = on_worlds[later, i, j]
            retreat_worlds(
                after, tells[t], before, asks[t], places[t], strides, w, h, ah, past,
                since, on_ends, on_begins, on_pasts[later], on_pasts[now], on_parameters,
                on_inputs, measures, phases, looks, recalls, back, sends, again, k, extent, at + t, laid, more,
                tile, tile + 1,
            )  # fmt: skip
            for i in range(low * many, high * many):
                acted[t, i] += on_acted[t, i]
            call_rows(policy, low, high, acts[t])  # type: ignore[call-arg]
            for i in range(low * wide, high * wide):
                total[i] = on_seen[t, i] + looked[i]
