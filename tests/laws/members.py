"""The members that every law runs over: one of each effect, and the variants that its static choices make."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from idm_env.effects import ALL, IDM, Brakes, CarFollowing, Curve, DriverCurve, Effect, Grade, PerceptionNoise, Wander
from idm_env.effects.free import FEATURES, PER
from idm_env.roads import Lane, Ring, Road
from idm_env.roads.merging import MERGER_GAP, MERGER_SPEED
from idm_env.simulator import Simulator
from idm_env.types import FAR, Adjacent, Command, Imagined, Params, Record, State

N = 5
DTYPE = torch.float64

MEMBERS: list[Effect] = [
    *(cls() for cls in ALL.values() if cls.hook != "change"),  # those are refused on one lane
    IDM(exponent=None),
    IDM(sharpness=1.0),
    Brakes(sharpness=1.0),
    Grade(profile=(0.0, 0.02, -0.03, 0.01, 0.0)),
    Grade(period=1200.0),
    Wander(of="desired_speed"),
    Wander(of="min_gap"),
    PerceptionNoise(signal="closing_speed"),
    *(Curve(feature=f, knots=(-1.0, 3.0, 8.0, 15.0)) for f in FEATURES),
    *(kind(feature="gap", by=state) for kind, state in zip((Curve, DriverCurve) * 3, PER, strict=False)),
    *(DriverCurve(target=t) for t in ("desired_speed", "max_accel", "comfort_decel", "min_gap")),
]


def label(effect: Effect) -> str:
    """Return a readable test id."""
    return repr(effect).replace(" ", "")


def around(effect: Effect, road: Road | None = None, **options: object) -> Simulator:
    """Return a simulator of IDM and Brakes with ``effect`` in it, in the place of IDM if it is car-following."""
    following = () if isinstance(effect, CarFollowing) else (IDM(),)
    base = [e for e in (*following, Brakes()) if e.name != effect.name]
    return Simulator(road or Lane(), (*base, effect), **options)  # type: ignore[arg-type]


def start(simulator: Simulator, params: Params, dtype: torch.dtype = DTYPE, batch: tuple[int, ...] = ()) -> State:
    """Return a lively platoon: uneven gaps, speeds and accelerations, at 120 m and 3 s, so that places matter."""
    generator = torch.Generator().manual_seed(7)
    wiggle = torch.rand((*batch, N), generator=generator, dtype=DTYPE)
    position = 320.0 - 22.0 * torch.arange(N, dtype=DTYPE) + 4.0 * wiggle
    speed = 9.0 + 4.0 * torch.rand((*batch, N), generator=generator, dtype=DTYPE)
    accel = torch.rand((*batch, N), generator=generator, dtype=DTYPE) - 0.6
    around = 400.0 if isinstance(simulator.road, Ring) else None
    return signalled(
        simulator.state(
            position.to(dtype), speed.to(dtype), params, accel=accel.to(dtype), step=590, circumference=around
        )
    )


def signalled(state: State) -> State:
    """Return a state in which somebody signals beside all but the first, where drivers look at that."""
    if MERGER_GAP not in state.memory:
        return state
    first = torch.arange(state.speed.shape[-1]) == 0
    seen = {MERGER_GAP: torch.where(first, FAR, 4.0 + state.position.remainder(9.0)), MERGER_SPEED: 0.8 * state.speed}
    return state._replace(memory={**state.memory, **seen})


def inputs_for(simulator: Simulator, steps: int, like: Tensor) -> dict[str, object]:
    """Return lively inputs for every effect of the simulator that takes one, time first."""
    generator = torch.Generator().manual_seed(11)

    def draw() -> Tensor:
        return torch.rand((steps, *like.shape), generator=generator, dtype=DTYPE).to(like.dtype)

    first = (torch.arange(like.shape[-1]) == 0).expand(steps, *like.shape)
    time = torch.arange(1, steps + 1, dtype=DTYPE).reshape(-1, *([1] * like.dim()))
    every = {
        "control": lambda: Command(draw() - 0.5, first),
        "replay": lambda: Record(
            (320.0 + 8.0 * simulator.dt * time + 0 * draw()).to(like.dtype), 8.0 + 0 * draw(), 0 * draw(), first
        ),
        "imagined": lambda: Imagined(10.0 + 5.0 * draw(), draw() - 0.5),
        "lane_command": lambda: draw().round(),
        "lateral": lambda: Adjacent(20.0 * (draw() - 0.5), 6.0 + draw(), torch.ones_like(draw())),
    }
    given = {name: make() for name, make in every.items() if name in simulator.by_name}
    return simulator.drawn(like, given, steps, seed=11)


def with_leaves(params: Params, effect: str) -> tuple[dict[str, dict[str, Tensor]], dict[str, Tensor]]:
    """Return params whose ``effect`` has leaf tensors, and those leaves."""
    leaves = {name: value.clone().requires_grad_() for name, value in params[effect].items()}
    return {**params, effect: leaves}, leaves  # type: ignore[dict-item]


def at_null(effects: Iterable[Effect]) -> dict[str, dict[str, Tensor]]:
    """Return defaults with every parameter that has a null set to it: each such effect is absent."""
    return {
        e.name: {p.name: torch.tensor(p.default if p.null is None else p.null, dtype=DTYPE) for p in e.parameters}
        for e in effects
    }
