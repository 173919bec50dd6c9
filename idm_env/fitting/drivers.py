"""Fitted drivers: one row each, and how many of them have a parameter on its bound."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
import torch
from torch import Tensor

from idm_env.fitting.evaluate import Errors
from idm_env.fitting.fit import Fit
from idm_env.parameters import Parameter, catalogue
from idm_env.reports import page
from idm_env.simulator import Simulator

MOST_ROWS = 1000
"""Drivers that the page lists; all are in drivers.csv."""


@dataclass(frozen=True, eq=False)
class Estimates:
    """Estimates, [groups, parameters] each, whether of one fit or of several that know nothing of each other.

    ``dt`` is the data's time step (s), ``fixed`` what was not fitted and has not its default.
    """

    simulator: Simulator
    dt: float
    fixed: Mapping[str, float]
    names: tuple[str, ...]
    groups: tuple[str, ...]
    values: Tensor
    standard_error: Tensor
    at_bound: Tensor
    identified: Tensor

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Declarations of the fitted parameters."""
        declared = catalogue(self.simulator.effects)
        return tuple(declared[name] for name in self.names)

    def own_for(self, groups: Sequence[str], pooled: Tensor) -> tuple[Tensor, list[str]]:
        """Return values [G, P] for ``groups``, and the groups that the fit has not seen.

        A group that was fitted keeps its values; any other gets the ``pooled`` ones [P].
        """
        index = {name: i for i, name in enumerate(self.groups)}
        rows = [self.values[index[name]] if name in index else pooled for name in groups]
        return torch.stack(rows), [name for name in groups if name not in index]

    @classmethod
    def joined(cls, table: pl.DataFrame, simulator: Simulator, dt: float, fixed: Mapping[str, float]) -> Estimates:
        """Return the estimates of several fits, from the rows of their ``Fit.table()``."""
        names = tuple(table["parameter"].unique(maintain_order=True))
        count = len(names)

        def column(name: str) -> Tensor:
            return torch.from_numpy(table[name].to_numpy().copy()).reshape(-1, count)

        groups, columns = tuple(table["group"].gather_every(count)), ("standard_error", "at_bound", "identified")
        return cls(simulator, dt, fixed, names, groups, column("estimate"), *map(column, columns))


def table(result: Fit, error: Errors, by: str) -> list[dict[str, Any]]:
    """Return one row per group: episodes, gap RMSE (m), each parameter with its standard error, and flags of doubt.

    A driver is told by ``run_id`` and ``vehicle_id``, another ``group`` by its name. What is not identified is NaN.
    ``bounds`` and ``not_identified`` list parameters by name, separated by blanks.
    """
    problem = result.problem
    count = torch.zeros(len(problem.groups)).index_add(0, problem.group, torch.ones(len(problem.batch)))
    square = torch.zeros(len(problem.groups), dtype=error.gap_rmse.dtype)
    rmse = (square.index_add(0, problem.group, error.gap_rmse.square()) / count).sqrt()
    errors = result.uncertainty
    values, spread, bound, identified = result.values(), errors.standard_error, errors.at_bound, errors.identified
    rows = []
    for g, group in enumerate(problem.groups):
        run, _, vehicle = group.rpartition("/")
        row: dict[str, Any] = {"run_id": run, "vehicle_id": vehicle} if by == "driver" else {"group": group}
        row |= {"episodes": int(count[g]), "gap_rmse_m": float(rmse[g])}
        for i, name in enumerate(result.names):
            row[name] = float(values[g, i]) if identified[g, i] or bound[g, i] else math.nan
            row[f"{name}_error"] = float(spread[g, i]) if identified[g, i] and not bound[g, i] else math.nan
        for what, which in {"bounds": bound[g], "not_identified": ~identified[g] & ~bound[g]}.items():
            row[what] = " ".join(name for name, yes in zip(result.names, which.tolist(), strict=True) if yes)
        rows.append(row | {"converged": bool(result.converged[g])})
    return rows


def bounds(estimates: Estimates) -> list[dict[str, Any]]:
    """Return one row per parameter: median, 10 and 90 %, and how many groups have it on a bound or not identified."""
    values = estimates.values
    rows = []
    for i, (name, p) in enumerate(zip(estimates.names, estimates.parameters, strict=True)):
        on = estimates.at_bound[:, i]
        lower = on & (values[:, i] < 0.5 * (p.low + p.high))
        low, middle, high = np.quantile(values[:, i].numpy(), [0.1, 0.5, 0.9]).tolist()
        row: dict[str, Any] = {"parameter": name, "words": p.words, "symbol": p.symbol, "unit": p.unit}
        row |= {"median": middle, "p10": low, "p90": high, "low": p.low, "high": p.high, "groups": len(values)}
        row |= {"on_low": int(lower.sum()), "on_high": int((on & ~lower).sum())}
        rows.append(row | {"not_identified": int((~estimates.identified[:, i] & ~on).sum())})
    return rows


