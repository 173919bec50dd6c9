"""Metrics of prediction over scenario files against single futures: by scene, and by kind and pace of all agents.

    python -m benchmarks.prediction FILE… [--shares] [--executor processes]

Shares of the ways in which agents go on (``idm_env.prediction.mixture``) are fitted to all scenes but the one that is
predicted, so every figure is held out. ``--shares`` prints those fitted to all scenes, which the package ships.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path

import numpy as np
import tyro

from benchmarks import command
from idm_env.data.scenario import Scenario
from idm_env.data.womd import scenarios
from idm_env.jobs.progress import OnProgress, silent
from idm_env.jobs.workers import HERE, Workers
from idm_env.prediction.files import OURS, case_of
from idm_env.prediction.metrics import HORIZONS, Case, Score, hits, score, summary
from idm_env.prediction.mixture import SHARES, Shares, pace_of
from idm_env.prediction.predict import METHODS, Mixture, Prediction, choose_futures, mixture
from idm_env.prediction.scene import MapScene

STRAIGHT = "constant velocity"
LEAST_S = 3
"""Agents whose future is known up to here (s) are scored; later horizons where they are known too."""
PRIOR_AGENTS = 2.0
"""Weight of equal shares, which are the prior (agents)."""
NOT_HIT = 1e-3
"""Chance (per way) that an agent ends where none of its futures does."""


@dataclass(frozen=True, eq=False)
class Seen:
    """One agent whose future is known: the share [H, 3] of each way's futures that hit it, per known horizon.

    NaN where it has no such futures (no lane).
    """

    kind: str
    pace: str
    hit: np.ndarray


def score_hits(case: Case, futures: Sequence[np.ndarray], weights: Sequence[np.ndarray]) -> Seen | None:
    """Return how the futures [N, S, 2] of each way, with weights [N], hit the truth of a case; None without a truth."""
    rows = []
    for seconds in HORIZONS:
        reached = [hits(replace(case, futures=one), seconds) if len(one) else None for one in futures]
        if any(hit is not None for hit in reached):
            parts = zip(reached, weights, strict=True)
            rows.append([np.nan if hit is None else float((hit * w).sum() / w.sum()) for hit, w in parts])
    return Seen(case.kind, pace_of(case.speed), np.array(rows)) if rows else None


def fit_shares(agents: Iterable[Seen]) -> Shares:
    """Return the shares of every kind and pace; those of which no agent is seen keep the prior."""
    every = list(agents)
    shares: Shares = {}
    for kind, pace in SHARES:
        prior = np.array([0.5, 0.5, 0.0] if kind == "pedestrian" else [1 / 3, 1 / 3, 1 / 3])
        group = [one.hit for one in every if (one.kind, one.pace) == (kind, pace)]
        shares[kind, pace] = tuple(float(x) for x in _expectation_maximisation(group, prior))
    return shares


def _expectation_maximisation(group: Sequence[np.ndarray], prior: np.ndarray) -> np.ndarray:
    """Return the shares of highest posterior density; every agent counts once, evenly over its horizons."""
    if not group:
        return prior
    chance = np.concatenate(group) + NOT_HIT
    counted = np.concatenate([np.full(len(hit), 1.0 / len(hit)) for hit in group])
    finite = np.isfinite(chance)
    share = prior
    for _ in range(200):
        # what an agent cannot do tells nothing of its share: there it explains as well as the others on average
        mean = (share * np.where(finite, chance, 0.0)).sum(-1) / (share * finite).sum(-1)
        part = share * np.where(finite, chance, mean[:, None])
        part = part / part.sum(-1, keepdims=True)
        share = PRIOR_AGENTS * prior + counted @ part
        share = share / share.sum()
    return np.asarray(share)


@dataclass(frozen=True, eq=False)
class Known:
    """An agent whose future is known: what it may do, and how far each way of going on hit the truth."""

    scene: MapScene
    mixture: Mixture
    seen: Seen

    @property
    def asked_for(self) -> bool:
        """Whether the file names it among the tracks to predict."""
        return self.mixture.agent in self.scene.scenario.to_predict

    def scored(self, prediction: Prediction) -> Score:
        """Return the score of a prediction of this agent."""
        return score(case_of(self.scene.scenario, prediction))


def known_agents(scenario: Scenario, _: OnProgress = silent) -> list[Known]:
    """Return the agents of a scene that are valid at the present and at ``LEAST_S``."""
    scene, agents = MapScene(scenario), []
    for index, agent in enumerate(scenario.agents):
        is_valid = agent.valid[scenario.present] and agent.valid[scenario.present + 10 * LEAST_S]
        if is_valid:
            one = mixture(scene, index)
            case = case_of(scenario, choose_futures(scene, one))
            hit = score_hits(case, one.futures, one.weights)
            assert hit is not None
            agents.append(Known(scene, one, hit))
    return agents


def held_out(scenes: Sequence[Sequence[Known]]) -> list[tuple[Known, Shares]]:
    """Return every agent with the shares fitted to the other scenes."""
    return [
        (one, fit_shares(other.seen for scene in scenes if scene is not own for other in scene))
        for own in scenes
        for one in own
    ]


def show(title: str, rows: dict[str, list[Score]]) -> None:
    """Print the metrics of some agents by every method."""
    print(f"{title}: {len(next(iter(rows.values())))} agents")
    print(f"  {'method':24s} {'minADE 3/5/8 s (m)':>22s} {'minFDE 3/5/8 s (m)':>22s} {'miss 3/5/8 s':>16s} {'mAP':>6s}")
    for name, items in rows.items():
        row = summary(items)
        columns = [
            " / ".join(f"{row[f'{what}_{s}s']:.2f}" for s in (3, 5, 8)) for what in ("minADE", "minFDE", "miss_rate")
        ]
        print(f"  {name:24s} {columns[0]:>22s} {columns[1]:>22s} {columns[2]:>16s} {row['mAP']:6.3f}")


def compared(agents: Iterable[tuple[Known, Shares]], methods: Sequence[str]) -> dict[str, list[Score]]:
    """Return scores by method; ours with the shares that are held out."""
    pairs = list(agents)
    single: dict[str, Callable[[MapScene, int], Prediction]] = {n: m for n, m in METHODS.items() if n in methods}
    return {OURS: [one.scored(choose_futures(one.scene, one.mixture, shares)) for one, shares in pairs]} | {
        name: [one.scored(method(one.scene, one.mixture.agent)) for one, _ in pairs] for name, method in single.items()
    }


def main(files: tyro.conf.Positional[list[Path]], shares: bool = False, place: Workers = HERE) -> None:
    """Score the scenes of the files.

    Args:
        files: Scenarios of the Waymo Open Motion Dataset.
        shares: Print the shares fitted to all scenes, and nothing else.
        place: Where scenes are worked on.
    """
    begin = time.perf_counter()
    parts = [scenario for path in files for scenario in scenarios(path)]
    with place.opened() as executor:
        scenes = [scene for _, scene in sorted(executor.map(known_agents, parts), key=itemgetter(0))]
    if shares:
        for (kind, pace), values in fit_shares(one.seen for scene in scenes for one in scene).items():
            count = sum((one.seen.kind, one.seen.pace) == (kind, pace) for scene in scenes for one in scene)
            print(f'    ("{kind}", "{pace}"): ({", ".join(f"{x:.3f}" for x in values)}),  # {count} agents')
        return
    spent = (time.perf_counter() - begin) / max(sum(len(scene) for scene in scenes), 1)
    agents = held_out(scenes)
    to_predict = [item for item in agents if item[0].asked_for]
    singles = [name for name in METHODS if name != OURS]
    show("all scenes, tracks to predict", compared(to_predict, singles))
    for name in dict.fromkeys(one.scene.scenario.id for one, _ in to_predict):
        here = [item for item in to_predict if item[0].scene.scenario.id == name]
        show(f"scene {name}, tracks to predict", compared(here, singles))
    for group in (None, *SHARES):
        here = [item for item in agents if group in (None, (item[0].seen.kind, item[0].seen.pace))]
        if here:
            show("all agents" if group is None else f"all agents, {group[0]}, {group[1]}", compared(here, [STRAIGHT]))
    print(f"{1e3 * spent:.0f} ms per agent")


if __name__ == "__main__":
    command(main)
