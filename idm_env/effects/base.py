"""What an effect is: one hook of five, parameters of its own, and static choices that are never tensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from torch import Tensor

from idm_env.parameters import Parameter
from idm_env.types import Driver, Motion, Scene

Hook = Literal["perceive", "adapt", "accelerate", "limit", "place"]
HOOKS: tuple[Hook, ...] = ("perceive", "adapt", "accelerate", "limit", "place")

P = dict[str, Tensor]
"""The parameters of one effect: name → tensor."""


@dataclass(frozen=True)
class Effect:
    """Base of all effects. A subclass overrides exactly one of the five hooks, and `remember` if it needs memory.

    ==============  =================================  ===========================  =======================
    hook            meaning                            composition                  example
    ==============  =================================  ===========================  =======================
    ``perceive``    what the driver sees               chained by ``rank``          Delay, GapBias
    ``adapt``       how the driver's parameters change chained, in simulator order  Memory, SpeedZone
    ``accelerate``  what the driver wants, in m/s²     summed                       IDM, Grade, Noise
    ``limit``       what the vehicle can               chained by ``rank``          Control, Lag, Brakes
    ``place``       put where a record says            chained, after integration   Replay
    ==============  =================================  ===========================  =======================

    Class attributes: ``kind`` is the name in ``effects.ALL`` and in YAML; ``needs`` names the optional neighbours
    of the scene that it reads; ``sees_truth`` marks effects of physics, which get the true scene instead of the
    perceived one; ``rank`` orders perceptions and limits, low first; ``adds`` says whether the effect can lift an
    acceleration above what the driver wants by himself, which is taken for granted of every effect that adapts,
    accelerates or limits and does not deny it: a simulator with such an effect has tyres (``Traction``). Dataclass
    fields are the static choices.
    """

    kind: ClassVar[str] = ""
    declared: ClassVar[tuple[Parameter, ...]] = ()
    needs: ClassVar[frozenset[str]] = frozenset()
    sees_truth: ClassVar[bool] = False
    remembers: ClassVar[bool] = False
    rank: ClassVar[int] = 0
    adds: ClassVar[bool] = False
    hook: ClassVar[Hook]

    def __init_subclass__(cls) -> None:
        mine = [hook for hook in HOOKS if getattr(cls, hook) is not getattr(Effect, hook)]
        if len(mine) != 1:
            raise TypeError(
                f"effect {cls.__name__} overrides {mine or 'no hook'}; override exactly one of {', '.join(HOOKS)}."
            )
        cls.hook = mine[0]
        # Not inherited: a subclass has another equation, and what its parent promised of his is not known of it.
        cls.adds = vars(cls).get("adds", cls.hook in ("adapt", "accelerate", "limit"))
        cls.remembers = cls.remember is not Effect.remember

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
        """Return what remains of the summed acceleration (m/s²)."""
        return accel

    def place(self, motion: Motion, scene: Scene, p: P) -> Motion:
        """Return the motion after integration, overridden where a record says so."""
        return motion

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor | None:
        """Return the memory before the first step, or None for an effect without one."""
        return None

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the memory after this step; ``scene.memory[self.name]`` holds the one before it."""
        return scene.memory[self.name]


@dataclass(frozen=True)
class CarFollowing(Effect):
    """An effect that wants an acceleration *and* owns the driver's parameters; a simulator has exactly one."""

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the wanted acceleration (m/s²)."""
        raise TypeError(f"{type(self).__name__} is a car-following effect without an equation: override accelerate.")

    def driver(self, p: P) -> Driver:
        """Return the driver before any adaptation."""
        raise TypeError(f"{type(self).__name__} is a car-following effect without a driver: override driver.")
