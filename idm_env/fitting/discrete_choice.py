"""Likelihood of recorded lane changes: a logit of the effects' wishes, and two models that know no effects.

A driver stays (0), or changes to the left or right where there is a lane and room, with probability::

    P(side) = λ/2 + (1 − λ) r Q(side),    Q(side) ∝ exp(h/τ) σ(m/τ),    Q(stay) ∝ 1

h is the utility and m the safety margin that the effects of the hook ``change`` state in the simulator (m/s²), added up
as the simulator does; for τ → 0 this is the simulator's rule, a change where h > 0 and m ≥ 0. The attention r is the
share of decisions at which drivers think of another lane at all; the lapse λ is the probability of a change for
reasons that effects know nothing of. Without these two, a driver who stays where he could gain, or one who leaves,
would outweigh all others.

Shapes: what belongs to decisions is ``[decisions]`` or ``[decisions, 2]`` (left, right), θ is ``[p]``.
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import optimize
from torch import Tensor

from idm_env.data import DataError
from idm_env.fitting.lane_decisions import Decisions
from idm_env.fitting.uncertainty import estimate_row
from idm_env.multilane.incentives import wished
from idm_env.parameters import Parameter, replaced
from idm_env.simulator import Simulator

TEMPERATURE = Parameter("temperature", "τ", "m/s²", 0.5, 0.01, 20.0, role="shape")
"""How much drivers differ from what the effects wish for: the scale of the logit."""
ATTENTION = Parameter("attention", "r", "1", 0.1, 1e-5, 1.0, role="shape")
"""The probability to think of another lane, at every decision."""
LAPSE = Parameter("lapse", "λ", "1", 1e-3, 1e-7, 0.5, role="shape")
"""The probability of a change, at every decision, that has nothing to do with the effects."""
STARTS = ((0.2, 0.9), (0.6, 0.9), (0.2, 0.05), (0.6, 0.05), (2.0, 0.05))
"""Temperatures and attentions from which a fit begins; the best end counts."""
_NEVER = -1e9
"""Logarithm of the probability of what is not possible: finite, so that derivatives are."""
_PRIOR = 3.0
"""Standard deviation of the prior of a gap acceptance's coefficients, which keeps them finite where few change."""


class Choice(abc.ABC):
    """A model of decisions with a vector of parameters."""

    title: str

    @property
    @abc.abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """Free parameters, with units and bounds."""

    @abc.abstractmethod
    def values(self, theta: Tensor, decisions: Decisions) -> Tensor:
        """Return ln P(side)/P(stay) of left and right, [N, 2], as if both were possible."""

    def starts(self) -> list[list[float]]:
        """Return where a fit begins."""
        return [[p.default for p in self.parameters]]

    @abc.abstractmethod
    def prior(self, theta: Tensor) -> Tensor:
        """Return the logarithm of the prior, but for a constant."""

    def log_probabilities(self, theta: Tensor, decisions: Decisions) -> Tensor:
        """Return the logarithms of the probabilities to stay, and to change to the left and right, [N, 3]."""
        sides = torch.where(decisions.possible, self.values(theta, decisions), _NEVER)
        return torch.cat((torch.zeros_like(sides[:, :1]), sides), -1).log_softmax(-1)

    def each(self, theta: Tensor, decisions: Decisions) -> Tensor:
        """Return the log-likelihood of every decision, [N]."""
        return self.log_probabilities(theta, decisions).gather(-1, decisions.chosen.unsqueeze(-1)).squeeze(-1)


