"""Calibration: from episodes to fitted parameters with standard errors, interruptible and resumable."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from scipy.stats import qmc
from torch import Tensor

from idm_env.data import Episode
from idm_env.effects import IDM, Brakes, CarFollowing, Effect, Replay
from idm_env.fitting.batch import Batch
from idm_env.fitting.prior import Prior
from idm_env.fitting.problem import Loss, Objective, Problem, group_of
from idm_env.fitting.solver import Normal, Progress, minimise, normal
from idm_env.fitting.uncertainty import Uncertainty, estimate_row, uncertainty
from idm_env.jobs import storage
from idm_env.jobs.progress import OnProgress
from idm_env.parameters import constrain, unconstrain
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.validation import one_of

Method = Literal["lm", "adam"]
STEPS, RATES = 500, (0.1, 0.01)
"""Of Adam: how many, and the learning rate at the first and at the last."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted parameters: own [G, P], shared [Q], their uncertainty, and how the search ended."""

    problem: Problem
    own: Tensor
    shared: Tensor
    uncertainty: Uncertainty
    converged: Tensor
    iterations: int

    @property
    def names(self) -> tuple[str, ...]:
        """Full names of the free parameters, own first."""
        return self.problem.own + self.problem.shared

    def values(self) -> Tensor:
        """Return own and shared values side by side, [G, P+Q]."""
        return torch.cat((self.own, self.shared.expand(len(self.own), -1)), dim=-1)

    def table(self) -> list[dict[str, Any]]:
        """Return one row per group and parameter: estimate, standard error, 95 % interval, and flags of doubt."""
        values, columns, rows = self.values(), self.uncertainty, []
        for g, group in enumerate(self.problem.groups):
            for i, (name, p) in enumerate(zip(self.names, self.problem.parameters, strict=True)):
                own = (x[g, i] for x in (values, columns.standard_error, columns.at_bound, columns.identified))
                rows.append({"group": group, **estimate_row(name, p, *own), "converged": bool(self.converged[g])})
        return rows


def base_simulator(dt: float = 0.1, base: CarFollowing | None = None, **choices: Any) -> Simulator:
    """Return the simulator to calibrate: a car-following law (IDM) and brakes in a lane behind replayed neighbours."""
    return Simulator(Lane(), (base or IDM(), Replay(), Brakes()), dt=dt, **choices)


def refuse_nan(items: Sequence[Episode], law: CarFollowing, effects: Sequence[Effect]) -> None:
    """Simulate each of the user's own, with its defaults, behind measured leaders; ValueError names a hook's NaN."""
    batch = Batch.stack(items)
    for effect in (law, *effects):
        if effect.own:
            simulator = base_simulator(batch.step, law).adding(*() if effect is law else (effect,))
            group = torch.zeros(len(batch), dtype=torch.int64)
            Problem(simulator, batch, (), (), group, ("all",)).simulate({})


def own_names(simulator: Simulator) -> tuple[str, ...]:
    """Return the full names of the parameters that a driver has of his own: those of the car-following law."""
    return tuple(f"{simulator.base.name}.{p.name}" for p in simulator.base.declared)


def fingerprint(problem: Problem, *options: object) -> str:
    """Return a digest of everything that determines a fit."""
    prior = problem.prior
    return storage.fingerprint(
        (problem.simulator, problem.own, problem.shared, problem.groups, options),
        (problem.objective, problem.relative, problem.loss, problem.skip, sorted(problem.fixed.items())),
        *(() if prior is None else (prior.centre, prior.deviation, prior.noise)),
        problem.batch.gap,
        problem.batch.position,
    )


