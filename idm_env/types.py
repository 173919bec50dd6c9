"""The nouns of the simulator: the one statement of shapes, signs and units.

Shapes
    The last dimension is vehicles, front first: the leader of vehicle ``i`` of a lane is vehicle ``i - 1``.
    Leading dimensions are batch. Anything that broadcasts against ``(..., vehicles)`` is accepted.
Signs and units
    SI. Position is the front bumper along the lane (m); a gap is bumper to bumper,
    ``position[leader] - length[leader] - position`` (m); closing speed is ``speed - lead_speed``, positive when
    approaching (m/s).
Nobody there
    A missing neighbour has ``present == 0``, a gap of ``FAR`` and the driver's own speed: no infinities, no
    NaN, and with the mask no interaction at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

Tree = TypeVar("Tree")
"""A tensor, None, or a tuple or mapping of trees."""

_CONSTANTS: dict[tuple[Any, ...], Tensor] = {}
_RECORDED: ContextVar[bool] = ContextVar("recorded", default=False)

FAR = 1e4
"""Gap to a neighbour that is not there (m): finite, so that nothing downstream meets an infinity."""

ENTRY_SPEED = 20.0
"""Speed that a trip asks for at the entry (m/s), where nothing else is said."""

Params = Mapping[str, Mapping[str, Tensor]]
"""Effect name → parameter name → tensor that broadcasts against ``(..., vehicles)``."""

Inputs = Mapping[str, Any]
"""Effect name → what that effect takes from outside at this step (a tensor or a tuple of tensors)."""

Memory = Mapping[str, Tensor]
"""Effect name → state of its own that the effect carries from step to step."""


class LaneState(NamedTuple):
    """Part of a state on a road of several lanes: links, which are integer tensors of shape ``(..., vehicles)``.

    ``lane`` counts from the right, which is 0. ``leader`` and ``follower`` are slots in the last dimension, a vehicle's
    own slot where there is nobody (on a ring: nobody but itself), so that a leader's follower is oneself. ``changed``,
    ``refused`` and ``blocked`` count what became of each vehicle's wishes for another lane: done; lost to a better
    claim on the same gap; not possible, because there was no lane or no room that is safe. ``unjudged`` are changes in
    front of another follower than the one who was judged, because he changed himself at the same time.

    ``trips`` is None where nobody comes: otherwise who is not present waits for his trip, or has made it. ``moving`` is
    None until a decision about lanes is made that takes time to do. On a network, where ``lane`` is the link,
    ``journeys`` say where everybody is going.
    """

    lane: Tensor
    leader: Tensor
    follower: Tensor
    changed: Tensor
    refused: Tensor
    blocked: Tensor
    unjudged: Tensor
    trips: Trips | None = None
    moving: Moving | None = None
    journeys: Journeys | None = None


LINKS: tuple[str, ...] = LaneState._fields[:7]
"""The links of a ``LaneState``: one whole number of each for every vehicle."""


class Trips(NamedTuple):
    """When every slot's vehicle wants to drive, and how often it has: tensors that broadcast to ``(..., vehicles)``.

    ``departs`` is when the first trip is due (s), ``again`` after how long the next one is (s; infinity for never, 0
    for as soon as it has left), ``lane`` where it enters, ``speed`` at which, if there is room (m/s). ``entered`` and
    ``left`` count what was done.
    """

    departs: Tensor
    again: Tensor
    lane: Tensor
    speed: Tensor
    entered: Tensor
    left: Tensor

    @classmethod
    def from_table(cls, frame: Any, dtype: torch.dtype = torch.float32) -> Trips:
        """Return one trip for each row of a table, none of them made again, in the order of departure.

        ``frame`` gives columns by name, as a ``DataFrame`` or a mapping does: ``depart`` (s), ``lane`` (0 on the
        right), and ``speed`` at the entry (m/s), 20 without that column. Others are for ``idm_env.tasks.trip_table``.

        Raises:
            ValueError: In one line, for columns that are missing, empty or of different lengths, or for a value that
                no trip has.
        """
        names = list(getattr(frame, "columns", frame))
        for name in ("depart", "lane"):
            if name not in names:
                raise ValueError(f"trips need a column '{name}'. Columns: depart, lane, speed.")
        counts = {len(frame[name]) for name in names}
        if len(counts) > 1 or 0 in counts:
            raise ValueError("trips: every column must have a value for each trip, and at least one.")
        numbers = []
        for name, (least, most) in {"depart": (0.0, 1e9), "lane": (0.0, 1e3), "speed": (1.0, 100.0)}.items():
            column = list(frame[name]) if name in names else [ENTRY_SPEED] * max(counts)
            numbers.append([_number(name, value, row, least, most) for row, value in enumerate(column)])
        depart, lane, speed = (torch.tensor(x, dtype=torch.float64) for x in numbers)
        order = depart.argsort(stable=True)
        none = torch.zeros(len(order), dtype=torch.int64)
        again = torch.full((len(order),), math.inf, dtype=dtype)
        return cls(depart[order].to(dtype), again, lane[order].long(), speed[order].to(dtype), none, none.clone())


def _number(name: str, value: Any, row: int, least: float, most: float) -> float:
    """Return a value of a trip as a number; ValueError, in one line, for any other value."""
    kind, shown = str(getattr(value, "dtype", type(value).__name__)), " ".join(f"{value!r:.80}".split())
    try:
        number = math.nan if kind.endswith(("bool", "bytes")) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not least <= number <= most:
        rule = f"at most {most:g}" if number > most else f"at least {least:g}"
        raise ValueError(f"trips: {name} = {shown} of row {row} must be a number of {rule}.")
    if name == "lane" and number != int(number):
        raise ValueError(f"trips: lane = {number:g} of row {row} must be a whole number.")
    return number


class Moving(NamedTuple):
    """Changes of lanes that take time: integer tensors of shape ``(..., vehicles)``.

    Until step ``until`` a vehicle that has left lane ``origin`` is still a leader there. ``shadow`` is the slot of the
    next such vehicle ahead on everybody's lane, one's own for nobody.
    """

    origin: Tensor
    until: Tensor
    shadow: Tensor


class Journeys(NamedTuple):
    """Vehicles' ways through a network: whole numbers of shape ``(..., vehicles)`` (int32), ``reserved`` a truth value.

    ``routes`` (routes, links) are lists of links, filled with −1, of which a vehicle follows ``route`` and is on link
    ``hop``. ``others`` (routes × links, 2) are places there (route × links + hop) on the lane to the left and to the
    right, from where the same roads follow; −1 for none, and empty without such lanes. A vehicle has been ``told`` to
    stop at the next line (1), or that it counts as inside the junction behind it (2: it goes before its foes, in red
    too), or has ``reserved`` that. Its trip is ``due`` at a step, and ``asks`` for a speed (m/s); it ``entered`` and
    ``left`` at steps, −1 for not yet.
    ``phases`` ``(..., signals)`` are what signals show, −1 for what their plan says.
    """

    routes: Tensor
    others: Tensor
    route: Tensor
    hop: Tensor
    told: Tensor
    reserved: Tensor
    due: Tensor
    asks: Tensor
    entered: Tensor
    left: Tensor
    phases: Tensor


class State(NamedTuple):
    """Everything that a step carries over.

    ``gap`` is state although positions imply it: in float32 the difference of two positions cancels, and the
    gradients with it. A step adds ``displacement[leader] - displacement`` instead. ``step`` is an integer
    tensor (scalar or one per batch row), so that time never forces a device to synchronise. ``lanes`` is None on roads
    whose order never changes; where it does, vehicles keep their slots and ``lanes`` says who leads whom.
    """

    position: Tensor
    speed: Tensor
    accel: Tensor
    gap: Tensor
    length: Tensor
    step: Tensor
    present: Tensor | None
    memory: Memory
    lanes: LaneState | None = None

    @property
    def clock(self) -> Tensor:
        """Steps, to broadcast against ``(..., vehicles)``."""
        return self.step if self.step.dim() == 0 else self.step.unsqueeze(-1)


class Motion(NamedTuple):
    """Result of integration, which replay overrides.

    Displacement in this step (m), then position (m), speed (m/s), acceleration (m/s²), validity and, where records say
    it, lane at its end (−1 where they do not).
    """

    displacement: Tensor
    position: Tensor
    speed: Tensor
    accel: Tensor
    present: Tensor | None
    lane: Tensor | None = None


class Neighbour(NamedTuple):
    """Another vehicle as seen by the driver: gap (m), its speed (m/s), its acceleration (m/s²), 1 if it is there.

    For an adjacent vehicle ``gap`` is the signed distance of the front bumpers, positive when it is ahead.
    """

    gap: Tensor
    speed: Tensor
    accel: Tensor
    present: Tensor


class Beside(NamedTuple):
    """A lane as a place to be: a driver's own (``scene.here``), or the one on his ``left`` or ``right``.

    ``exists`` is 1 where there is such a lane and it may be entered here. ``leader`` and ``follower`` are those that he
    has or would have; the follower's ``gap`` is the one behind him. ``wanted`` is what the driver wants there (m/s²),
    ``with_me`` and ``without_me`` what that follower wants behind him and if he is not there (m/s²; 0 where there is
    nobody). ``ends`` is how far the lane goes on (m).
    """

    exists: Tensor
    leader: Neighbour
    follower: Neighbour
    wanted: Tensor
    with_me: Tensor
    without_me: Tensor
    ends: Tensor


class Wish(NamedTuple):
    """Utilities and margins of a change to the left and to the right, by an effect of the hook ``change``.

    Utility (m/s²): a change is wished where the sum over effects is above 0. Margin (m/s²): it is safe where the least
    of all effects is at least 0. The sum over effects also has the largest single utility of each side, for which a
    driver signals: he may have to go where the sum, which knows of dangers, does not want him to. An effect may say a
    margin of its own that counts ``despite`` a smaller one of others, that of a driver who accepts more, and how much
    he ``must`` (0 to 1): by as much what one effect wishes for most counts instead of the sum.
    """

    left: Tensor
    right: Tensor
    left_margin: Tensor
    right_margin: Tensor
    left_most: Tensor | None = None
    right_most: Tensor | None = None
    left_despite: Tensor | None = None
    right_despite: Tensor | None = None
    left_must: Tensor | None = None
    right_must: Tensor | None = None


class PastScenes(Protocol):
    """Scenes of the steps before, which a simulator keeps where an effect looks back."""

    def at(self, scene: Scene, seconds: Tensor) -> Scene:
        """Return the scene of some seconds ago."""

    def pushed(self, scene: Scene) -> Tensor:
        """Return the buffer after this step."""


class Scene(NamedTuple):
    """One step as every vehicle sees it; effects read this and know no topology.

    ``second_leader``, ``behind``, ``merger`` (who signals from a lane beside that he wants to be the leader) and
    ``lane`` (0 on the right, 0 on a road of one) are filled only where an effect of the simulator needs them, ``here``,
    ``left`` and ``right`` only for the hook ``change``; ``inputs`` and ``memory`` are keyed by effect name, ``time`` is
    in seconds, ``euler`` tells how speeds will be integrated.
    """

    position: Tensor
    speed: Tensor
    accel: Tensor
    leader: Neighbour
    second_leader: Neighbour | None
    behind: Neighbour | None
    time: Tensor
    dt: float
    euler: bool
    inputs: Inputs
    memory: Memory
    history: PastScenes | None = None
    here: Beside | None = None
    left: Beside | None = None
    right: Beside | None = None
    merger: Neighbour | None = None
    lane: Tensor | None = None

    def past(self, seconds: Tensor) -> Scene:
        """Return the scene of some seconds ago, interpolated between steps; ``seconds`` broadcasts over vehicles.

        ValueError for a scene without a past: the effect that asks must say how far it ``looks_back``.
        """
        if self.history is None:
            raise ValueError("this scene has no past. Let the effect's `looks_back` return how many seconds it needs.")
        return self.history.at(self, seconds)

    def input(self, name: str) -> Any:
        """Return the input of effect ``name``; ValueError tells which input is missing."""
        if name not in self.inputs:
            raise ValueError(
                f"effect '{name}' takes an input, and none was given. Pass inputs={{'{name}': …}} to step or rollout."
            )
        return self.inputs[name]


class Driver(NamedTuple):
    """Car-following parameters in force at this step, after every adaptation.

    ``max_accel`` a (m/s²), ``comfort_decel`` b (m/s²), ``time_gap`` T (s), ``min_gap`` s0 (m), ``desired_speed``
    v0 (m/s); ``extra_gap`` (m) is added to the desired gap s*.
    """

    max_accel: Tensor
    comfort_decel: Tensor
    time_gap: Tensor
    min_gap: Tensor
    desired_speed: Tensor
    extra_gap: Tensor | float = 0.0


class Mark(NamedTuple):
    """A mark on a ``lane`` (None: on all) from ``begin`` to ``end`` (m), and whether one must stop before it."""

    lane: int | None
    begin: float
    end: float
    stops: bool


class Command(NamedTuple):
    """Input of the effect ``control``: commanded acceleration (m/s²) and where it is in force (bool)."""

    accel: Tensor
    active: Tensor


class Record(NamedTuple):
    """Input of the effect ``replay``: the record at the *end* of the step and which vehicles follow it.

    ``active`` (bool) marks replayed vehicles; ``present`` (0 or 1, or None for all there) which vehicles exist. On a
    road of several lanes ``lane`` says where each is, be it replayed or not, and is −1 where that is left to it.
    """

    position: Tensor
    speed: Tensor
    accel: Tensor
    active: Tensor
    present: Tensor | None = None
    lane: Tensor | None = None


class Imagined(NamedTuple):
    """Input of the effect ``imagined``: a free gap Δp (m) and closing speed Δv (m/s), both per vehicle."""

    gap: Tensor
    closing_speed: Tensor


class Adjacent(NamedTuple):
    """Input of the effect ``lateral``: signed distance (m), speed (m/s) and presence of the adjacent-lane vehicle."""

    distance: Tensor
    speed: Tensor
    present: Tensor


def mapped(function: Callable[..., Tensor], first: Tree, *rest: Any) -> Tree:
    """Apply a function to every tensor of like-shaped tuples and mappings; what is no tensor stays as it is."""
    if hasattr(first, "dim"):  # a tensor, or what stands for one while a step is recorded
        return function(first, *rest)  # type: ignore[return-value]
    if isinstance(first, Mapping):
        return {k: mapped(function, v, *(r[k] for r in rest)) for k, v in first.items()}  # type: ignore[return-value]
    if not isinstance(first, tuple):
        return first
    parts = (mapped(function, *each) for each in zip(first, *rest, strict=True))
    return type(first)(*parts) if hasattr(first, "_fields") else tuple(parts)  # type: ignore[return-value]


def constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the tensor of these numbers, made once: a GPU waits for every copy of Python's numbers."""
    tensor = None if torch.compiler.is_compiling() else _CONSTANTS.get((values, dtype, device))
    if tensor is None:
        with torch.inference_mode(False):
            tensor = torch.tensor(values, dtype=dtype, device=device)
        with suppress(NotImplementedError):
            tensor.untyped_storage()  # raises within torch.func, whose tensors end with the transform
            if type(tensor) is Tensor and not torch.compiler.is_compiling():
                _CONSTANTS[values, dtype, device] = tensor
    return tensor


@contextmanager
def recording() -> Iterator[None]:
    """Mark work inside as recorded: for any values, not for these."""
    before = _RECORDED.set(True)
    try:
        yield
    finally:
        _RECORDED.reset(before)


def is_recording() -> bool:
    """Return whether work is being recorded."""
    return _RECORDED.get()


def worthwhile(mask: Tensor) -> bool:
    """Return whether any is true, so that work for those alone can be left out where there are none.

    True, and nothing is asked, where the answer would be waited for (a GPU) or is not one for all values (a recording).
    """
    return mask.device.type != "cpu" or is_recording() or torch.compiler.is_compiling() or bool(mask.any())
