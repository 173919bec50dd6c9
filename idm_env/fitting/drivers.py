"""What a fit says of its drivers: one row each, and how many of them have a parameter on its bound."""

from __future__ import annotations

from typing import Any

import torch

from idm_env import report as page
from idm_env.fitting.evaluate import Errors
from idm_env.fitting.fit import Fit

MOST_ROWS = 1000
"""Drivers that the page lists; all are in drivers.csv."""


def table(found: Fit, error: Errors) -> list[dict[str, Any]]:
    """Return one row per group: episodes, gap RMSE (m), each parameter with its standard error, and what is doubtful.

    ``bounds`` and ``not_identified`` list parameters by name, separated by blanks.
    """
    problem = found.problem
    count = torch.zeros(len(problem.groups)).index_add(0, problem.group, torch.ones(len(problem.batch)))
    square = torch.zeros(len(problem.groups), dtype=error.gap_rmse.dtype)
    rmse = (square.index_add(0, problem.group, error.gap_rmse.square()) / count).sqrt()
    values, spread, bound = found.values(), found.uncertainty.standard_error, found.uncertainty.at_bound
    rows = []
    for g, group in enumerate(problem.groups):
        row: dict[str, Any] = {"group": group, "episodes": int(count[g]), "gap_rmse_m": float(rmse[g])}
        for i, name in enumerate(found.names):
            row |= {name: float(values[g, i]), f"{name}_error": float(spread[g, i])}
        chosen = {"bounds": bound[g], "not_identified": ~found.uncertainty.identified[g] & ~bound[g]}
        for what, told in chosen.items():
            row[what] = " ".join(name for name, yes in zip(found.names, told.tolist(), strict=True) if yes)
        rows.append(row | {"converged": bool(found.converged[g])})
    return rows


def bounds(found: Fit) -> list[dict[str, Any]]:
    """Return one row per parameter: median, 10 and 90 %, and how many groups have it on a bound or not identified."""
    values, flags = found.values(), found.uncertainty
    rows = []
    for i, (name, p) in enumerate(zip(found.names, found.problem.parameters, strict=True)):
        on = flags.at_bound[:, i]
        lower = on & (values[:, i] < 0.5 * (p.low + p.high))
        share = torch.tensor([0.1, 0.5, 0.9], dtype=values.dtype)
        low, middle, high = torch.quantile(values[:, i], share).tolist()
        rows.append({
            "parameter": name, "symbol": p.symbol, "unit": p.unit, "median": middle, "p10": low, "p90": high,
            "low": p.low, "high": p.high, "groups": len(values), "on_low": int(lower.sum()),
            "on_high": int((on & ~lower).sum()), "not_identified": int((~flags.identified[:, i] & ~on).sum()),
        })  # fmt: skip
    return rows


def sentence(rows: list[dict[str, Any]]) -> str:
    """Return which parameters sit on a bound for how many groups, most first: "b on its bound for 69 of 171"."""
    count = {row["symbol"]: row["on_low"] + row["on_high"] for row in rows}
    told = [
        f"{symbol} on its bound for {n} of {rows[0]['groups']}"
        for symbol, n in sorted(count.items(), key=lambda item: -item[1])
        if n
    ]
    return f"Bounds: {', '.join(told)}." if told else "Bounds: no parameter is on one."


def blocks(found: Fit, rows: list[dict[str, Any]], shares: list[dict[str, Any]]) -> list[page.Block]:
    """Return the table of parameters with their shares at bounds, and the table of drivers."""

    def share(count: int, groups: int) -> page.Cell:
        return page.Cell(f"{count} ({100 * count / groups:.0f} %)" if count else "0", count, 2 * count > groups)

    parameters = [
        {
            "parameter": f"{row['symbol']} {row['parameter'].split('.')[1].replace('_', ' ')}",
            "unit": row["unit"],
            "median": row["median"],
            "10 %": row["p10"],
            "90 %": row["p90"],
            f"on its lowest, of {row['groups']}": share(row["on_low"], row["groups"]),
            "lowest": row["low"],
            f"on its highest, of {row['groups']}": share(row["on_high"], row["groups"]),
            "highest": row["high"],
            "not identified": share(row["not_identified"], row["groups"]),
        }
        for row in shares
    ]
    several = len(rows) > MOST_ROWS
    listed = [_row(found, row) for row in rows[:MOST_ROWS]]
    return [
        page.table(parameters),
        page.note("10 % and 90 %: so many of the groups lie below. Lowest and highest: where a parameter may lie."),
        page.heading("One row per driver" if found.problem.groups != ("all",) else "All drivers together"),
        page.table(listed),
        page.note(
            "After ±: standard error, which allows for correlated residuals, not for a wrong model. ⊣: on its bound, "
            "?: not identified by these data (standard error above half of the value). A click on a heading sorts. "
            + (f"The first {MOST_ROWS} of {len(rows)} rows; all" if several else "The same rows")
            + " are in drivers.csv."
        ),
    ]


def _row(found: Fit, row: dict[str, Any]) -> dict[str, Any]:
    shown: dict[str, Any] = {
        "driver": row["group"], "episodes": row["episodes"], "gap RMSE (m)": page.Cell(
            f"{row['gap_rmse_m']:.2f}", row["gap_rmse_m"]
        ),
    }  # fmt: skip
    on, doubtful = row["bounds"].split(), row["not_identified"].split()
    for name, p in zip(found.names, found.problem.parameters, strict=True):
        value, spread = row[name], row[f"{name}_error"]
        unit = "" if p.unit == "1" else f" ({p.unit})"
        # A spread that says nothing is not a number worth reading; drivers.csv has it.
        after = "⊣" if name in on else "?" if name in doubtful else f"± {spread:.1g}"
        shown[f"{p.symbol}{unit}"] = page.Cell(f"{value:.3g} {after}", value, name in on)
    return shown | {"converged": row["converged"]}
