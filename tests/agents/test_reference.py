"""The ring with a shock is a test: what learns nothing fails it. A sample of ``benchmarks.agents reference``."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from agents import evaluate, reference
from agents.classical import no_command
from agents.evaluate import SPEED_RATIO, as_judged, evaluate_ring
from agents.policy import Policy
from agents.rollout import ring_start

GUARDED: dict[str, Any] = {"task": "ring", "failsafe": 3.0, "shock": 0.0}
SHOCK = as_judged(GUARDED)


def judged(environment, names, every=1):
    made = reference.families(environment, 8)
    rows = {}
    for name in names:
        family = made[name]()
        chosen = range(0, len(family.names), every)
        rows[name] = (family, chosen, reference.judge(family, environment, (0,), chosen))
    return rows


def test_constants_and_follower_stopper_fail_the_ring_with_a_shock():
    for _, chosen, found in judged(SHOCK, ("constants", "FollowerStopper"), every=4).values():
        assert len(found) == len(chosen) and not any(row["passed"] for row in found)
    constant = evaluate_ring(lambda o: o.new_full((len(o), 1), 0.025), GUARDED)
    assert constant["speed_ratio"] > 0.95, "without the shock one of them nearly dissolves the wave"


@pytest.mark.parametrize("name", reference.RANDOM)
def test_random_policies_fail_it(name):
    ((_, _, found),) = judged(SHOCK, (name,)).values()
    assert len(found) == 8 and not any(row["passed"] for row in found)


def test_an_oracle_can_pass_it():
    family = reference.families(SHOCK)["oracle told the uniform speed"]()
    patient = family.names.index("0.05 (1 U − v)")
    for draws in ((0,), (1, 2, 3, 4, 5)):
        assert reference.judge(family, SHOCK, draws, (patient,))[0]["passed"]


def test_one_line_passes_the_ring_and_fails_the_long_one():
    """Of a searched family; on a ring of 44 one vehicle has twice as many humans to calm."""
    for environment, passes in ((SHOCK, True), ({**SHOCK, "vehicles": 44, "length": [440.0, 540.0]}, False)):
        family = reference.families(environment)["one line of a gap"]()
        line = family.names.index("0.002 s⁻² (s − 4 m)")
        assert reference.judge(family, environment, (0,), (line,))[0]["passed"] is passes


def test_behind_a_safe_speed_the_line_passes_with_real_brakes_too():
    """Without one it touches others; so a test of agents with real brakes has this row."""
    brakes = {**SHOCK, "failsafe": 0.0, "max_command": [-4.5, 2.6]}
    for name, passes in (("one line of a gap", False), ("one line of a gap, at most Krauß's safe speed", True)):
        family = reference.families(brakes)[name]()
        (row,) = reference.judge(family, brakes, (0,), (family.names.index("0.002 s⁻² (s − 4 m)"),))
        assert row["passed"] is passes and (row["collisions"] == 0) is passes


def test_a_search_keeps_the_best_rule_that_it_has_seen(monkeypatch):
    """By the score on its own rings, never on those that judge; the same again from the same numbers."""
    draws = []

    def judged_by_gain(family, environment, draw, chosen):
        draws.extend(draw)
        return [float(family.names[i].split()[0]) for i in chosen]

    monkeypatch.setattr(reference, "judge", judged_by_gain)
    monkeypatch.setattr(reference, "score", lambda gain: -abs(gain - 0.01))
    (name,) = reference.searched(SHOCK, 6, 24).names
    assert float(name.split()[0]) == pytest.approx(0.01, rel=0.1) and name == reference.searched(SHOCK, 6, 24).names[0]
    assert min(draws) >= 1000


def test_policies_that_drive_together_do_what_each_does_alone(monkeypatch):
    """In one batch or alone, networks and rules alike."""
    for module in (reference, evaluate):
        monkeypatch.setattr(module, "STEPS", 1100)
    torch.manual_seed(0)
    policies = [Policy(3, (4,)) for _ in range(3)]
    for i, policy in enumerate(policies):
        with torch.no_grad():
            policy.body[-1].bias.fill_(0.01 * (i + 1))
    both = reference.judge(reference.networks(policies, "abc"), SHOCK, (0,), (0, 2))
    for found, policy in zip(both, (policies[0], policies[2]), strict=True):
        assert found["ratios"] == pytest.approx(evaluate_ring(policy, SHOCK)["ratios"], abs=1e-3)
    still = reference.judge(reference.families(SHOCK)["constants"](), SHOCK, (0,), (0,))[0]
    assert still["ratios"] == pytest.approx(evaluate_ring(no_command, SHOCK)["ratios"], abs=1e-3)


def test_rules_command_what_their_names_say():
    start = ring_start(GUARDED, (230.0, 260.0), 100)
    seen = start.task.observe(start.world).flatten(1)
    state = start.world.state
    speed, lead, gap = (x[:, :1] for x in (state.speed, state.speed[:, -1:], state.gap))
    made = reference.families(GUARDED)
    family = made["proportional rules"]()
    at = family.names.index("0.3 Δv + 0.1 (s − 2 m − v · 1.5 s)")
    wanted = 0.3 * (lead - speed) + 0.1 * (gap - 2.0 - 1.5 * speed)
    assert torch.allclose(family.acts(start, (at,))(seen), wanted.clamp(-1.0, 1.0), atol=1e-4)
    family = made["Krauß's safe speed and a constant"]()
    at = family.names.index("1 m/s², b = 3 m/s², τ = 1 s")
    allowed = torch.minimum(start.task.safe_command(start.world), torch.ones(2, 1))
    assert torch.allclose(family.acts(start, (at,))(seen), allowed.clamp(-1.0, 1.0), atol=1e-3)


def test_rows_are_judged_on_fresh_rings_only_where_the_six_are_passed(monkeypatch):
    asked = []

    def judge(family, environment, draws, chosen):
        asked.append((tuple(draws), list(chosen)))
        good = [i % 2 == 0 for i in chosen] if draws == (0,) else [i > 0 for i in chosen]
        return [
            {"speed_ratio": 0.9 + 0.01 * i, "speed_std": 0.1, "time_gap": 1.0, "collisions": 0, "passed": x}
            for i, x in zip(chosen, good, strict=True)
        ]

    monkeypatch.setattr(reference, "judge", judge)
    found = reference.tried(reference.Family("abcd", lambda start, chosen: no_command), GUARDED)
    assert asked == [((0,), [0, 1, 2, 3]), ((1, 2, 3, 4, 5), [0, 2])]
    assert (found["tried"], found["six"], found["passed"], found["best"]) == (4, 2, ["c"], "d")
    assert found["figures"]["speed_ratio"] < SPEED_RATIO
