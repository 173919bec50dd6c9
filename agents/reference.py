"""What needs no learning: families of policies beside which a test of agents on the ring says what it is worth.

Constants, proportional rules, one line of a gap, a rule that is searched for as long as an agent trains, Krauß's safe
speed, FollowerStopper, random networks, and an oracle that is told the uniform speed. All policies of a family drive
the same rings at once. A task that more than 5 % of the random policies pass is no test.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.func import functional_call, stack_module_state, vmap

from agents.classical import FollowerStopper, PISaturation, Seen, seen
from agents.environments import first_seed, human_driving, task_of
from agents.evaluate import STEPS, evaluate_ring, judge_ring, judged_rings, score
from agents.policy import Policy
from agents.rollout import FRESH, Act, Driven, Start, drive, uniform_speed
from idm_env.tasks import Task
from idm_env.tasks.failsafe import safe_accel
from idm_env.types import mapped

ROWS_AT_ONCE = 192
"""Rings that are driven together: every step of all of them is kept."""
RANDOM = ("random networks", "random linear policies")
_SEARCHED = 1000
"""Draw of the first rings of a search: judgements begin with draw 0."""
HIDDEN: tuple[tuple[int, ...], ...] = ((32, 32), ())


class Family(NamedTuple):
    """Policies of one kind: a name for each, and the actions of some of them (indices) in the rings of a start."""

    names: Sequence[str]
    acts: Callable[[Start, Sequence[int]], Act]


def rules(names: Sequence[str], columns: Sequence[Sequence[float]], wanted: Callable[..., Tensor]) -> Family:
    """Return a family of accelerations (m/s²): ``wanted(task, view, uniform, *numbers)``, numbers ``(policies, 1, 1)``.

    ``columns`` holds the numbers of each policy.
    """
    table = torch.tensor(columns)

    def acts(start: Start, chosen: Sequence[int]) -> Act:
        task, numbers = start.task, [x.view(-1, 1, 1) for x in table[list(chosen)].unbind(-1)]
        uniform = uniform_speed(start).unsqueeze(-1)

        def act(observation: Tensor) -> Tensor:
            view = seen(observation, task)
            view = Seen(*(x.view(len(chosen), -1, 1) for x in view))
            accel = wanted(task, view, uniform, *numbers).expand_as(view.speed)
            return task.action(accel).reshape(-1, 1)

        return act

    return Family(names, acts)


def grid(wanted: Callable[..., Tensor], form: str, *axes: Sequence[float]) -> Family:
    """Return a family with all combinations of numbers; ``form`` makes the name of each."""
    columns = list(itertools.product(*axes))
    return rules([form.format(*c) for c in columns], columns, wanted)


def networks(policies: Sequence[Policy], names: Sequence[str]) -> Family:
    """Return a family of networks of the same layout."""

    def acts(start: Start, chosen: Sequence[int]) -> Act:
        parts = stack_module_state([policies[i] for i in chosen])
        run = vmap(lambda weights, fixed, x: functional_call(policies[0], (weights, fixed), (x,)))
        return lambda observation: run(*parts, observation.view(len(chosen), -1, observation.shape[-1])).reshape(-1, 1)

    return Family(names, acts)


def safe(task: Task, view: Seen, decel: float | Tensor = 3.0, seconds: float | Tensor = 1.0) -> Tensor:
    """Return Krauß's safe acceleration of what a vehicle sees."""
    dt, euler = task.simulator.dt, task.simulator.integration == "euler"
    return safe_accel(view.speed, view.lead_speed, view.gap, decel, seconds, dt, euler)


def told(task: Task, view: Seen, uniform: Tensor, gain: Tensor, share: Tensor) -> Tensor:
    """Return ``k (f U − v)``, at most what is safe: an oracle is told each ring's uniform speed U."""
    return torch.minimum(gain * (share * uniform - view.speed), safe(task, view))


def follower_stopper(task: Task, view: Seen, uniform: Tensor, share: Tensor, each: Tensor) -> Tensor:
    """Return what reaches FollowerStopper's speed in one step; U is a share of each ring's uniform speed, or of all."""
    desired = share * torch.where(each > 0, uniform, uniform.median())
    return (FollowerStopper(task, desired=desired).wanted(view) - view.speed) / task.step_time


