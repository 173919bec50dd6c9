"""A fitting problem: its free parameters, own and shared, and its residual.

Free parameters are *own* (one value per group of drivers) or *shared* (one value for all). Values travel as two
tensors: ``own`` [..., groups, P] and ``shared`` [..., Q], in the order of the names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from idm_env.compiled.kernels import dispatch
from idm_env.data import DataError, Episode
from idm_env.fitting.batch import Batch
from idm_env.fitting.prior import Prior
from idm_env.fitting.solver import Box, Normal
from idm_env.parameters import Parameter, catalogue, nearest, replaced
from idm_env.simulator import Simulator
from idm_env.types import Inputs, State
from idm_env.validation import one_of

if TYPE_CHECKING:
    from idm_env.compiled.kernels.drivers import BehindRecord

Objective = Literal["spacing", "speed", "both"]
Loss = Literal["mse", "rmse"]
IDM_NAMES = ("idm.max_accel", "idm.comfort_decel", "idm.time_gap", "idm.min_gap", "idm.desired_speed")


class Simulated(NamedTuple):
    """The driver's gap (m) and speed (m/s) at every sample after the first, [T−1, ..., rows]."""

    gap: Tensor
    speed: Tensor


@dataclass(frozen=True, eq=False)
class Problem:
    """A simulator, measured episodes, and the parameters to find.

    ``group`` gives every row's group. ``objective`` is the residual: ``spacing`` (simulated − measured gap, m),
    ``speed`` (m/s) or ``both`` (gap/``scales[0]`` and speed/``scales[1]``); ``relative`` divides by the row's mean
    measured value. Samples of the first ``skip`` seconds do not count. ``loss`` says how episodes of a group add up:
    ``mse`` sums squared residuals, ``rmse`` sums every episode's root mean square, so that a few bad episodes do not
    decide for all. ``kernels=False`` keeps to the torch path where fused kernels would fit. ``fixed`` gives parameters
    that are not free another value than their default. ``prior`` is what is known of the own parameters beforehand;
    it asks for ``loss="mse"``.
    """

    simulator: Simulator
    batch: Batch
    own: tuple[str, ...]
    shared: tuple[str, ...]
    group: Tensor
    groups: tuple[str, ...]
    objective: Objective = "spacing"
    relative: bool = False
    loss: Loss = "mse"
    skip: float = 0.0
    scales: tuple[float, float] = (1.0, 0.3)
    kernels: bool = True
    seed: int = 0
    fixed: Mapping[str, float] = field(default_factory=dict)
    prior: Prior | None = None

    def __post_init__(self) -> None:
        parameters = catalogue(self.simulator.effects)
        for name in (*self.own, *self.shared, *self.fixed):
            if name not in parameters:
                raise ValueError(f"unknown parameter '{name}'.{nearest(name, parameters)}")
        if self.prior is not None and self.loss != "mse":
            raise ValueError(f"a prior weighs squared residuals; loss = '{self.loss}' has none. Use 'mse'.")
        if abs(self.simulator.dt - self.batch.step) > 1e-9:
            raise ValueError(
                f"the simulator steps by {self.simulator.dt:g} s, the batch by {self.batch.step:g} s. Give both one dt."
            )
        one_of("objective", self.objective, get_args(Objective))
        one_of("loss", self.loss, get_args(Loss))

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Declarations of the free parameters, own first."""
        declared = catalogue(self.simulator.effects)
        return tuple(declared[name] for name in self.own + self.shared)

    @cached_property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds of the free parameters, own first."""
        low = torch.tensor([p.low for p in self.parameters], dtype=torch.float64)
        return low, torch.tensor([p.high for p in self.parameters], dtype=torch.float64)

    @cached_property
    def boxes(self) -> tuple[Box, Box]:
        """Bounds of own and of shared parameters; a step may be of any length."""
        (low, high), count = self.bounds, len(self.own)
        anywhere = torch.full_like(low, torch.inf)
        return Box(low[:count], high[:count], anywhere[:count]), Box(low[count:], high[count:], anywhere[count:])

    @property
    def costs(self) -> None:
        """A rollout without derivatives takes two fifths of the time of one with them, and tells much less."""

    @property
    def stiffness(self) -> Tensor:
        """Nothing is known of shared parameters beforehand."""
        return torch.zeros(len(self.shared), dtype=torch.float64)

    @cached_property
    def _inputs(self) -> Inputs:
        return self.batch.inputs(self.simulator, self.seed)

    @cached_property
    def weight(self) -> Tensor:
        """1 for every sample that counts, [T−1, rows]."""
        weight = self.batch.valid[1:].clone()
        weight[: round(self.skip / self.batch.dt)] = 0
        return weight

    @property
    def samples(self) -> Tensor:
        """Residuals that count, per row."""
        return self.weight.sum(0) * (2.0 if self.objective == "both" else 1.0)

    def params(self, values: dict[str, Tensor]) -> dict[str, dict[str, Tensor]]:
        """Return defaults with some parameters replaced, each by a tensor that broadcasts against rows × vehicles."""
        params = self.simulator.defaults(dtype=self.batch.gap.dtype)
        fixed = {name: torch.tensor(value, dtype=self.batch.gap.dtype) for name, value in self.fixed.items()}
        return replaced(params, {**fixed, **values})

    def simulate(self, values: dict[str, Tensor]) -> Simulated:
        """Roll the drivers out behind their measured leaders; ``values`` are [..., rows] by parameter name.

        ValueError names an effect of one's own that returns NaN.
        """
        if self._compiled is None:
            return self._rollout(values)
        params = self.params({name: value.unsqueeze(-1) for name, value in values.items()})
        state = self.batch.start(self.simulator, params)
        simulated = Simulated(*self._compiled.simulate(state, params, self.batch.substeps))
        # NaN that an effect of one's own has made is told by the step itself.
        is_nan = self.simulator.own and bool(simulated.gap.isnan().any())
        return self._rollout(values) if is_nan else simulated

    def _rollout(self, values: dict[str, Tensor]) -> Simulated:
        _, driver = self.batch.columns(self.simulator)
        params = self.params({name: value.unsqueeze(-1) for name, value in values.items()})
        state = self.batch.start(self.simulator, params)

        def keep(now: State) -> tuple[Tensor, Tensor]:
            return now.gap[..., driver], now.speed[..., driver]

        _, samples = self.simulator.rollout(state, self._inputs, params, self.batch.steps, keep=keep)
        return Simulated(*(x[self.batch.substeps - 1 :: self.batch.substeps] for x in samples))

    def rows(self, own: Tensor, shared: Tensor) -> dict[str, Tensor]:
        """Return the value of every free parameter for every row, from values per group."""
        per_row = own.index_select(-2, self.group)
        values = {name: per_row[..., i] for i, name in enumerate(self.own)}
        for i, name in enumerate(self.shared):
            values[name] = shared[..., i, None].expand(per_row.shape[:-1])
        return values

    def residual(self, simulated: Simulated) -> Tensor:
        """Return the weighted residual [T−1 (twice for both), ..., rows], 0 where a sample does not count."""
        shape = (-1, *(1,) * (simulated.gap.dim() - 2), len(self.batch))
        return self._weigh(
            simulated.gap - self.batch.gap[1:].reshape(shape), simulated.speed - self.batch.speed[1:].reshape(shape)
        )

    @cached_property
    def weights(self) -> tuple[Tensor, Tensor]:
        """Weights of gap and speed residuals, each [T−1, rows]; 0 where the objective does not look."""
        both = []
        for name, measured, scale in (
            ("spacing", self.batch.gap[1:], self.scales[0]),
            ("speed", self.batch.speed[1:], self.scales[1]),
        ):
            weight = self.weight / (scale if self.objective == "both" else 1.0)
            if self.relative:
                mean = (measured.abs() * self.weight).sum(0) / self.weight.sum(0).clamp_min(1.0)
                weight = weight / mean.clamp_min(0.1)
            both.append(weight if self.objective in (name, "both") else torch.zeros_like(weight))
        return both[0], both[1]

    def _weigh(self, gap: Tensor, speed: Tensor) -> Tensor:
        """Stack weighted differences (or derivatives) of gap and speed: linear in both."""
        shape = (-1, *(1,) * (gap.dim() - 2), gap.shape[-1])
        pair = {"spacing": gap * self.weights[0].reshape(shape), "speed": speed * self.weights[1].reshape(shape)}
        return torch.cat([x for name, x in pair.items() if self.objective in (name, "both")])

    @cached_property
    def _prepared(self) -> BehindRecord | str:
        """The compiled rollout of these drivers, or why there is none."""
        from idm_env.compiled.kernels import drivers

        batch, (vehicles, driver) = self.batch, self.batch.columns(self.simulator)
        records = {"position": batch.position, "speed": batch.all_speed, "accel": batch.accel, "present": batch.present}
        start = batch.start(self.simulator, self.params({}))
        return drivers.prepared(
            self.simulator, start, {n: x[:, :, vehicles] for n, x in records.items()}, self._inputs, driver
        )

    @property
    def _compiled(self) -> BehindRecord | None:
        """The compiled rollout, where there is one and kernels can run."""
        if not self.kernels or dispatch.surroundings() is not None:
            return None
        return None if isinstance(self._prepared, str) else self._prepared

    def sum_groups(self, x: Tensor) -> Tensor:
        """Sum [S, rows, ...] over the rows of every group: [S, G, ...]."""
        return x.new_zeros(x.shape[0], len(self.groups), *x.shape[2:]).index_add(1, self.group, x)

    def row_normal(self, own: Tensor, shared: Tensor) -> tuple[Normal, Tensor]:
        """Linearise and return the equations of every row, and its weight in the loss [S, rows].

        With ``loss="mse"`` a row costs ``Σ r²``; with ``"rmse"`` it costs ``√(Σ r²/n)``, whose gradient and majorising
        matrix are those of Σ r² with weight ``1/(n · RMSE)``: iteratively reweighted least squares, which never raises
        the cost.
        """
        square, gradient, hessian = self.equations(own, shared)
        if self.loss == "mse":
            return Normal(square, gradient, hessian), torch.ones_like(square)
        samples = self.samples.clamp_min(1.0)
        cost = torch.sqrt(square / samples + 1e-12)
        weight = 1.0 / (samples * cost)
        return Normal(cost, gradient * weight[..., None], hessian * weight[..., None, None]), weight

    def normal(self, own: Tensor, shared: Tensor) -> Normal:
        """Linearise at these values and sum the normal equations over the rows of every group, without the prior."""
        rows, _ = self.row_normal(own, shared)
        return Normal(*(self.sum_groups(x) for x in (rows.cost, rows.gradient, rows.hessian)))

    def equations(self, own: Tensor, shared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return Σr² [S, rows], Jᵀr [S, rows, N] and JᵀJ [S, rows, N, N]; own [S, G, P], shared [S, Q]."""
        if self._compiled is not None:
            state, params, names, start_by = self._linear(self._compiled, own, shared)
            targets = torch.stack((self.batch.gap[1:], self.batch.speed[1:]))
            return self._compiled.normal_equations(
                state, params, names, targets, torch.stack(self.weights), self.batch.substeps, start_by=start_by
            )
        residual, jacobian = self.linearise(own, shared)
        return (
            residual.square().sum(0),
            torch.einsum("tpsb,tsb->sbp", jacobian, residual),
            torch.einsum("tpsb,tqsb->sbpq", jacobian, jacobian),
        )

    def _linear(
        self, compiled: BehindRecord, own: Tensor, shared: Tensor
    ) -> tuple[State, dict[str, dict[str, Tensor]], tuple[str, ...], Tensor | None]:
        """Return start, parameters, names of the free ones, and the start's derivative by these (for memories)."""
        values = self.rows(own, shared)
        remembers = any(e.remembers for e in self.simulator.effects)
        if remembers:
            values = {name: x.detach().clone().requires_grad_() for name, x in values.items()}
        with torch.set_grad_enabled(remembers):
            params = self.params({name: value.unsqueeze(-1) for name, value in values.items()})
            state = self.batch.start(self.simulator, params)
        return state, params, tuple(values), compiled.start_by(state, values)

    def linearise(self, own: Tensor, shared: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residual [T, ..., rows] and its Jacobian [T, P+Q, ..., rows], by forward-mode differentiation.

        All directions share one rollout: values once, tangents as a further batch dimension.
        """
        if self._compiled is not None:
            state, params, names, start_by = self._linear(self._compiled, own, shared)
            gap, speed, gap_by, speed_by = self._compiled.sensitivities(
                state, params, names, self.batch.substeps, start_by=start_by
            )
            return self.residual(Simulated(gap, speed)), self._weigh(gap_by, speed_by)
        values = self.rows(own, shared)
        point = torch.stack(list(values.values()))
        one = torch.eye(len(point), dtype=point.dtype).reshape(2 * [len(point)] + [1] * (point.dim() - 1))

        def simulated(point: Tensor) -> Simulated:
            return self._rollout(dict(zip(values, point, strict=True)))

        def differentiate(direction: Tensor) -> tuple[Simulated, Simulated]:
            samples, tangents = torch.func.jvp(simulated, (point,), (direction,))[:2]
            return samples, tangents

        directions = one.expand(-1, *point.shape)
        # A tangent that is the same in all directions is put before its dimensions only: vmap fails at another place.
        samples, tangents = torch.func.vmap(differentiate, out_dims=(None, 0))(directions)  # type: ignore[arg-type]
        return self.residual(samples), self._weigh(*(x.movedim(0, 1) for x in tangents))


def group_of(episodes: Sequence[Episode], by: str) -> tuple[Tensor, tuple[str, ...]]:
    """Return each episode's group and the names of the groups.

    ``by`` is ``driver`` (one vehicle of one run), ``all``, or a column that is constant over an episode, such as
    vehicle_name. DataError names the nearest column for an unknown one.
    """
    if by == "driver":
        labels = [f"{e.run_id}/{e.vehicle_id}" for e in episodes]
    elif by == "all":
        labels = ["all"] * len(episodes)
    elif by in ("run_id", "vehicle_id", "leader_id"):
        labels = [str(getattr(e, by)) for e in episodes]
    else:
        columns = set.intersection(*(set(e.labels) for e in episodes)) | {"driver", "all", "run_id", "vehicle_id"}
        if by not in columns:
            raise DataError(f"cannot group by '{by}': no such column, constant for a driver.{nearest(by, columns)}")
        labels = [e.labels[by] for e in episodes]
    number = {name: i for i, name in enumerate(dict.fromkeys(labels))}
    return torch.tensor([number[label] for label in labels]), tuple(number)
