"""An effect of one's own: a docstring, its parameters, one method. Null means absent, so it can be found in data."""

from dataclasses import dataclass
from typing import ClassVar

import torch

from idm_env import IDM, Brakes, Effect, Lane, Parameter, Simulator


@dataclass(frozen=True)
class Fatigue(Effect):
    """Drivers slow down with time on the road: ``v0 → v0 exp(−k t)``."""

    kind: ClassVar[str] = "fatigue"
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("rate", "k", "1/s", 1e-3, -0.01, 0.01, null=0.0),)

    def adapt(self, driver, scene, p):  # type: ignore[no-untyped-def]
        """Return the driver with the desired speed in force."""
        return driver._replace(desired_speed=driver.desired_speed * torch.exp(-p["rate"] * scene.time))


plain = Simulator(Lane(), (IDM(), Brakes()))
tired = plain.adding(Fatigue())
params = tired.defaults(dtype=torch.float64)
params["fatigue"]["rate"] = torch.zeros((), dtype=torch.float64, requires_grad=True)  # its null
state = tired.state(torch.zeros(1, dtype=torch.float64), torch.full((1,), 20.0, dtype=torch.float64), params)
end, kept = tired.rollout(state, {}, params, steps=600)
without, _ = plain.rollout(state, {}, params, steps=600)
assert torch.equal(end.position, without.position)  # absent at the null …
end.speed.sum().backward()
sensitivity = params["fatigue"]["rate"].grad.item()
print(f"d(speed after 60 s)/dk at k = 0: {sensitivity:.0f} m — an absent effect is found by differentiating it")
assert sensitivity < 0  # … and yet visible there