@dataclass(frozen=True)
class UtilityLogit(Choice):
    """The logit of the wishes of a simulator's effects; ``free`` are full names of parameters of these effects."""

    simulator: Simulator
    free: tuple[str, ...]

    @property
    def title(self) -> str:  # type: ignore[override]
        """The effects' titles."""
        return " and ".join(effect.name for effect in self.simulator.lane_change_models)

    @cached_property
    def _free(self) -> tuple[Parameter, ...]:
        named = {f"{e.name}.{p.name}": p for e in self.simulator.lane_change_models for p in e.parameters}
        for name in self.free:
            if name not in named:
                raise ValueError(f"parameter '{name}' says nothing on lane changes. Take some of {', '.join(named)}.")
        return tuple(named[name] for name in self.free)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The free parameters, temperature, attention and lapse."""
        return (*self._free, TEMPERATURE, ATTENTION, LAPSE)

    def starts(self) -> list[list[float]]:
        """Return the defaults, at several temperatures and attentions."""
        return [[*(p.default for p in self._free), *start, LAPSE.default] for start in STARTS]

    def prior(self, theta: Tensor) -> Tensor:
        """Return ``ln √λ``: as if half a lapse had been seen, so that one more is never impossible."""
        return 0.5 * theta[-1].log()

    def values(self, theta: Tensor, decisions: Decisions) -> Tensor:
        """Return ``h/τ + ln σ(m/τ)``."""
        params = replaced(decisions.params, dict(zip(self.free, theta, strict=False)))
        wish = wished(self.simulator, decisions.scene, params)
        utility, margin = torch.stack(wish[:2], -1), torch.stack(wish[2:4], -1)
        return utility / theta[-3] + torch.nn.functional.logsigmoid(margin / theta[-3])

    def log_probabilities(self, theta: Tensor, decisions: Decisions) -> Tensor:
        """Return ``ln (λ/2 + (1 − λ) r Q)`` of both sides, and the remainder for staying."""
        wished_for = super().log_probabilities(theta, decisions)
        attention, lapse = theta[-2], theta[-1]
        sides = decisions.possible.to(theta.dtype)
        stays = torch.cat((1.0 - 0.5 * sides.sum(-1, keepdim=True), 0.5 * sides), -1)
        lapsed = torch.where(stays > 0, lapse.log() + stays.clamp_min(0.1).log(), _NEVER)
        first = torch.arange(3) == 0
        # Whoever does not think of another lane stays; an attention of 1 leaves nothing of that.
        absent = torch.where(first, torch.log1p(-lapse) + torch.log1p(-attention.clamp_max(1.0 - 1e-9)), _NEVER)
        parts = torch.log1p(-lapse) + attention.log() + wished_for, absent.expand_as(wished_for), lapsed
        return torch.stack(parts).logsumexp(0)


def _coefficient(name: str, default: float = 0.0) -> Parameter:
    return Parameter(name, name.replace("_", " "), "1", default, -50.0, 50.0, role="shape")


@dataclass(frozen=True)
class LinearLogit(Choice):
    """A logit without a car-following law: a constant rate to each side, or the acceptance of gaps (Ahmed 1999, MIT).

    ``ln P(side)/P(stay) = c_side + Σ β_k x_k``, x: logarithms of the gaps to the leader and the follower there (at most
    200 m), how much faster than the driver the leader there is, and how much slower the follower (10 m/s; 0
    where nobody is). Coefficients have a normal prior of deviation 3; a constant rate has none.
    """

    title: str
    coefficients: tuple[str, ...] = ()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Two constants, logarithms of odds, and the coefficients."""
        return (*(_coefficient(n, -4.0) for n in ("left", "right")), *(_coefficient(n) for n in self.coefficients))

    def values(self, theta: Tensor, decisions: Decisions) -> Tensor:
        """Return the linear form."""
        if not self.coefficients:
            return theta.expand(len(decisions), 2)
        scene, sides = decisions.scene, []
        for i, side in enumerate((scene.left, scene.right)):
            assert side is not None
            gaps = [torch.log(n.gap.clamp(1.0, 200.0) / 15.0) for n in (side.leader, side.follower)]
            lead = 0.1 * (side.leader.speed - scene.speed) * side.leader.present
            lag = 0.1 * (scene.speed - side.follower.speed) * side.follower.present
            sides.append(theta[i] + torch.stack((*gaps, lead, lag), -1) @ theta[2:])
        return torch.stack(sides, -1)

    def prior(self, theta: Tensor) -> Tensor:
        """Return that of the coefficients."""
        return -0.5 * (theta[2:] / _PRIOR).square().sum()


CONSTANT_RATE = LinearLogit("constant rate")
GAP_ACCEPTANCE = LinearLogit("gap acceptance", ("lead_gap", "lag_gap", "lead_speed", "lag_speed"))


class Chosen(NamedTuple):
    """A fitted model of decisions: values, standard errors, log-likelihood, and flags of doubt (bool)."""

    model: Choice
    theta: Tensor
    standard_error: Tensor
    log_likelihood: float
    at_bound: Tensor
    identified: Tensor

    def table(self) -> list[dict[str, Any]]:
        """Return one row per parameter: estimate, standard error, 95 % interval, and flags of doubt."""
        columns = zip(self.theta, self.standard_error, self.at_bound, self.identified, strict=True)
        return [estimate_row(p.name, p, *column) for p, column in zip(self.model.parameters, columns, strict=True)]


