"""What a policy remembers: running means and a recurrent unit, in rollouts, trainings and checkpoints."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from agents import apg, common, distil, evaluate
from agents.policy import Driving, Policy
from agents.rollout import drive, ring_start

MEMORIES = {
    "history": {"history": (3.0, 40.0)},
    "recurrent": {"recurrent": 4},
    "both": {"history": (9.0,), "recurrent": 2},
}


def test_a_running_mean_of_a_constant_and_of_a_step_are_known():
    policy = Policy(1, (4,), history=(10.0,))
    past = policy.step(torch.full((2, 1), 3.0), None)[1]
    for _ in range(50):
        past = policy.step(torch.full((2, 1), 3.0), past)[1]
    assert torch.equal(past.means, torch.full((2, 1, 1, 1), 3.0))  # it begins at the first observation
    for k in range(1, 31):
        past = policy.step(torch.zeros(2, 1), past)[1]
        assert torch.allclose(past.means, torch.tensor(3.0 * np.exp(-k / 10.0), dtype=torch.float32), rtol=1e-5)


@pytest.mark.parametrize("memory", MEMORIES.values(), ids=MEMORIES)
def test_what_was_seen_in_an_ended_episode_is_forgotten_and_in_the_others_it_is_not(memory):
    torch.manual_seed(0)
    policy = Policy(3, (8,), **memory)
    seen = torch.randn(7, 4, 6)  # steps, environments, two agents
    whole, cut = Driving(policy), Driving(policy)
    for t, observation in enumerate(seen):
        if t == 4:
            cut.begin(torch.tensor([True, False, False, True]))
        a, b = whole(observation), cut(observation)
    fresh = Driving(policy)
    for observation in seen[4:]:
        c = fresh(observation)
    assert torch.equal(b[[0, 3]], c[[0, 3]]) and torch.equal(b[[1, 2]], a[[1, 2]]) and not torch.equal(a[0], b[0])
    # Agents do not see each other's memory.
    alone = Driving(policy)
    for observation in seen:
        d = alone(observation[:, 3:])
    assert torch.allclose(d[:, 0], a[:, 1])


@pytest.mark.parametrize("memory", MEMORIES.values(), ids=MEMORIES)
def test_predict_carries_the_state_as_stable_baselines3_does(memory):
    torch.manual_seed(0)
    policy = Policy(3, (8,), **memory)
    seen, driving, state = np.random.default_rng(0).normal(size=(6, 2, 3)).astype(np.float32), Driving(policy), None
    for t, observation in enumerate(seen):
        starts = np.array([t == 3, False])
        driving.begin(torch.as_tensor(starts))
        action, state = policy.predict(observation, state, episode_start=starts)
        assert np.array_equal(action, driving(torch.as_tensor(observation)).detach().numpy())
    assert policy.remembers and not Policy(3).remembers


@pytest.mark.parametrize("memory", MEMORIES.values(), ids=MEMORIES)
def test_a_checkpoint_gives_back_the_memory_and_every_rollout_begins_anew(memory, ring, tmp_path):
    torch.manual_seed(0)
    policy = Policy(3, (8,), **memory)
    with torch.no_grad():
        policy.body[-1].weight.mul_(100.0)
    common.save(tmp_path / "a.pt", policy, "apg", ring, {})
    again = common.load(tmp_path / "a.pt")[0]
    start = ring_start(ring, (60.0, 70.0), 20)
    driven = [drive(start, p, 30).action for p in (policy, policy, again)]
    assert torch.equal(driven[0], driven[1]) and torch.equal(driven[0], driven[2])
    plain = drive(start, policy.forward, 30).action  # as if every step were the first
    assert torch.equal(plain[0], driven[0][0]) and not torch.equal(plain[5:], driven[0][5:])


def test_what_is_remembered_lets_a_policy_do_what_no_single_observation_tells():
    """Two rows see the same at last and have seen different things before: only a memory tells them apart."""
    torch.manual_seed(0)
    sign = torch.sign(torch.randn(64, 1))
    for memory, solved in (({}, False), ({"recurrent": 8}, True), ({"history": (10.0,)}, True)):
        policy = Policy(1, (16,), **memory)
        optimiser = torch.optim.Adam(policy.parameters(), lr=2e-2)
        for _ in range(150):
            driving = Driving(policy)
            for t in range(6):
                action = driving(sign if t == 0 else torch.zeros(64, 1))
            error = (action - 0.8 * sign).square().mean()
            optimiser.zero_grad()
            error.backward()
            optimiser.step()
        assert (float(error.detach()) < 0.05) == solved


@pytest.mark.parametrize("memory", [{"history": (0.5, 2.0)}, {"recurrent": 4}], ids=["history", "recurrent"])
def test_apg_with_a_memory_resumes_exactly(memory, quick, tmp_path):
    whole = apg.Arguments(**quick, count=4, window=25, **memory)
    apg.train(dataclasses.replace(whole, out=tmp_path / "whole"))
    apg.train(dataclasses.replace(whole, cpu_seconds=1e-9))
    apg.train(dataclasses.replace(whole, resume=True))
    a, b = (torch.load(out / "last.pt", weights_only=True)["policy"] for out in (tmp_path / "whole", whole.out))
    assert a["made"] == b["made"] and all(torch.equal(a["state"][k], b["state"][k]) for k in a["state"])
    dt = 0.1
    assert a["made"]["history"] == [x / dt for x in memory.get("history", ())]


def test_a_memory_is_asked_for_in_yaml_and_what_makes_no_sense_is_told(tmp_path, quick):
    file = tmp_path / "a.yaml"
    file.write_text("configures: agent\nagent: apg\nhistory: [5, 30]\nrecurrent: 3\n")
    read = common.load_agent(file, apg.Arguments, "apg")
    assert read.history == (5.0, 30.0) and read.recurrent == 3
    with pytest.raises(ValueError, match=r"history = .* must be times above 0 \(s\)"):
        apg.Arguments(history=(5.0, 0.0))
    with pytest.raises(ValueError, match="clone = 5 fits single observations"):
        apg.Arguments(clone=5, recurrent=4)
    quick["environment"]["failsafe"] = 3.0
    apg.train(apg.Arguments(**{**quick, "updates": 1}, count=4, window=5, recurrent=2))
    with pytest.raises(ValueError, match="has a memory, and what is fitted has none"):
        distil.taught(distil.Arguments(environment=quick["environment"], teacher=quick["out"] / "last.pt"))


def test_a_video_and_a_picture_show_a_policy_that_remembers(ring, tmp_path):
    torch.manual_seed(0)
    policy = Policy(3, (8,), history=(20.0,))
    evaluate.picture(tmp_path / "a.png", ring, policy, human=3, steps=5)
    assert (tmp_path / "a.png").stat().st_size > 1000
