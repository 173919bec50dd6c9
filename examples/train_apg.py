"""Train by gradients through traffic (APG) in 1 to 2 minutes: ``python examples/train_apg.py [follow|ring] [updates]``.

The policy is IDM's formula with a network beside it that begins at zero, so that learning starts from a driver.
"""

import sys
import time

import gymnasium
import torch

import idm_env  # registers DiffIDM-v0

RECIPES = {
    # updates, environments, steps of a window, learning rate, (v0, T, s0, a, b, share of the formula) to begin with
    "ring": (30, 16, 2000, 1e-3, (10.0, 0.15, 2.5, 0.7, 0.8, 0.007)),  # from the best rule of docs/returns.csv
    "follow": (40, 24, 500, 1e-2, (30.0, 1.2, 2.0, 1.5, 2.0, 1.0)),
}


class Driver(torch.nn.Module):
    """Actions of an agent that sees its speed (m/s), the leader's and the gap (m): IDM's formula, and a network."""

    def __init__(self, task, begin):
        super().__init__()
        self.log = torch.nn.Parameter(torch.tensor(begin).log())
        self.net = torch.nn.Sequential(torch.nn.Linear(3, 32), torch.nn.Tanh(), torch.nn.Linear(32, 1))
        torch.nn.init.zeros_(self.net[2].weight), torch.nn.init.zeros_(self.net[2].bias)
        self.relative = task.features.names[1] == "relative_speed"
        self.length = getattr(task, "vehicle_length", 0.0) if task.features.names[2] == "headway" else 0.0
        self.limit = task.command_limits[1]

    def forward(self, seen):
        speed, lead, gap = seen.reshape(-1, 3).unbind(-1)
        lead, gap = (speed + lead if self.relative else lead), (gap - self.length).clamp_min(0.5)
        v0, headway, s0, a, b, share = self.log.exp()
        wish = s0 + (speed * headway + speed * (speed - lead) / (2.0 * (a * b).sqrt())).clamp_min(0.0)
        accel = a * (1.0 - (speed / v0) ** 4 - (wish / gap) ** 2)
        inputs = torch.stack((speed / 10.0, (lead - speed) / 2.0, torch.log(gap / 10.0)), -1)
        return ((share * accel + self.net(inputs).squeeze(-1)) / self.limit).clamp(-1.0, 1.0).unsqueeze(-1)


def trained(name, updates=None, seed=0, shown=print):
    """Return the policy of a recipe, or of fewer updates."""
    most, count, window, rate, begin = RECIPES[name]
    torch.manual_seed(seed)
    warm = {"warmup_pool": 64} if name == "ring" else {}
    env = gymnasium.make_vec(
        "DiffIDM-v0", num_envs=count, task=name, output="torch", observation="raw", autoreset_mode="SameStep", **warm
    )
    policy = Driver(env.unwrapped.task, begin)
    optimiser = torch.optim.Adam(policy.parameters(), lr=rate)
    env.reset(seed=1000 + seed)
    for update in range(updates or most):
        env.unwrapped.detach()  # the graph of this window begins here
        rewards = env.unwrapped.unroll(policy, window).reward
        optimiser.zero_grad()
        (-rewards.mean()).backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimiser.step()
        shown(f"update {update}: mean reward {float(rewards.detach().mean()):.3f}")
    return policy


def returns(name, act, seeds):
    """Return the returns of an episode for each seed: of actions, or of human driving where ``act`` is None."""
    env = gymnasium.make_vec(
        "DiffIDM-v0", num_envs=len(seeds), task=name, output="torch", observation="raw", autoreset_mode="SameStep"
    )
    seen, _ = env.reset(seed=list(seeds))
    total, going = torch.zeros(len(seeds)), torch.ones(len(seeds))
    with torch.no_grad():
        for _ in range(env.unwrapped.task.horizon):
            seen, reward, terminated, truncated, _ = env.step(None if act is None else act(seen))
            reward = reward.reshape(len(seeds), -1).mean(-1)
            total, going = total + going * reward, going * ~(terminated | truncated)
    return total


if __name__ == "__main__":
    name = sys.argv[1] if len(sys.argv) > 1 else "follow"
    updates = int(sys.argv[2]) if len(sys.argv) > 2 else 6  # all of them where "0" is given
    torch.set_num_threads(1)
    human, begin = returns(name, None, range(5)).mean(), time.process_time()
    agent = returns(name, trained(name, updates), range(5)).mean()
    print(f"mean return of 5 episodes: human drivers {human:.0f}, agent {agent:.0f}")
    print(f"{time.process_time() - begin:.0f} CPU seconds, idm_env {idm_env.__version__}")
    assert agent > human
