"""Drivers behind records by printed phases against ``Simulator``: the same values, the same derivatives."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from idm_env.compiled.kernels import dispatch, drivers
from idm_env.effects import IDM, AccelNoise, Brakes, Effect, Grade, Replay, make
from idm_env.effects.base import CarFollowing, P
from idm_env.parameters import Parameter
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.types import Adjacent, Command, Driver, Imagined, Params, Record, Scene, State
from tests.laws.members import MEMBERS

ROWS, STEPS = 7, 90
INTEGRATIONS = ("ballistic", "euler", "midpoint")


class Measured:
    """Drivers behind leaders that brake to a stop and drive off; neighbours that come, go and change."""

    def __init__(
        self, effects: tuple[Effect, ...], integration: str, dtype: torch.dtype = torch.float64, **options: int
    ) -> None:
        self.rows, self.steps = options.get("rows", ROWS), options.get("steps", STEPS)
        self.generator = torch.Generator().manual_seed(options.get("seed", 3))
        self.dtype, self.samples_every = dtype, 3
        self.simulator = Simulator(Lane(), (*effects, Replay()), 0.1, integration)  # type: ignore[arg-type]
        self.needs = frozenset().union(*(e.needs for e in effects))
        comes_and_goes = bool(self.needs)
        ahead = 2 if "second_leader" in self.needs else 1
        self.driver, self.vehicles = ahead, ahead + 1 + ("behind" in self.needs)
        self.records = self.make_records(comes_and_goes)
        self.inputs = self.make_inputs(comes_and_goes)
        self.params = self.make_params()
        self.start = self.make_start()

    def draw(self, low: float, high: float, *shape: int) -> Tensor:
        return (low + (high - low) * torch.rand(*shape, generator=self.generator, dtype=torch.float64)).to(self.dtype)

    def make_records(self, comes_and_goes: bool) -> dict[str, Tensor]:
        shape = (self.rows, self.vehicles)
        time = 0.1 * torch.arange(self.steps + 1, dtype=self.dtype)[:, None, None]
        wave = torch.sin(time + self.draw(0, 6, *shape))
        speed = (self.draw(4, 12, *shape) + self.draw(0, 9, *shape) * wave).clamp_min(0)
        place = 60.0 - 25.0 * torch.arange(self.vehicles, dtype=self.dtype) + self.draw(0, 5, *shape)
        present = torch.ones(self.steps + 1, *shape, dtype=self.dtype)
        if comes_and_goes:
            present = (torch.sin(2.0 * time + self.draw(0, 6, *shape)) > -0.6).to(self.dtype)
            present[..., self.driver] = 1.0
        return {
            "position": place + torch.cumsum(0.1 * speed, 0), "speed": speed, "present": present,
            "accel": self.draw(-2, 2, self.steps + 1, *shape),
        }  # fmt: skip

    def make_inputs(self, comes_and_goes: bool) -> dict[str, object]:
        full = (self.steps, self.rows, self.vehicles)
        active = (torch.arange(self.vehicles) != self.driver).expand(full)
        record = Record(
            *(self.records[n][1:] for n in ("position", "speed", "accel")), active,
            self.records["present"][1:] if comes_and_goes else None,
        )  # fmt: skip
        every = {
            "replay": lambda: record,
            "control": lambda: Command(self.draw(-1, 1, *full), ~active),
            "imagined": lambda: Imagined(self.draw(5, 20, *full), self.draw(-1, 1, *full)),
            "lateral": lambda: Adjacent(
                self.draw(-20, 20, *full), self.draw(0, 9, *full), (self.draw(0, 1, *full) > 0.4).to(self.dtype)
            ),
        }
        given = {name: make() for name, make in every.items() if name in self.simulator.by_name}
        return self.simulator.drawn(self.records["speed"][0], given, self.steps, seed=3)

    def make_params(self) -> dict[str, dict[str, Tensor]]:
        made: dict[str, dict[str, Tensor]] = {}
        for effect in self.simulator.effects:
            made[effect.name] = {}
            for p in effect.parameters:
                low, high = max(p.low, p.default - 0.4 * abs(p.default)), min(p.high, p.default + 0.4 * abs(p.default))
                made[effect.name][p.name] = self.draw(low, high if high > low else low + 0.1, self.rows, 1)
        return made

    def make_start(self) -> State:
        now = {n: x[0] for n, x in self.records.items()}
        present = now["present"] if "replay" in self.inputs and self.inputs["replay"].present is not None else None  # type: ignore[attr-defined]
        return self.state(self.params, now, present)

    def state(self, params: Params, now: dict[str, Tensor] | None = None, present: Tensor | None = None) -> State:
        now = now or {n: x[0] for n, x in self.records.items()}
        if present is None and self.needs:
            present = now["present"]
        return self.simulator.state(
            now["position"], now["speed"], params, accel=now["accel"], present=present,
            length=torch.tensor(4.5, dtype=self.dtype), step=torch.arange(self.rows) + 580,
        )  # fmt: skip

    @property
    def behind(self) -> drivers.BehindRecord:
        made = drivers.prepared(self.simulator, self.start, self.records, self.inputs, self.driver)
        assert not isinstance(made, str), made
        return made

    # -- both ways -----------------------------------------------------------------------------------------------

    def compiled(self, state: State, params: Params) -> tuple[Tensor, Tensor]:
        return self.behind.simulate(state, params, self.samples_every)

    def by_torch(self, state: State, params: Params) -> tuple[Tensor, Tensor]:
        with dispatch.off():
            _, kept = self.simulator.rollout(
                state, self.inputs, params, self.steps,
                keep=lambda s: (s.gap[..., self.driver], s.speed[..., self.driver]),
            )  # fmt: skip
        every = self.samples_every
        return kept[0][every - 1 :: every], kept[1][every - 1 :: every]

    def leaves(self) -> tuple[State, dict[str, dict[str, Tensor]], dict[str, Tensor]]:
        """Return a start and parameters of leaf tensors, and those leaves by name."""
        params = {e: {n: x.clone().requires_grad_() for n, x in p.items()} for e, p in self.params.items()}
        found = {f"{e}.{n}": x for e, p in params.items() for n, x in p.items()}
        state = self.state(params)
        own = torch.arange(self.vehicles) == self.driver
        for name in ("gap", "speed", "accel"):
            leaf = getattr(state, name).detach()[..., self.driver].clone().requires_grad_()
            found[f"start {name}"] = leaf
            state = state._replace(**{name: torch.where(own, leaf[..., None], getattr(state, name))})
        return state, params, found


def close(ours: Tensor, theirs: Tensor, dtype: torch.dtype, what: str = "", double: float = 1e-9) -> None:
    scale = theirs.detach().abs().max().clamp_min(1.0)
    error = float((ours.detach() - theirs.detach()).abs().max() / scale)
    assert error < (5e-4 if dtype == torch.float32 else double), (what, error)


def groups() -> Iterator[tuple[Effect, ...]]:
    """Yield all members of the laws' list, as many different ones at once as go together."""
    left = [m for m in MEMBERS if not isinstance(m, Replay)]
    while left:
        taken: list[Effect] = []
        following = next((m for m in left if isinstance(m, CarFollowing)), IDM())
        for m in (following, *left):
            free = m.name not in {t.name for t in taken} and not (isinstance(m, CarFollowing) and m is not following)
            if free and len(taken) < 7 and not (m.name == "imagined" and len(taken) > 3):
                taken.append(m)
        left = [m for m in left if not any(m is t for t in taken)]
        yield tuple(taken) if any(t.name == "brakes" for t in taken) else (*taken, Brakes(width=0.3))


