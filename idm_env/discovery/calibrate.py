"""One calibration for all: the null, models with terms, and other laws are fitted alike before they are judged.

Whatever is calibrated more carefully looks better. So every model has its own population of drivers and its own weight
of that population, both from closed-loop simulation of the runs that fit, by one procedure.
"""

from collections.abc import Sequence

import numpy as np

from idm_env.discovery import judge
from idm_env.discovery.closed_loop import ClosedLoopFit, evaluate
from idm_env.discovery.march import BASE
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.records import Records, Rows
from idm_env.discovery.solve import Population, Solution
from idm_env.parameters import Parameter

POPULATION = {"max_accel": 1.3, "comfort_decel": 1.8, "time_gap": 1.3, "min_gap": 2.2, "desired_speed": 32.0}
WIDTH = 0.6
"""Width of the first, weak prior of log θ; later the drivers' own spread is taken, between 0.3 and this."""


def calibrate(
    records: Records, model: Hypothesis, values: np.ndarray, start: np.ndarray | None = None
) -> ClosedLoopFit:
    """Calibrate a model in closed-loop simulation of ``records``, φ as it stands.

    1. Drivers one by one, with a prior that hardly weighs anything, from the law's usual values and ``start`` [G, P].
    2. Their median and spread are the population, the prior of everyone.
    3. Its weight is the one that predicts best what a driver's parameters have not seen (``closed_loop.evaluate``).
    """
    own = model.catalogue.own
    problem, theta = judge.unweighed(records, model, values, first_prior(own), start=start)
    return evaluate(records, model, values, population(theta, problem.rows, own), theta)


def drivers_of(fit: ClosedLoopFit, records: Records) -> Solution:
    """Return the parameters of the drivers of ``records`` by a calibrated model."""
    return judge.calibrate(records, fit.model, fit.values, fit.problem.prior, start=fit.theta)


def population(theta: np.ndarray, rows: Rows, own: Sequence[Parameter] = BASE.declared) -> Population:
    """Return the drivers' own spread as prior: median and scaled median deviation of log θ [G, P].

    Of fewer than five groups with rows it is the first, weak prior.
    """
    seen = np.unique(rows.group)
    if len(seen) < 5:
        return first_prior(own)
    centre = np.median(theta[seen], axis=0)
    spread = 1.4826 * np.median(np.abs(theta[seen] - centre), axis=0)
    return Population(centre, np.clip(1.5 * spread, 0.3, WIDTH))


def first_prior(own: Sequence[Parameter] = BASE.declared) -> Population:
    """Return the weak prior that a search starts from, of the drivers' own parameters."""
    centre = [POPULATION.get(p.name, p.default if p.null is None else p.null) for p in own]
    return Population(np.log(centre), np.full(len(centre), WIDTH))
