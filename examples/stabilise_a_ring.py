"""Stabilise a ring in under a minute: gradients through traffic teach one vehicle to dissolve the stop-and-go wave."""

import gymnasium
import torch

import idm_env  # registers DiffIDM-v0

torch.manual_seed(0)
torch.set_num_threads(1)
# Human drivers have had 300 s to grow a wave; the failsafe brakes for the queue, and learning must drive on from there.
ring = {"task": "ring", "output": "torch", "observation": "raw", "warmup": 3000, "warmup_pool": 64, "failsafe": 3.0}
ring |= {"reward": "flow", "shock": 0.0}  # mean speed less effort; nobody brakes but for the queue
env = gymnasium.make_vec("DiffIDM-v0", num_envs=24, autoreset_mode="SameStep", max_episode_steps=3000, **ring)
test = gymnasium.make_vec("DiffIDM-v0", num_envs=4, autoreset_mode="Disabled", max_episode_steps=-1, **ring)


def speeds_under(policy):
    """Mean of all speeds and their worst deviation in a ring (m/s), 200 to 250 s after the take-over; None: humans."""
    seen, speeds = test.reset(seed=1)[0], []
    with torch.no_grad():
        for step in range(2500):
            seen = test.step(None if policy is None else policy(seen))[0]
            if step >= 2000:
                speeds.append(test.unwrapped.state.speed)
    every = torch.stack(speeds)
    return float(every.mean()), float(every.std((0, 2)).max())


middle, scale = torch.tensor([3.75, 0.0, 10.8]), torch.tensor([2.25, 0.75, 2.7])  # v, v_lead − v, headway in a wave
net = torch.nn.Sequential(torch.nn.Linear(3, 32), torch.nn.Tanh(), torch.nn.Linear(32, 1), torch.nn.Tanh())
with torch.no_grad():
    net[2].weight.mul_(0.01)


def policy(observation):
    return net((observation - middle) / scale)


human, untrained = speeds_under(None), speeds_under(policy)
optimiser = torch.optim.Adam(net.parameters(), lr=1e-3)
observation, _ = env.reset(seed=0)
for update in range(12):
    env.unwrapped.detach()  # the graph of this minute of traffic begins here
    observation, total = observation.detach(), torch.zeros(())
    push = 0.02 * torch.randn(24, 1)  # a vehicle that only stands would never feel what driving on is worth
    for _ in range(600):
        observation, reward, *_ = env.step(policy(observation) + push)
        total = total + reward.mean() / 600
    optimiser.zero_grad()
    (-total).backward()
    torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
    optimiser.step()
    print(f"update {update}: mean reward {float(total.detach()):.3f}")

for name, (mean, deviation) in {"humans": human, "untrained": untrained, "trained": speeds_under(policy)}.items():
    print(f"{name:>9}: mean speed {mean:.2f} m/s, standard deviation {deviation:.2f} m/s")
print("idm_env", idm_env.__version__)
assert mean > 1.2 * human[0] > untrained[0] and deviation < 0.5 < human[1]
