"""Parameters that every episode draws anew from ranges, for all its drivers alike: domain randomisation."""

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401 (registers the environments)
from idm_env.effects import IDM, Brakes
from idm_env.model_file import Model, save_model
from idm_env.tasks import Draw, make_task

RANGES = {"idm": {"time_gap": [0.8, 1.2]}, "idm.max_accel": [0.7, 1.4]}


@pytest.mark.parametrize("name", ["ring", "follow", "platoon", "highway", "merge"])
def test_all_drivers_of_an_episode_have_what_it_has_drawn(name: str) -> None:
    task = make_task(name, randomise=RANGES)
    params, seeds = task.params(torch.float64, "cpu"), torch.arange(400)
    world = task.reset(Draw.of(seeds, torch.zeros_like(seeds)), params)
    made = task.episode_params(world.episode, params)["idm"]
    for parameter, (low, high) in (("time_gap", (0.8, 1.2)), ("max_accel", (0.7, 1.4))):
        drawn = made[parameter]
        assert drawn.shape == (400, task.vehicles) and bool((drawn == drawn[:, :1]).all())
        # Evenly: mean and deviation of 400 draws, within four standard errors.
        assert abs(float(drawn[:, 0].mean()) - (low + high) / 2) < 4 * (high - low) / 12**0.5 / 20
        assert abs(float(drawn[:, 0].std()) - (high - low) / 12**0.5) < 0.1 * (high - low)
        assert low <= float(drawn.min()) and float(drawn.max()) <= high
    pair = torch.stack([made["time_gap"][:, 0], made["max_accel"][:, 0]])
    assert abs(float(torch.corrcoef(pair)[0, 1])) < 0.2  # one does not tell the other
    assert torch.equal(made["min_gap"], params["idm"]["min_gap"])
    inputs = task.inputs(world, None, {n: x[0] for n, x in task.normals(
        Draw.of(seeds, torch.zeros_like(seeds)), world.state.step, 1, torch.float64).items()})  # fmt: skip
    full = {**params, "idm": {**params["idm"], **{n: made[n] for n in ("time_gap", "max_accel")}}}
    after, usual = (task.simulator.step(world.state, inputs, p).speed for p in (full, params))
    normals = {k: v for k, v in inputs.items() if k in task.simulator.draws}
    assert torch.equal(task.step(world, None, normals, params).state.speed, after) and not torch.equal(after, usual)


def test_episodes_draw_anew_as_single_environments_do_and_compiled_loops_as_torch() -> None:
    keywords = {
        "task": "ring", "randomise": RANGES, "vehicles": 8, "length": 170.0, "max_episode_steps": 5, "warmup": 10,
        "warmup_pool": 4,
    }  # fmt: skip
    both = [gymnasium.make_vec("DiffIDM-v0", num_envs=3, output=o, **keywords) for o in ("numpy", "torch")]
    alone = gymnasium.make("DiffIDM-v0", **keywords)
    seen = [np.asarray(env.reset(seed=[4, 5, 6])[0]) for env in both]
    np.testing.assert_array_equal(alone.reset(seed=5)[0], seen[0][1])
    drawn = []
    for _ in range(12):
        rows = [env.step(u(torch.zeros(3, 1))) for env, u in zip(both, (torch.Tensor.numpy, torch.clone), strict=True)]
        np.testing.assert_allclose(np.asarray(rows[0][0]), np.asarray(rows[1][0].detach()), atol=2e-6)
        told = alone.step(np.zeros(1, np.float32))
        np.testing.assert_array_equal(alone.reset()[0] if told[3] else told[0], rows[0][0][1])
        drawn.append(both[0].unwrapped.batch.world.episode["randomised"].clone())
    assert len({x.numpy().tobytes() for x in drawn}) > 1  # episodes of one pool differ


