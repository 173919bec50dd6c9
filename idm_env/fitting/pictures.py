"""Pictures of fits: measured against simulated drivers, and how fitted parameters spread."""

from __future__ import annotations

import numpy as np

from idm_env import report as page
from idm_env.fitting.evaluate import Errors
from idm_env.fitting.fit import Fit
from idm_env.fitting.problem import Problem, Simulated

MEASURED, SIMULATED = "#20242c", "#d1495b"


def examples(problem: Problem, error: Errors, simulated: Simulated) -> page.Block:
    """Draw gap and speed of the best, the median and the worst episode."""
    order = error.gap_rmse.argsort()
    chosen = [(words, int(order[k])) for words, k in (("best", 0), ("median", len(order) // 2), ("worst", -1))]
    figure, axes = page.figure(2, 3, size=(11.0, 5.2))
    for column, (words, row) in enumerate(chosen):
        episode = problem.batch.episodes[row]
        time = episode.time_s - episode.time_s[0]
        for axis, measured, model, unit in (
            (axes[0, column], episode.gap_m, simulated.gap, "gap (m)"),
            (axes[1, column], episode.speed_mps, simulated.speed, "speed (m/s)"),
        ):
            axis.plot(time, measured, color=MEASURED, lw=1.4, label="measured")
            axis.plot(time[1:], model[: len(time) - 1, row].numpy(), color=SIMULATED, lw=1.2, label="simulated")
            axis.set_ylabel(unit if column == 0 else "")
            axis.grid(alpha=0.25)
        axes[0, column].set_title(f"{words}: {episode.key}\nRMSE {float(error.gap_rmse[row]):.2f} m", fontsize=9)
        axes[1, column].set_xlabel("time (s)")
    axes[0, 0].legend(frameon=False)
    return page.picture(figure, "Best, median and worst episode, in free simulation behind the measured leader.")


def parameters(found: Fit) -> page.Block:
    """Draw the distribution over groups of every free parameter, or estimates with intervals for a few groups."""
    names = found.names
    figure, axes = page.figure(1, len(names), size=(2.3 * len(names), 2.8))
    values = found.values().numpy()
    spread = found.uncertainty.standard_error.numpy()
    for i, (name, p) in enumerate(zip(names, found.problem.parameters, strict=True)):
        axis = axes[0, i]
        if len(values) > 12:
            axis.hist(values[:, i], bins=min(30, len(values) // 3), color="#2e6f9e")
            axis.set_ylabel("groups" if i == 0 else "")
        else:
            # An interval ends where the parameter may not go.
            half = 1.96 * np.nan_to_num(spread[:, i], nan=np.inf)
            room = np.stack((values[:, i] - p.low, p.high - values[:, i])).clip(0.0)
            bars = np.minimum(half, room)
            axis.errorbar(np.arange(len(values)), values[:, i], bars, fmt="o", color="#2e6f9e", capsize=3)
            axis.set_xticks(np.arange(len(values)), [g[:14] for g in found.problem.groups], rotation=90, fontsize=7)
        axis.set_title(f"{name.split('.')[1]} {p.symbol} ({p.unit})", fontsize=9)
        axis.grid(alpha=0.25)
    caption = "Estimates of all groups." if len(values) > 12 else "Estimates with 95 % intervals."
    return page.picture(figure, caption)
