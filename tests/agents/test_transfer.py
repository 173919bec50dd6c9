"""Transfer: hidden effects that the truth has too, drift beside what was found, rows that are done once."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from agents import apg
from benchmarks import agents_transfer as transfer
from idm_env.config import Model, load_model, save_model
from idm_env.data import synthetic
from idm_env.effects import IDM, Asymmetry, Brakes
from idm_env.tasks import make_task


@pytest.mark.parametrize("case", ["delay", "two"])
def test_the_truth_has_the_effects_that_were_hidden_in_the_data(case, tmp_path, monkeypatch):
    given, real = [], synthetic.generate

    def generate(seed, *, effect):
        given.append(effect)
        return real(seed, effect=effect, runs=8, followers=3, seconds=5.0)

    monkeypatch.setattr(synthetic, "generate", generate)
    monkeypatch.setattr(transfer, "learnt", lambda trajectories, out: (out / "plain.yaml", out / "model.yaml"))
    environments = transfer.generated(case, tmp_path)
    assert list(environments)[-1] == transfer.TRUTH
    params = make_task(**{**environments[transfer.TRUTH], "warmup": 0, "warmup_pool": 0}).params(torch.float64, "cpu")
    for name, strength in given[0].items():
        assert [float(x) for x in params[name].values() if x.dim() == 0 and float(x) == strength]
    assert len(given[0]) == (2 if case == "two" else 1) and params["idm"]["time_gap"].shape == (22,)


def test_drift_comes_beside_what_was_found(tmp_path, monkeypatch):
    found = SimpleNamespace(settings=SimpleNamespace(sigma=np.array([0.6]), memory_time=np.array([12.0])))
    monkeypatch.setattr(transfer, "tell", lambda *given, **options: SimpleNamespace(found={"wander": found}))
    corrected = tmp_path / "model.yaml"
    drivers = {"1/2": {"idm": {"time_gap": 1.2}}, "1/3": {"idm": {"time_gap": 1.7}}}
    save_model(
        corrected,
        Model(
            (IDM(), Asymmetry(), Brakes()), {"idm": {"time_gap": 1.4}, "asymmetry": {"strength": -0.3}}, drivers=drivers
        ),
    )
    trajectories = synthetic.generate(1, runs=1, followers=2, seconds=30.0)[0]
    model = load_model(transfer.unsteady(trajectories, corrected, tmp_path / "drifting.yaml"))
    assert [e.name for e in model.effects] == ["idm", "asymmetry", "brakes", "wander"] and model.drivers == drivers
    assert model.parameters["wander"] == {"sigma": 0.6, "memory_time": 12.0}
    assert model.parameters["asymmetry"] == {"strength": -0.3}


def test_rows_are_done_once_and_an_interrupted_training_goes_on(quick, ring, tmp_path, monkeypatch):
    monkeypatch.setattr(transfer, "UPDATES", 2)
    judged = []

    def evaluate(act, environment, lengths, warmup, draws):
        judged.append(environment)
        return {"speed_ratio": 0.9, "speed_std": 0.1, "time_gap": 1.0, "collisions": len(judged)}

    monkeypatch.setattr(transfer, "evaluate_ring", evaluate)
    small = {"updates": 1, "hidden": (4, 4), "count": 2, "window": 10, "evaluate_every": 1e9, "explore": 0.0}
    arguments = apg.Arguments
    monkeypatch.setattr(transfer.apg, "Arguments", lambda **given: arguments(**{**given, **small, "updates": 2}))
    *untrained, part, _ = transfer.parts_of("two", {"plain IDM": ring, transfer.TRUTH: ring}, tmp_path, 1)
    assert [other.name for other in untrained] == [*transfer.UNTRAINED, "human drivers: plain IDM"]
    assert part.name == "plain IDM" and part.trained_in == ring
    apg.train(arguments(environment=ring, out=part.out, **small))  # interrupted after the first of two updates
    found = transfer.row(part)
    assert [r["collisions"] for r in found.values()] == [1, 2, 3] and judged[1]["failsafe"] == transfer.FAILSAFE
    _, content = transfer.common.load(part.out / "last.pt")
    assert content["training"]["update"] == 1
    assert transfer.row(part) == found and len(judged) == 3
    alone = transfer.row(untrained[-1])
    assert judged[3] == ring and transfer.cells(untrained[-1], alone)[1:] == ["", *"––––", "–", "0.900, 0.10, 4"]
    assert transfer.cells(part, found)[:2] == ["plain IDM", "0"] and transfer.cells(part, found)[5] == "1"


def test_behind_a_failsafe_policies_remember_and_are_judged_with_it_only(ring, tmp_path, monkeypatch):
    small = {"updates": 1, "hidden": (4, 4), "count": 2, "window": 10}
    arguments, figures = apg.Arguments, {"speed_ratio": 0.9, "speed_std": 0.1, "time_gap": 1.0, "collisions": 0}
    monkeypatch.setattr(transfer, "evaluate_ring", lambda act, *rest: {**figures, "collisions": int(act.remembers)})
    monkeypatch.setattr(transfer.apg, "Arguments", lambda **given: arguments(**{**given, **small}))
    environments = {name: {**ring, **transfer.GUARDED} for name in ("plain IDM", transfer.TRUTH)}
    *_, part, last = transfer.parts_of("i80", environments, tmp_path, 1, transfer.REMEMBERING)
    assert set(part.judged_in) == {"truth", "own"} and last.name == transfer.TRUTH
    found = transfer.row(part)
    assert found["truth"]["collisions"] == 1 and transfer.cells(part, found)[6] == "–"
    content = transfer.common.load(part.out / "last.pt")[1]
    assert content["environment"]["failsafe"] == 3.0 and content["policy"]["made"]["history"] == [50.0, 300.0]


def test_what_seeds_say_together():
    def rows(*collisions):
        return [{"collisions": n, "speed_ratio": 0.9, "speed_std": 0.1} for n in collisions]

    told = transfer.told("corrected model", rows(3, 3, 6), rows(9, 12, 15), 30)
    assert told.startswith(
        "corrected model: 12 of 90 rings with a collision, 13 % (10 to 20), 3 seeds; median ratio 0.900"
    )
    assert "collisions 0.07" in told and "speed_std 1.0" in told