def test_ranges_stand_over_parameters_and_single_drivers(tmp_path: Path) -> None:
    file = tmp_path / "model.yaml"
    single = {str(t): {"idm": {"time_gap": t, "min_gap": 2.0 + t}} for t in (1.3, 1.7)}
    save_model(file, Model((IDM(), Brakes()), {}, drivers=single))
    task = make_task("ring", drivers=str(file), parameters={"idm.max_accel": 1.1}, randomise={"idm.time_gap": [0.9, 1]})
    params, seeds = task.params(torch.float64, "cpu"), torch.arange(9)
    made = task.episode_params(task.reset(Draw.of(seeds, seeds), params).episode, params)["idm"]
    assert bool((made["time_gap"] <= 1.0).all()) and set(made["min_gap"].flatten().tolist()) == {3.3, 3.7}
    assert float(made["max_accel"]) == 1.1


@pytest.mark.parametrize(
    ("randomise", "message"),
    [
        ({"idm": {"time_gap": 1.0}}, r"randomise\.idm\.time_gap = 1\.0 must be \[lowest, highest\]"),
        ({"idm": {"time_gap": [1.0]}}, r"must be one number or \[lowest, highest\]\."),
        ({"idm": {"time_gap": [2.0, 1.0]}}, r"= \[2\.0, 1\.0\] must rise: write \[1, 2\]\."),
        ({"idm": {"time_gap": [1.0, float("inf")]}}, r"must be a finite number"),
        ({"idm.max_accel": [-1.0, 1.0]}, r"max_accel = -1 m/s² is outside \[0\.1, 10\] m/s²"),
        ({"idm.max_accel": [1.0, 11.0]}, r"max_accel = 11 m/s² is outside \[0\.1, 10\] m/s²"),
        ({"idm": {"time_gab": [1.0, 2.0]}}, r"Did you mean 'idm\.time_gap'"),
        ({"nobody": {"time_gap": [1.0, 2.0]}}, r"unknown effect 'nobody'"),
        ({"time_gap": [1.0, 2.0]}, r"randomise\.time_gap cannot be drawn .* Did you mean 'idm\.time_gap'"),
        ([1.0, 2.0], r"randomise = \[1\.0, 2\.0\] must be a mapping"),
    ],
)
def test_what_cannot_be_drawn_is_said_in_one_line(randomise: object, message: str) -> None:
    with pytest.raises(ValueError, match=message) as told:
        make_task("ring", randomise=randomise)
    assert "\n" not in str(told.value)


def test_a_signal_plan_is_drawn_for_every_episode() -> None:
    """Agents are shown the plan that drivers meet; a red longer than a cycle is no plan."""
    plan = {"signal.cycle": [40, 80], "signal.red": [10, 40]}
    task, seeds = make_task("approach", randomise=plan), torch.arange(50)
    params = task.params(torch.float64, "cpu")
    world = task.reset(Draw.of(seeds, seeds), params)
    met = task.episode_params(world.episode, params)["signal"]
    for name, (low, high) in (("cycle", plan["signal.cycle"]), ("red", plan["signal.red"])):
        shown = world.episode[f"signal_{name}"]
        assert torch.equal(shown, met[name].expand_as(shown)) and len(shown[:, 0].unique()) == 50
        assert low <= float(shown.min()) and float(shown.max()) <= high
    with pytest.raises(ValueError, match=r"signal\.red = 70 s must not exceed signal\.cycle = 40 s"):
        make_task("approach", randomise=plan | {"signal.red": [10, 70]}).params(torch.float64, "cpu")


def test_demand_is_drawn_for_every_episode_and_given_at_a_reset() -> None:
    """Within its range, each lane its own; ``reset(options=…)`` holds from then on."""
    task = make_task("merge", controlled=0.1, randomise={"inflow": [1500, 3000], "ramp_inflow": [400, 800]})
    draw = Draw.of(torch.arange(200), torch.zeros(200, dtype=torch.int64))
    trips = task.begin(draw, task.params(torch.float64, "cpu")).state.lanes.trips
    slots = [(trips.lane == k) & trips.again.isfinite() for k in range(3)]
    hourly = [3600.0 * mine.sum(-1) / trips.again.masked_fill(~mine, 0.0).amax(-1) for mine in slots]
    assert 395 < float(hourly[0].min()) < 420 and 780 < float(hourly[0].max()) < 815
    assert 745 < float(hourly[1].min()) < 780 and 1450 < float(hourly[1].max()) < 1505
    env = gymnasium.make("DiffIDM-v0", task="merge", randomise={"inflow": [2900, 3000]})
    inside = []
    for options in ({"inflow": 800}, None, {"inflow": 3500}):
        env.reset(seed=0 if not inside else None, options=options)
        inside.append(float(env.unwrapped.state.present.sum()))
    assert max(inside[:2]) < 10.0 < inside[2]


