"""One platoon, one rollout, one gradient: how the last vehicle's place depends on the time gap of every driver."""

import torch

from idm_env import IDM, Brakes, Lane, Simulator

simulator = Simulator(Lane(), (IDM(), Brakes()), dt=0.1)
params = simulator.defaults(dtype=torch.float64)
params["idm"]["time_gap"] = torch.full((6,), 1.5, dtype=torch.float64, requires_grad=True)

position = -30.0 * torch.arange(6, dtype=torch.float64)  # front first
speed = torch.full((6,), 15.0, dtype=torch.float64)
state = simulator.state(position, speed, params)
end, kept = simulator.rollout(state, {}, params, steps=300)
end.position[-1].backward()

gradient = params["idm"]["time_gap"].grad
print("speed of the last vehicle every 5 s:", [round(v, 1) for v in kept.speed[::50, -1].tolist()])
print("metres per second of everybody's time gap:", [round(g, 1) for g in gradient.tolist()])
assert (gradient[1:] < 0).all()
