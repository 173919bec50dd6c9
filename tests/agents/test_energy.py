"""Fuel behind measured leaders: what is driven is what was recorded, and what is told of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks import agents_energy, agents_energy_oracle
from idm_env import metrics
from idm_env.data import episodes, synthetic

IDM = {"max_accel": 1.1, "comfort_decel": 1.2, "time_gap": 1.4, "min_gap": 2.2, "desired_speed": 35.0}
PARAMS = {"idm": {name: torch.tensor(x, dtype=torch.float64) for name, x in IDM.items()}}


@pytest.fixture(scope="module")
def items():
    found = list(episodes(synthetic.generate(3, runs=1, followers=2, seconds=40.0)[0], max_gap=None, smooth=True))
    return [found[0], found[1].part(0, 250)]


def test_the_recorded_follower_drives_as_recorded_and_only_its_record_counts(items):
    run = agents_energy.driven(items, PARAMS, "recorded", None, (-3.0, 3.0))
    for i, episode in enumerate(items):
        n = len(episode) - 1
        assert run["valid"][:, i].sum() == n and run["speed"].shape[1:] == (2, agents_energy.BEHIND + 1)
        np.testing.assert_allclose(run["speed"][:n, i, 0], episode.speed_mps[1:], atol=1e-9)
        np.testing.assert_allclose(run["gap"][:n, i, 0], episode.gap_m[1:], atol=1e-6)
    r = agents_energy.judged(run)
    own = agents_energy.judged({k: x[:249, 1:] for k, x in run.items()})
    assert float(r["kamal"][1]) == pytest.approx(float(own["kamal"][0]))  # what comes after its record is not judged
    assert r["collisions"] == 0 and r["nearest"] <= min(e.gap_m[1:].min() for e in items) + 1e-6


def test_an_agent_commands_vehicle_1_within_its_limits(items):
    def brake(seen):
        assert seen.shape == (2, 3)
        return -torch.ones(2, 1, requires_grad=True)  # as a network's

    idm = agents_energy.driven(items, PARAMS, "idm", None, (-3.0, 3.0))
    run = agents_energy.driven(items, PARAMS, "agent", brake, (-2.0, 3.0))
    assert torch.allclose(run["accel"][0, :, 0], torch.full((2,), -2.0, dtype=torch.float64))
    assert torch.allclose(run["speed"][0, :, 1:], idm["speed"][0, :, 1:])  # those behind have not noticed yet
    assert float(run["speed"][200:, :, 0].abs().max()) < 1e-6
    assert agents_energy.judged(run)["farthest"] > agents_energy.judged(idm)["farthest"]


def test_only_vehicle_1_drifts_and_without_strength_it_is_idm(items):
    idm = agents_energy.driven(items, PARAMS, "idm", None, (-3.0, 3.0))

    def drifted(sigma, seed):
        wander = {"sigma": torch.tensor(sigma).double(), "memory_time": torch.tensor(10.0).double()}
        return agents_energy.Platoon(items, {**PARAMS, "wander": wander}, "drift").drifted(seed)

    torch.testing.assert_close(drifted(0.0, 0)["speed"], idm["speed"], atol=1e-9, rtol=0.0)
    strong = drifted(0.5, 1)
    off = (strong["speed"] - idm["speed"]).abs()
    assert float(off[0, :, 1:].max()) < 1e-9 < float(off[0, :, 0].min())  # those behind only follow it
    assert not torch.equal(strong["speed"], drifted(0.5, 2)["speed"])
    assert torch.equal(strong["speed"], drifted(0.5, 1)["speed"])


def test_fuel_of_steady_driving_is_that_of_the_models():
    speed = torch.full((50, 1, 11), 12.0, dtype=torch.float64)
    run = {"speed": speed, "accel": 0.0 * speed, "gap": speed, "valid": torch.ones(50, 1, dtype=torch.bool)}
    steady = agents_energy.judged(run)
    for model in metrics.FUELS:
        wanted = metrics.fuel_per_100_km(speed[:, 0, 0], 0.0 * speed[:, 0, 0], model)
        assert float(steady[model][0]) == pytest.approx(float(wanted))
    dearer = {**steady, "kamal": 2.0 * steady["kamal"], "speed": 0.9 * steady["speed"]}
    cells = agents_energy.told("x", steady, dearer)
    assert cells[1].endswith("; +50.0 %, 1 of 1") and cells[2].endswith("; +0.0 %, 0 of 1") and cells[3] == "+11.1 %"


def test_a_vehicle_that_knows_the_future_saves_within_what_is_admissible(items):
    with torch.no_grad():
        reference = agents_energy.Platoon(items, PARAMS, "idm").rolled()
    found = agents_energy_oracle.planned(items, PARAMS, "kamal", 60, reference)
    before, after = (agents_energy.judged(run) for run in (reference, found))
    assert bool((after["kamal"] < 0.98 * before["kamal"]).all())
    assert bool(((after["speed"] / before["speed"] - 1.0).abs() <= 0.02).all()) and after["collisions"] == 0
    own, gap, usual = found["speed"][..., 0], found["gap"][..., 0], reference["gap"][..., 0]
    least = torch.minimum((0.8 * own).clamp_min(2.0), usual)
    assert bool(((gap >= least - 1e-6) & (gap <= 120.0) | ~found["valid"]).all())
    # What is kept is a run of the simulator: those behind have answered to it.
    again = agents_energy.Platoon(items, PARAMS, "agent").rolled(found["accel"][..., 0])
    torch.testing.assert_close(again["speed"], found["speed"], atol=1e-6, rtol=0.0)


def test_where_no_plan_is_admissible_the_reference_stays(items, monkeypatch):
    monkeypatch.setattr(agents_energy_oracle, "FARTHEST", 0.0)
    with torch.no_grad():
        reference = agents_energy.Platoon(items, PARAMS, "idm").rolled()
    found = agents_energy_oracle.planned(items, PARAMS, "circles", 2, reference)
    assert all(torch.equal(found[name], reference[name]) for name in ("speed", "accel", "gap"))


def test_the_thriftiest_driver_on_the_grid_is_as_fast_and_saves(items, monkeypatch):
    usual = {name: IDM[name] for name in agents_energy_oracle.GRID}
    monkeypatch.setattr(agents_energy_oracle, "GRID", {"max_accel": (IDM["max_accel"], 0.5), "time_gap": (1.4, 30.0)})
    found = agents_energy_oracle.thriftiest(items, PARAMS)
    assert found == {"max_accel": 0.5, "time_gap": 1.4}  # a time gap of 30 s saves more, and falls back
    with torch.no_grad():
        same = agents_energy_oracle.driving(items, PARAMS, usual)
        soft = agents_energy_oracle.driving(items, PARAMS, found)
        reference = agents_energy.Platoon(items, PARAMS, "idm").rolled()
    torch.testing.assert_close(same["speed"], reference["speed"])
    assert float(agents_energy.judged(soft)["kamal"].mean()) < float(agents_energy.judged(same)["kamal"].mean())
