"""Pictures of a discovery; None where there is nothing to show. What they show is said in ``report.html``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from idm_env.discovery import words
from idm_env.discovery.judge import halves
from idm_env.discovery.solve import projected

if TYPE_CHECKING:
    from idm_env.discovery.finish import Discovery
    from idm_env.discovery.judge import Judged
    from idm_env.discovery.ladder import Ladder
    from idm_env.discovery.search import Scored
    from idm_env.discovery.selection import Round

BEFORE, AFTER, TRUTH, GREY = "#c0392b", "#1f6fb2", "#222222", "#9aa5b1"
plt.rcParams.update(
    {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "figure.dpi": 110, "legend.frameon": False}
)


def ranking(this: Round) -> Figure:
    """Bars of all candidates of a round, best on top."""
    order = np.argsort(this.tested.gain)[-22:]
    gain = 100 * (1 - np.exp(-this.tested.gain[order]))
    ends = this.tested.interval[order]
    finite = np.isfinite(ends).all(1)  # a single run tells no interval
    low, high = (np.where(finite, 100 * (1 - np.exp(-np.where(finite, e, 0.0))), gain) for e in ends.T)
    figure, axes = plt.subplots(layout="constrained", figsize=(7.2, 0.24 * len(order) + 1.0))
    colours = [AFTER if p < 0.05 else GREY for p in this.tested.p_value[order]]
    axes.barh(range(len(order)), gain, color=colours)
    axes.errorbar(gain, range(len(order)), xerr=[gain - low, high - gain], fmt="none", ecolor=TRUTH, lw=0.8)
    axes.set_yticks(range(len(order)), [words.plain(this.scored[i].term.label) for i in order])
    axes.set_xlabel("held-out gain (%)")
    axes.axvline(0, color=TRUTH, lw=0.6)
    edge = max(float(gain.max()), 1.0)
    axes.set_xlim(max(float(low.min()), -edge) - 0.05 * edge, max(float(high.max()), 1.0) * 1.05)
    return figure


def _projected(scored: Scored) -> np.ndarray | None:
    """Return the response [R, m] to a candidate's first parameter, of a curve to all, off the drivers' own."""
    solution = scored.solution
    if solution is None or not solution.linear.by_phi.shape[-1]:
        return None
    mine = solution.model.where(scored.term.label)
    weight = solution.values[mine] if scored.term.size > 4 else np.eye(scored.term.size)[0]
    return projected(solution)[..., mine] @ weight


def look_alikes(d: Discovery) -> Figure | None:
    """Heat map of cosines."""
    names, columns = [], []
    for s in d.rounds[0].scored:
        column = _projected(s) if s.term.effect is not None else None
        if column is not None and np.sum(column**2) > 1e-9:
            names.append(words.plain(s.term.label))
            columns.append(column.ravel() / np.sqrt(np.sum(column**2)))
    if len(names) < 2:
        return None
    cosine = np.array(columns) @ np.array(columns).T
    figure, axes = plt.subplots(layout="constrained", figsize=(6.6, 5.8))
    image = axes.imshow(cosine, cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_xticks(range(len(names)), names, rotation=70, ha="right")
    axes.set_yticks(range(len(names)), names)
    for i in range(len(names)):
        for j in range(len(names)):
            if i != j and abs(cosine[i, j]) > 0.4:
                axes.text(j, i, f"{cosine[i, j]:.1f}", ha="center", va="center", fontsize=6)
    figure.colorbar(image, shrink=0.8)
    return figure


def curves(d: Discovery) -> Figure | None:
    """Estimate and interval of every added curve over its coordinate."""
    shown = []
    for f in d.result.found:
        term = next(t for t in d.judgement.terms if t.label == f.label)
        if len(f.parameters) > words.MANY:
            shown.append((term, list(f.parameters.values())))
    if not shown:
        return None
    figure, axes = plt.subplots(len(shown), 1, figsize=(8.0, 2.6 * len(shown)), squeeze=False, layout="constrained")
    for axis, (term, knots) in zip(axes[:, 0], shown, strict=True):
        first, distance, count = term.knots
        x = first + distance * np.arange(count)
        axis.plot(x, [k.estimate for k in knots], color=AFTER, marker=".")
        axis.fill_between(x, [k.low for k in knots], [k.high for k in knots], color=AFTER, alpha=0.15)
        axis.axhline(0, color=TRUTH, lw=0.5)
        axis.set_xlabel(term.coordinate)
        axis.set_ylabel(f"{term.what}" + ("" if knots[0].unit == "1" else f" ({knots[0].unit})"))
    return figure


def dependences(ladder: Ladder | None) -> Figure | None:
    """Mean of what the smooth function of the scene takes off, over each coordinate."""
    if ladder is None or not ladder.dependences:
        return None
    figure, axes = plt.subplots(3, 3, layout="constrained", figsize=(9.0, 6.2), sharey=True)
    for axis, curve in zip(axes.ravel(), ladder.dependences, strict=True):
        axis.plot(curve.at, curve.effect_m, color=AFTER, marker=".")
        axis.fill_between(curve.at, curve.low_m, curve.high_m, color=AFTER, alpha=0.15)
        axis.axhline(0, color=TRUTH, lw=0.5)
        axis.set_xlabel(curve.coordinate + ("" if curve.unit == "1" else f" ({curve.unit})"))
    figure.supylabel("simulated less measured gap (m)", fontsize=9)
    return figure


def _trace(judged: Judged, follower: int) -> tuple[np.ndarray, ...]:
    """Return time, measured gap and simulated gap of all pieces of a follower's record.

    Pieces are divided by NaN, and simulated gaps where the driver's parameters change. The samples are those of every
    table.
    """
    rows, second = judged.rows, halves(judged.rows)
    pieces: list[np.ndarray] = []
    for i in np.flatnonzero(judged.follower[rows.record] == follower):
        valid = rows.valid[i]
        sample = rows.samples[i][valid]
        time = rows.records.column("time")[sample]
        piece = np.stack([time, rows.records.gap[sample], judged.gap[i][valid]])
        change = np.flatnonzero(np.diff(second[i][valid])) + 1
        piece = np.insert(piece, change, [*piece[:2, change], np.full(len(change), np.nan)], axis=1)
        pieces += [piece, np.array([[time[-1]], [np.nan], [np.nan]])]
    time, measured, simulated = np.concatenate(pieces, axis=1)
    return time - time[0], measured, simulated


def tested(d: Discovery, judged: Judged | None) -> np.ndarray:
    """Return the followers [F] of the runs of the test set by their error, the best first; none without a test set."""
    if judged is None:
        return np.zeros(0, int)
    inside = [run in d.result.error.held_out_runs for run, _ in judged.followers]
    seen = np.flatnonzero(np.isfinite(judged.gap_rmse) & inside)
    return seen[np.argsort(judged.gap_rmse[seen])]


def typical(d: Discovery) -> int | None:
    """Return the follower of the test set whose error with the null is the median one, None where there is none."""
    order = tested(d, d.judgement.before)
    return int(order[len(order) // 2]) if len(order) else None


def named(d: Discovery) -> list[tuple[str, Judged, str, str]]:
    """Return name, result, colour and line style of the models compared, the null first."""
    looks = ((BEFORE, "-"), (AFTER, "--"))
    return [(name, judged, *look) for (name, judged), look in zip(d.judgement.results.items(), looks, strict=False)]


def first_screen(d: Discovery, size: tuple[float, float] = (9.0, 4.0)) -> Figure | None:
    """Measured and simulated gap of the typical follower over time, and the residual of both models below."""
    follower = typical(d)
    if follower is None:
        return None
    figure, (above, below) = plt.subplots(2, 1, figsize=size, sharex=True, height_ratios=(3, 2), layout="constrained")
    handles = []
    for i, (name, judged, colour, style) in enumerate(named(d)):
        time, measured, simulated = _trace(judged, follower)
        if not i:
            handles += above.plot(time, measured, color=TRUTH, lw=1.5, label="measured")
        label = f"{name}: {judged.gap_rmse[follower]:.2f} m"
        handles += above.plot(time, simulated, color=colour, ls=style, lw=1.1, label=label)
        below.plot(time, simulated - measured, color=colour, ls=style, lw=1.1)
    below.axhline(0, color=TRUTH, lw=0.6)
    above.set_ylabel("gap (m)")
    below.set_ylabel("residual (m)")
    below.set_xlabel("time (s)")
    columns = len(handles) if size[0] > 6 else 1
    figure.legend(handles=handles, loc="outside upper left", ncols=columns)
    return figure


def gaps(d: Discovery) -> Figure | None:
    """Best, median and worst follower of the test set."""
    models = named(d)
    order = tested(d, models[-1][1] if models else None)
    if not len(order):
        return None
    picks = [order[0], order[len(order) // 2], order[-1]]
    figure, axes = plt.subplots(3, 1, layout="constrained", figsize=(9.0, 7.0))
    for axis, follower, title in zip(axes, picks, ("best", "median", "worst"), strict=True):
        texts = []
        for i, (name, judged, colour, style) in enumerate(models):
            time, measured, simulated = _trace(judged, int(follower))
            if not i:
                axis.plot(time, measured, color=TRUTH, lw=1.4, label="measured")
            axis.plot(time, simulated, color=colour, ls=style, lw=1, label=name)
            texts.append(f"{name} {judged.gap_rmse[follower]:.2f} m")
        run, vehicle = models[0][1].followers[follower]
        axis.set_title(f"{title}: run {run}, vehicle {vehicle}: {', '.join(texts)}", loc="left", fontsize=9)
        axis.set_ylabel("gap (m)")
    figure.legend(handles=axes[0].get_legend_handles_labels()[0], loc="outside upper left", ncols=3)
    axes[-1].set_xlabel("time (s)")
    return figure
