"""Laws of gradients through choices of lanes: what each way of deciding promises, on small scenes."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from idm_env import population
from idm_env.choices import chances
from idm_env.effects import IDM, Brakes, MandatoryChange, Mobil
from idm_env.kernels import dispatch
from idm_env.roads import Lanes, lane_drop
from idm_env.simulator import Simulator
from idm_env.types import Wish
from tests.laws.test_changes import DTYPE, ROADS, mixed

BOTH = (Mobil(), MandatoryChange())


def made(kind: str, how: str, temperature: float = 0.1, *, n: int = 10, batch: int = 2, seed: int = 1) -> Any:
    """Return a simulator that decides so, a state and parameters."""
    simulator, state, params = mixed(ROADS[kind](3), n, 20.0 * n, batch=batch, seed=seed, effects=BOTH)
    return dataclasses.replace(simulator, decisions=how, temperature=temperature), state, params


def varied(params: Any, values: Tensor) -> Any:
    """Return parameters with these time gap, politeness, threshold and deceleration that is safe."""
    names = ("politeness", "threshold", "safe_decel")
    mobil = {**params["mobil"], **dict(zip(names, values[1:], strict=True))}
    return {**params, "idm": {**params["idm"], "time_gap": values[0]}, "mobil": mobil}


@pytest.mark.parametrize("kind", ["ring", "drop"])
def test_the_surrogate_has_the_values_of_hard_choices_and_a_gradient_for_what_matters_through_them(kind: str) -> None:
    """To the last bit, links and counts included; without a graph it does not even look."""
    values = torch.tensor([1.4, 0.2, 0.1, 3.0], dtype=DTYPE, requires_grad=True)
    found = {}
    for how in ("pathwise", "surrogate"):
        simulator, state, params = made(kind, how, 0.3)
        with dispatch.off():
            end, kept = simulator.rollout(state, {}, varied(params, values), 60)
            (slope,) = torch.autograd.grad(kept.position.mean(), values)
        found[how] = end, kept, slope
    (hard, one, frozen), (end, two, slope) = found.values()
    assert hard.links.changed.sum() >= 5
    assert all(torch.equal(a, b) for a, b in zip([*one, *hard.links], [*two, *end.links], strict=True))
    assert (frozen[1:] == 0).all() and (slope[1:3].abs() > 1e-3).all() and slope.isfinite().all()
    with torch.no_grad(), dispatch.off():
        assert simulator.rollout(state, {}, params, 20)[0].choices is None


@pytest.mark.parametrize("kind", ["ring", "open", "drop"])
def test_soft_becomes_hard_as_the_temperature_falls(kind: str) -> None:
    """Vehicles that compete for a gap included: to rounding, where the lanes are those of hard choices."""
    hard, state, params = made(kind, "pathwise", batch=4)
    with dispatch.off():
        end, kept = hard.rollout(state, {}, params, 60)
        errors = []
        for temperature in (1.0, 0.1, 1e-5):
            soft = dataclasses.replace(hard, decisions="soft", temperature=temperature)
            last, given = soft.rollout(state, {}, params, 60)
            errors.append(float((given.position - kept.position).abs().max()))
            torch.testing.assert_close(last.choices.shares.sum(-1), torch.ones_like(state.speed))
    assert end.links.changed.sum() > 10 and end.links.refused.sum() > 0
    assert errors[0] > errors[1] > 1e-3 and errors[2] < 1e-6
    assert torch.equal(last.links.lane, end.links.lane)


@pytest.mark.parametrize("kind", ["ring", "drop"])
def test_gradients_of_soft_are_finite_differences(kind: str) -> None:
    """By what matters through choices alone, too: nothing is frozen."""
    simulator, state, params = made(kind, "soft", 0.5, n=6, batch=1)

    def far(values: Tensor) -> Tensor:
        return simulator.rollout(state, {}, varied(params, values), 35)[1].position[-1].mean()

    values = torch.tensor([1.4, 0.2, 0.1, 3.0], dtype=DTYPE, requires_grad=True)
    (slope,) = torch.autograd.grad(far(values), values)
    step = 1e-6 * torch.eye(4, dtype=DTYPE)
    with torch.no_grad():
        expected = torch.stack([(far(values + h) - far(values - h)) / 2e-6 for h in step])
    torch.testing.assert_close(slope, expected, rtol=1e-4, atol=1e-6)
    assert (expected[:3].abs() > 1e-4).all()


def test_scores_are_unbiased() -> None:
    """One driver, one choice: beside the exact derivative of the mean over it, within standard errors."""
    simulator = Simulator(Lanes(2), (IDM(), Mobil(every=3.0), Brakes()), decisions="score", temperature=0.5)
    params = simulator.defaults(dtype=DTYPE)
    params["mobil"]["politeness"] = torch.tensor(0.0, dtype=DTYPE)  # the first has no reason to go
    draws, steps = 4000, 30
    position, speed = torch.tensor([40.0, 0.0], dtype=DTYPE), torch.full((2,), 15.0, dtype=DTYPE)

    def drive(time_gap: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        """Return how far the second comes, and the logarithm of the chance of what he chose; the first stays."""
        rows = len(normal)
        given = {**params, "idm": {**params["idm"], "time_gap": time_gap}}
        state = simulator.state(position.expand(rows, 2), speed.expand(rows, 2), given, lane=0)
        normals = torch.stack((torch.zeros_like(normal), normal), -1).expand(steps, rows, 2)
        end, _ = simulator.rollout(state, {"decisions": normals}, given, steps)
        assert end.links is not None and end.choices is not None and (end.links.lane[:, 0] == 0).all()
        return end.position[:, 1], end.choices.log_probability[:, 1]

    value = torch.tensor(1.5, dtype=DTYPE, requires_grad=True)
    far, log = drive(value, torch.tensor([-9.0, 9.0], dtype=DTYPE))  # to the left; there is no right, so he stays
    chance = log.exp()
    assert chance.sum().item() == pytest.approx(1.0) and 0.2 < chance[0] < 0.8 and far[0] > far[1] + 1.0
    (exact,) = torch.autograd.grad((far * chance).sum(), value)
    normal = torch.randn(draws, generator=torch.Generator().manual_seed(1), dtype=DTYPE)
    values = torch.full((draws, 1), 1.5, dtype=DTYPE, requires_grad=True)  # so that every draw has its own gradient
    far, log = drive(values, normal)
    (frozen,) = torch.autograd.grad(far.sum(), values, retain_graph=True)
    (scored,) = torch.autograd.grad(((far.detach() - far.detach().mean()) * log).sum(), values)
    each = frozen + scored
    error = float(each.std()) / draws**0.5
    assert abs(float(each.mean() - exact)) < 3.0 * error
    assert abs(float(frozen.mean() - exact)) > 10.0 * error


def test_drawn_choices_are_safe_and_repeat() -> None:
    """However hot: nobody overlaps; the same seed gives the same bits, another one other choices."""
    simulator, state, params = made("drop", "score", 5.0, n=30)
    ends = [simulator.rollout(state, {}, params, 100, seed=seed) for seed in (1, 1, 2)]
    assert torch.equal(ends[0][1].position, ends[1][1].position)
    assert not torch.equal(ends[0][0].links.lane, ends[2][0].links.lane)
    assert all((kept.gap > 0).all() for _, kept in ends)
    assert ends[0][0].links.changed.sum() > 100 and (ends[0][0].choices.log_probability < 0).all()


def test_chances_are_a_logit_of_what_is_safe() -> None:
    """Published form where all is safe; nothing for what is not; the hard choice in the limit."""
    u, v = torch.tensor(0.3, dtype=DTYPE), torch.tensor(-0.2, dtype=DTYPE)
    safe, unsafe, there = torch.tensor(3.0, dtype=DTYPE), torch.tensor(-0.1, dtype=DTYPE), torch.tensor(True)
    both = chances(Wish(u, v, safe, safe), there, there, 0.5)
    expected = torch.tensor([0.3, 0.0, -0.2], dtype=DTYPE).div(0.5).softmax(0)
    torch.testing.assert_close(both, expected)
    for wish, left in ((Wish(u, v, unsafe, safe), there), (Wish(u, v, safe, safe), ~there)):
        one = chances(wish, left, there, 0.5)
        assert one[0] == 0
        torch.testing.assert_close(one[1:], expected[1:] / expected[1:].sum())
    cold = chances(Wish(u, u + 1.0, safe, unsafe), there, there, 1e-4)
    torch.testing.assert_close(cold, torch.tensor([1.0, 0.0, 0.0], dtype=DTYPE))


@pytest.mark.parametrize("how", ["surrogate", "score", "soft"])
def test_vehicles_come_and_go_however_it_is_decided(how: str) -> None:
    """Everybody is accounted for, is on one lane when he enters, and has a gradient."""
    road = Lanes(2, length=160.0, ends=(lane_drop(1, at=110.0),))
    simulator = Simulator(road, (IDM(), *BOTH, Brakes()), decisions=how)  # type: ignore[arg-type]
    params = simulator.defaults(dtype=DTYPE)
    gap = torch.tensor(1.2, dtype=DTYPE, requires_grad=True)
    params["idm"]["time_gap"] = gap
    given = population.trips({0: 900.0, 1: 900.0}, 3600.0, slots=6, dtype=DTYPE)
    state = population.waiting(simulator, given, params)
    state, kept = simulator.rollout(state, {}, params, 180, seed=1)
    found = population.counts(simulator, state)
    assert found.due == found.inside + found.left + found.queued and found.left > 0
    assert state.choices is not None
    torch.testing.assert_close(state.choices.shares.sum(-1), torch.ones_like(state.speed))
    assert torch.autograd.grad(kept.speed.sum(), gap)[0].abs() > 0


def test_what_cannot_be_is_one_line() -> None:
    """A way or a temperature that there is not; choices without normals."""
    effects = (IDM(), Mobil(), Brakes())
    with pytest.raises(ValueError, match=r"decisions = 'sof' is unknown. Did you mean 'soft'\?"):
        Simulator(Lanes(2), effects, decisions="sof")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="temperature = 0 m/s² must be above 0"):
        Simulator(Lanes(2), effects, temperature=0.0)
    here = torch.zeros(1, dtype=DTYPE)
    score = Simulator(Lanes(2), effects, decisions="score")
    params = score.defaults(dtype=DTYPE)
    state = score.state(here, here, params, lane=0)
    with pytest.raises(ValueError, match="'decisions' takes normals, and none were given"):
        score.rollout(state, {}, params, 2)
    assert score.rollout(state, {}, params, 2, seed=1)[0].choices is not None
