"""What chance gives where nothing is added: the same drivers with other noise, beside replicas of one such set.

    PYTHONPATH=. python studies/2026-11-27-spiked/redrawn.py "I-80|none|0|8" gap_stiffness 20

Arguments are a set of ``benchmarks.spiked``, a candidate of the catalogue, and the number of draws of each kind.
"""

import sys
import zlib
from dataclasses import replace

import numpy as np

from benchmarks import DATA
from benchmarks.spiked import drivers_of, spiked
from idm_env.discovery import calibrate, judge, noise, replica
from idm_env.discovery.discover import prepare
from idm_env.discovery.model import Hypothesis, simple
from idm_env.discovery.records import windows
from idm_env.discovery.score import held_out, log_gain
from idm_env.discovery.search import Search
from idm_env.discovery.solve import Problem, Solution, solve


def fitted(key: str, again: int) -> tuple[Problem, Solution]:
    """Return the windows of a set, and drivers of IDM fitted to them."""
    source, effect, times, _ = key.split("|")
    made = spiked(drivers_of(source, DATA), effect, float(times), zlib.crc32(key.encode()), again)
    records, model = prepare(made, "driver"), Hypothesis()
    rows = windows(records)
    problem = Problem(rows, noise.first_noise(rows), calibrate.first_prior())
    search = Search(problem, [], False, lambda *_: None)
    start = judge.unweighed(records, model, np.zeros(0), problem.prior)[1]
    null = search.null(model, start, np.zeros(0))
    return judge.windowed(records, search.problem, null)


def shares(problem: Problem, theta: np.ndarray, name: str, seed: int) -> tuple[float, float]:
    """Return what a smooth function of the scene takes off the squared error, and what a candidate does."""
    model, term = Hypothesis(), simple(name)
    scene = replica.statistics(seed)["scene"](problem.rows, replica.ahead(problem, theta, model))
    before = solve(problem, model, theta, np.zeros(0), iterations=1)
    after = solve(problem, model.adding(term), before.theta, np.array(term.starts[0]), iterations=2)
    gain = float(log_gain(held_out(problem, before), held_out(problem, after)).mean())
    return scene, 1.0 - float(np.exp(-2.0 * gain))


def main(key: str, name: str, draws: int) -> None:
    """Print means and standard deviations."""
    problem, solution = fitted(key, 0)
    floor, seed = judge.floor(problem.rows.records)["horizon_rmse_m"], zlib.crc32(key.encode())
    gaussian = replica.drivers_of(problem, solution, floor, replica.statistics(seed))
    own = replica._own_noise(problem, solution, gaussian, floor)
    together = replace(own, theta=solution.theta)
    each = {"drawn anew": [shares(p, s.theta, name, seed) for p, s in (fitted(key, k + 1) for k in range(draws))]}
    for kind, drivers in (("Gaussian", gaussian), ("own residuals", own), ("the same, drivers not spread", together)):
        random = np.random.default_rng(seed)
        replicas = (replica._fitted(problem, drivers, random, floor) for _ in range(draws))
        each[kind] = [shares(p, theta, name, seed) for p, theta in replicas]
    print(f"{key}: scene {shares(problem, solution.theta, name, seed)[0]:.4f}")
    for kind, rows in each.items():
        print(kind, *(f"{m:.4f} ± {s:.4f}" for m, s in zip(np.mean(rows, 0), np.std(rows, 0), strict=True)))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
