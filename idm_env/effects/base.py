"""Effects: one hook of six, parameters of their own, and static choices that are never tensors.

Shapes: what belongs to vehicles is ``[..., n]``, in SI units; parameters are scalars or ``[..., n]``.
"""

import math
import re
from dataclasses import Field, dataclass, fields, is_dataclass
from inspect import formatannotation
from numbers import Integral, Real
from typing import Any, ClassVar, Literal, get_args

import torch
from torch import Tensor

from idm_env.effects.watched import RETURNS, watched
from idm_env.parameters import Parameter
from idm_env.types import Driver, Mark, Motion, Scene, Wish
from idm_env.validation import shown

CHOICES: dict[str, type] = {"float": Real, "int": Integral, "bool": bool, "str": str}
"""Types of choices that are checked where an effect is made."""

Hook = Literal["perceive", "adapt", "accelerate", "limit", "place", "change"]
HOOKS: tuple[Hook, ...] = ("perceive", "adapt", "accelerate", "limit", "place", "change")

Sought = Literal["anywhere", "profile", "interval", "step", "given", "never"]
"""What a search has to find beside a strength: nothing, a curve over places, an interval of places, a moment; nothing,
because a column of the file gives the profile; or that no search tries the effect by itself."""
Neighbour = Literal["leader", "second leader", "vehicle behind", "vehicle in an adjacent lane"]
"""Whom a record must show for the effect to be seen in it."""

NEEDED = frozenset({"second_leader", "behind", "merger", "lane"})
"""Neighbours that a scene has where an effect ``needs`` them."""


def hint_of(field: Field[Any]) -> str:
    """Return the type that a choice declares, as it is written, whether its file keeps annotations as texts or not."""
    return field.type if isinstance(field.type, str) else formatannotation(field.type)


P = dict[str, Tensor]
"""The parameters of one effect: name → tensor."""


