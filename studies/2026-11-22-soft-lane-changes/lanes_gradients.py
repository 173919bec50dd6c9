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
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from idm_env.choices import Decisions
from idm_env.effects import IDM, Brakes, MandatoryChange, Mobil
from idm_env.progress import OnProgress
from idm_env.roads import Lanes, lane_drop
from idm_env.simulator import Simulator
from idm_env.types import State

NAMES = (
    ("idm", "time_gap"), ("idm", "max_accel"), ("idm", "desired_speed"), ("mobil", "politeness"),
    ("mobil", "threshold"), ("mobil", "safe_decel"),
)  # fmt: skip
EACH, LANES, STEPS, DT = 8, 3, 50, 0.2
ROADS = {"ring": Lanes(LANES, ring=130.0), "drop": Lanes(LANES, ends=(lane_drop(2, at=160.0),))}
Params = dict[str, dict[str, Tensor]]


def simulator_of(kind: str, how: Decisions = "pathwise", temperature: float = 0.1) -> Simulator:
    """Return the simulator of a kind of scene."""
    own = (IDM(), Mobil(), MandatoryChange(), Brakes())
    return Simulator(ROADS[kind], own, dt=DT, decisions=how, temperature=temperature)


def begun(kind: str, scenes: Sequence[int], draws: int, at: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return position, speed, lane and desired speed of scenes ``(scenes, draws, vehicles)``, draws from ``at`` on."""
    found = []
    for scene in scenes:
        generator = torch.Generator().manual_seed(1000 * scene + len(kind))
        place = torch.randperm(EACH, generator=generator) + 0.5 * torch.rand(EACH, generator=generator)
        lane = torch.cat((torch.arange(LANES), torch.randint(LANES, (EACH - LANES,), generator=generator)))
        pace, wish = (
            6.0 + 6.0 * torch.rand(EACH, generator=generator),
            12.0 + 18.0 * torch.rand(EACH, generator=generator),
        )
        more = torch.Generator().manual_seed(7_000_003 * scene + at)
        shift = 3.0 * torch.rand((draws, EACH), generator=more)
        found.append((15.0 * place + shift, pace.expand(draws, EACH), lane.expand(draws, EACH), wish.expand(1, EACH)))
    position, pace, lane, wish = (torch.stack(column) for column in zip(*found, strict=True))
    return position.double(), pace.double(), lane, wish.double()


def distances(
    kind: str, simulator: Simulator, scenes: Sequence[int], draws: int, logs: Tensor, at: int = 0
) -> tuple[State, Tensor]:
    """Return the state at the end, and how far vehicles came on average (m), ``(scenes, draws)``.

    ``logs`` ``(scenes, parameters)`` are logarithms of factors of the parameters.
    """
    position, pace, lane, wish = begun(kind, scenes, draws, at)
    params: Params = simulator.defaults(dtype=torch.float64)
    params["idm"] = {**params["idm"], "desired_speed": wish, "time_gap": torch.tensor(1.2, dtype=torch.float64)}
    for i, (effect, name) in enumerate(NAMES):
        params[effect] = {**params[effect], name: params[effect][name] * logs[:, i, None, None].exp()}
    state = simulator.state(position, pace, params, lane=lane)
    end, _ = simulator.rollout(state, {}, params, STEPS, keep=None, seed=1_000_003 * scenes[0] + at)
    return end, (end.position - position).mean(-1)


def slopes(kind: str, simulator: Simulator, scenes: Sequence[int], draws: int, at: int = 0) -> Tensor:
    """Return the gradient of each scene by back-propagation, the mean over draws; with ``score`` its own estimator."""
    logs = torch.zeros((len(scenes), len(NAMES)), dtype=torch.float64, requires_grad=True)
    end, far = distances(kind, simulator, scenes, draws, logs, at)
    if simulator.decisions == "score":
        assert end.choices is not None
        # Everybody else's mean is a baseline that one's own choices do not change.
        other = (far.detach().sum(-1, keepdim=True) - far.detach()) / (draws - 1)
        far = far + (far.detach() - other) * end.choices.log_probability.sum(-1)
    return torch.autograd.grad(far.mean(-1).sum(), logs)[0]


def differences(
    kind: str, simulator: Simulator, scenes: Sequence[int], draws: int, at: int = 0, step: float = 0.02
) -> Tensor:
    """Return central differences of each scene's objective, with the same draws on both sides."""
    found = []
    with torch.no_grad():
        for i in range(len(NAMES)):
            aside = torch.zeros((len(scenes), len(NAMES)), dtype=torch.float64)
            aside[:, i] = step
            up, down = (distances(kind, simulator, scenes, draws, way * aside, at)[1].mean(-1) for way in (1, -1))
            found.append((up - down) / (2 * step))
    return torch.stack(found, -1)


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

ROWS = {"pathwise": 8192, "surrogate": 160, "soft": 160, "score": 2048}
"""Worlds that are driven at once: what a graph of theirs takes is about a gigabyte."""


def table(scenes: int, on_progress: OnProgress, draws: int = 1024) -> None:
    """Print all estimators beside differences of hard choices, and those that draw beside their own, too."""
    cases = {kind: range(i, scenes, len(ROADS)) for i, kind in enumerate(ROADS)}

    def over(what: str, how: Decisions, tau: float, many: int, one: Callable[..., Tensor]) -> Tensor:
        found, each, done = [], max(1, ROWS[how] // many), 0
        for kind, numbers in cases.items():
            for first in range(0, len(numbers), each):
                on_progress(what, done, scenes)
                some = numbers[first : first + each]
                found.append(one(kind, simulator_of(kind, how, tau), some, many))
                done += len(some)
        return torch.cat(found)

    expected = over("differences", "pathwise", 0.1, draws, differences)
    again = over("other draws", "pathwise", 0.1, draws, partial(differences, at=1))
    head = "cosine (quartiles), ratio (quartiles), both of the mean over (n) scenes"
    print(f"all parameters, then MOBIL's: {head}; CPU ms per scene and draw")
    print(f"{'differences, other draws':30s}{beside(again, expected)}", flush=True)
    for how, tau, many in ESTIMATORS:
        label = how if how == "pathwise" else f"{how}, τ {tau:g}"
        begin = time.process_time()
        found = over(label, how, tau, many, slopes)
        each = 1000.0 * (time.process_time() - begin) / scenes / many
        print(f"{label:30s}{beside(found, expected)} {each:8.2g}", flush=True)
        if how == "score":
            own = over("its own differences", how, tau, many, partial(differences, at=1, step=0.05))
            print(f"{'  beside its own differences':30s}{beside(found, own)}", flush=True)


__all__ = ["differences", "distances", "simulator_of", "slopes", "table"]
