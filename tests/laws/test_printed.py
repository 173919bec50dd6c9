"""The law of printed kernels: for any simulator they yield what its torch step yields, values and gradients.

Each program costs one to two seconds to compile, so cases share programs: states and parameters are data.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from idm_env.compiled.kernels import dispatch
from idm_env.effects import ALL, BASES, IDM, Brakes, CarFollowing, Effect, make
from idm_env.effects.base import P
from idm_env.parameters import Parameter
from idm_env.roads import Lane, Ring, Road
from idm_env.simulator import Simulator
from idm_env.types import Driver, Scene
from tests.laws.members import DTYPE, MEMBERS, N, around, inputs_for, label

pytest.importorskip("numba")


@pytest.fixture(autouse=True)
def torch_path() -> Iterator[None]:
    """Laws of the step run on the torch path; here both run."""
    yield


# -- effects that the package has never seen ---------------------------------------------------------------------


@dataclass(frozen=True)
class Tailgating(Effect):
    """Perceives: gaps look ``c tanh(Δv)`` longer where the leader drives off, in a form that no other effect has."""

    kind: ClassVar[str] = "tailgating"
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("extra", "c", "m", 1.5, -5.0, 5.0, null=0.0),)

    def perceive(self, scene: Scene, p: P) -> Scene:
        leader = scene.leader
        away = torch.tanh(leader.speed - scene.speed) * leader.present
        return scene._replace(leader=leader._replace(gap=leader.gap + p["extra"] * away))


@dataclass(frozen=True)
class Tiredness(Effect):
    """Adapts, with a memory: ``T (1 + k m)``, where m grows with braking and is forgotten."""

    kind: ClassVar[str] = "tiredness"
    declared: ClassVar[tuple[Parameter, ...]] = (
        Parameter("strength", "k", "1", 0.4, -0.9, 3.0, null=0.0),
        Parameter("forgetting", "τ", "s", 8.0, 1.0, 100.0, role="shape"),
    )

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        return 0.1 * torch.ones_like(scene.speed)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        return driver._replace(time_gap=driver.time_gap * (1.0 + p["strength"] * scene.memory[self.name]))

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        level = scene.memory[self.name]
        return level + scene.dt * (torch.relu(-scene.accel) / driver.comfort_decel - level / p["forgetting"])


@dataclass(frozen=True)
class Hesitation(Effect):
    """Looks back: an acceleration ``k (v_l(t) − v_l(t − τ))``, from two looks at the past by other delays."""

    kind: ClassVar[str] = "hesitation"
    declared: ClassVar[tuple[Parameter, ...]] = (
        Parameter("strength", "k", "1/s", 0.3, -2.0, 2.0, null=0.0),
        Parameter("delay", "τ", "s", 0.37, 0.0, 0.6, role="shape"),
    )

    @property
    def looks_back(self) -> float:
        return 0.6

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        first, second = scene.past(0.5 * p["delay"]), scene.past(p["delay"])
        change = 0.5 * (scene.leader.speed + first.leader.speed) - second.leader.speed
        return p["strength"] * change * scene.leader.present


MINE: list[Effect] = [Tailgating(), Tiredness(), Hesitation()]
every = pytest.mark.parametrize("effect", [*MEMBERS, *MINE], ids=label)


def together(road: Road, integration: str = "ballistic") -> Simulator:
    """Return one simulator of the whole catalogue, and of the effects above."""
    others = {"curve", "driver_curve", *BASES} - {"idm"}
    catalogue = [make(name) for name in ALL if name not in others and ALL[name].hook != "change"]
    curves = [make("curve", feature="speed", knots=(-1.0, 3.0, 8.0, 15.0)), make("driver_curve", target="time_gap")]
    return Simulator(road, (*catalogue, *curves, *MINE), 0.1, integration)  # type: ignore[arg-type]


# -- states ------------------------------------------------------------------------------------------------------


def lively(road: Road) -> tuple[Tensor, Tensor, Tensor]:
    """Return positions, speeds and accelerations of two platoons at 120 m to 320 m."""
    generator = torch.Generator().manual_seed(7)
    wiggle, pace, push = (torch.rand((2, N), generator=generator, dtype=DTYPE) for _ in range(3))
    return 320.0 - 22.0 * torch.arange(N, dtype=DTYPE) + 4.0 * wiggle, 9.0 + 4.0 * pace, push - 0.6


KINKS: dict[str, tuple[list[float], list[float], list[float]]] = {
    # gaps, speeds (leader first), accelerations; the first gap is that of a ring's first vehicle
    "gaps of zero": ([20, 0, 0, 0, 0], [4, 5, 3, 4, 0], [0] * 5),
    "overlap": ([20, -1, -5, -0.5, -30], [4, 5, 3, 4, 8], [0] * 5),
    "standstill": ([20, 2, 2, 8, 0], [0] * 5, [0] * 5),
    "equal speeds": ([20, 16, 16, 8, 32], [8] * 5, [0] * 5),
    "stops": ([20, 2, 2, 0.5, 0.25], [0.25, 0.125, 0.5, 0.25, 0], [-2, -1, 0, -8, -1]),
    "nobody near": ([400, 500, 2000, 800, 300], [16, 8, 24, 8, 30], [0.5, 0, -0.5, 0, 0]),
}


def kinks() -> tuple[Tensor, Tensor, Tensor]:
    """Return a batch of states at which some derivative jumps; all gaps are exact in binary."""
    gaps, speeds, accels = (torch.tensor([case[i] for case in KINKS.values()], dtype=DTYPE) for i in range(3))
    back = torch.cat((torch.zeros(len(gaps), 1, dtype=DTYPE), torch.cumsum(gaps[:, 1:] + 5.0, -1)), -1)
    return 320.0 - back, speeds, accels


# -- both paths --------------------------------------------------------------------------------------------------


@dataclass
class Case:
    """A simulator at a state, with leaves in all that a rollout is differentiated by."""

    simulator: Simulator
    motion: tuple[Tensor, Tensor, Tensor]
    steps: int
    dtype: torch.dtype
    present: Tensor | None = None
    presence_changes: bool = False

    def run(self) -> tuple[list[Tensor], dict[str, Tensor]]:
        """Return final state, memories and all that is kept; and the gradients of a random sum of them."""
        leaves: dict[str, Tensor] = {}

        def leaf(name: str, value: Tensor) -> Tensor:
            leaves[name] = value.detach().clone().to(self.dtype).requires_grad_()
            return leaves[name]

        simulator = self.simulator
        params = {
            effect: {name: leaf(f"{effect}.{name}", value) for name, value in values.items()}
            for effect, values in simulator.defaults(dtype=self.dtype).items()
        }
        position, speed, accel = (
            leaf(name, x) for name, x in zip(("position", "speed", "accel"), self.motion, strict=True)
        )
        lap = None
        if isinstance(simulator.road, Ring):
            first, last = self.motion[0][..., 0], self.motion[0][..., -1]
            lap = (first - last + 5.0 + 20.0).to(self.dtype)
        state = simulator.state(position, speed, params, accel=accel, step=590, present=self.present, circumference=lap)
        inputs = inputs_for(simulator, self.steps, speed.detach())
        for effect, value in inputs.items():
            if isinstance(value, Tensor):
                inputs[effect] = leaf(f"input {effect}", value)
            else:
                parts = {k: v for k, v in value._asdict().items() if v is not None and v.dtype != torch.bool}
                inputs[effect] = value._replace(**{k: leaf(f"input {effect} {k}", v) for k, v in parts.items()})
        if self.presence_changes and "replay" in inputs:
            there = (torch.arange(self.steps)[:, None, None] + torch.arange(N)) % 4 > 0
            inputs["replay"] = inputs["replay"]._replace(present=there.to(self.dtype).expand(-1, *speed.shape))
        if (refusal := dispatch.refusal(simulator, state, inputs, params)) not in (None, "off"):
            raise AssertionError(refusal)
        last, kept = simulator.rollout(state, inputs, params, self.steps)
        outputs = [last.position, last.speed, last.accel, last.gap, *kept, *last.memory.values()]
        generator = torch.Generator().manual_seed(1)
        weights = [torch.rand(x.shape, generator=generator, dtype=DTYPE).to(x.dtype) - 0.3 for x in outputs]
        # A memory that is 0 or 1 has no gradient in torch, and one of zeros where it is compiled.
        outputs, weights = zip(*((x, w) for x, w in zip(outputs, weights, strict=True) if x.requires_grad), strict=True)
        found = torch.autograd.grad(list(outputs), list(leaves.values()), list(weights), allow_unused=True)
        plain = [last.position, last.speed, last.accel, last.gap, *kept, *last.memory.values()]
        if last.present is not None:
            plain.append(last.present)
        gradients = {n: torch.zeros_like(leaves[n]) if g is None else g for n, g in zip(leaves, found, strict=True)}
        return [x.detach() for x in plain], gradients


def agree(case: Case, exact: float, loose: float) -> None:
    """Assert that both paths yield the same: values to ``exact``, gradients to ``loose``, of the largest."""
    values, gradients = case.run()
    with dispatch.off("off"):
        expected, wanted = case.run()
    for i, (a, b) in enumerate(zip(values, expected, strict=True)):
        close(f"output {i}", a, b, exact)
    for name, b in wanted.items():
        close(name, gradients[name], b, loose)


def close(name: str, a: Tensor, b: Tensor, tolerance: float) -> None:
    """Assert agreement row by row: a row of large numbers excuses no other."""
    assert a.shape == b.shape and a.dtype == b.dtype, name
    assert torch.equal(torch.isfinite(a), torch.isfinite(b)), name
    a, b = (x.double().nan_to_num(0.0, 0.0, 0.0) for x in (a, b))
    scale = (b.abs().amax(-1, keepdim=True) if b.dim() > 1 else b.abs()).clamp_min(1.0)
    worst = float(((a - b).abs() / scale).max()) if a.numel() else 0.0
    assert worst <= tolerance, f"{name}: {worst:.1e} apart"


# -- the law -----------------------------------------------------------------------------------------------------


@every
def test_a_hundred_steps_of_every_member(effect: Effect) -> None:
    """And its kinks, which need no other program: one and three steps from each."""
    simulator = around(effect)
    agree(Case(simulator, lively(simulator.road), 100, torch.float64), 1e-11, 1e-9)
    for steps in (1, 3):
        agree(Case(simulator, kinks(), steps, torch.float64), 1e-12, 1e-11)


def several() -> list[list[Effect]]:
    """Return all members in groups of up to four that may drive together: no name twice, and one law of following."""
    groups: list[list[Effect]] = []
    for effect in (*MEMBERS, *MINE):
        for group in groups:
            laws = isinstance(effect, CarFollowing) and any(isinstance(e, CarFollowing) for e in group)
            if len(group) < 4 and not laws and effect.name not in {e.name for e in group}:
                group.append(effect)
                break
        else:
            groups.append([effect])
    return groups


@pytest.mark.parametrize("effects", several(), ids=lambda group: " ".join(e.name for e in group))
def test_every_member_in_single_precision_on_a_ring(effects: list[Effect]) -> None:
    """Ring, midpoint, float32; four members share a program."""
    laws = [e for e in effects if isinstance(e, CarFollowing)] or [IDM()]
    others = [e for e in effects if not isinstance(e, CarFollowing)]
    brakes = [] if any(isinstance(e, Brakes) for e in others) else [Brakes()]
    simulator = Simulator(Ring(), (*laws, *brakes, *others), integration="midpoint")
    agree(Case(simulator, lively(simulator.road), 20, torch.float32), 2e-5, 1e-3)


@pytest.mark.parametrize(
    ("integration", "road", "dtype"),
    [("ballistic", Lane(), torch.float64), ("ballistic", Ring(), torch.float32), ("euler", Ring(), torch.float64),
     ("euler", Lane(), torch.float32), ("midpoint", Lane(), torch.float64), ("midpoint", Ring(), torch.float32)],
    ids=str,
)  # fmt: skip
def test_all_effects_at_once(road: Road, integration: str, dtype: torch.dtype) -> None:
    """Whole catalogue, every pair of roads, integrations and precisions."""
    simulator = together(road, integration)
    double = dtype == torch.float64
    agree(Case(simulator, lively(road), 10, dtype), *((1e-12, 1e-11) if double else (2e-5, 2e-3)))
    if double and isinstance(road, Lane):  # vehicles that overlap fit no ring
        agree(Case(simulator, kinks(), 2, dtype), 1e-12, 1e-11)


@pytest.mark.parametrize("changes", [False, True], ids=["for good", "now and then"])
def test_absent_vehicles(changes: bool) -> None:
    """Leaders, second leaders and followers that are not there, or come and go."""
    motion = lively(Lane())
    present = torch.tensor([[1, 0, 1, 1, 0], [0, 1, 1, 0, 1]], dtype=DTYPE)
    agree(Case(together(Lane()), motion, 10, torch.float64, present, changes), 1e-12, 1e-11)


def test_alone() -> None:
    """One vehicle: nobody ahead, nobody behind."""
    motion = tuple(x[:, :1] for x in lively(Lane()))
    agree(Case(together(Lane()), motion, 10, torch.float64), 1e-12, 1e-11)
