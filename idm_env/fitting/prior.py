"""Log-normal priors of parameters, by which little data give a maximum a posteriori."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Prior:
    """Independent log-normal priors of the own parameters, and the noise that residuals are weighed by.

    ``ln θ ~ N(ln centre, deviation²)``, both [G, P]; ``noise`` is the standard deviation of a residual as if residuals
    were independent, in their unit. A fit then minimises ``Σ r² + noise² Σ ((ln θ − ln centre) / deviation)²``.
    """

    centre: Tensor
    deviation: Tensor
    noise: float

    def __post_init__(self) -> None:
        for name in ("centre", "deviation"):
            value = getattr(self, name)
            if not bool((value > 0).all()):
                raise ValueError(f"prior {name} = {float(value.min()):g} must be positive. Priors are log-normal.")
        if not self.noise > 0:
            raise ValueError(f"prior noise = {self.noise:g} must be positive, in the unit of the residual.")

    def equations(self, own: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the prior's parts of cost [..., G], gradient Jᵀr [..., G, P] and Gauss–Newton matrix."""
        residual = self.noise * torch.log(own / self.centre) / self.deviation
        slope = self.noise / (self.deviation * own)
        return residual.square().sum(-1), slope * residual, torch.diag_embed(slope.square())

    def following(self, own: Tensor) -> Prior:
        """Return the same: the centre stands."""
        return self