GROUPS = list(groups())


def test_all_members_are_in_some_group() -> None:
    missing = [m for m in MEMBERS if not isinstance(m, Replay) and not any(m in g for g in GROUPS)]
    assert not missing


FEW = (IDM(), Brakes(), make("delay"), make("memory"), make("second_leader"))
OF_RECORDS = (IDM(), *(m for m in MEMBERS if m.name == "curve_over_lead_change_3s"), Brakes())
"""What is seen of the past is the leader's alone: nothing of it has an adjoint."""


@pytest.mark.parametrize(
    ("effects", "integration"),
    [(g, INTEGRATIONS[i % 3]) for i, g in enumerate(GROUPS)]
    + [(FEW, "euler"), (FEW, "midpoint"), (OF_RECORDS, "euler")],
    ids=lambda x: x if isinstance(x, str) else "+".join(e.name for e in x),
)
def test_values_and_derivatives_are_the_simulators(effects: tuple[Effect, ...], integration: str) -> None:
    """Rollout, its gradient in start and parameters, and the Jacobian by all parameters."""
    measured = Measured(effects, integration)
    state, params, leaves = measured.leaves()
    ours, theirs = measured.compiled(state, params), measured.by_torch(state, params)
    for name, a, b in zip(("gap", "speed"), ours, theirs, strict=True):
        close(a, b, torch.float64, name)
    seeds = [measured.draw(-1, 1, *x.shape) for x in ours]
    found = []
    for out in (ours, theirs):
        total = sum((x * s).sum() for x, s in zip(out, seeds, strict=True))
        assert isinstance(total, Tensor)
        found.append(torch.autograd.grad(total, list(leaves.values()), retain_graph=True, allow_unused=True))
    for name, a, b in zip(leaves, *found, strict=True):
        zero = torch.zeros_like(leaves[name])
        close(zero if a is None else a, zero if b is None else b, torch.float64, name, 1e-8)
    names = tuple(n for n in leaves if "." in n)
    names = names[:: -(-len(names) // 9)]
    values = {n: leaves[n][:, 0].detach().clone().requires_grad_() for n in names}
    again = {
        e: {n: values[f"{e}.{n}"][:, None] if f"{e}.{n}" in values else x for n, x in p.items()}
        for e, p in measured.params.items()
    }
    start = measured.state(again)
    along = measured.behind.start_by(start, values)
    gap, speed, gap_by, speed_by = measured.behind.sensitivities(start, again, names, 3, start_by=along)
    plain = measured.compiled(measured.state(measured.params), measured.params)
    assert torch.equal(gap, plain[0]) and torch.equal(speed, plain[1])
    jacobian = measured.by_torch(start, again)
    for signal, by in zip(jacobian, (gap_by, speed_by), strict=True):
        for t in (0, len(signal) // 2, len(signal) - 1):
            # Drivers do not act on each other, so the derivative of the sum over drivers is every driver's own.
            row = torch.autograd.grad(signal[t].sum(), list(values.values()), retain_graph=True, allow_unused=True)
            for j, (name, slope) in enumerate(zip(names, row, strict=True)):
                close(by[t, j], torch.zeros_like(by[t, j]) if slope is None else slope, torch.float64, name, 1e-8)


@pytest.mark.parametrize("rows", [1, 300])
def test_float32_and_tiles(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Single precision, more rows than a tile holds, several copies of them, and threads."""
    for dtype in (torch.float32, torch.float64):
        measured = Measured(FEW, "ballistic", dtype, rows=rows, steps=150)
        params = {e: {n: torch.stack((x, 0.9 * x, 1.1 * x)) for n, x in p.items()} for e, p in measured.params.items()}
        shape = (3, rows, measured.vehicles)
        start = {n: x[0].expand(shape) for n, x in measured.records.items()}
        state = measured.state(params, start, start["present"])
        ours = measured.compiled(state, params)
        for a, b in zip(ours, measured.by_torch(state, params), strict=True):
            close(a, b, dtype)
        for threads in (1, 3):
            monkeypatch.setattr(torch, "get_num_threads", lambda many=threads: many)
            again = measured.behind.simulate(state, params, 3)
            assert all(torch.equal(a, b) for a, b in zip(again, ours, strict=True))


def test_normal_equations_are_those_of_the_jacobian() -> None:
    measured = Measured(FEW, "midpoint", rows=40)
    names = ("idm.time_gap", "delay.delay", "memory.strength", "second_leader.weight")
    arguments = (measured.start, measured.params, names)
    shape = (2, STEPS // 3, 40)
    targets, weights = measured.draw(0, 20, *shape), measured.draw(0, 1, *shape)
    gap, speed, gap_by, speed_by = measured.behind.sensitivities(*arguments, 3)
    for looked_at in ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0)):
        w = weights * torch.tensor(looked_at, dtype=torch.float64)[:, None, None]
        residual = torch.cat((w[0] * (gap - targets[0]), w[1] * (speed - targets[1])))
        jacobian = torch.cat((w[0][:, None] * gap_by, w[1][:, None] * speed_by))
        cost, gradient, normal = measured.behind.normal_equations(*arguments, targets, w, 3)
        torch.testing.assert_close(cost, residual.square().sum(0))
        torch.testing.assert_close(gradient, torch.einsum("tjb,tb->bj", jacobian, residual))
        torch.testing.assert_close(normal, torch.einsum("tjb,tkb->bjk", jacobian, jacobian))


@dataclasses.dataclass(frozen=True)
class Impatience(Effect):
    """An effect that the package has never seen: a memory of standing, and a look at the past."""

    kind: ClassVar[str] = "impatience"
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("gain", "g", "1", 0.3, -2.0, 2.0, null=0.0),)

    @property
    def looks_back(self) -> float:
        return 0.6

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        return p["gain"] * driver.time_gap + 0.0 * scene.speed

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        earlier = scene.past(0.0 * p["gain"] + 0.35)
        return p["gain"] * scene.memory[self.name] * torch.tanh(scene.speed - earlier.speed)

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        return 0.95 * scene.memory[self.name] + 0.05 * torch.exp(-scene.speed)


@pytest.mark.parametrize("integration", INTEGRATIONS)
def test_an_unknown_effect_is_compiled_too(integration: str) -> None:
    test_values_and_derivatives_are_the_simulators((IDM(), Brakes(), Impatience()), integration)


@dataclasses.dataclass(frozen=True)
class Branching(Effect):
    """One that cannot be recorded."""

    kind: ClassVar[str] = "branching"
    declared: ClassVar[tuple[Parameter, ...]] = Impatience.declared

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        return p["gain"] * scene.speed if (scene.speed > 3.0) else 0.0 * scene.speed


def test_what_cannot_be_recorded_says_why() -> None:
    measured = Measured((IDM(), Brakes(), Branching()), "ballistic")
    with pytest.warns(UserWarning, match="the torch path runs instead: effect 'branching' uses a Python `if`"):
        why = drivers.prepared(measured.simulator, measured.start, measured.records, measured.inputs, measured.driver)
    assert isinstance(why, str) and "branching" in why


def test_neighbours_must_be_records() -> None:
    measured = Measured((IDM(), Brakes()), "ballistic")
    record = measured.inputs["replay"]
    assert isinstance(record, Record)
    loose = {"replay": record._replace(active=torch.zeros_like(record.active))}
    why = drivers.prepared(measured.simulator, measured.start, measured.records, loose, measured.driver)
    assert why == "some neighbour is no record"


def test_noise_and_grades_are_inputs_and_places() -> None:
    """Drifting acceleration has a memory; a grade reads the driver's own position, which then is a state."""
    grade = Grade(profile=(0.0, 0.02, -0.03, 0.01, 0.0))
    measured = Measured((IDM(), Brakes(), AccelNoise(), grade), "ballistic")
    assert "position" in measured.behind.kernel.program.states
    assert "position" not in Measured((IDM(), Brakes()), "ballistic").behind.kernel.program.states
    np.testing.assert_allclose(
        measured.compiled(measured.start, measured.params)[0], measured.by_torch(measured.start, measured.params)[0],
        atol=1e-9,
    )  # fmt: skip
