"""Metrics of prediction over scenario files, per scene, against three single futures.

    python benchmarks/prediction.py FILE… [--all-moving]

``--all-moving`` adds every agent that will have moved by 3 m to those that the files name.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from idm_env.data.womd import Scenario, scenarios
from idm_env.prediction.files import case_of
from idm_env.prediction.metrics import Score, score, summary
from idm_env.prediction.predict import METHODS
from idm_env.prediction.scene import Scene


def moving(scenario: Scenario) -> list[int]:
    chosen, now = set(scenario.to_predict), scenario.present
    for index, agent in enumerate(scenario.agents):
        later = now + np.flatnonzero(agent.valid[now:])
        if agent.valid[now] and len(later) > 50:
            moved = agent.position[later[-1]] - agent.position[now]
            chosen |= {index} if np.hypot(*moved) > 3.0 else set()
    return sorted(chosen)


def show(title: str, cases: dict[str, list[Score]]) -> None:
    print(f"{title}: {len(next(iter(cases.values())))} agents")
    print(f"  {'method':24s} {'minADE 3/5/8 s (m)':>24s} {'minFDE 3/5/8 s (m)':>24s} {'miss 3/5/8 s':>18s} {'mAP':>6s}")
    for name, items in cases.items():
        row = summary(items)
        columns = [
            "/".join(f"{row[f'{what}_{s}s']:{form}}" for s in (3, 5, 8))
            for what, form in (("minADE", "7.2f"), ("minFDE", "7.2f"), ("miss_rate", "5.2f"))
        ]
        print(f"  {name:24s} {columns[0]:>24s} {columns[1]:>24s} {columns[2]:>18s} {row['mAP']:6.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--all-moving", action="store_true")
    options = parser.parse_args()
    every: dict[str, list[Score]] = {name: [] for name in METHODS}
    spent = dict.fromkeys(METHODS, 0.0)
    for path in options.files:
        for scenario in scenarios(path):
            scene = Scene(scenario)
            here: dict[str, list[Score]] = {name: [] for name in METHODS}
            wanted = moving(scenario) if options.all_moving else scenario.to_predict
            for index in (i for i in wanted if scenario.agents[i].valid[scenario.present]):
                for name, method in METHODS.items():
                    begin = time.perf_counter()
                    here[name].append(score(case_of(scenario, method(scene, index))))
                    spent[name] += time.perf_counter() - begin
            show(scenario.id, here)
            for name, cases in here.items():
                every[name] += cases
    show("all scenes", every)
    print("ms per agent: " + ", ".join(f"{name} {1e3 * spent[name] / len(every[name]):.0f}" for name in METHODS))


if __name__ == "__main__":
    main()
