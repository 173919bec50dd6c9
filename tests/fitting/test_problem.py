"""The linearised rollout: exact tangents, parity of kernels and torch, and what a batch holds."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
import pytest
import torch

from idm_env.data import DataError, Episodes
from idm_env.data.episode import windows
from idm_env.data.synthetic import Truth
from idm_env.effects import IDM, Brakes, ImaginedLeader, Lateral, Replay, make
from idm_env.fitting.batch import Batch
from idm_env.fitting.problem import IDM_NAMES, Problem, group_of
from idm_env.roads import Lane
from idm_env.simulator import Simulator

NONE = torch.zeros(0, dtype=torch.float64)


def problem_of(
    items: Episodes, *effects: str, substeps: int = 1, shared: tuple[str, ...] = (), **options: object
) -> Problem:
    """Return a per-driver problem of IDM with further effects."""
    batch = Batch.stack(items, substeps=substeps)
    simulator = Simulator(Lane(), (IDM(), Replay(), Brakes(), *(make(e) for e in effects)), dt=batch.step)
    group, names = group_of(batch.episodes, "driver")
    return Problem(simulator, batch, IDM_NAMES, shared, group, names, **options)  # type: ignore[arg-type]


def start(problem: Problem) -> torch.Tensor:
    """Return plausible, different values for every group, [G, 5]."""
    base = torch.tensor([1.3, 1.7, 1.3, 2.1, 31.0], dtype=torch.float64)
    factor = 1.0 + 0.02 * torch.arange(len(problem.groups), dtype=torch.float64)[:, None]
    return base * factor


@pytest.mark.parametrize(
    ("effects", "shared", "values"),
    [
        ((), (), ()),
        (("delay",), ("delay.delay",), (0.33,)),
        (("memory",), ("memory.strength", "memory.memory_time"), (0.4, 60.0)),
        (("second_leader", "follower"), ("second_leader.weight", "follower.gain"), (0.2, 0.1)),
        (("lag", "speed_dependent_gap"), ("lag.lag", "speed_dependent_gap.extra_gap"), (0.4, 2.0)),
        (("lateral",), ("lateral.gain",), (0.1,)),
    ],
)
@pytest.mark.parametrize("substeps", [1, 2])
def test_jacobians_are_those_of_finite_differences(
    platoon: tuple[Episodes, Truth], effects: tuple[str, ...], shared: tuple[str, ...], values: tuple[float, ...],
    substeps: int
) -> None:  # fmt: skip
    """For IDM and for effects with memory, neighbours and lags, over 4 s."""
    items = Episodes(tuple(e.part(0, 40) for e in platoon[0][:2]), ())
    problem = problem_of(items, *effects, shared=shared, substeps=substeps, kernels=False, objective="both")
    own, common = start(problem)[None], torch.tensor([values], dtype=torch.float64)
    residual, jacobian = problem.linearise(own, common)
    torch.testing.assert_close(residual[:, 0], problem.residual(problem.simulate(problem.rows(own[0], common[0]))))
    for i in range(len(IDM_NAMES) + len(shared)):
        differences = []
        for sign in (1, -1):
            a, b = own.clone(), common.clone()
            if i < len(IDM_NAMES):
                a[..., i] += sign * 1e-5
            else:
                b[..., i - len(IDM_NAMES)] += sign * 1e-5
            differences.append(problem.residual(problem.simulate(problem.rows(a[0], b[0]))))
        expected = (differences[0] - differences[1]) / 2e-5
        torch.testing.assert_close(jacobian[:, i, 0], expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max() + 1))


@pytest.mark.parametrize("objective", ["spacing", "speed", "both"])
@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("integration", ["ballistic", "euler", "midpoint"])
def test_kernels_and_torch_agree(
    platoon: tuple[Episodes, Truth], objective: str, relative: bool, integration: str
) -> None:
    """Rollout, its gradient and the normal equations of both paths, from several starts at once."""
    pytest.importorskip("numba")
    items = Episodes(tuple(e.part(0, 25) for e in platoon[0][:3]), ())
    slow = problem_of(items, substeps=2, objective=objective, relative=relative, kernels=False)
    slow = dataclasses.replace(slow, simulator=dataclasses.replace(slow.simulator, integration=integration))
    quick = dataclasses.replace(slow, kernels=True)
    assert quick._compiled is not None and slow._compiled is None
    own = torch.stack((start(slow), 1.3 * start(slow)))
    none = torch.zeros(2, 0, dtype=torch.float64)
    for a, b in zip(slow.equations(own, none), quick.equations(own, none), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-7, atol=1e-7 * float(a.abs().max()))
    gradients = []
    for problem in (slow, quick):
        leaf = start(slow).requires_grad_()
        simulated = problem.simulate(problem.rows(leaf, NONE))
        problem.residual(simulated).square().sum().backward()
        gradients.append(leaf.grad)
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-7, atol=1e-7 * float(gradients[0].abs().max()))


@pytest.mark.parametrize(
    ("effects", "shared", "values"),
    [
        (("delay",), ("delay.delay",), (0.33,)),
        (("memory",), ("memory.strength", "memory.memory_time"), (0.4, 60.0)),
        (("second_leader", "follower"), ("second_leader.weight", "follower.gain"), (0.2, 0.1)),
        (("lag", "lateral", "regime_shift"), ("lag.lag", "regime_shift.time"), (0.4, 2.0)),
    ],
)
def test_a_corrected_model_is_compiled(
    platoon: tuple[Episodes, Truth], effects: tuple[str, ...], shared: tuple[str, ...], values: tuple[float, ...]
) -> None:
    """Normal equations of both paths, own and shared parameters, at two starts at once; memories start from both."""
    pytest.importorskip("numba")
    items = Episodes(tuple(e.part(0, 30) for e in platoon[0][:3]), ())
    slow = problem_of(items, *effects, shared=shared, substeps=2, objective="both", kernels=False)
    quick = dataclasses.replace(slow, kernels=True)
    assert quick._compiled is not None
    own = torch.stack((start(slow), 1.3 * start(slow)))
    common = torch.tensor([values, values], dtype=torch.float64) * torch.tensor([[1.0], [0.9]], dtype=torch.float64)
    for a, b in zip(slow.equations(own, common), quick.equations(own, common), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-8 * float(a.abs().max()))
    for a, b in zip(slow.linearise(own, common), quick.linearise(own, common), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-8 * float(a.abs().max()))


def test_a_batch_starts_measured_and_counts_only_what_was_measured(platoon: tuple[Episodes, Truth]) -> None:
    """Rows of different length: padding has no weight, and the record is met at every sample."""
    items = Episodes((platoon[0][0].part(0, 300), platoon[0][1]), ())
    batch = Batch.stack(items, substeps=4)
    assert batch.valid.sum(0).tolist() == [300.0, float(len(items[1]))]
    assert batch.steps == (len(items[1]) - 1) * 4
    np.testing.assert_allclose(batch.gap[:300, 0].numpy(), items[0].gap_m)
    lead = batch.position[::4, 1, 1] - batch.length[1, 1] - batch.position[::4, 1, 2]
    np.testing.assert_allclose(lead[: len(items[1])].numpy(), items[1].gap_m, atol=1e-9)
    small = Batch.stack(items[:1], substeps=4)
    assert small.steps == 299 * 4 and len(small) == 1
    torch.testing.assert_close(small.position, batch.position[: small.steps + 1, :1])


def test_an_effect_of_ones_own_is_given_what_was_measured_of_its_kind(platoon: tuple[Episodes, Truth]) -> None:
    @dataclasses.dataclass(frozen=True)
    class Beside(Lateral):
        kind: ClassVar[str] = "beside"

    @dataclasses.dataclass(frozen=True)
    class Fancied(ImaginedLeader):
        kind: ClassVar[str] = "fancied"

    items = Episodes(tuple(e.part(0, 100) for e in platoon[0][:1]), ())
    ours, given = (
        Batch.stack(items, substeps=1).inputs(Simulator(Lane(), (IDM(), Replay(), Brakes(), effect), dt=0.1))
        for effect in (Beside(), Lateral())
    )
    for mine, known in zip(ours["beside"], given["lateral"], strict=True):
        torch.testing.assert_close(mine, known)
    with pytest.raises(DataError, match="effect 'fancied' takes an input that measured data do not have"):
        Batch.stack(items, substeps=1).inputs(Simulator(Lane(), (IDM(), Replay(), Brakes(), Fancied()), dt=0.1))


def test_windows_cover_everything_once(platoon: tuple[Episodes, Truth]) -> None:
    """A short rest stays with the window before it."""
    episode = platoon[0][0]
    cut = windows([episode], 30.0)
    np.testing.assert_array_equal(np.concatenate([w.gap_m for w in cut]), episode.gap_m)
    assert [round(w.seconds) for w in cut][:2] == [30, 30] and cut[-1].seconds < 50.5


def test_errors(platoon: tuple[Episodes, Truth]) -> None:
    """One line each, with the value, the rule and the cure."""
    problem = problem_of(platoon[0])
    with pytest.raises(ValueError, match=r"unknown parameter 'idm.headway'"):
        dataclasses.replace(problem, own=("idm.headway",))
    with pytest.raises(ValueError, match="Did you mean 'spacing'"):
        dataclasses.replace(problem, objective="spaceing")
    with pytest.raises(ValueError, match=r"steps by 0\.05 s, the batch by 0\.1 s"):
        dataclasses.replace(problem, simulator=dataclasses.replace(problem.simulator, dt=0.05))
    with pytest.raises(DataError, match="cannot group by 'vehicle'"):
        group_of(problem.batch.episodes, "vehicle")
    with pytest.raises(DataError, match="no episode"):
        Batch.stack([])
    with pytest.raises(DataError, match=r"steps of 0\.1 and 0\.2 s"):
        Batch.stack([platoon[0][0], dataclasses.replace(platoon[0][1], dt=0.2)])