def random_policies(environment: Mapping[str, Any], count: int, hidden: Sequence[int]) -> list[Policy]:
    """Return policies as training begins with them, the layers drawn anew and the last one at a random scale and bias.

    Half of them: the last layer times 0.01 to 3, drawn evenly in the logarithm, its bias ± 0 to 0.1. The others: as
    before any update, then every weight moved by ± 0.01 (what a first step of Adam does), and the last bias by 0.025.
    """
    observations, _ = human_driving(environment, first_seed(0, 0))
    policies = []
    for i in range(count):
        torch.manual_seed(i)
        policy = Policy(observations.shape[-1], hidden)
        policy.mean.copy_(observations.mean(0))
        policy.scale.copy_(observations.std(0).clamp_min(1e-3))
        with torch.no_grad():
            last = policy.body[-1]
            assert isinstance(last, torch.nn.Linear)
            if i % 2:
                for x in policy.parameters():
                    x.add_(0.01 * torch.sign(torch.randn_like(x)))
                last.bias.add_(0.025 * (i % 4 == 1))
            else:
                last.weight.mul_(10.0 ** (2.5 * torch.rand(())))
                last.bias.add_(0.2 * (torch.rand(()) - 0.5))
        policies.append(policy)
    return policies


def linear(numbers: Tensor) -> Family:
    """Return the family of ``g (s − s0) + k Δv``, at most Krauß's safe speed, from numbers ``(policies, 3)``."""
    names = ["{:.3g} s⁻² (s − {:.3g} m) + {:.3g} s⁻¹ Δv".format(*row) for row in numbers.tolist()]
    return rules(
        names, numbers.tolist(),
        lambda task, view, uniform, g, gap, k: torch.minimum(
            g * (view.gap - gap) + k * (view.lead_speed - view.speed), safe(task, view)
        ),
    )  # fmt: skip


