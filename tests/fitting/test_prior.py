"""Log-normal priors: without data the fit is the prior, with many it is the data, and in between it is the mode."""

from __future__ import annotations

import pytest
import torch

from idm_env.data import Episodes
from idm_env.data.synthetic import Truth
from idm_env.fitting.fit import fit
from idm_env.fitting.prior import Prior
from idm_env.fitting.solver import normal

CENTRE = (1.6, 2.0, 1.3, 2.0, 30.0)


def prior_of(groups: int, noise: float, deviation: float = 0.3) -> Prior:
    centre = torch.tensor(CENTRE, dtype=torch.float64).expand(groups, -1).clone()
    return Prior(centre, torch.full_like(centre, deviation), noise)


def test_little_data_leave_the_prior_and_many_overrule_it(platoon: tuple[Episodes, Truth]) -> None:
    short, long = [platoon[0][0].part(0, 11)], [platoon[0][0]]
    given = prior_of(1, 1.0)
    second = fit(short, loss="mse", prior=given)
    assert torch.allclose(second.own, given.centre, rtol=0.05)
    spread = second.uncertainty.standard_error / second.own
    assert ((spread > 0.2) & (spread <= 0.3001)).all()  # of a deviation of 0.3, one second takes little
    free = fit(long, loss="mse", starts=1)
    held = fit(long, loss="mse", prior=prior_of(1, 1e-3))
    assert torch.allclose(held.own, free.own, rtol=2e-3)


def test_the_mode_is_stationary_and_no_other_point_near_it_costs_less(platoon: tuple[Episodes, Truth]) -> None:
    found = fit([platoon[0][1].part(0, 300)], loss="mse", prior=prior_of(1, 0.5))
    now = normal(found.problem, found.own[None], found.shared[None])
    scale = now.hessian[0].diagonal(dim1=-2, dim2=-1) * found.own
    assert (now.gradient[0].abs() < 1e-2 * scale).all()
    for i in range(5):
        for factor in (0.97, 1.03):
            other = found.own.clone()
            other[:, i] *= factor
            assert normal(found.problem, other[None], found.shared[None]).cost > now.cost


def test_groups_have_priors_of_their_own(platoon: tuple[Episodes, Truth]) -> None:
    given = prior_of(2, 1.0)
    given.centre[1, 4] = 20.0
    found = fit([e.part(0, 5) for e in platoon[0][:2]], loss="mse", prior=given)
    assert found.own[0, 4] > 25.0 > 21.0 > found.own[1, 4]


def test_what_a_prior_cannot_be_is_named(platoon: tuple[Episodes, Truth]) -> None:
    items = [platoon[0][0].part(0, 20)]
    with pytest.raises(ValueError, match="loss = 'rmse' has none"):
        fit(items, loss="rmse", prior=prior_of(1, 1.0))
    with pytest.raises(ValueError, match="knows no prior"):
        fit(items, loss="mse", method="adam", prior=prior_of(1, 1.0))
    with pytest.raises(ValueError, match=r"noise = 0 must be positive"):
        prior_of(1, 0.0)
    with pytest.raises(ValueError, match=r"deviation = -1 must be positive"):
        prior_of(1, 1.0, deviation=-1.0)
