"""The scene from above: lanes, everybody, and of one agent its history, futures and true path."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from idm_env.data.scenario import Agent, Scenario
from idm_env.prediction.predict import Prediction
from idm_env.reports.diagrams import less

STOP, CAUTION = "#c1121f", "#e09f3e"
LANE, OTHERS, OWN, FUTURE, TRUTH = "#cfcfcf", "#9a9a9a", "#111111", "#0b5fa5", "#d1495b"


def body(agent: Agent, step: int) -> np.ndarray:
    """Return the corners [4, 2] of an agent at a step."""
    c, s = np.cos(agent.heading[step]), np.sin(agent.heading[step])
    half = 0.5 * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [agent.length, agent.width]
    return np.asarray(agent.position[step] + half @ np.array([[c, s], [-s, c]]))


def scene_picture(scenario: Scenario, prediction: Prediction) -> tuple[Figure, str]:
    """Return the picture of one agent's prediction and its caption; wider lines are more probable futures.

    Stop signs are red octagons, lights that are red or yellow are squares.
    """
    present = scenario.present
    agent = scenario.agents[prediction.agent]
    past = np.flatnonzero(agent.valid[: present + 1])
    later = present + np.flatnonzero(agent.valid[present:])
    here = agent.position[present]
    shown = np.concatenate([prediction.futures.reshape(-1, 2), agent.position[later], here[None]])
    middle = 0.5 * (shown.min(0) + shown.max(0))
    reach = max(25.0, 0.5 * float(np.ptp(shown, axis=0).max()) + 8.0)
    figure = Figure(figsize=(6.5, 6.5), layout="constrained")
    axis = figure.subplots()
    for lane in scenario.lanes:
        axis.plot(*lane.line.T, color=LANE, lw=1, zorder=0)
    for other in scenario.agents:
        if other.valid[present]:
            mine = other is agent
            axis.add_patch(Polygon(body(other, present), color=OWN if mine else OTHERS, zorder=3 if mine else 1, lw=0))
    labelled: list[np.ndarray] = []
    for number, (future, confidence) in enumerate(zip(prediction.futures, prediction.confidence, strict=True)):
        line = np.concatenate([here[None], future])
        axis.plot(
            *line.T, color=FUTURE, lw=1.2 + 3 * confidence, alpha=0.8, zorder=2, label=None if number else "futures"
        )
        axis.plot(*future[-1], "o", color=FUTURE, ms=4, zorder=4)
        if all(np.hypot(*(future[-1] - other)) > 0.05 * reach for other in labelled):
            labelled.append(future[-1])
            axis.annotate(f"{100 * confidence:.0f} %", future[-1], (4, 4), textcoords="offset points", fontsize=8)
    for control in scenario.controls:
        stops = control.shows in ("sign", "stop")
        if stops or control.shows == "caution":
            mark, colour = ("8", STOP) if control.shows == "sign" else ("s", STOP if stops else CAUTION)
            axis.plot(*control.point, mark, color=colour, ms=6, mec="white", zorder=3)
    axis.plot(*agent.position[past].T, color=OWN, lw=2, zorder=4, label="last second")
    if len(later) > 1:
        axis.plot(*agent.position[later].T, "--", color=TRUTH, lw=1.8, zorder=5, label="what it did")
        axis.plot(*agent.position[later[-1]], "x", color=TRUTH, ms=7, mew=2, zorder=5)
    axis.set(xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] - reach, middle[1] + reach), aspect="equal")
    for ticks, name, low in ((axis.xaxis, "x", middle[0] - reach), (axis.yaxis, "y", middle[1] - reach)):
        first = 10.0 * np.ceil(0.1 * low)
        along = np.arange(0.0, low + 2.0 * reach - first, 10.0 * np.ceil(reach / 30.0))
        ticks.set_ticks(first + along, [f"{m:.0f}" for m in along])
        ticks.set_label_text(f"{less(name, first, 'm')} (m)")
    axis.legend(loc="upper right", fontsize=8, framealpha=0.9)
    how = "on lanes" if prediction.source == "lane" else "off the lanes"
    return figure, f"{scenario.id}: {agent.kind} {agent.id}, predicted {how}"
