"""The ring: Flow's definition by hand, and the physics that the task is about."""

import pytest
import torch

from idm_env.tasks import Draw, make_task
from tests.equilibrium import equilibrium_speed


def start(task, count=1, seed=0, dtype=torch.float64):
    params = task.params(dtype, "cpu")
    return task.reset(Draw.of(torch.arange(count) + seed, torch.zeros(count, dtype=torch.int64)), params), params


def test_the_observation_is_what_is_written_and_the_reward_flows():
    task = make_task("ring", warmup=50, reward="flow")
    before, params = start(task)
    command = torch.tensor([[0.5]], dtype=torch.float64)
    after = task.step(before, command, {"noise": torch.zeros(1, 22, dtype=torch.float64)}, params)
    v, position, ring = after.state.speed[0], after.state.position[0], float((after.state.gap + 5.0).sum())
    seen = task.observe(after)[0, 0]
    agent, leader = task.agents[0], (task.agents[0] - 1) % 22
    headway = float((position[leader] - position[agent]) % ring)
    expected = [float(v[agent]) / 5, float(v[leader] - v[agent]), headway / 10]
    torch.testing.assert_close(seen, torch.tensor(expected, dtype=torch.float64))
    reward = task.rewards(before, command, after)
    assert float(reward) == pytest.approx(4.0 * float(v.mean()) / 20.0 - 4.0 * 0.5)


def test_noise_is_flows():
    task = make_task("ring", effects=["noise"], warmup=0)
    assert float(task.params(torch.float64, "cpu")["noise"]["sigma"]) == pytest.approx(0.2 * 0.1**0.5)


def test_the_command_moves_only_the_controlled_vehicle():
    task = make_task("ring", warmup=20, noise=0.0, controlled=[3])
    before, params = start(task)
    speeds = [
        task.step(before, torch.tensor([[u]], dtype=torch.float64), None, params).state.speed for u in (-0.1, 0.5)
    ]
    changed = (speeds[0] - speeds[1]).abs()[0]
    assert float(changed[3]) == pytest.approx(0.06)
    changed[3] = 0.0
    assert float(changed.max()) == 0.0


def test_lengths_are_drawn_from_the_range():
    task = make_task("ring", warmup=0, noise=0.0)
    world, _ = start(task, count=500)
    length = (world.state.gap + world.state.length).sum(-1)
    assert 220.0 <= float(length.min()) < 222.0
    assert 268.0 < float(length.max()) <= 270.0


def test_a_wave_start_fits_the_ring():
    task = make_task("ring", warmup=0, start="wave", length=250.0)
    world, _ = start(task)
    torch.testing.assert_close((world.state.gap + 5.0).sum(), torch.tensor(250.0, dtype=torch.float64))
    assert float(world.state.gap.min()) > 0.5
    gaps = task.road.gaps(world.state.position, world.state.length, torch.tensor([250.0]))
    torch.testing.assert_close(gaps, world.state.gap)


@pytest.mark.slow
def test_without_control_the_wave_emerges_and_costs_a_third_of_the_speed():
    task = make_task("ring", length=[220.0, 270.0], warmup=750, shock=0.0)
    with torch.no_grad():
        world, params = start(task, count=12)
        speeds = []
        draw = Draw.of(torch.arange(12), torch.ones(12, dtype=torch.int64))
        normals = task.normals(draw, torch.zeros(12, dtype=torch.int64), 3000, torch.float64)["noise"]
        for t in range(3000):
            world = task.step(world, None, {"noise": normals[t]}, params)
            speeds.append(world.state.speed)
    speed = torch.stack(speeds)
    even = equilibrium_speed((world.state.gap + 5.0).mean(-1) - 5.0, params["idm"])
    lost = 1.0 - speed[2000:].mean((0, 2)) / even
    assert 0.25 < float(lost.mean()) < 0.40
    # A wave: at one time some stand while others drive, and it is not there in the beginning.
    assert float(speed[-1].min()) < 0.5
    assert float(speed[-1].max()) > 1.3 * float(even.max())
    assert float(speed[0].std(-1).mean()) < 0.2 * float(speed[-1].std(-1).mean())


def test_a_policy_of_constant_speed_calms_the_traffic():
    # One vehicle that never exceeds 70 % of the equilibrium speed dissolves the wave, and all drive faster for it.
    task = make_task("ring", length=250.0, start="wave", warmup=300, noise=0.0, shock=0.0)
    world, params = start(task)
    even = equilibrium_speed(torch.tensor(250.0 / 22 - 5.0, dtype=torch.float64), params["idm"])
    calm = even * 0.7
    with torch.no_grad():
        waves = float(world.state.speed.mean())
        for _ in range(3000):
            speed, gap = task.pick(world.state.speed), task.pick(world.state.gap)
            wanted = torch.minimum(calm, (gap - 2.2).clamp_min(0.0))
            world = task.step(world, (2.0 * (wanted - speed)).clamp(-1.0, 1.0), None, params)
    assert float(world.state.speed.std()) < 1e-6
    assert float(world.state.speed.mean()) > 1.03 * waves


def shocked_speeds(shock_after=1.0):
    """The speeds of all vehicles after every step, and what they could depend on; a human brakes for a second."""
    task = make_task("ring", warmup=300, noise=0.0, length=260.0, shock=4.0, shock_after=shock_after, shock_seconds=1.0)
    with torch.no_grad():
        world, params = start(task, count=2)
    world = world._replace(state=world.state._replace(step=torch.tensor([0, -5])))
    push = torch.zeros(2, 1, dtype=torch.float64, requires_grad=True)
    params["idm"]["time_gap"].requires_grad_()
    speeds = [world.state.speed]
    for _ in range(40):
        world = task.step(world, push, None, params)
        speeds.append(world.state.speed)
    return torch.stack(speeds), push, params["idm"]["time_gap"]