def fit(
    episodes: Sequence[Episode],
    *,
    by: str = "driver",
    simulator: Simulator | None = None,
    free: Sequence[str] | None = None,
    shared: Sequence[str] = (),
    objective: Objective = "spacing",
    relative: bool = False,
    loss: Loss = "rmse",
    skip: float = 0.0,
    method: Method = "lm",
    starts: int = 4,
    iterations: int = 60,
    seed: int = 0,
    substeps: int | None = None,
    start: tuple[Tensor, Tensor] | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Prior | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    on_progress: OnProgress | None = None,
) -> Fit:
    """Calibrate ``free`` parameters per group of drivers, and ``shared`` ones for all, behind the measured leaders.

    Where ``free`` is not given it is the car-following law's parameters (IDM's, unless ``simulator`` has another).
    ``by`` is ``driver``, ``all`` or a column. ``method`` is ``lm`` (Levenberg–Marquardt with exact forward-mode
    Jacobians, from ``starts`` starts per group, the pooled optimum among them) or ``adam`` (500 steps of reverse
    mode, learning rate 0.1 → 0.01, as in the paper). ``start`` gives own [G, P] and shared [Q] values (SI) to begin
    from; ``fixed`` gives parameters that are not free another value than their default. ``prior`` makes it a maximum
    a posteriori, from the prior's centre unless ``start`` is given.
    ``checkpoint`` names the folder that makes an interrupted fit resumable with the same result. ValueError and
    DataError for what cannot be fitted.
    """
    one_of("method", method, get_args(Method))
    if prior is not None and method != "lm":
        raise ValueError(f"method = '{method}' knows no prior. Use 'lm'.")
    if prior is not None and start is None:
        start = prior.centre, torch.empty(0, dtype=prior.centre.dtype)
    batch = Batch.stack(episodes, substeps=substeps)
    group, names = group_of(batch.episodes, by)
    simulator = dataclasses.replace(simulator or base_simulator(), dt=batch.step)
    chosen = own_names(simulator) if free is None else tuple(free)
    cost: dict[str, Any] = {"objective": objective, "relative": relative, "loss": loss, "skip": skip, "prior": prior}
    problem = Problem(simulator, batch, chosen, tuple(shared), group, names, fixed=dict(fixed or {}), **cost)
    saved = storage.Store(checkpoint, fingerprint(problem, method, starts, iterations, seed), resume)
    begin = start or (_defaults(problem, problem.own).expand(len(names), -1), _defaults(problem, problem.shared))
    if method == "adam":
        own, common, converged, count = _adam(problem, *begin, saved, on_progress)
    else:
        own, common, converged, count = _levenberg(
            problem, begin, starts if start is None else 1, iterations, seed, saved, on_progress
        )
    result = Fit(problem, own, common, uncertainty(problem, own, common), converged, count)
    saved.remove()
    return result


def _defaults(problem: Problem, names: Sequence[str]) -> Tensor:
    declared = dict(zip(problem.own + problem.shared, problem.parameters, strict=True))
    # A strength starts at its null where it has a gradient there, at its first start otherwise.
    values = [
        p.default
        if p.null is None
        else (p.null if p.role == "strength" and not p.starts else (*p.starts, p.default)[0])
        for p in (declared[name] for name in names)
    ]
    return torch.tensor(values, dtype=problem.batch.gap.dtype)


