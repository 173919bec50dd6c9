"""Many steps of worlds with a policy between them, and their adjoint, in one call each.

Policy and step are loops over rows. What every step is given was laid out beforehand: tables of addresses, one a step.
A window goes on until the worlds of some row end: they begin anew outside. The worlds of a block do several steps
before those of the next one do: what they read and write stays in the cache.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from idm_env.compiled.kernels.dense import PITCH
from idm_env.compiled.kernels.phases import call_rows
from idm_env.compiled.kernels.tiles import exact

BLOCK = PITCH
"""Rows of a block: as many as the loops of a policy do at once."""

AHEAD = 8
"""Steps that a block does before the next one; where an episode ends in another block they are done again."""


@exact
def each_table(step, block, asks, begin, end):
    """Do the steps of some tables with a block of rows, then with the next one: what they touch stays in the cache."""
    for low in range(begin, end, block):
        for ask in asks:
            call_rows(step, low, min(low + block, end), ask)  # type: ignore[call-arg]


@exact
def window(policy, acts, step, asks, rows, held, odd, begin, end, first, last, seen, last_seen, ends, cuts):
    """Do steps ``first`` to ``last`` of some blocks, or until somebody's episode is over; return the next step.

    Every action is ``held`` for some steps; ``odd`` steps of the first one are done. ``seen`` (actions + 1, …) is what
    the policy observes and ``last_seen`` (steps, …) what is observed after a step; ``ends`` and ``cuts`` (steps, rows)
    tell whose episode is over, which ends with its action. Blocks before the one that stops have done more: those
    steps are done again, and read what they read before.
    """
    wide, stop = seen.shape[1] // rows, last
    for block in range(begin, end):
        low, high, t = block * BLOCK, min((block + 1) * BLOCK, rows), first
        while t < stop:
            if (t + odd) % held == 0:
                call_rows(policy, low, high, acts[t])  # type: ignore[call-arg]
            call_rows(step, low, high, asks[t])  # type: ignore[call-arg]
            to = (t + odd + 1) // held
            if (t + odd + 1) % held == 0:
                for i in range(low * wide, high * wide):
                    seen[to, i] = last_seen[t, i]
            t += 1
            for i in range(low, high):
                if ends[t - 1, i] or cuts[t - 1, i]:
                    stop = min(stop, (t + odd + held - 1) // held * held - odd)
    return stop


@exact
def window_back(
    policy, acts, step, asks, rows, size, held, begin, end, first, steps, over, on_worlds, mid, pasts, on_seen, on_last,
    on_acted, acted, done, told, looked, total, recalled, on_later, remembers, each, parameters,
):  # fmt: skip
    """Do the adjoint of some steps of some blocks, the last step first; ``first`` is the number of the first one.

    ``on_worlds`` (2, blocks, vehicles) and ``pasts`` (2, rows, …) take turns as what falls on a world before and after
    a step; what falls on worlds ``mid`` between decisions and a step is added for all steps but the first. ``on_seen``,
    ``on_last`` and ``on_acted`` fall on what was observed and done; ``done`` falls on the action of a step, ``acted``
    on actions in all, ``told`` on what was observed after a step. ``looked`` is what comes from the policy, and
    ``total`` all that falls on what it saw. ``recalled`` falls on what it remembered before a step (``remembers``: if
    anything does), ``on_later`` on that after it. What falls on parameters in ``each`` step is added. Nothing flows
    into another episode, or past the end of one within an action (``over``).
    """
    wide, many, deep = told.shape[0] // rows, acted.shape[1] // rows, on_later.shape[0] // rows
    for block in range(begin, end):
        low, high = block * BLOCK, min((block + 1) * BLOCK, rows)
        for t in range(steps - 1, -1, -1):
            later, now, action = (t + first + 1) % 2, (t + first) % 2, (t + first) // held
            decides_next = (t + first + 1) % held == 0
            for i in range(low, high):
                for j in range(i * wide, (i + 1) * wide):
                    told[j] = on_last[t, j] if over[t, i] or not decides_next else on_last[t, j] + total[j]
                if decides_next:
                    for j in range(i * deep, (i + 1) * deep):
                        on_later[j] = 0.0 if over[t, i] else recalled[j]
                        if not remembers:
                            recalled[j] = 0.0
                if over[t, i]:
                    on_worlds[later, :, i * size : (i + 1) * size] = 0
                    pasts[later, i] = 0
            call_rows(step, low, high, asks[t])  # type: ignore[call-arg]
            for k in range(len(mid) if t > 0 else 0):
                for i in range(mid.shape[1]):
                    for j in range(low * size, high * size):
                        on_worlds[now, i, j] += mid[k, i, j]
            for i in range(len(parameters)):
                for j in range(low * size, high * size):
                    parameters[i, j] += each[i, j]
            for i in range(low * many, high * many):
                acted[action, i] += done[i]
            if (t + first) % held == 0:
                for i in range(low * many, high * many):
                    acted[action, i] += on_acted[action, i]
                call_rows(policy, low, high, acts[t])  # type: ignore[call-arg]
                for i in range(low * wide, high * wide):
                    total[i] = on_seen[action, i] + looked[i]
