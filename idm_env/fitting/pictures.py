"""Pictures of fits: measured against simulated drivers, and how fitted parameters spread."""

from typing import Any

import numpy as np

from idm_env.data import Episode
from idm_env.fitting.drivers import Estimates
from idm_env.fitting.evaluate import Errors
from idm_env.fitting.problem import Problem, Simulated
from idm_env.reports import diagrams, page

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


def residuals(problem: Problem, simulated: Simulated) -> page.Block:
    """Draw how the gap's residual, simulated minus measured, spreads over time, over speed, and over its own size."""
    apart, time, speed = [], [], []
    for row, episode in enumerate(problem.batch.episodes):
        gap = simulated.gap[: len(episode) - 1, row].numpy()
        apart.append(gap - episode.gap_m[1:])
        time.append((episode.time_s - episode.time_s[0])[1:])
        speed.append(episode.speed_mps[1:])
    residual = np.concatenate(apart)
    figure, axes = page.figure(1, 3, size=(11.0, 3.3))
    reach = max(0.1, 1.05 * float(np.percentile(np.abs(residual), 97)))
    for axis, values, label in (
        (axes[0, 0], np.concatenate(time), "time since the start (s)"),
        (axes[0, 1], np.concatenate(speed), "measured speed (m/s)"),
    ):
        _bands(axis, values, residual)
        axis.set(xlabel=label, ylim=(-reach, reach))
    axes[0, 0].set_ylabel("simulated − measured gap (m)")
    axes[0, 0].legend(frameon=False, fontsize=8, loc="upper left")
    axes[0, 2].hist(np.clip(residual, -reach, reach), bins=61, color="#2e6f9e")
    axes[0, 2].set(xlabel="simulated − measured gap (m)", yticks=[])
    for axis in axes[0]:
        axis.grid(alpha=0.25)
    return page.picture(
        figure,
        f"The gap's residual of all {len(problem.batch)} episodes. A model that lacks nothing leaves a band around 0 "
        "of the same width everywhere; a slope or a bend over speed is what it lacks.",
    )


def _bands(axis: Any, x: np.ndarray, residual: np.ndarray, most: int = 40) -> None:
    """Draw median, quartiles and 5 to 95 % of a residual in bins of equal width that hold enough samples."""
    edges = np.linspace(x.min(), max(x.max(), x.min() + 1e-6), most + 1)
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, most - 1)
    enough = max(5, len(x) // (20 * most))
    bins = [b for b in range(most) if (index == b).sum() >= enough]
    if not bins:
        return
    middle = 0.5 * (edges[:-1] + edges[1:])[bins]
    levels = np.array([np.percentile(residual[index == b], [5, 25, 50, 75, 95]) for b in bins]).T
    axis.fill_between(middle, levels[0], levels[4], color=SIMULATED, alpha=0.15, lw=0, label="5 … 95 %")
    axis.fill_between(middle, levels[1], levels[3], color=SIMULATED, alpha=0.3, lw=0, label="quartiles")
    axis.plot(middle, levels[2], color=SIMULATED, lw=1.5, label="median")
    axis.axhline(0.0, color=MEASURED, lw=0.8)


def space_time(problem: Problem, simulated: Simulated) -> list[page.Block]:
    """Draw the drivers of the largest run and lane in space and time, as measured and as simulated."""
    episodes = problem.batch.episodes
    place: dict[tuple[str, int], list[int]] = {}
    for row, episode in enumerate(episodes):
        place.setdefault((episode.run_id, _lane(episode)), []).append(row)
    (run, lane), rows = max(place.items(), key=lambda item: sum(len(episodes[row]) for row in item[1]))
    measured, model = [], []
    for row in rows:
        episode = episodes[row]
        lead = episode.leader.position_m - episode.leader.length_m
        gap, speed = episode.gap_m.copy(), episode.speed_mps.copy()
        measured.append(diagrams.VehicleLine(episode.key, episode.time_s, lead - gap, speed))
        gap[1:] = simulated.gap[: len(episode) - 1, row].numpy()
        speed[1:] = simulated.speed[: len(episode) - 1, row].numpy()
        model.append(diagrams.VehicleLine(episode.key, episode.time_s, lead - gap, speed))
    panels = [diagrams.Panel(title, tuple(lines)) for title, lines in (("measured", measured), ("simulated", model))]
    where = f"run {run}" + (f", lane {lane}" if lane >= 0 else "")
    word = "episode" if len(rows) == 1 else "episodes"
    return [
        page.picture(
            diagrams.figure_of(panels, columns=2),
            f"{len(rows)} {word} of {where}, the largest of {len(place)}: measured left, and right each driver "
            "simulated alone behind its measured leader. Colours are speeds.",
        )
    ]


def _lane(episode: Episode) -> int:
    """Return the lane in which a driver is most of the time, −1 where no lane is known."""
    label = episode.labels.get("lane", "")
    if label.lstrip("-").isdigit():
        return int(label)
    lanes = episode.columns.get("lane")
    return -1 if lanes is None or not len(lanes) else int(np.median(lanes))


def parameters(estimates: Estimates) -> page.Block:
    """Draw the distribution over groups of every free parameter, or estimates with intervals for a few groups."""
    names = estimates.names
    figure, axes = page.figure(1, len(names), size=(2.3 * len(names), 2.8))
    values = estimates.values.numpy()
    spread = estimates.standard_error.numpy()
    for i, (name, p) in enumerate(zip(names, estimates.parameters, strict=True)):
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
            axis.set_xticks(np.arange(len(values)), [g[:14] for g in estimates.groups], rotation=90, fontsize=7)
        axis.set_title(f"{name.split('.')[1]} {p.symbol} ({p.unit})", fontsize=9)
        axis.grid(alpha=0.25)
    caption = "Estimates of all groups." if len(values) > 12 else "Estimates with 95 % intervals."
    return page.picture(figure, caption)
