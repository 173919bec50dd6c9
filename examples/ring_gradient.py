"""The ring environment with gradients: push one parameter of a policy uphill on the return, through 200 steps."""

import gymnasium
import torch

import idm_env  # registers DiffIDM-v0

env = gymnasium.make("DiffIDM-v0", task="ring", output="torch", warmup=0, max_episode_steps=400)
gain = torch.full((1,), 0.5, requires_grad=True)
returns = []
for update in range(3):
    observation, _ = env.reset(seed=0)
    total = torch.zeros(())
    for _ in range(200):
        own_speed, relative_speed = observation[0], observation[1]
        action = torch.tanh(gain * relative_speed).reshape(1)
        observation, reward, terminated, truncated, _ = env.step(action)
        total = total + reward
    returns.append(float(total.detach()))
    (gradient,) = torch.autograd.grad(total, gain)
    print(f"update {update}: return {returns[-1]:.2f}, d(return)/d(gain) {gradient.item():+.3f}")
    gain = (gain + 0.1 * gradient.sign()).detach().requires_grad_()
assert returns[0] < returns[1] < returns[2]
print("idm_env", idm_env.__version__)
