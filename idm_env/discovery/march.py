"""Discovery's rollout of one driver behind a record, with a whole catalogue of effects in one compiled loop.

Discovery rolls out the same records some thousand times with small changes of parameters. So one step of a real
simulator, ``Simulator(Lane(), (base, every candidate, Brakes()), dt, "midpoint")``, is recorded and printed into the
loop of ``march_loops``, each effect behind a flag; absent effects cost one comparison. No equation stands here.

Parameters of a row are a flat vector φ, laid out by a ``Catalogue``; behind them come tables of ``ROOM`` numbers, each
``[first knot or begin, knots per unit or end, edge, period, values …]``: ``SLOTS`` for what has no name, then one for
every effect with a profile.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from idm_env import delay_buffer, effects as known
from idm_env.compiled.kernels import record_lanes, threads
from idm_env.compiled.kernels.record_lanes import COLUMNS as COLUMNS
from idm_env.compiled.records import march_loops
from idm_env.compiled.scalar import library
from idm_env.compiled.scalar.graph import Leaf, TimeStep
from idm_env.compiled.scalar.record import Form, Recording, Untraceable, record, slot_name
from idm_env.compiled.scalar.regions import Flagged, Regions
from idm_env.compiled.scalar.straight import Straight
from idm_env.discovery.slots import SETS, TARGETS, Push, Slot as Changed
from idm_env.effects import IDM, Brakes, CarFollowing, Effect
from idm_env.effects.free import FEATURES, PER
from idm_env.parameters import Parameter
from idm_env.roads import Lane
from idm_env.step import CarFollowingStep

ROOM = march_loops.ROOM
BASE = IDM()
"""The car-following law unless another one is named."""
SLOTS = 4
"""Curves and intervals without a name that a model can have at once."""
NONE, CURVE, INTERVAL = 0, 1, 2
PULSE, PAST = "pulse", "past"
"""Slots of a pulse, and of the one curve over a feature of the past that a model can have."""
PULSED = ("acceleration", "time_gap", "desired_speed", "accel_and_decel")
"""What a short pulse can change."""


def _column(name: str) -> str:
    return f"state[COLUMN + {COLUMNS.index(name)}]"


_SEEN: dict[Leaf, str] = {Leaf(n): f"state[{n.upper()}]" for n in ("speed", "accel", "gap", "length", "step")}
_SEEN |= {Leaf("position"): "state[PLACE]", Leaf("led"): "1.0", Leaf("led", 1): _column("second_present")}
_SEEN |= {Leaf("speed", 1): "state[LEAD_SPEED]", Leaf("accel", 1): "state[LEAD_ACCEL]"}
# A gap to the second leader is counted from the leader's rear, whose length is then not needed.
_SEEN |= {Leaf("length", 1): "0.0", Leaf("gap", 1): f"({_column('second_rear')} - {_column('lead_rear')})"}
_SEEN |= {Leaf("speed", 2): _column("second_speed"), Leaf("accel", 2): _column("second_accel")}
_SEEN |= {Leaf("leads"): _column("behind_present"), Leaf("led", -1): "1.0"}
_SEEN |= {Leaf("gap", -1): f"(state[POSITION] - state[LENGTH] - {_column('behind_front')})"}
_SEEN |= {Leaf("speed", -1): _column("behind_speed"), Leaf("accel", -1): _column("behind_accel")}
"""Where the loop has what a step reads."""
_BESIDE = {name: _column(f"beside_{name}") for name in ("distance", "speed", "present")}


PINNED = 1.0001
"""Upper bound over the lower one of a parameter that stays where it is."""


@dataclass(frozen=True)
class Catalogue:
    """A car-following law and candidates as the loop has them, and how θ, φ and the flags are laid out.

    θ are the law's parameters, each driver's own, and the strengths of the effects ``personal``. Those of the law that
    it is tried ``without`` stay at their low bounds. ``located`` says whether there is room for what has no name;
    a loop without it compiles in a fraction of the time.
    """

    effects: tuple[Effect, ...]
    base: CarFollowing = BASE
    located: bool = True
    personal: tuple[str, ...] = ()
    without: tuple[str, ...] = ()

    @classmethod
    def of(cls, effects: Sequence[Effect] = (), period: float = 0.0, base: CarFollowing = BASE) -> Catalogue:
        """Return the package's candidates and ``effects``, which replace those of the same name, on a lap (m)."""
        by_name = {e.name: e for e in (*(known.make(name) for name in known.CANDIDATES), *effects)}
        return cls(tuple(_on_lap(e, period) for e in by_name.values()), base)

    @property
    def own(self) -> tuple[Parameter, ...]:
        """Declarations of θ."""
        return tuple(p for _, p in self.of_driver)

    @cached_property
    def of_driver(self) -> tuple[tuple[str, Parameter], ...]:
        """Effect and declaration of every entry of θ."""
        pinned = {
            p: replace(p, default=p.low, high=PINNED * p.low) for p in self.base.declared if p.name in self.without
        }
        law = ((self.base.name, pinned.get(p, p)) for p in self.base.declared)
        return (*law, *((name, p) for name in self.personal for p in self.by_name[name].parameters))

    def at_bounds(self, theta: np.ndarray) -> dict[str, int]:
        """Return how many groups have each of the drivers' parameters at a bound, in any of their log θ [..., G, P]."""
        low, high = self.bounds.T
        count = ((theta < low + 1e-3) | (theta > high - 1e-3)).reshape(-1, *theta.shape[-2:]).any(0).sum(0)
        return {p.name: int(n) for p, n in zip(self.own, count, strict=True) if p.name not in self.without}

    @cached_property
    def bounds(self) -> np.ndarray:
        """Bounds of log θ [P, 2]."""
        return np.log(np.array([(p.low, p.high) for p in self.own]))

    @cached_property
    def by_name(self) -> dict[str, Effect]:
        """Candidates by name."""
        return {e.name: e for e in self.effects}

    @cached_property
    def flagged(self) -> tuple[Effect, ...]:
        """Everything behind a flag, adaptations in the order in which they act."""
        labels = (*map(str, range(SLOTS)), PAST, PULSE) if self.located else ()
        slots = [kind for label in labels for kind in _slots(label)]
        return tuple(sorted((*self.effects, *slots), key=lambda e: e.rank if e.hook == "adapt" else 0))

    @cached_property
    def flags(self) -> dict[str, int]:
        """Place of every effect's flag."""
        return {e.name: i for i, e in enumerate(self.flagged)}

    @cached_property
    def index(self) -> dict[str, int]:
        """Place in φ of every parameter, by full name."""
        names = [f"{e.name}.{p.name}" for e in (*self.flagged, Brakes()) for p in e.parameters]
        return {name: i for i, name in enumerate(names)}

    @cached_property
    def null(self) -> np.ndarray:
        """Parameters at their nulls, others at their defaults, and empty tables."""
        declared = [p for e in (*self.flagged, Brakes()) for p in e.parameters]
        values = [p.default if p.null is None else p.null for p in declared]
        return np.append(np.array(values), np.zeros(ROOM * len(self.tables)))

    @cached_property
    def tables(self) -> dict[str, int]:
        """Number of the table of every slot ("0", "1", …) and of every effect with a profile."""
        profiles = [e.name for e in self.effects if e.sought in ("profile", "given")]
        unnamed = (*map(str, range(SLOTS)), PAST) if self.located else ()
        return {name: i for i, name in enumerate((*unnamed, *profiles))}

    def table_at(self, name: str) -> int:
        """Return where a table begins in φ."""
        return len(self.index) + ROOM * self.tables[name]

    def shape(self, what: str, coordinate: str, label: str, by: str = "") -> tuple[str, dict[str, float]]:
        """Return which effect stands for a change of ``what`` over a coordinate in a slot, and what φ says of it.

        ``by`` is the state that the change is proportional to, "" for none.
        """
        changed = TARGETS.get(what, ())
        slots = {e.targets if isinstance(e, Changed) else (): e for e in _slots(label)}
        effect = slots[next((t for t in slots if set(t) & set(changed)), ())]
        flags = {"over": float(list(FEATURES).index(coordinate))} if coordinate else {}
        flags |= {"by": 1.0 + list(PER).index(by)} if by else {}
        flags |= {n: float(n in changed) for n in (effect.targets if isinstance(effect, Changed) else ())}
        return effect.name, {f"{effect.name}.{name}": value for name, value in flags.items()}


