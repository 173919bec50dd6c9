"""Many steps of worlds with a policy between them, and their adjoint, in one call each.

Policy and step are loops over rows. What every step is given was laid out beforehand: tables of addresses, one a step.
A window goes on until the worlds of some row end: they begin anew outside. The worlds of a block do several steps
before those of the next one do: what they read and write stays in the cache.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from idm_env.kernels.dense import PITCH
from idm_env.kernels.phases import call_rows
from idm_env.kernels.tiles import exact

BLOCK = PITCH
"""Rows of a block: as many as the loops of a policy do at once."""

AHEAD = 8
"""Steps that a block does before the next one; where an episode ends in another block they are done again."""


@exact
def window(policy, acts, step, asks, rows, begin, end, first, last, seen, last_seen, ends, cuts):
    """Do steps ``first`` to ``last`` of some blocks, or until somebody's episode is over; return the next step.

    ``seen`` (steps + 1, …) is what the policy observes and ``last_seen`` (steps, …) what is observed after a step;
    ``ends`` and ``cuts`` (steps, rows) tell whose episode is over. Blocks before the one that stops have done more:
    those steps are done again, and read what they read before.
    """
    wide, stop = seen.shape[1] // rows, last
    for block in range(begin, end):
        low, high, t = block * BLOCK, min((block + 1) * BLOCK, rows), first
        while t < stop:
            call_rows(policy, low, high, acts[t])  # type: ignore[call-arg]
            call_rows(step, low, high, asks[t])  # type: ignore[call-arg]
            for i in range(low * wide, high * wide):
                seen[t + 1, i] = last_seen[t, i]
            t += 1
            for i in range(low, high):
                if ends[t - 1, i] or cuts[t - 1, i]:
                    stop = t
    return stop


@exact
def window_back(
    policy, acts, step, asks, rows, size, begin, end, odd, steps, ends, cuts, on_worlds, pasts, on_seen, on_last,
    on_acted, acted, told, looked, total, recalled, on_later, remembers, each, parameters,
):  # fmt: skip
    """Do the adjoint of some steps of some blocks, the last step first; ``odd`` says whether the first one's number is.

    ``on_worlds`` (2, blocks, vehicles) and ``pasts`` (2, rows, …) take turns as what falls on a world before and after
    a step. ``on_seen``, ``on_last`` and ``on_acted`` fall on what was observed and done; ``acted`` falls on actions in
    all, ``told`` on what was observed after a step. ``looked`` is what comes from the policy, and ``total`` all that
    falls on what it saw. ``recalled`` falls on what it remembered before a step (``remembers``: if anything does),
    ``on_later`` on that after it. What falls on parameters in ``each`` step is added. Nothing flows into another
    episode.
    """
    wide, many, deep = told.shape[0] // rows, acted.shape[1] // rows, on_later.shape[0] // rows
    for block in range(begin, end):
        low, high = block * BLOCK, min((block + 1) * BLOCK, rows)
        for t in range(steps - 1, -1, -1):
            later = (t + odd + 1) % 2
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
                    pasts[later, i] = 0
            call_rows(step, low, high, asks[t])  # type: ignore[call-arg]
            for i in range(len(parameters)):
                for j in range(low * size, high * size):
                    parameters[i, j] += each[i, j]
            for i in range(low * many, high * many):
                acted[t, i] += on_acted[t, i]
            call_rows(policy, low, high, acts[t])  # type: ignore[call-arg]
            for i in range(low * wide, high * wide):
                total[i] = on_seen[t, i] + looked[i]