def searched(environment: Mapping[str, Any], generations: int = 3, count: int = 16) -> Family:
    """Return the best linear rule of a cross-entropy search over the logarithms of its numbers, on rings of its own.

    Three generations take about as long as APG trains.
    """
    drawing = torch.Generator().manual_seed(0)
    low, high = torch.tensor([[1e-4, 2.0, 1e-3], [1.0, 8.0, 1.0]]).log()
    middle, spread, best = (low + high) / 2.0, (high - low) / 2.0, list[tuple[Any, Tensor]]()
    for generation in range(generations):
        numbers = (middle + spread * torch.randn(count, 3, generator=drawing)).clamp(low, high)
        rows = judge(linear(numbers.exp()), environment, (_SEARCHED + generation,), range(count))
        best += [(score(row), x) for row, x in zip(rows, numbers, strict=True)]
        best = sorted(best, key=lambda each: each[0], reverse=True)[: count // 4]
        elite = torch.stack([x for _, x in best])
        middle, spread = elite.mean(0), elite.std(0) + 0.05 * (high - low)
    return linear(best[0][1][None].exp())


def families(environment: Mapping[str, Any], count: int = 200) -> dict[str, Callable[[], Family]]:
    """Return what makes every family, by name; ``count`` random policies of each kind."""
    makers: dict[str, Callable[[], Family]] = {
        "constants": lambda: grid(
            lambda task, view, uniform, accel: accel, "{:g} m/s²", [round(0.005 * i, 3) for i in range(25)]
        ),
        "proportional rules": lambda: grid(
            lambda task, view, uniform, k, g, seconds: (
                k * (view.lead_speed - view.speed) + g * (view.gap - 2.0 - seconds * view.speed)
            ),
            "{:g} Δv + {:g} (s − 2 m − v · {:g} s)",
            (0.1, 0.3, 0.6, 1.0), (0.01, 0.03, 0.1, 0.2, 0.5), (0.5, 1.0, 1.5, 2.0),
        ),
        "one line of a gap": lambda: grid(
            lambda task, view, uniform, g, gap: g * (view.gap - gap), "{:g} s⁻² (s − {:g} m)",
            (0.001, 0.002, 0.004, 0.008, 0.016), (3.0, 4.0, 5.0),
        ),
        "one line of a gap, at most Krauß's safe speed": lambda: grid(
            lambda task, view, uniform, g, gap: torch.minimum(g * (view.gap - gap), safe(task, view)),
            "{:g} s⁻² (s − {:g} m)", (0.001, 0.002, 0.004, 0.008, 0.016), (3.0, 4.0, 5.0),
        ),
        "searched rule": lambda: searched(environment),
        "Krauß's safe speed and a constant": lambda: grid(
            lambda task, view, uniform, accel, decel, seconds: torch.minimum(accel, safe(task, view, decel, seconds)),
            "{:g} m/s², b = {:g} m/s², τ = {:g} s",
            (0.005, 0.01, 0.02, 0.025, 0.03, 0.05, 0.1, 0.3, 1.0), (1.0, 2.0, 3.0), (1.0, 1.5, 2.0),
        ),
        "FollowerStopper": lambda: grid(
            follower_stopper, "{:g} of the uniform speed, each told: {:g}",
            (0.8, 0.85, 0.9, 0.95, 0.97, 1.0), (0.0, 1.0),
        ),
        "oracle told the uniform speed": lambda: grid(
            told, "{:g} ({:g} U − v)", (0.05, 0.1, 0.2, 0.5, 1.0), (0.9, 0.95, 0.97, 0.98, 0.99, 1.0, 1.02)
        ),
    }  # fmt: skip
    numbers = [str(i) for i in range(count)]
    for name, hidden in zip(RANDOM, HIDDEN, strict=True):
        makers[name] = partial(lambda hidden: networks(random_policies(environment, count, hidden), numbers), hidden)
    return makers


def repeated(start: Start, times: int) -> Start:
    """Return the rings of a start over and over, with the same noise for each."""
    world = mapped(lambda x: x.repeat(times, *(1 for _ in x.shape[1:])), start.world)
    return start._replace(world=world, seeds=start.seeds * times)


def judge(
    family: Family, environment: Mapping[str, Any], draws: Sequence[int], chosen: Sequence[int]
) -> list[dict[str, Any]]:
    """Return the figures of the chosen policies of a family, each on one ring of every length and draw."""
    start = judged_rings(environment, draws=draws)
    rings = len(start.world.state.speed)
    rows, at_once = [], max(1, ROWS_AT_ONCE // rings)
    for part in (chosen[i : i + at_once] for i in range(0, len(chosen), at_once)):
        driven = drive(repeated(start, len(part)), family.acts(start, part), STEPS // start.task.held)
        for i in range(len(part)):
            own = Driven(*(x[:, i * rings : (i + 1) * rings] for x in driven))
            rows.append(judge_ring(start, own))
    return rows


def passing(
    names: Sequence[str], judged: Callable[[Sequence[int], Sequence[int]], list[dict[str, Any]]]
) -> dict[str, Any]:
    """Return how many policies pass the test, how many of these on its fresh draws too, and the best of all.

    ``judged(draws, chosen)`` gives the figures of some of them. The best is that with the highest ``evaluate.score``
    on draw 0, which ``figures`` tell.
    """
    first = judged((0,), range(len(names)))
    passed = [i for i, row in enumerate(first) if row["passed"]]
    fresh = judged(FRESH, passed)
    both = [i for i, row in zip(passed, fresh, strict=True) if row["passed"]]
    best = max(range(len(first)), key=lambda i: score(first[i]))
    return {
        "tried": len(first), "six": len(passed), "passed": [names[i] for i in both],
        "best": names[best], "figures": first[best],
    }  # fmt: skip


def tried(family: Family, environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``passing`` of a family: on six rings, and on thirty fresh ones."""
    return passing(family.names, lambda draws, chosen: judge(family, environment, draws, chosen))


def alone(make: Callable[[], Act | None], environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``passing`` of a single policy; ``make`` gives it anew, for it may have a memory."""
    return passing([""], lambda draws, chosen: [evaluate_ring(make(), environment, draws=draws) for _ in chosen])


def singles(environment: Mapping[str, Any]) -> dict[str, Callable[[], Act | None]]:
    """Return what makes each policy that drives alone."""
    task = task_of(environment)
    return {"IDM (a human driver more)": lambda: None, "PI with saturation": lambda: PISaturation(task)}