def _adam(
    problem: Problem, own: Tensor, shared: Tensor, saved: storage.Store, on_progress: OnProgress | None
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Minimise the mean squared residual over all groups at once, on the real line behind the bounds.

    The rate falls linearly from ``RATES[0]`` to ``RATES[1]``. An interrupted run goes on as if it had not stopped.
    """
    start = (*own.unbind(-1), *shared)
    leaves = [unconstrain(p, x).clone().requires_grad_() for p, x in zip(problem.parameters, start, strict=True)]
    optimiser = torch.optim.Adam(leaves, lr=RATES[0])
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, RATES[1] / RATES[0], total_iters=STEPS)
    begin = 0
    if (state := saved.get("adam")) is not None:
        with torch.no_grad():
            for leaf, value in zip(leaves, state["leaves"], strict=True):
                leaf.copy_(value)
        optimiser.load_state_dict(state["optimiser"])
        schedule.load_state_dict(state["schedule"])
        begin = state["step"]

    def values() -> tuple[Tensor, Tensor]:
        inside = [constrain(p, x) for p, x in zip(problem.parameters, leaves, strict=True)]
        cut = len(problem.own)
        return torch.stack(inside[:cut], dim=-1), torch.stack(inside[cut:]) if inside[cut:] else shared

    for step in range(begin + 1, STEPS + 1):
        optimiser.zero_grad()
        residual = problem.residual(problem.simulate(problem.rows(*values())))
        loss = residual.square().sum() / problem.samples.sum()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        if step % 10 == 0:
            now = {"optimiser": optimiser.state_dict(), "schedule": schedule.state_dict(), "step": step}
            saved.put("adam", {"leaves": [x.detach() for x in leaves], **now})
        if on_progress is not None:
            on_progress("adam", step, STEPS, float(loss.detach()) ** 0.5)
    own, shared = (x.detach() for x in values())
    problem.simulate(problem.rows(own, shared))  # NaN has no inverse, and is told by whose it is
    # A Gauss–Newton step from here would gain less than a hundredth of the cost.
    end = normal(problem, own[None], shared[None])
    gain = torch.einsum("gp,gpq,gq->g", end.gradient[0], torch.linalg.pinv(end.hessian[0]), end.gradient[0])
    return own, shared, gain <= 0.01 * end.cost[0], STEPS


def _levenberg(
    problem: Problem, begin: tuple[Tensor, Tensor], starts: int, iterations: int, seed: int, saved: storage.Store,
    on_progress: OnProgress | None,
) -> tuple[Tensor, Tensor, Tensor, int]:  # fmt: skip
    own, shared = begin
    if starts > 1 and len(problem.groups) > 1:
        pooled = dataclasses.replace(problem, group=torch.zeros_like(problem.group), groups=("all",))
        fleet = _phase("pooled", pooled, own[:1][None], shared[None], iterations, saved, on_progress)[0]
        own, shared = fleet.own[0].expand(len(problem.groups), -1), fleet.shared[0]
    if starts > 1 and not problem.shared:
        several = _spread(problem, own, starts, seed)
        first = _phase("starts", problem, several, shared.expand(starts, -1), min(10, iterations), saved, on_progress)
        best = first[1].cost.nan_to_num(torch.inf).argmin(0)
        own = first[0].own[best, torch.arange(len(best))]
    progress, _ = _phase("final", problem, own[None], shared[None], iterations, saved, on_progress)
    converged = progress.done[0] if not problem.shared else torch.full((len(problem.groups),), progress.finished)
    return progress.own[0], progress.shared[0], converged, progress.iteration


def _spread(problem: Problem, own: Tensor, starts: int, seed: int) -> Tensor:
    """Return [starts, G, P]: the given values, then factors of ½ to 2 on them by a scrambled Sobol sequence."""
    sampler = qmc.Sobol(len(problem.own), seed=seed)
    points = torch.as_tensor(sampler.random(max(1, 2 ** (starts - 1).bit_length())), dtype=own.dtype)[: starts - 1]
    low, high = (bound[: len(problem.own)] for bound in problem.bounds)
    around = own[None] * (4.0 ** (points - 0.5))[:, None, :]
    return torch.cat((own[None], torch.minimum(torch.maximum(around, low), high)))


def _phase(
    name: str, problem: Problem, own: Tensor, shared: Tensor, iterations: int, saved: storage.Store,
    on_progress: OnProgress | None,
) -> tuple[Progress, Normal]:  # fmt: skip
    state = saved.get(name)
    progress = Progress.begin(own, shared) if state is None else Progress(**state)

    def on_step(now: Progress, equations: Normal) -> None:
        saved.put(name, dataclasses.asdict(now))
        if on_progress is not None:
            cost = equations.cost.amin(0).sum()
            mean = cost / len(problem.batch) if problem.loss == "rmse" else (cost / problem.samples.sum()).sqrt()
            on_progress(name, now.iteration, iterations, float(mean))

    progress, equations = minimise(problem, progress, iterations, on_step=on_step)
    if bool(equations.cost.isnan().all(0).any()):
        problem.simulate(problem.rows(progress.own, progress.shared))  # tells whose it is
    return progress, equations
