"""Gradients through lane changes: each estimator of ``decisions=`` beside finite differences, on small scenes.

``python -m benchmarks.lanes gradients`` draws scenes (half of them rings, half a lane that ends; eight drivers, no two
alike). The objective of a scene is how far its vehicles come on average in ten seconds (m), the mean over draws of
where they begin (a metre or two) and, with ``score``, of what they choose: that is what has a derivative although
choices jump. Central differences take the same draws on both sides. A gradient is by the logarithms of six parameters
that all drivers share. Printed are, over scenes, the cosine to the differences and the ratio of lengths (medians and
quartiles), for all six parameters and for the three of MOBIL, which matter through choices alone; then both of the mean
over all scenes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from idm_env.choices import Decisions
from idm_env.effects import IDM, Brakes, MandatoryChange, Mobil
from idm_env.progress import OnProgress
from idm_env.roads import Lanes, lane_drop
from idm_env.simulator import Simulator

NAMES = (
    ("idm", "time_gap"), ("idm", "max_accel"), ("idm", "desired_speed"), ("mobil", "politeness"),
    ("mobil", "threshold"), ("mobil", "safe_decel"),
)  # fmt: skip
EACH, LANES, STEPS, DT = 8, 3, 50, 0.2
ROADS = {"ring": Lanes(LANES, ring=130.0), "drop": Lanes(LANES, ends=(lane_drop(2, at=160.0),))}
Objective = Callable[[Tensor], Tensor]
Params = dict[str, dict[str, Tensor]]


def simulator_of(kind: str, how: Decisions = "pathwise", temperature: float = 0.1) -> Simulator:
    """Return the simulator of a kind of scene."""
    own = (IDM(), Mobil(), MandatoryChange(), Brakes())
    return Simulator(ROADS[kind], own, dt=DT, decisions=how, temperature=temperature)


def begun(kind: str, scene: int, draws: int, at: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return position, speed and lane of one scene in every draw from ``at`` on, and its drivers' desired speeds."""
    generator = torch.Generator().manual_seed(1000 * scene + len(kind))

    def rand(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    index = torch.arange(EACH)
    place = 15.0 * (torch.randperm(EACH, generator=generator) + 0.5 * rand(EACH))
    lane = torch.where(index < 3, index, torch.randint(LANES, (EACH,), generator=generator))
    wish, pace = 12.0 + 18.0 * rand(EACH), 6.0 + 6.0 * rand(EACH)
    more = torch.Generator().manual_seed(7_000_003 * scene + at)
    shift = 3.0 * torch.rand((draws, EACH), generator=more, dtype=torch.float64)
    return place + shift, pace.expand(draws, EACH), lane.expand(draws, EACH), wish


def distances(kind: str, simulator: Simulator, scene: int, draws: int, logs: Tensor, at: int = 0) -> tuple[Any, Tensor]:
    """Return the state at the end of one scene in every draw, and how far vehicles came on average (m)."""
    position, pace, lane, wish = begun(kind, scene, draws, at)
    params: Params = simulator.defaults(dtype=torch.float64)
    params["idm"] = {**params["idm"], "desired_speed": wish, "time_gap": torch.tensor(1.2, dtype=torch.float64)}
    for (effect, name), log in zip(NAMES, logs, strict=True):
        params[effect] = {**params[effect], name: params[effect][name] * log.exp()}
    state = simulator.state(position, pace, params, lane=lane)
    end, _ = simulator.rollout(state, {}, params, STEPS, keep=None, seed=1_000_003 * scene + at)
    return end, (end.position - position).mean(-1)


def slopes(kind: str, simulator: Simulator, scene: int, draws: int) -> Tensor:
    """Return the gradient of one scene by back-propagation, the mean over draws; with ``score`` its own estimator."""
    total = torch.zeros(len(NAMES), dtype=torch.float64)
    block = min(draws, 256)
    for at in range(0, draws, block):
        logs = torch.zeros(len(NAMES), dtype=torch.float64, requires_grad=True)
        end, far = distances(kind, simulator, scene, block, logs, at)
        loss = far.mean()
        if simulator.decisions == "score":
            # Everybody else's mean is a baseline that one's own choices do not change.
            other = (far.detach().sum() - far.detach()) / (block - 1)
            loss = loss + ((far.detach() - other) * end.choices.log_probability.sum(-1)).mean()
        total += torch.autograd.grad(loss, logs)[0] * (block / draws)
    return total


def differences(kind: str, simulator: Simulator, scene: int, draws: int, step: float = 0.02, at: int = 0) -> Tensor:
    """Return central differences of one scene's objective, with the same draws on both sides."""
    found = []
    with torch.no_grad():
        for i in range(len(NAMES)):
            aside = torch.zeros(len(NAMES), dtype=torch.float64)
            aside[i] = step
            up, down = (distances(kind, simulator, scene, draws, way * aside, at)[1].mean() for way in (1, -1))
            found.append((up - down) / (2 * step))
    return torch.stack(found)


def beside(found: Tensor, expected: Tensor) -> str:
    """Return cosines and ratios of lengths over scenes, ``(scenes, parameters)`` each: quartiles, and of the means.

    First for all parameters, then for those of MOBIL, in scenes in which these make a difference.
    """
    quarters = torch.tensor([0.25, 0.5, 0.75], dtype=found.dtype)
    told = []
    for part in (slice(0, len(NAMES)), slice(3, len(NAMES))):
        one, other = found[:, part], expected[:, part]
        some = other.norm(dim=-1) > 0.02 * expected.norm(dim=-1)
        one, other = one[some], other[some]
        cosine = torch.nn.functional.cosine_similarity(one, other, dim=-1)
        c, r = (x.quantile(quarters) for x in (cosine, one.norm(dim=-1) / other.norm(dim=-1)))
        one, other = one.mean(0), other.mean(0)
        whole = torch.nn.functional.cosine_similarity(one, other, dim=0)
        told.append(
            f"{c[1]:6.2f} ({c[0]:5.2f} to {c[2]:5.2f}) {r[1]:6.2f} ({r[0]:5.2f} to {r[2]:5.2f}) "
            f"{whole:6.2f} {one.norm() / other.norm():6.2f} ({int(some.sum())})"
        )
    return " | ".join(told)


ESTIMATORS: tuple[tuple[Decisions, float, int], ...] = (
    ("pathwise", 0.1, 1024), ("surrogate", 0.03, 32), ("surrogate", 0.1, 32), ("surrogate", 0.3, 32),
    ("surrogate", 1.0, 32), ("soft", 0.1, 32), ("soft", 0.3, 32), ("score", 0.1, 512), ("score", 0.3, 512),
)  # fmt: skip
"""How choices are made, at which temperature (m/s²), and how many draws of each scene."""


def table(scenes: int, on_progress: OnProgress, draws: int = 1024) -> None:
    """Print all estimators beside differences of hard choices; those that draw or share beside their own, too."""
    cases = [(kind, i) for i in range((scenes + 1) // 2) for kind in ROADS][:scenes]

    def over(what: str, one: Callable[[str, int], Tensor]) -> Tensor:
        found = []
        for done, (kind, i) in enumerate(cases):
            on_progress(what, done, len(cases))
            found.append(one(kind, i))
        return torch.stack(found)

    def hard(at: int) -> Tensor:
        return over("differences", lambda kind, i: differences(kind, simulator_of(kind), i, draws, at=at))

    expected, again = hard(0), hard(1)
    head = "cosine (quartiles), ratio (quartiles), both of the mean over (n) scenes"
    print(f"all parameters, then MOBIL's: {head}; CPU seconds per scene and draw")
    print(f"{'differences, other draws':30s}{beside(again, expected)}", flush=True)
    for how, temperature, many in ESTIMATORS:
        label = how if how == "pathwise" else f"{how}, τ {temperature:g}"

        def slope(kind: str, i: int, how: Decisions = how, tau: float = temperature, many: int = many) -> Tensor:
            return slopes(kind, simulator_of(kind, how, tau), i, many)

        begin = time.process_time()
        found = over(label, slope)
        each = (time.process_time() - begin) / len(cases) / many
        print(f"{label:30s}{beside(found, expected)} {each:8.1g}", flush=True)
        if how == "score":

            def own(kind: str, i: int, how: Decisions = how, tau: float = temperature, many: int = many) -> Tensor:
                return differences(kind, simulator_of(kind, how, tau), i, 2 * many, step=0.05)

            print(f"{'  beside its own differences':30s}{beside(found, over('own differences', own))}", flush=True)


__all__ = ["differences", "distances", "simulator_of", "slopes", "table"]