def _slots(label: str) -> tuple[Changed | Push, ...]:
    choices = {"label": label, "given": label == PULSE, "past": label == PAST}
    return (*(Changed(**choices, targets=t) for t in SETS), Push(**choices))  # type: ignore[arg-type]


def _on_lap(effect: Effect, period: float) -> Effect:
    """Return an effect of places on a lap; the lap's length is kept apart from other constants, as the time step is."""
    if period and any(f.name == "period" for f in fields(effect)):
        return replace(effect, period=TimeStep(period))  # type: ignore[call-arg]
    return effect


def default_catalogue() -> Catalogue:
    """Return the package's candidates and those that are registered."""
    return _default(known.candidates())


@lru_cache(maxsize=8)
def _default(names: tuple[str, ...]) -> Catalogue:
    return Catalogue.of([known.make(name) for name in names])


@dataclass(frozen=True, eq=False)
class Loop:
    """A catalogue's compiled loop for one time step; ``reads`` gives its inputs' texts for effects at work."""

    catalogue: Catalogue
    text: str
    varying: np.ndarray
    reads: Callable[[frozenset[str]], list[str]]

    @lru_cache(maxsize=64)  # noqa: B019 (loops are kept as long)
    def _read(self, working: frozenset[str]) -> tuple[np.ndarray, ...]:
        """Return the places in φ, and the columns of others, that a step reads with these effects at work."""
        text = " ".join(self.reads(working))
        numbers = (re.findall(form, text) for form in (r"\bp\[(\d+)\]", r"COLUMN \+ (\d+)\]"))
        return tuple(np.array(sorted({int(x) for x in each}), np.int64) for each in numbers)

    def roll(
        self, rows: Any, theta: np.ndarray, phi: np.ndarray, on: np.ndarray, tables: np.ndarray, pulse: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return gap and speed [C, R, samples] of rows; θ [C, G, P], φ [C, G, …], ``pulse`` [C, 4] or [0, 4]."""
        records, module = rows.records, library.load("march", self.text)
        working = [e for e, is_on in zip(self.catalogue.flagged, on, strict=True) if is_on]
        is_wound, lead = lead_steps(working, records.dt)
        reads = self._read(frozenset(e.name for e in working))
        law: tuple[Any, ...] = records.length, theta, phi.reshape(-1, phi.shape[-1]), on, *reads, tables
        law += back_steps(working, records.dt), records.dt, self.varying
        wound, out = np.zeros((0, 0, 0)), np.empty((2, len(theta), len(rows), rows.steps // rows.every))

        def split(record: np.ndarray, start: np.ndarray, steps: int, work: int, *winding: np.ndarray) -> None:
            arguments: tuple[Any, ...] = records.signals, records.bounds, record, start, records.group[record], *law
            arguments += lead, steps, rows.every, pulse, *winding, wound, *out
            tiles = -(-len(theta) * len(record) // record_lanes.LANES)
            count = threads.count(record_lanes.LANES * tiles * work)
            threads.split(lambda begin, end: module.march(*arguments, begin, end), tiles, 1, count)

        settle = np.maximum(records.bounds[rows.record], rows.start - lead)
        if is_wound and module.MEMORIES:
            wound = np.empty((len(theta), len(rows), module.MEMORIES))
            order = np.lexsort((settle, rows.record))
            record, ends = np.unique(rows.record[order], return_index=True)
            ends = np.append(ends, len(rows))
            last = settle[order[ends[1:] - 1]]
            split(record, last, 1, int((last - records.bounds[record]).max(initial=0)), ends, order, settle)
        split(rows.record, rows.start, rows.steps, rows.steps, *np.zeros((3, 0), np.int64))
        return out[0], out[1]


def why_not_recorded(effect: Effect, dt: float = 0.1) -> str | None:
    """Return why an effect cannot be put into the loop, or None."""
    try:
        loop(Catalogue((effect,)), dt)
    except (Untraceable, ValueError) as error:
        return str(error)
    return None


def pulsed(catalogue: Catalogue, pulse: np.ndarray, on: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Set flags [flags] and weights of pulses [copies, 4]: place in ``PULSED`` + 1 or 0, first step, end step, amount.

    Returns what the loop takes of them [copies, 4]: steps, and the amount as a change or as a push. All copies have the
    same flags: a push has no weight that would keep it from the others.
    """
    steps = np.column_stack([pulse[:, 1:], np.zeros(len(pulse))])
    for copy in np.flatnonzero(pulse[:, 0]):
        what = PULSED[int(pulse[copy, 0]) - 1]
        name, weights = catalogue.shape(what, "", PULSE)
        on[catalogue.flags[name]] = 1
        if what == "acceleration":
            steps[copy, 2:] = 0.0, pulse[copy, 3]
        for weight, value in weights.items():
            phi[copy, :, catalogue.index[weight]] = value
    return steps


def back_steps(effects: Sequence[Effect], dt: float) -> int:
    """Return how many steps of the past some effects look back."""
    seconds = max((e.looks_back for e in effects), default=0.0)
    return delay_buffer.slots(seconds, dt) + 1 if seconds else 0


@lru_cache(maxsize=64)
def loop(catalogue: Catalogue, dt: float) -> Loop:
    """Return the loop of a catalogue; recorded and printed once per process, compiled once per printed text.

    ValueError for an effect that reads what records do not show.
    """
    graph = Regions()
    recorded = _recorded(catalogue, dt, graph)
    read_tables = {node.label for node in graph.serial if node.op == "table"}
    for name, number in catalogue.tables.items():
        if number not in read_tables:
            raise ValueError(f"effect '{name}' is a profile and does not read it by effects.places.curve.")
    memories = list(recorded.begin)
    driver = {f"{name}.{p.name}": f"th[{i}]" for i, (name, p) in enumerate(catalogue.of_driver)}
    inputs = {slot_name(e.name, ""): f"state[{'PUSH' if isinstance(e, Push) else 'PULSE'}]" for e in _slots(PULSE)}
    for effect in catalogue.effects:
        inputs |= {slot_name(effect.name, part): text for part, text in _BESIDE.items()}

    def read(slot: Leaf) -> str:
        name = slot.name
        if slot in _SEEN:
            return _SEEN[slot]
        if slot.shift == 0 and name.startswith("on "):
            return f"flags[{catalogue.flags[name[3:]]}]"
        if slot.shift == 0 and name.startswith("memory of "):
            return f"memory[{memories.index(name[10:])}]"
        if slot.shift == 0 and name in inputs:
            return inputs[name]
        if slot.shift == 0 and name in driver:
            return driver[name]
        if slot.shift == 0 and name in catalogue.index:
            return f"p[{catalogue.index[name]}]"
        raise ValueError(f"it reads '{name}' of a vehicle that records do not show.")

    straight = Straight(graph, read)
    after = recorded.respond
    moved = [(f"moved[{name.upper()}]", after[name]) for name in ("displacement", "speed", "accel")]
    remembered = [(f"memory[{j}]", after[f"memory of {m}"]) for j, m in enumerate(memories)]
    blocks = {
        "sense": straight.lines([(f"h[now, {j}]", node) for j, node in enumerate(recorded.sense)]),
        "beginning": straight.lines([(f"moved[{3 + j}]", recorded.begin[m]) for j, m in enumerate(memories)]),
        "wind": straight.lines(remembered),
        "respond": straight.lines([*moved, *remembered]),
    }
    blocks["constants"] = straight.constants()
    text = Path(march_loops.__file__).read_text(encoding="utf-8")
    counts = f"SIGNALS, MEMORIES, CONSTANTS = {max(len(recorded.sense), 1)}, {len(memories)}, {straight.kept}\n"
    text = text.replace("compiled = ", f"{counts}compiled = ", 1)
    for name, lines in blocks.items():
        marks = f"    # <{name}>\n    # </{name}>\n"
        assert marks in text, name
        text = text.replace(marks, "".join(f"    {line}\n" for line in lines))
    every = [*after.values(), *recorded.sense, *recorded.begin.values()]
    varying = np.array([float(x) for x in straight.varying.values] or [0.0])
    return Loop(
        catalogue, text, varying, lambda names: [read(x) for x in straight.leaves(every, {f"on {n}" for n in names})]
    )


def _recorded(catalogue: Catalogue, dt: float, graph: Regions) -> Recording:
    tables = catalogue.tables
    wrapped = []
    for effect in catalogue.flagged:
        table = tables.get(getattr(effect, "label", "") if isinstance(effect, (Changed, Push)) else effect.name)
        wrapped.append(Flagged(effect, graph, f"on {effect.name}", table))
    adjacent = [e.name for e in catalogue.effects if e.beyond == "vehicle in an adjacent lane"]
    inputs = [(name, tuple(_BESIDE), (False,) * len(_BESIDE)) for name in adjacent]
    inputs += [(e.name, ("",), (False,)) for e in (_slots(PULSE) if catalogue.located else ())]
    memories = tuple(e.name for e in catalogue.flagged if e.remembers)
    stepping = CarFollowingStep(Lane(), (catalogue.base, *wrapped, Brakes()), dt, "midpoint")  # type: ignore[arg-type]
    return record(stepping, Form(tuple(inputs), memories, present=False), graph)


def lead_steps(effects: Sequence[Effect], dt: float) -> tuple[bool, int]:
    """Return whether memories are wound up from a record's beginning, and for how many steps a driver settles on it."""
    seconds = [e.wind_up_s for e in effects]
    return math.inf in seconds, round(max([Effect.wind_up_s, *(s for s in seconds if s < math.inf)]) / dt)
