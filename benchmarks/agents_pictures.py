"""The picture of docs/agents.md on how soon agents solve a test: ``python benchmarks/agents.py picture``.

For each task and agent the share of seeds that have not solved it yet, against the CPU seconds of training (Kaplan
and Meier 1958): a seed that never solves counts as long as it was trained. Of an agent's trials the one is shown that
solves most seeds, of equals the one with most of them, of these the one that solves soonest, or was trained longest.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from scipy.stats import CensoredData, ecdf

from benchmarks.agents_tables import Row, groups

AGENTS = {"apg": "#1e5adc", "shac": "#1a7850", "ppo": "#b2182b", "sac": "#ef8a62"}
TASKS = {"ring": "ring with a shock", "follow": "behind a recorded leader"}


def shown(out: Path, config: str, seeds: Sequence[int]) -> list[Row]:
    """Return the results, without failures, of the trial that is shown."""
    parts = [[r for r in part if r["history"]] for part in groups(out, config, seeds).values()]

    def rank(part: Sequence[Row]) -> tuple[int, int, float]:
        summaries = [r["summary"] for r in part]
        took = [s["cpu_seconds"] for s in summaries if s["solved"]]
        spent = max((s["spent"] for s in summaries), default=0.0)
        return len(took), len(part), -statistics.median(took) if took else spent

    return max(parts, key=rank, default=[])


def curve(axes: Axes, rows: Sequence[Row], name: str, colour: str) -> None:
    """Draw the share of seeds that are not solved yet."""
    summaries = [r["summary"] for r in rows]
    solved = [s["cpu_seconds"] for s in summaries if s["solved"]]
    spent = [s["spent"] for s in summaries if not s["solved"]]
    left = ecdf(CensoredData(uncensored=solved, right=spent)).sf
    x, y = [1.0, *left.quantiles], [1.0, *left.probabilities]
    axes.step(x, y, where="post", color=colour, label=f"{name}: {len(solved)} of {len(rows)} seeds")
    axes.plot(spent, left.evaluate(spent), "|", color=colour, markersize=10)


def draw(out: Path, seeds: Sequence[int], path: Path) -> None:
    """Write the picture, a panel per task."""
    figure, panels = plt.subplots(1, len(TASKS), figsize=(10, 3.6), sharey=True, layout="constrained")
    for axes, (task, title) in zip(panels, TASKS.items(), strict=True):
        for agent, colour in AGENTS.items():
            rows = shown(out, f"{task}-{agent}", seeds)
            if rows:
                curve(axes, rows, agent.upper(), colour)
        axes.set(title=title, xscale="log", xlabel="CPU seconds of training", ylim=(-0.03, 1.03))
        axes.legend(frameon=False)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("share of seeds not solved yet")
    figure.savefig(path, dpi=110)
    print(path)