@dataclass(frozen=True)
class Effect:
    """Base of all effects. A subclass overrides exactly one of the six hooks, and `remember` if it needs memory.

    ==============  =================================  ===========================  =======================
    hook            meaning                            composition                  example
    ==============  =================================  ===========================  =======================
    ``perceive``    what the driver sees               chained by ``rank``          Delay, GapBias
    ``adapt``       how a driver's parameters change   chained, in simulator order  Memory, SpeedZone
    ``accelerate``  what the driver wants, in m/s²     summed                       IDM, Grade, Noise
    ``limit``       what the vehicle can               chained by ``rank``          Control, Lag, Brakes
    ``place``       put where a record says            chained, after integration   Replay
    ``change``      wishes for the lanes beside        utilities summed, least      Mobil
                                                       margin; the road executes
    ==============  =================================  ===========================  =======================

    Class attributes: ``kind`` is the name in ``effects.ALL`` and in YAML; ``needs`` names the optional neighbours
    of the scene that it reads; ``sees_truth`` marks effects of physics, which get the true scene instead of the
    perceived one; ``rank`` orders perceptions and limits, low first, and what discovery adds to a driver; ``adds`` says
    whether the effect can lift an acceleration above what the driver wants by himself, which is taken for granted of
    every effect that adapts, accelerates or limits and does not deny it: a simulator with such an effect has tyres
    (``Traction``). ``draws`` marks effects whose input is one standard normal per vehicle and step, which whoever runs
    the simulator draws; the memory of such an effect, if it has one, is a standard normal in the long run. Dataclass
    fields are the static choices. ``guided`` names what events of a network write into the memory of an effect: the
    place of a closed line (m) or the limit of a link (m/s).

    What a search and a report have to know of an effect stands beside its equation, too:

    ==============  ====================================================================================================
    ``title``       its plain name
    ``equation``    what it adds to IDM, in one line
    ``sources``     the publications it is taken from, in full (``effects/references.json``); none for common knowledge
    ``wording``     what drivers do then, in a clause: with the strength below its null, and above; ``{law}`` is the
                    law that the effect completes
    ``looks_like``  what it is most easily confused with: candidates, or parameters and curves in plain words
    ``told_by``     data that would tell it from these
    ``cancels``     candidates whose response is nearly its own with the other sign: the pairs are tried jointly
    ``latency``     the response comes late by the first parameter (s). Latencies are one class, told apart by sharp
                    inputs only, and one below a step of the data belongs to how these were made
    ``sought``      what has to be found beside the strength
    ``acts_on``     what it changes: an acceleration, a parameter of the driver, a perceived signal, the response
    ``beyond``      whom the record must show
    ``takes``       the type of what it takes from outside at every step (``scene.input``), if anything
    ``wind_up_s``   spin-up time (s) before a prediction; default 0.1 s, the whole record for effects with memory
    ``per_driver``  whether its strengths, all above 0, may be each driver's own, with a population
    ``column``      column of a file that gives its ``profile``, if measured
    ==============  ====================================================================================================

    Where a search starts and how far it goes stands in the parameters (``starts``, ``searched``).
    """

    kind: ClassVar[str] = ""
    declared: ClassVar[tuple[Parameter, ...]] = ()
    needs: ClassVar[frozenset[str]] = frozenset()
    sees_truth: ClassVar[bool] = False
    remembers: ClassVar[bool] = False
    rank: ClassVar[int] = 0
    adds: ClassVar[bool] = False
    guided: ClassVar[Literal["", "stop", "limit"]] = ""
    draws: ClassVar[bool] = False
    hook: ClassVar[Hook]
    own: ClassVar[bool] = False
    """Whether the effect is the user's own, whose hooks are watched (``effects/watched.py``)."""

    sources: ClassVar[tuple[str, ...]] = ()
    title: ClassVar[str] = ""
    equation: ClassVar[str] = ""
    wording: ClassVar[tuple[str, str]] = ("", "")
    looks_like: ClassVar[tuple[str, ...]] = ()
    told_by: ClassVar[str] = ""
    cancels: ClassVar[tuple[str, ...]] = ()
    latency: ClassVar[bool] = False
    sought: ClassVar[Sought] = "anywhere"
    acts_on: ClassVar[str] = "acceleration"
    beyond: ClassVar[Neighbour] = "leader"
    takes: ClassVar[type | None] = None
    wind_up_s: ClassVar[float] = 0.1
    per_driver: ClassVar[bool] = False
    column: ClassVar[str] = ""

    def __new__(cls, *choices: Any, **named: Any) -> Any:
        """Return an effect. ValueError, in one line, for a number, truth value or text that its choices do not take."""
        values = dict(zip(getattr(cls, "__match_args__", ()), choices, strict=False)) | named
        for field in fields(cls) if is_dataclass(cls) else ():
            hint, value = hint_of(field), values.get(field.name, field.default)
            kind = hint.removesuffix(" | None")
            if kind not in CHOICES or value is field.default or (value is None and kind != hint):
                continue
            if isinstance(value, bool) != (kind == "bool") or not isinstance(value, CHOICES[kind]) or value != value:
                raise ValueError(f"{cls.kind}.{field.name} = {shown(value)} must be of type {kind}, and no NaN.")
        return super().__new__(cls)

    def __init_subclass__(cls) -> None:
        mine = [hook for hook in HOOKS if getattr(cls, hook) is not getattr(Effect, hook)]
        if len(mine) != 1:
            raise TypeError(
                f"effect {cls.__name__} overrides {mine or 'no hook'}; override exactly one of {', '.join(HOOKS)}."
            )
        cls.hook = mine[0]
        if cls.kind and not re.fullmatch(r"[\w-]+", cls.kind):
            raise TypeError(
                f"effect {cls.__name__}: kind = {cls.kind!r} names files and columns. Take letters, digits, _ and -."
            )
        if not isinstance(cls.needs, property) and (unknown := cls.needs - NEEDED):
            raise TypeError(
                f"effect {cls.__name__}: needs = {sorted(unknown)} is unknown. A scene has {', '.join(sorted(NEEDED))}."
            )
        for promise, kinds in (("sought", Sought), ("beyond", Neighbour)):
            if (value := getattr(cls, promise)) not in get_args(kinds):
                raise TypeError(
                    f"effect {cls.__name__}: {promise} = {value!r} is none of {', '.join(map(repr, get_args(kinds)))}."
                )
        # Not inherited: a subclass has another equation, and what its parent promised of his is not known of it.
        cls.adds = vars(cls).get("adds", cls.hook in ("adapt", "accelerate", "limit"))
        cls.own = not cls.__module__.startswith("idm_env.")
        for name in RETURNS if cls.own else ():
            if name in vars(cls):
                setattr(cls, name, watched(name, vars(cls)[name]))
        if not isinstance(cls.remembers, property):
            cls.remembers = cls.remember is not Effect.remember
        if cls.remembers is True and "wind_up_s" not in vars(cls):
            cls.wind_up_s = math.inf

    @property
    def name(self) -> str:
        """Key of this effect in params, inputs and memory; unique in one simulator."""
        return self.kind

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of this effect; overridden where static choices decide how many there are."""
        return self.declared

    @property
    def looks_back(self) -> float:
        """Seconds of the past that this effect may ask the scene for (``scene.past``); 0 for none."""
        return 0.0

    @property
    def decides_every(self) -> float:
        """Seconds between two decisions of an effect that changes lanes; the least of a simulator's effects holds."""
        return 1.0

    @property
    def decides_in_blocks(self) -> int:
        """Slots of a block that decides together, blocks taking turns; 0: all decide at once. The largest holds."""
        return 0

    @classmethod
    def strength_of(cls, change: float) -> float:
        """Return the strength that changes what it ``acts_on`` by ``change``, to first order, from its null on.

        A scan over places or times finds ``change``; a search starts from what this makes of it.
        """
        return change

    def perceive(self, scene: Scene, p: P) -> Scene:
        """Return the scene as the driver sees it."""
        return scene

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver's parameters in force."""
        return driver

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return this effect's acceleration (m/s²), to be summed with the others."""
        return scene.accel

    def limit(self, accel: Tensor, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the summed acceleration within a limit (m/s²)."""
        return accel

    def place(self, motion: Motion, scene: Scene, p: P) -> Motion:
        """Return the motion after integration, overridden where a record says so."""
        return motion

    def change(self, scene: Scene, driver: Driver, p: P) -> Wish:
        """Return utilities and margins of a change to either side; ``scene.here``, ``left`` and ``right`` are there."""
        none = torch.zeros_like(scene.speed)
        return Wish(none, none, none, none)

    def room(self, scene: Scene, p: P) -> Tensor | None:
        """Return how far each driver can go on, or wants to, on the lane ``scene.lane`` (m), None for any way.

        Drivers ask this of their own lane and of those beside when they decide: one without room is not entered. It
        is no hook, and goes with one; the effect ``needs`` the lane.
        """
        return None

    def marks(self, time: float, p: P) -> tuple[Mark, ...]:
        """Return the marks to draw on the road at a time (s), for scalar parameters; usually none."""
        return ()

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor | None:
        """Return the memory before the first step, or None for an effect without one."""
        return None

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the memory after this step; ``scene.memory[self.name]`` holds the one before it."""
        return scene.memory[self.name]


@dataclass(frozen=True)
class CarFollowing(Effect):
    """An effect that wants an acceleration *and* owns the driver's parameters; a simulator has exactly one.

    At the low bounds of its ``spared`` parameters a part of it is absent, and the rest is a law.
    """

    spared: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if not vars(cls).get("kind"):  # a base of laws: what it lacks its heirs have
            return
        has = {
            "equation: override accelerate": cls.accelerate is not CarFollowing.accelerate,
            "driver: override driver": cls.driver is not CarFollowing.driver,
            "parameters: declare some": cls.declared or cls.parameters is not Effect.parameters,
        }
        if lacks := [what for what, present in has.items() if not present]:
            raise TypeError(f"car-following law {cls.__name__} has no {'; no '.join(lacks)}.")

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the wanted acceleration (m/s²)."""
        raise NotImplementedError

    def driver(self, p: P) -> Driver:
        """Return the driver before any adaptation."""
        raise NotImplementedError


@dataclass(frozen=True)
class Remembering(Effect):
    """The memory of an effect that changes lanes, in the steps between two decisions."""

    kind: ClassVar[str] = "remembering"
    adds: ClassVar[bool] = False
    of: Effect

    @property
    def name(self) -> str:
        """That of the effect."""
        return self.of.name

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Those of the effect."""
        return self.of.parameters

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Change nothing."""
        return driver

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor | None:
        """Return the effect's."""
        return self.of.initial_memory(scene, driver, p)

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the effect's."""
        return self.of.remember(scene, driver, p)
