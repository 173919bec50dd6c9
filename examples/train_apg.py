"""Train by gradients through traffic (APG) in 1 to 2 minutes: ``python examples/train_apg.py [TASK] [updates]``.

The policy is IDM's formula with a network beside it that begins at zero, so that learning starts from a driver. It
observes its speed, its leader's and the gap, in every task.
"""

import sys
import time

import gymnasium
import torch

import idm_env  # registers DiffIDM-v0

SEEN = {"features": ["speed", "lead_speed", "gap"], "scaling": "raw"}
OPEN = ("open_highway", "merge", "bottleneck", "approach")
RECIPES = {
    # updates, environments, steps of a window, learning rate, (v0, T, s0, a, b, share of the formula) to begin with:
    # about those of the best rule of a search; on open lanes a little faster than drivers, whom nobody exceeds
    "ring": (30, 16, 2000, 1e-3, (10.0, 0.15, 2.5, 0.7, 0.8, 0.007)),
    "follow": (40, 24, 500, 1e-2, (30.0, 1.2, 2.0, 1.5, 2.0, 1.0)),
    "platoon": (30, 24, 500, 3e-3, (14.0, 2.24, 1.28, 1.11, 0.594, 1.0)),
    "replay": (30, 24, 300, 3e-3, (31.3, 0.914, 3.83, 1.55, 2.57, 1.0)),
    "replay_lanes": (20, 8, 200, 3e-3, (21.4, 3.0, 4.75, 3.0, 0.571, 0.0597)),
    "open_highway": (15, 8, 120, 3e-3, (33.0, 1.0, 2.0, 1.4, 2.0, 1.0)),
    "merge": (15, 8, 120, 3e-3, (33.0, 1.0, 2.0, 1.4, 2.0, 1.0)),
    "bottleneck": (15, 8, 120, 3e-3, (33.0, 1.0, 2.0, 1.4, 2.0, 1.0)),
    "approach": (15, 8, 120, 3e-3, (16.0, 1.0, 2.0, 1.4, 2.0, 1.0)),
    "highway": (20, 8, 300, 3e-3, (40.0, 0.106, 3.65, 3.0, 1.84, 0.17)),
}
# The recipes are for the scales of the sources, which may be negative; the ring is Flow's, on which nobody brakes, and
# highway's that of HighwayEnv.
SOURCES = {
    "ring": {"reward": "flow", "shock": 0.0, "warmup": 750}, "follow": {"reward": "source"},
    "platoon": {"reward": "quadratic"}, "replay": {"reward": "imitation"}, "replay_lanes": {"reward": "imitation"},
    "highway": {"vehicles": 50, "lanes_count": 4, "warmup": 0},
    **{name: {"reward": "delay", "controlled": 0.1, "careful": True, "added": False} for name in OPEN},
}  # fmt: skip


class Driver(torch.nn.Module):
    """Actions of agents that see their speed (m/s), the leader's and the gap (m): IDM's formula, and a network."""

    def __init__(self, task, begin):
        super().__init__()
        self.log = torch.nn.Parameter(torch.tensor(begin).log())
        self.net = torch.nn.Sequential(torch.nn.Linear(3, 32), torch.nn.Tanh(), torch.nn.Linear(32, 1))
        torch.nn.init.zeros_(self.net[2].weight), torch.nn.init.zeros_(self.net[2].bias)
        self.limit = task.command_limits[1]

    def forward(self, seen):
        speed, lead, gap = seen.unflatten(-1, (-1, 3)).unbind(-1)
        gap = gap.clamp_min(0.5)
        v0, headway, s0, a, b, share = self.log.exp()
        wish = s0 + (speed * headway + speed * (speed - lead) / (2.0 * (a * b).sqrt())).clamp_min(0.0)
        accel = a * (1.0 - (speed / v0) ** 4 - (wish / gap) ** 2)
        inputs = torch.stack((speed / 10.0, (lead - speed) / 2.0, torch.log(gap / 10.0)), -1)
        return ((share * accel + self.net(inputs).squeeze(-1)) / self.limit).clamp(-1.0, 1.0)


def trained(name, updates=None, seed=0, shown=print):
    """Return the policy of a recipe, or of fewer updates."""
    most, count, window, rate, begin = RECIPES[name]
    torch.manual_seed(seed)
    given = {"output": "torch", "observation": SEEN, "autoreset_mode": "SameStep", **SOURCES.get(name, {})}
    given |= {"warmup_pool": 64} if name == "ring" else {}
    env = gymnasium.make_vec("DiffIDM-v0", num_envs=count, task=name, **given)
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
    given = {"output": "torch", "observation": SEEN, "autoreset_mode": "SameStep", **SOURCES.get(name, {})}
    env = gymnasium.make_vec("DiffIDM-v0", num_envs=len(seeds), task=name, **given)
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