def fit_choice(
    model: Choice, decisions: Decisions, *, starts: Sequence[Sequence[float]] | None = None, errors: bool = True
) -> Chosen:
    """Return the parameters of largest likelihood (with its prior, if the model has one) within their bounds.

    Standard errors are the larger of two: those of the curvature of the likelihood, and those that allow for what
    decisions of one driver have in common (clustered by vehicle). A parameter on its bound, or one of which the 95 %
    interval is wider than half of its bounds, is not identified. ``starts`` replaces the
    model's own; ``errors`` False leaves standard errors out. DataError where nobody changes lanes.
    """
    if decisions.changes == 0:
        raise DataError("nobody changes lanes, and nothing can be fitted to that. Check the column 'lane'.")
    low, high = (np.array([getattr(p, side) for p in model.parameters]) for side in ("low", "high"))

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        theta = torch.tensor(x, dtype=torch.float64, requires_grad=True)
        total = -model.each(theta, decisions).sum() - model.prior(theta)
        (gradient,) = torch.autograd.grad(total, theta)
        return float(total.detach()), gradient.numpy()

    how: dict[str, Any] = {"jac": True, "method": "L-BFGS-B", "bounds": list(zip(low, high, strict=True))}
    how["options"] = {"maxiter": 500, "ftol": 1e-12, "gtol": 1e-7}
    ends = [optimize.minimize(cost, np.clip(start, low, high), **how) for start in starts or model.starts()]
    theta = torch.tensor(min(ends, key=lambda end: float(end.fun)).x, dtype=torch.float64)
    span = torch.tensor(high - low)
    at_bound = torch.minimum(theta - torch.tensor(low), torch.tensor(high) - theta) < 1e-6 * span
    error = torch.full_like(theta, torch.nan)
    if errors:
        error = _standard_errors(model, theta, decisions, at_bound)
    identified = ~at_bound & (2 * 1.96 * error < 0.5 * span)
    each = float(model.each(theta, decisions).sum())
    return Chosen(model, theta, error, each, at_bound, identified)


def _standard_errors(model: Choice, theta: Tensor, decisions: Decisions, at_bound: Tensor) -> Tensor:
    """Return standard errors, infinite where nothing is known; a parameter on its bound counts as given."""
    free = torch.nonzero(~at_bound).squeeze(-1)
    error = torch.full_like(theta, torch.inf)
    if len(free) == 0:
        return error

    def each(x: Tensor) -> Tensor:
        return model.each(theta.scatter(0, free, x), decisions)

    def total(x: Tensor) -> Tensor:
        return -each(x).sum() - model.prior(theta.scatter(0, free, x))

    curvature = torch.autograd.functional.hessian(total, theta[free])
    scores = torch.autograd.functional.jacobian(each, theta[free], vectorize=True, strategy="forward-mode")
    drivers = torch.zeros(len(decisions.vehicles), len(free), dtype=theta.dtype)
    drivers = drivers.index_add(0, decisions.vehicle, scores)
    if bool((torch.linalg.eigvalsh(curvature) <= 0).any()):
        return error
    inverse = torch.linalg.inv(curvature)
    clustered = inverse @ (drivers.T @ drivers) @ inverse
    error[free] = torch.maximum(inverse.diagonal(), clustered.diagonal()).clamp_min(0.0).sqrt()
    return error


def folds(decisions: Decisions, count: int, seed: int) -> Tensor:
    """Return the fold of every vehicle, stratified by whether it changes lanes."""
    changes = torch.zeros(len(decisions.vehicles)).index_add(0, decisions.vehicle, (decisions.chosen > 0).float())
    shuffle = torch.randperm(len(changes), generator=torch.Generator().manual_seed(seed))
    order = shuffle[torch.argsort(-(changes[shuffle] > 0).int(), stable=True)]
    fold = torch.empty(len(changes), dtype=torch.int64)
    fold[order] = torch.arange(len(changes)) % count
    return fold


class HeldOut(NamedTuple):
    """Decisions judged by models that have not seen their drivers: log-likelihood [N] and probabilities [N, 3]."""

    log_likelihood: Tensor
    probabilities: Tensor


def held_out(fitted: Sequence[Chosen], decisions: Decisions, fold: Tensor) -> list[HeldOut]:
    """Return log-likelihoods and probabilities of every model on the drivers held out of its fit, fold by fold.

    These fits begin where that to all drivers ended.
    """
    results = []
    for all_drivers in fitted:
        model = all_drivers.model
        scores = torch.zeros(len(decisions), dtype=torch.float64)
        probabilities = torch.zeros(len(decisions), 3, dtype=torch.float64)
        for k in range(int(fold.max()) + 1):
            mine = fold[decisions.vehicle] == k
            others = fit_choice(model, decisions.select(~mine), starts=[all_drivers.theta.tolist()], errors=False)
            with torch.no_grad():
                seen = decisions.select(mine)
                scores[mine] = model.each(others.theta, seen)
                probabilities[mine] = model.log_probabilities(others.theta, seen).exp()
        results.append(HeldOut(scores, probabilities))
    return results


def per_vehicle(decisions: Decisions, value: Tensor) -> Tensor:
    """Return the sum of a value over every vehicle's decisions, of vehicles that have any."""
    count = len(decisions.vehicles)
    sums = torch.zeros(count, dtype=value.dtype).index_add(0, decisions.vehicle, value)
    some = torch.zeros(count, dtype=torch.bool).index_fill(0, decisions.vehicle, True)
    return sums[some]