def sentence(rows: list[dict[str, Any]]) -> str:
    """Return which parameters sit on a bound for how many groups, most first."""
    parts = [f"{words} for {n} of {rows[0]['groups']}" for words, n in _on_bounds(rows) if n]
    return f"On its bound: {', '.join(parts)}." if parts else "No parameter is on a bound."


def _on_bounds(rows: list[dict[str, Any]]) -> list[tuple[str, int]]:
    """Return every parameter in words and how many groups have it on a bound, most first."""
    return sorted(((row["words"], row["on_low"] + row["on_high"]) for row in rows), key=lambda item: -item[1])


def over_fitting(
    rows: list[dict[str, Any]], fitted: float, held_out: float | None, by: str, parts: str = "runs"
) -> str:
    """Return the signs of over-fitting and the cure; nothing where there are none.

    It shows in a gap RMSE (m) on held-out ``parts`` (runs or drivers) above 1.5 times that on the fitted ones, and in a
    parameter that is on its bound for more than a third of several groups.
    """
    words, on = _on_bounds(rows)[0]
    groups = rows[0]["groups"]
    signs = []
    if held_out is not None and held_out > 1.5 * fitted:
        signs.append(f"the gap RMSE is {held_out:.2f} m on held-out {parts} and {fitted:.2f} m on the fitted ones")
    if groups > 1 and 3 * on > groups:
        signs.append(f"{words} is on its bound for {on} of {groups}")
    if not signs:
        return ""
    cure = "Fit more runs" if by == "all" else "Fit one set of parameters to all (--by all)"
    return f"Over-fitting: {', and '.join(signs)}. {cure}, or with a prior (idm_env.fitting.fit.fit(prior=...))."


def failure(rows: list[dict[str, Any]], error: Errors) -> str:
    """Return the signs of a failed fit and the cure; nothing where there are none.

    It failed where most stretches collide, or the median gap RMSE is above the median gap; above half of it with most
    estimates on bounds, or a tenth with four of five. Bounds alone are no failure: seconds of an even drive have them.
    """
    on, total = sum(n for _, n in _on_bounds(rows)), len(rows) * rows[0]["groups"]
    collisions, count = int((error.smallest_gap <= 0).sum()), len(error.gap_rmse)
    rmse, gap = float(error.gap_rmse.median()), float(error.measured_gap.median())
    signs = []
    if len(rows) > 2 and ((5 * on >= 4 * total and 10 * rmse > gap) or (2 * on > total and 2 * rmse > gap)):
        signs.append(f"{on} of {total} estimates are on bounds")
    if 2 * collisions > count:
        signs.append(f"{collisions} of {count} stretches collide")
    if rmse > gap:
        signs.append(f"the gap RMSE is {rmse:.3g} m, and the gap {gap:.3g} m (medians)")
    cure = "Check leaders, lanes, units and clocks of the file; model.yaml is not written."
    return f"The fit failed: {', and '.join(signs)}. {cure}" if signs else ""


def parameters(shares: list[dict[str, Any]]) -> page.Block:
    """Return the table of parameters with their shares at bounds, of rows of ``bounds``."""

    def share(count: int, groups: int) -> page.Cell:
        return page.Cell(f"{count} ({100 * count / groups:.0f} %)" if count else "0", count, 2 * count > groups)

    rows = []
    for row in shares:
        name, n = f"{row['symbol']} {row['parameter'].split('.')[1].replace('_', ' ')}", row["groups"]
        middle = {"unit": row["unit"], "median": row["median"], "10 %": row["p10"], "90 %": row["p90"]}
        low = {f"on its lowest, of {n}": share(row["on_low"], n), "lowest": row["low"]}
        high = {f"on its highest, of {n}": share(row["on_high"], n), "highest": row["high"]}
        rows.append({"parameter": name, **middle, **low, **high, "not identified": share(row["not_identified"], n)})
    return page.table(rows)


def listed(estimates: Estimates, rows: Sequence[dict[str, Any]]) -> page.Block:
    """Return the table of drivers; ``rows`` are those of the first ``MOST_ROWS`` drivers at least."""
    return page.table([_row(estimates, row) for row in rows[:MOST_ROWS]])


def _row(estimates: Estimates, row: dict[str, Any]) -> dict[str, Any]:
    name = row["group"] if "group" in row else f"{row['run_id']}/{row['vehicle_id']}"
    shown: dict[str, Any] = {
        "driver": name,
        "episodes": row["episodes"],
        "gap RMSE (m)": page.Cell(f"{row['gap_rmse_m']:.2f}", row["gap_rmse_m"]),
    }
    on, doubtful = (row["bounds"] or "").split(), (row["not_identified"] or "").split()
    for name, p in zip(estimates.names, estimates.parameters, strict=True):
        value, spread = row[name], row[f"{name}_error"]
        unit = "" if p.unit == "1" else f" ({p.unit})"
        after = "⊣" if name in on else "" if spread is None else f"± {spread:.1g}"
        shown[f"{p.symbol}{unit}"] = page.Cell("?" if name in doubtful else f"{value:.3g} {after}", value, name in on)
    return shown | {"converged": row["converged"]}
