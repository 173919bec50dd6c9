"""Lanes of 50 vehicles, stepped by every path of this package and by ``diffidm`` 0.0.3.

Ours: IDM with exact bounds (δ = 4), brakes with an exact floor, ballistic steps with exact stops, six parameters per
vehicle, gaps, speeds and positions carried. diffidm: its layer (softplus floors), fed by shifted views, and an Euler
step. Float32, vehicles sorted along their lane.
"""

from __future__ import annotations

import contextlib
from typing import Any

import torch
from torch import Tensor

from benchmarks.bench.measure import Case
from idm_env.compiled.kernels import dispatch
from idm_env.effects import IDM, Brakes
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.types import State

LANE = 50
STEPS = 10
LENGTH = 5.0
RANGES = {
    "max_accel": (0.8, 2.0),
    "comfort_decel": (1.0, 2.5),
    "time_gap": (1.0, 2.0),
    "min_gap": (1.5, 3.0),
    "desired_speed": (20.0, 35.0),
}


class Traffic:
    """One problem of N vehicles, the same for everybody."""

    def __init__(self, vehicles: int, device: str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        generator = torch.Generator().manual_seed(0)
        shape = (vehicles // LANE, LANE)

        def draw(low: float, high: float) -> Tensor:
            return (
                (low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)).to(dtype).to(device)
            )

        self.simulator = Simulator(Lane(), (IDM(), Brakes()))
        self.params = {"idm": {k: draw(*v) for k, v in RANGES.items()}, "brakes": {"max_decel": draw(6.0, 9.0)}}
        headway = torch.arange(LANE, dtype=dtype, device=device) * 30.0
        self.position = (10_000.0 - headway).expand(shape) + draw(-5.0, 5.0)
        self.speed = draw(5.0, 20.0)
        self.state = self.simulator.state(self.position, self.speed, self.params)
        self.leaves = [*self.params["idm"].values(), *self.params["brakes"].values()]

    def require(self, needed: bool) -> None:
        """Switch the parameters' gradients on or off, and forget those that are there."""
        for leaf in self.leaves:
            leaf.grad = None
            leaf.requires_grad_(needed)

    def ours(self, simulator: Simulator, kernel: bool, backward: bool, steps: int = STEPS) -> Case:
        """Return a case of one of our paths: ``steps`` steps from the same start."""

        def run() -> None:
            self.require(backward)
            with contextlib.nullcontext() if kernel else dispatch.off("benchmark of the torch path"):
                with torch.set_grad_enabled(backward):
                    last, _ = simulator.rollout(self.state, {}, self.params, steps, keep=None)
                if backward:
                    last.speed.sum().backward()

        return Case(run, steps)

    def calls(self) -> Case:
        """Return a case of ten calls of one step each: nothing stays in cache between steps."""

        def run() -> None:
            self.require(False)
            state: State = self.state
            with torch.no_grad():
                for _ in range(STEPS):
                    state, _ = self.simulator.rollout(state, {}, self.params, 1, keep=None)

        return Case(run, STEPS)

    def moves(self) -> Case:
        """Return a case that reads the nine arrays that a step reads and writes the four that it writes, and no more.

        One step per call cannot be faster: three states and six parameters come from memory, four states go there.
        """
        from idm_env.compiled.kernels.tiles import exact
        from idm_env.compiled.kernels.workspace import take

        read = [getattr(self.state, n).reshape(-1).numpy() for n in ("gap", "speed", "position")]
        read += [leaf.detach().reshape(-1).numpy() for leaf in self.leaves]
        written = [take(x.shape, x.dtype) for x in read[:4]]
        loop = exact(_read_and_write)
        return Case(lambda: loop(*read, *written))

    def theirs(self, layer: Any, backward: bool) -> Case:
        """Return a case of diffidm: the same lanes, its equations."""
        idm, far = self.params["idm"], torch.full_like(self.position[:, :1], 1e4)
        dt = torch.tensor(self.simulator.dt)

        def step(position: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
            ahead = torch.cat((position[:, :1] + far, position[:, :-1] - LENGTH), -1)
            lead_speed = torch.cat((speed[:, :1], speed[:, :-1]), -1)
            accel = layer.apply(
                idm["max_accel"], -self.params["brakes"]["max_decel"], idm["comfort_decel"], speed,
                idm["desired_speed"], ahead - position, speed - lead_speed, idm["min_gap"], idm["time_gap"], dt,
            )  # fmt: skip
            return position + speed * dt, speed + accel * dt

        def run() -> None:
            self.require(backward)
            position, speed = self.position, self.speed
            with torch.set_grad_enabled(backward):
                for _ in range(STEPS):
                    position, speed = step(position, speed)
            if backward:
                speed.sum().backward()

        return Case(run, STEPS)


def _read_and_write(  # type: ignore[no-untyped-def]
    gap, speed, position, a, b, c, d, e, f, next_gap, next_speed, next_position, next_accel
):  # fmt: skip
    for i in range(len(gap)):
        next_gap[i] = gap[i] + a[i] + b[i]
        next_speed[i] = speed[i] + c[i]
        next_position[i] = position[i] + d[i]
        next_accel[i] = e[i] + f[i]


def triad(elements: int = 20_000_000) -> tuple[Case, int]:
    """Return ``a = b + s c`` over arrays far larger than any cache, and the bytes that it moves (three per element)."""
    a, b, c = (torch.ones(elements) for _ in range(3))
    return Case(lambda: torch.add(b, c, alpha=2.0, out=a)), 3 * 4 * elements


def accuracy(steps: int = 100) -> dict[str, float]:
    """Return the worst relative error of float32 gradients against float64 autograd after 100 steps in lanes of 50.

    Per parameter: the largest difference over the largest component. The loss is the mean speed and gap at the end.
    """

    def gradients(traffic: Traffic, kernel: bool) -> list[Tensor]:
        traffic.require(True)
        with contextlib.nullcontext() if kernel else dispatch.off("reference"):
            last, _ = traffic.simulator.rollout(traffic.state, {}, traffic.params, steps, keep=None)
        loss = last.speed.sum() + last.gap[:, 1:].sum()
        return [g.double() for g in torch.autograd.grad(loss, traffic.leaves)]

    def double(traffic: Traffic) -> Traffic:
        """Return the same numbers in float64, so that only the arithmetic differs."""
        copy = Traffic(20 * LANE, dtype=torch.float64)
        columns = ("position", "speed", "accel", "gap", "length")
        copy.state = copy.state._replace(**{name: getattr(traffic.state, name).double() for name in columns})
        for leaf, same in zip(copy.leaves, traffic.leaves, strict=True):
            leaf.copy_(same)
        return copy

    true = gradients(double(Traffic(20 * LANE)), kernel=False)

    def worst(found: list[Tensor]) -> float:
        return max(float((a - b).abs().max() / b.abs().max()) for a, b in zip(found, true, strict=True))

    return {
        "kernel float32": worst(gradients(Traffic(20 * LANE), kernel=True)),
        "eager float32": worst(gradients(Traffic(20 * LANE), kernel=False)),
        "kernel float64": worst(gradients(double(Traffic(20 * LANE)), kernel=True)),
    }
