"""Five methods on one fitting problem: cost until the same error on the I-80 training pairs.

The problem is that of ``ParameterFitting`` over the ring environment: five IDM parameters, one value for all drivers,
simulated behind the measured leaders with the environment's own step. Each method stops at the first error within 1
% of the best known one. Cost is counted in simulated vehicle-steps (a reverse pass counts as two forward ones, a
tangent as one each) and in CPU time of one thread. Run: python -m benchmarks.parameter_fitting FILE [--seeds 3]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import tyro

from benchmarks import command
from idm_env.data import load
from idm_env.tasks import make_task
from idm_env.wrappers import ParameterFitting

TOLERANCE = 1.01
MOST_EVALUATIONS = 3000


class ReachedError(Exception):
    """The error is within the tolerance."""


class Meter:
    """Counts simulated vehicle-steps and CPU time, and stops a method at the target."""

    def __init__(self, steps: int, target: float) -> None:
        self.steps, self.target = steps, target
        self.count, self.best, self.begin = 0.0, float("inf"), time.process_time()

    def add(self, error: float, rollouts: float) -> None:
        """Count rollouts and look at their error; raise at the target or when there were too many."""
        self.count += rollouts * self.steps
        self.best = min(self.best, error)
        if error <= self.target:
            raise ReachedError
        if self.count > MOST_EVALUATIONS * self.steps:
            raise StopIteration


def adam(problem: ParameterFitting, meter: Meter, seed: int) -> None:
    optimiser = torch.optim.Adam(problem.parameters(), lr=0.1)
    while True:
        optimiser.zero_grad()
        loss = problem.mean_squared_error()
        loss.backward()
        meter.add(float(loss.detach()) ** 0.5, 3.0)
        optimiser.step()


def levenberg(problem: ParameterFitting, meter: Meter, seed: int) -> None:
    tangents = 1.0 + len(problem.free)
    problem.fit(starts=1, on_progress=lambda phase, step, most, rmse: meter.add(rmse, tangents))


def guesses(problem: ParameterFitting, meter: Meter) -> Callable[[np.ndarray], float]:
    """Return the error of guesses: every free parameter, scaled from its bounds to [−1, 1]."""
    low, high = (x.numpy() for x in problem.problem.bounds)

    def judge(guess: np.ndarray) -> float:
        with torch.no_grad():
            error = float(problem.root_mean_squared_error(low + 0.5 * (np.clip(guess, -1.0, 1.0) + 1.0) * (high - low)))
        meter.add(error, 1.0)
        return error

    return judge


def cma(problem: ParameterFitting, meter: Meter, seed: int) -> None:
    import cma as library

    judge = guesses(problem, meter)
    search = library.CMAEvolutionStrategy(
        np.zeros(len(problem.free)), 0.5, {"bounds": [-1.0, 1.0], "seed": seed + 1, "verbose": -9}
    )
    while True:
        guesses_of_turn = search.ask()
        search.tell(guesses_of_turn, [judge(x) for x in guesses_of_turn])


def evolution(problem: ParameterFitting, meter: Meter, seed: int) -> None:
    from scipy.optimize import differential_evolution

    limits = [(-1.0, 1.0)] * len(problem.free)
    differential_evolution(guesses(problem, meter), limits, rng=seed, tol=0.0, maxiter=10**6, polish=False)


def random_search(problem: ParameterFitting, meter: Meter, seed: int) -> None:
    judge, generator = guesses(problem, meter), np.random.default_rng(seed)
    while True:
        judge(generator.uniform(-1.0, 1.0, len(problem.free)))


METHODS = {
    "Levenberg–Marquardt": levenberg,
    "Adam": adam,
    "CMA-ES": cma,
    "differential evolution": evolution,
    "random search": random_search,
}


def main(file: tyro.conf.Positional[Path], seeds: int = 3) -> None:
    """Print a line per method.

    Args:
        file: Trajectories with columns in_manifest and split.
        seeds: Of methods that draw.
    """
    torch.set_num_threads(1)
    measured = load(file).where("in_manifest=true").where("split=train")
    task = make_task("ring")
    best = ParameterFitting(task, measured)
    best.fit(starts=4)
    with torch.no_grad():
        target = TOLERANCE * float(best.root_mean_squared_error())
    print(
        f"{len(best.episodes)} drivers, target {target:.3f} m, {best.vehicle_steps / 1e6:.2f} M vehicle-steps a rollout"
    )
    print(f"{'method':24s} {'reached':>8s} {'M vehicle-steps':>16s} {'CPU s':>8s} {'error m':>8s}   (medians)")
    for name, method in METHODS.items():
        rows = []
        count = 1 if method in (levenberg, adam) else seeds
        for seed in range(count):
            problem = ParameterFitting(task, measured)
            meter = Meter(problem.vehicle_steps, target)
            reached = False
            try:
                method(problem, meter, seed)
            except ReachedError:
                reached = True
            except (StopIteration, RuntimeError):
                pass
            rows.append((reached, meter.count / 1e6, time.process_time() - meter.begin, meter.best))
        middle = np.median([row[1:] for row in rows], axis=0)
        print(f"{name:24s} {sum(r[0] for r in rows)} of {count:2d} {middle[0]:16.1f} {middle[1]:8.2f} {middle[2]:8.3f}")


if __name__ == "__main__":
    command(main)
