"""Drivers who are not the same from second to second: steady and drifting ones on the same normals, and a gradient."""

import torch

from idm_env import IDM, Brakes, Lane, Simulator
from idm_env.effects import AccelNoise, PerceptionNoise, Wander

drifts = (Wander(), PerceptionNoise(), PerceptionNoise(signal="closing_speed"), AccelNoise())
simulator = Simulator(Lane(), (IDM(), *drifts, Brakes()))
params = simulator.defaults(dtype=torch.float64)
# A platoon in its stationary state: T = 1.5 s and s0 = 2 m at 10 m/s; its first car wants to go no faster.
position = -22.2 * torch.arange(10, dtype=torch.float64)
params["idm"]["desired_speed"] = torch.where(position == 0, 10.0, 33.0)
start = simulator.state(position, torch.full_like(position, 10.0), params, seed=1)
last = {}
for share in (0.0, 0.5, 1.0):
    for drift in drifts:
        default = simulator.defaults(dtype=torch.float64)[drift.name]["sigma"]
        params[drift.name]["sigma"] = (share * default).requires_grad_()
    _, kept = simulator.rollout(start, {}, params, 1200, seed=2)  # the same seed, the same normals
    last[share] = kept.speed[600:, 1:].std()
    print(f"{share:.0%} of the drift: speeds of the followers vary by {last[share].item():.3f} m/s")
assert last[0.0] < 0.01 < last[0.5] < last[1.0]
last[1.0].backward()
print("d(variation)/dσ:", {drift.name: round(params[drift.name]["sigma"].grad.item(), 2) for drift in drifts})