def test_in_a_shock_one_human_brakes_for_its_time_whatever_is_ahead():
    speeds, _, _ = shocked_speeds()
    change = (speeds[1:] - speeds[:-1]).detach()
    for row, first in ((0, 10), (1, 15)):
        braked = change[:, row, 11] < -0.39
        assert braked.nonzero().flatten().tolist() == list(range(first, first + 10))
        torch.testing.assert_close(change[first : first + 10, row, 11], torch.full((10,), -0.4, dtype=torch.float64))
    twice = shocked_speeds(shock_after=[1.0, 2.5])[0].detach()
    braked = (twice[1:, 0, 11] - twice[:-1, 0, 11]) < -0.39
    assert braked.nonzero().flatten().tolist() == [*range(10, 20), *range(25, 28)]
    assert bool((twice[30:36, 0, 11] == 0.0).all()), "he stands until the second is over"
    # Who drives ahead does not feel it, who follows does.
    felt = (shocked_speeds(shock_after=60.0)[0] - speeds).detach()[:, 0]
    assert float(felt[:, :11].abs().max()) == 0.0
    assert float(felt[-1, 12]) > 0.5


def test_waves_come_again_at_drawn_times():
    """In every minute of an episode one drawn human brakes, never an agent; in no two episodes alike."""
    task = make_task("ring", warmup=0, controlled=2)
    world, _ = start(task, count=200)
    first, who = world.episode["shock_step"], world.episode["shock_who"]
    assert first.shape == who.shape == (200, 5)
    assert torch.equal(first // 600, torch.arange(5).expand(200, 5)) and int((first % 600).max()) <= 580
    assert set(who.flatten().tolist()) == set(range(22)) - set(task.agents)
    assert len({tuple(row) for row in first.tolist()}) == 200
    assert (
        make_task("ring", controlled="all")
        .reset(Draw.of(torch.zeros(1).long(), torch.zeros(1).long()), make_task("ring").params(torch.float64, "cpu"))
        .episode
        == {}
    )


def test_gradients_flow_past_a_shock_and_not_into_it():
    speeds, push, time_gap = shocked_speeds()
    one = speeds[:, 0]
    assert float(torch.autograd.grad(one[-1, 0], push, retain_graph=True)[0][0]) == pytest.approx(4.0)

    def slope(later, earlier):
        change = one[later, 11] - one[earlier, 11]
        return float(torch.autograd.grad(change, time_gap, retain_graph=True)[0])

    assert slope(10, 0) != 0.0
    assert slope(20, 10) == 0.0
    assert slope(30, 20) != 0.0


def test_the_driver_opposite_is_no_agent_and_a_wrong_one_is_told():
    assert make_task("ring", shock=4.0, controlled=2).shocked == 12
    assert make_task("ring", shock=4.0, controlled=[5]).shocked == 16
    for keywords, message in (
        ({"shock": -1.0}, "shock = -1"),
        ({"shock": 4.0, "shock_seconds": 0.0}, "shock_seconds = 0"),
        ({"shock": 4.0, "shock_after": [60.0, -1.0]}, r"shock_after\[1\] = -1"),
        ({"shock": 4.0, "shock_after": [60.0, 61.0]}, "each at least shock_seconds = 2 s after the one before"),
        ({"shock": 4.0, "shock_after": []}, "must be a time, or several"),
        ({"shock": 4.0, "shock_after": 60.0, "controlled": "all"}, "needs a human driver"),
        ({"shock_every": 1.0}, "shock_every = 1 s must be at least 2"),
        ({"shock": 4.0, "shock_vehicle": 0}, "shock_vehicle = 0 must be a human driver"),
        ({"shock": 4.0, "shock_vehicle": 22}, "shock_vehicle = 22 must be a human driver"),
    ):
        with pytest.raises(ValueError, match=message):
            make_task("ring", **keywords)


def test_tailgating_costs_as_the_catalogue_says():
    flow = {"speed": 0.2, "effort": -4.0}
    plain, dear = (make_task("ring", warmup=30, reward=flow | more) for more in ({}, {"tailgating": -3.0}))
    world, _ = start(plain)
    close = world._replace(state=world.state._replace(gap=torch.full_like(world.state.gap, 0.4)))
    none = torch.zeros(1, 1, dtype=torch.float64)
    difference = plain.rewards(close, none, close) - dear.rewards(close, none, close)
    assert float(difference) == pytest.approx(3.0 * (1.0 - 0.4 / max(float(close.state.speed[0, 0]), 1.0)))


def test_touching_ends_it():
    task = make_task("ring", warmup=0, controlled=2)
    world, _ = start(task, count=2)
    gap = world.state.gap.clone()
    gap[1, 7] = 0.0
    ends = task.ended(world._replace(state=world.state._replace(gap=gap)))
    assert ends.terminated.tolist() == [[False, False], [True, True]]


def test_any_effect_can_be_put_in():
    from idm_env.effects import ALL, BASES

    left_out = {"control", "replay", "imagined", "lateral", "lane_command", "idm"}
    lanes = {name for name, cls in ALL.items() if cls.hook == "change"}
    for name in sorted(set(ALL) - left_out - set(BASES) - lanes):
        task = make_task("ring", effects=[name], warmup=3, vehicles=6, length=100.0)
        world, _ = start(task)
        assert bool(torch.isfinite(world.state.speed).all()), name
    with pytest.raises(ValueError, match="task 'ring' does not give"):
        make_task("ring", effects=["lateral"])