def test_an_agent_is_in_every_episode_whose_vehicles_are_drawn() -> None:
    said = r"= \[18, 26\] leaves vehicle 20 out, which is an agent\. Control vehicles below 18, or draw more\."
    with pytest.raises(ValueError, match=said):
        make_task("highway", controlled=[3, 20], randomise={"vehicles": [18, 26]})


@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_a_world_of_fewer_vehicles_is_the_world_of_that_number(output: str) -> None:
    """Bit for bit, on every face; all numbers of the range are drawn, and a window is a loop of steps."""
    keywords = {"task": "highway", "length": 250.0, "hold": 1.0, "warmup": 20, "output": output}
    drawn = {**keywords, "randomise": {"vehicles": [4, 5]}}
    env, alone = gymnasium.make_vec("DiffIDM-v0", num_envs=4, **drawn), gymnasium.make("DiffIDM-v0", **drawn)
    given, _ = env.reset(seed=3)
    first, counts = np.array(torch.as_tensor(given)), env.unwrapped.batch.world.state.present.sum(-1).long().tolist()
    assert set(counts) == {4, 5}
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (15, 4, 1)).astype(np.float32)
    given_as = torch.tensor if output == "torch" else np.array
    steps = [env.step(given_as(action)) for action in actions]
    fixed = {n: gymnasium.make("DiffIDM-v0", vehicles=n, **keywords) for n in (4, 5)}
    for i, count in enumerate(counts):
        for face in (fixed[count], alone):
            seen, _ = face.reset(seed=3 + i)
            np.testing.assert_array_equal(seen, first[i])
            for action, step in zip(actions, steps, strict=True):
                for own, every in zip(face.step(given_as(action[i]))[:4], step[:4], strict=True):
                    np.testing.assert_array_equal(own, every[i])
    if output == "torch":
        env.reset(seed=3)
        moves = iter(torch.tensor(actions))
        window = env.unwrapped.unroll(lambda seen: next(moves), steps=15)
        torch.testing.assert_close(window.reward, torch.stack([step[1] for step in steps]), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize(
    ("task", "randomise", "said"),
    [
        ("merge", {"inflow": [3000, 1500]}, "randomise.inflow = [3000, 1500] must rise"),
        ("merge", {"inflow": 2000}, "randomise.inflow = 2000 must be [lowest, highest]"),
        ("merge", {"inflow": [1000, 20000]}, "makes a demand of 25333.3 vehicles an hour impossible"),
        (
            "merge",
            {"vehicles": [18, 26]},
            "randomise.vehicles cannot be drawn in task 'merge', where inflow, ramp_inflow",
        ),
        (
            "ring",
            {"vehicles": [18, 26]},
            "can. Task 'highway' draws vehicles; elsewhere draw inflow, or give a ring length=[186, 268]",
        ),
        ("highway", {"vehicles": [26, 18]}, "randomise.vehicles = [26, 18] must rise: write [18, 26]."),
        ("highway", {"vehicles": [18.5, 26]}, "randomise.vehicles = 18.5 must be a whole number."),
        ("highway", {"vehicles": [0, 26]}, "randomise.vehicles = 0 must be at least 1."),
        ("highway", {"vehicles": 20}, "randomise.vehicles = 20 must be [lowest, highest]."),
        ("highway", {"vehicles": [18, 900]}, "900 vehicles of 5 m and a metre each do not fit 2 lanes of 1000 m."),
    ],
)
def test_what_cannot_be_drawn_is_told_with_what_can(task: str, randomise: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)) as told:
        make_task(task, randomise=randomise)
    assert "\n" not in str(told.value)
