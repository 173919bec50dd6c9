"""Environments as fitting problems: hidden parameters come back by gradients, by the fit, and by guesses."""

import gymnasium as gym
import polars as pl
import pytest
import torch

import idm_env  # noqa: F401
from idm_env.data import Trajectories
from idm_env.effects import IDM, Brakes, Replay
from idm_env.model_file import load_model, save_model
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.tasks.recorded import head, made_up_leader
from idm_env.wrappers import ParameterFitting

HIDDEN = {"time_gap": 1.4, "max_accel": 1.1, "min_gap": 2.6}
FREE = tuple(f"idm.{name}" for name in HIDDEN)


@pytest.fixture(scope="module")
def recording():
    """A driver with hidden parameters, simulated exactly, behind the made-up leader."""
    simulator = Simulator(Lane(), (IDM(), Brakes(), Replay()))
    params = simulator.defaults(dtype=torch.float64)
    for name, value in {**HIDDEN, "comfort_decel": 1.5, "desired_speed": 30.0}.items():
        params["idm"][name] = torch.tensor(value, dtype=torch.float64)
    leader = torch.as_tensor(made_up_leader(0.1).motion[0, :900])
    state = simulator.state(leader[:1, 0] - torch.tensor([0.0, 35.0]), leader[:1, 1].expand(2).clone(), params)
    rows = []
    for t in range(900):
        for i in range(2):
            rows.append(
                {
                    "vehicle_id": "ab"[i],
                    "time_s": 0.1 * t,
                    "position_m": float(state.position[i]),
                    "speed_mps": float(state.speed[i]),
                    "length_m": 5.0,
                    "leader_id": None if i == 0 else "a",
                }
            )
        if t + 1 < 900:
            record = head(leader[t + 1 : t + 2], torch.tensor([True, False]))
            record = record._replace(**{k: getattr(record, k).squeeze(0) for k in ("position", "speed", "accel")})
            state = simulator.step(state, {"replay": record}, params)
    return Trajectories.from_frame(pl.DataFrame(rows, infer_schema_length=None))


def problem(recording, **keywords):
    env = gym.make("DiffIDM-v0", warmup=1, **keywords)
    return env, ParameterFitting(env, recording, free=FREE)


def test_the_loss_is_differentiable_and_falls_under_adam(recording):
    _, fitting = problem(recording)
    assert all(leaf.is_leaf and leaf.requires_grad for leaf in fitting.parameters())
    optimiser = torch.optim.Adam(fitting.parameters(), lr=0.1)
    first = float(fitting.mean_squared_error().detach())
    for _ in range(60):
        optimiser.zero_grad()
        loss = fitting.mean_squared_error()
        loss.backward()
        optimiser.step()
    assert float(loss.detach()) < 0.05 * first


def test_gradcheck_of_the_loss(recording):
    _, fitting = problem(recording)
    values = torch.tensor([1.2, 0.9, 2.2], dtype=torch.float64, requires_grad=True)
    for error in (fitting.root_mean_squared_error, fitting.mean_squared_error):
        assert torch.autograd.gradcheck(error, (values,), rtol=1e-2, atol=1e-5)


def test_errors_are_what_their_names_say(recording):
    _, fitting = problem(recording)
    plain = fitting.problem
    own = torch.stack(list(fitting.values().values()), dim=-1).detach().expand(len(plain.groups), -1)
    residual = plain.residual(plain.simulate(plain.rows(own, own.new_zeros(0))))
    expected = float(residual.square().sum() / plain.samples.sum())
    assert float(fitting.mean_squared_error().detach()) == pytest.approx(expected)
    assert float(fitting.root_mean_squared_error().detach()) == pytest.approx(expected**0.5)
    assert float(fitting.root_mean_squared_error(own[0])) == pytest.approx(expected**0.5)


@pytest.mark.parametrize("change", [lambda p: p.set_values({"idm.time_gap": 2.0}), lambda p: p.fit(iterations=2)])
def test_an_optimiser_made_before_stays_connected(recording, change):
    _, fitting = problem(recording)
    optimiser = torch.optim.Adam(fitting.parameters(), lr=0.1)
    fitting.mean_squared_error().backward()
    change(fitting)
    assert all(leaf.grad is None for leaf in fitting.parameters())
    before = {name: float(value.detach()) for name, value in fitting.values().items()}
    fitting.mean_squared_error().backward()
    optimiser.step()
    after = {name: float(value.detach()) for name, value in fitting.values().items()}
    assert all(after[name] != before[name] for name in FREE)


def test_values_that_cannot_be_set_change_nothing(recording):
    _, fitting = problem(recording)
    before = [leaf.detach().clone() for leaf in fitting.parameters()]
    with pytest.raises(ValueError, match="not free here"):
        fitting.set_values({"idm.time_gap": 2.0, "idm.exponent": 4.0})
    assert all(torch.equal(a, b) for a, b in zip(before, fitting.parameters(), strict=True))


def test_fit_finds_what_was_hidden_and_the_environment_takes_it(recording, tmp_path):
    env, fitting = problem(recording)
    fitting.fit()
    found = {name: float(value.detach()) for name, value in fitting.values().items()}
    for name, value in HIDDEN.items():
        assert found[f"idm.{name}"] == pytest.approx(value, rel=0.02)
    fitting.apply()
    assert float(env.unwrapped.params["idm"]["time_gap"]) == pytest.approx(found["idm.time_gap"], rel=1e-5)
    env.reset(seed=0)
    env.step(None)
    # What was not free is the environment's, and a saved model makes the same drivers.
    assert fitting.fixed["idm.desired_speed"] == 30.0
    save_model(tmp_path / "model.yaml", fitting.model())
    model = load_model(tmp_path / "model.yaml")
    assert model.parameters["idm"]["min_gap"] == pytest.approx(found["idm.min_gap"])
    assert float(gym.make("DiffIDM-v0", effects=str(tmp_path / "model.yaml")).unwrapped.params["idm"]["min_gap"]) > 2.4


def test_effects_of_the_environment_are_part_of_the_problem(recording):
    env = gym.make("DiffIDM-v0", warmup=1, effects=["delay"], parameters={"delay.delay": 0.3})
    fitting = ParameterFitting(env, recording, free=("idm.time_gap", "delay.delay"))
    assert float(fitting.values()["delay.delay"].detach()) == pytest.approx(0.3, abs=1e-3)
    fitting.mean_squared_error().backward()
    assert all(float(leaf.grad.abs()) > 0 for leaf in fitting.parameters())


def test_a_parameter_that_there_is_not_is_an_error(recording):
    with pytest.raises(ValueError, match=r"Did you mean 'idm.time_gap'"):
        ParameterFitting(gym.make("DiffIDM-v0", warmup=1), recording, free=["idm.time_gab"])


def test_what_is_no_environment_of_ours_is_an_error(recording):
    with pytest.raises(ValueError, match="no environment of this package"):
        ParameterFitting(gym.make("CartPole-v1"), recording)
