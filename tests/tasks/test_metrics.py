"""Traffic figures against values known by hand."""

import pytest
import torch

from idm_env import metrics
from tests.equilibrium import equilibrium_speed


def test_fuel_is_the_published_polynomial():
    speed, accel = torch.tensor([0.0, 20.0, 20.0]), torch.tensor([0.0, 0.0, 1.0])
    rate = metrics.fuel(speed, accel)
    assert float(rate[0]) == pytest.approx(0.1569)
    assert float(rate[1]) == pytest.approx(0.1569 + 0.49 - 0.2966 + 0.478, abs=1e-4)
    assert float(rate[2] - rate[1]) == pytest.approx(0.07224 + 1.9362 + 0.43, abs=1e-4)


@pytest.mark.parametrize(
    ("speed", "accel", "grams"),
    [
        (0.0, 0.0, 0.1271),  # idling
        (20.0, 0.0, 0.19829 + 0.42244 + 0.222408),
        (20.0, 1.0, 0.843138 + 0.23956 + 0.161184 + 1.10948 + 1.01112),
        (20.0, 9.0, 0.843138 + 1.510224 * 2.393599 + 1.01112 * 2.393599**2),  # the engine gives 48.9891/v − 0.056
        (20.0, -0.2, 0.843138 - 0.2 * 1.510224 + 0.04 * 1.01112),
        (20.0, -0.26, 0.0),  # beyond a0 + a1 v + a3 v² = −0.25682 the fuel is cut off
        (3.0, -2.0, 0.1271),  # not below idling up to 5.07 m/s
        (5.0, 3.0, 0.19829 + 0.10561 + 0.003475 + 3.0 * (0.23956 + 0.040296 + 0.0693425) + 9.0 * 0.25278),
    ],
)
def test_the_fuel_of_circles_is_the_published_polynomial(speed, accel, grams):
    x = torch.tensor([speed, accel], dtype=torch.float64, requires_grad=True)
    rate = metrics.fuel(x[0], x[1], "circles")
    assert float(rate.detach()) * 0.745 == pytest.approx(grams, rel=1e-5)
    if rate.requires_grad:
        assert bool(torch.isfinite(torch.autograd.grad(rate, x)[0]).all())


def test_braking_never_costs_more_and_an_unknown_fuel_is_told():
    speed, accel = torch.meshgrid(torch.linspace(0.2, 35.0, 60), torch.linspace(-5.0, 5.0, 101), indexing="ij")
    for model in metrics.FUELS:
        rate = metrics.fuel(speed, accel, model)
        assert bool((rate.diff(dim=-1) >= -1e-6).all()) and float(rate.min()) >= 0.0
    with pytest.raises(ValueError, match=r"fuel_model = 'circle' is unknown\. Did you mean 'circles'"):
        metrics.fuel(speed, accel, "circle")


def test_energy_of_a_steady_drive_is_force_times_way():
    speed = torch.full((100,), 20.0, dtype=torch.float64)
    energy = metrics.traction_energy(speed, torch.zeros_like(speed), 0.1)
    assert float(energy) == pytest.approx((9.81 * 0.015 + 4e-4 * 400.0) * 200.0)
    assert float(metrics.traction_energy(speed, torch.full_like(speed, -5.0), 0.1)) == 0.0


def test_amplification_of_sines():
    t = torch.linspace(0.0, 62.8, 629, dtype=torch.float64)
    speed = 10.0 + torch.stack((torch.sin(t), 1.5 * torch.sin(t - 1.0), 0.5 * torch.sin(t - 2.0)), -1)
    gain = metrics.amplification(speed)
    torch.testing.assert_close(gain, torch.tensor([1.0, 1.5, 0.5], dtype=torch.float64), rtol=1e-2, atol=0)


def test_equilibrium_speed_does_not_accelerate():
    from idm_env.effects import IDM
    from idm_env.roads import Ring
    from idm_env.simulator import Simulator

    simulator = Simulator(Ring(200.0), (IDM(),))
    params = simulator.defaults(dtype=torch.float64)
    speed = equilibrium_speed(torch.tensor(15.0, dtype=torch.float64), params["idm"]).expand(10)
    position = -20.0 * torch.arange(10, dtype=torch.float64)
    accel = simulator.acceleration(simulator.state(position, speed, params), {}, params)
    torch.testing.assert_close(accel, torch.zeros(10, dtype=torch.float64), rtol=0, atol=1e-10)


def test_time_gaps_are_finite_at_standstill():
    assert float(metrics.time_gap(torch.tensor(3.0), torch.tensor(0.0))) == 3.0


def test_conflicts_are_those_known_by_hand():
    gap, closing = torch.tensor([20.0, 20.0, 0.5, -1.0]), torch.tensor([5.0, -5.0, 0.0, 2.0], requires_grad=True)
    time, decel = metrics.time_to_collision(gap, closing), metrics.drac(gap, closing)
    assert time.tolist() == [4.0, torch.inf, torch.inf, 0.0]
    assert decel.tolist() == [0.625, 0.0, 0.0, pytest.approx(200.0)]
    (slope,) = torch.autograd.grad(decel.sum() + time[0], closing)
    assert slope.tolist() == pytest.approx([0.25 - 0.8, 0.0, 0.0, 200.0])


def test_post_encroachment_is_from_the_rear_of_the_first_to_the_front_of_the_second():
    """At 10 and 20 m/s through 100 … 110 m: the first, 5 m long, is out after 11.5 s, the second 13 s after in."""
    t, area = 0.4 * torch.arange(80, dtype=torch.float64), (100.0, 110.0)
    first, second, never = 10.0 * t, 20.0 * t - 160.0, 3.0 * t - 50.0
    pairs = torch.stack([torch.stack(x, -1) for x in ((first, second), (second, first), (first, never))], 1)
    length = torch.tensor([5.0, 5.0], dtype=torch.float64)
    times = metrics.post_encroachment_time(pairs, length, area, 0.4)
    assert times[:2].tolist() == pytest.approx([13.0 - 11.5] * 2) and bool(times[2].isnan())
    together = torch.stack((first, first - 4.0), -1)
    assert float(metrics.post_encroachment_time(together, length, area, 0.4)) == pytest.approx(10.4 - 11.5)
