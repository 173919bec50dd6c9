"""Train with RLlib (new API stack): PPO on a native batch of rings, and on two agents of one ring through PettingZoo.

RLlib pins gymnasium 1.2.2, so it has an environment of its own: `make rllib` sets it up and runs this file.
"""

import os
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from idm_env.envs.pettingzoo import parallel_env

RING = {"task": "ring", "warmup": 1000, "failsafe": 3.0}
COUNT, STEPS = 16, 500


def ppo() -> PPOConfig:
    """Return what both have in common. `num_env_runners` above 0 samples in as many processes or machines."""
    return (
        PPOConfig()
        .training(
            lr=1e-3, gamma=0.99, lambda_=0.95, grad_clip=0.5, train_batch_size_per_learner=COUNT * STEPS,
            minibatch_size=1000, num_epochs=5, vf_clip_param=1e6,
        )
        .rl_module(
            model_config=DefaultModelConfig(fcnet_hiddens=[32, 32], fcnet_activation="tanh", free_log_std=True)
        )
        .env_runners(num_env_runners=0)
        .reporting(metrics_num_episodes_for_smoothing=COUNT)
        .debugging(seed=0)
    )  # fmt: skip


def one_agent() -> PPOConfig:
    """Return PPO on 16 rings that are one native vector; RLlib counts on resets in the step after an episode's end."""
    return ppo().environment(
        "idm_env:DiffIDM-v0", env_config={**RING, "max_episode_steps": STEPS, "autoreset_mode": "NextStep"}
    ).env_runners(num_envs_per_env_runner=COUNT, gym_env_vectorize_mode="vector_entry_point")  # fmt: skip


def two_agents() -> PPOConfig:
    """Return PPO on rings with two agents, which share one policy."""
    register_env("two_agents", lambda more: ParallelPettingZooEnv(parallel_env(**more)))
    return (
        ppo()
        .environment("two_agents", env_config={**RING, "controlled": 2, "max_cycles": STEPS})
        .env_runners(num_envs_per_env_runner=COUNT)
        .multi_agent(policies={"shared"}, policy_mapping_fn=lambda agent, episode, **more: "shared")
    )


def quiet(learner: Any) -> None:
    """Let policies begin by commanding almost nothing: RLlib's own begin with noise that makes everybody stop."""
    with torch.no_grad():
        for module in learner.module.values():
            module.pi.log_std.fill_(-2.5)
            [layer for layer in module.pi.modules() if isinstance(layer, torch.nn.Linear)][-1].weight.mul_(0.01)


def train(config: PPOConfig, updates: int) -> list[tuple[int, float]]:
    """Train; return (steps of all rings so far, mean reward of an agent's step), one row per update."""
    algorithm = config.build_algo()
    algorithm.learner_group.foreach_learner(quiet)
    algorithm.env_runner_group.sync_weights(from_worker_or_learner_group=algorithm.learner_group)
    rows = []
    for _ in range(updates):
        found: dict[str, Any] = algorithm.train()["env_runners"]
        # Means over the last 16 episodes, those of this update, and over the agents, who are paid alike.
        agents = max(len(found.get("agent_episode_returns_mean", ())), 1)
        reward = found["episode_return_mean"] / found["episode_len_mean"] / agents
        rows.append((int(found["num_env_steps_sampled_lifetime"]), float(reward)))
    algorithm.stop()
    return rows


if __name__ == "__main__":
    ray.init("local", include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    for name, config in (("one agent", one_agent()), ("two agents", two_agents())):
        for steps, reward in train(config, 2):
            print(f"{name}, {steps} steps: mean reward {reward:.3f}")
    ray.shutdown()
