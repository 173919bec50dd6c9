"""Drivers' own noise, from normals that are drawn beforehand, so that a step stays a function (hook ``accelerate``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.parameters import Parameter
from idm_env.types import Driver, Scene


@dataclass(frozen=True)
class Noise(Effect):
    """Acceleration noise ``+ σ n``: white, or an Ornstein–Uhlenbeck process of unit variance (``correlated=True``).

    Input ``noise``: independent standard normals ξ of this step. White: n = ξ. Correlated, over the memory time τ:
    ``n' = ρ n + √(1 − ρ²) ξ`` with ``ρ = exp(−Δt/τ)``, starting from 0.
    """

    kind: ClassVar[str] = "noise"
    sees_truth: ClassVar[bool] = True
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("sigma", "σ", "m/s²", 0.1, 0.0, 2.0, null=0.0),)
    correlated: bool = False

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """σ, and τ where the noise is correlated."""
        memory_time = (Parameter("memory_time", "τ", "s", 2.0, 0.1, 60.0, role="shape"),)
        return self.declared + (memory_time if self.correlated else ())

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor | None:
        """Return n = 0 where the noise is correlated."""
        return torch.zeros_like(scene.speed) if self.correlated else None

    def _level(self, scene: Scene, p: P) -> Tensor:
        normals: Tensor = scene.input(self.name)
        if not self.correlated:
            return normals
        decay = torch.exp(-scene.dt / p["memory_time"])
        return decay * scene.memory[self.name] + torch.sqrt(1.0 - decay * decay) * normals

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return σ n (m/s²)."""
        return p["sigma"] * self._level(scene, p)

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return n."""
        return self._level(scene, p)
