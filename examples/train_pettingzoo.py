"""Train with PettingZoo: two vehicles of a ring are two agents; they share one policy, learned by PPO."""

import supersuit
from stable_baselines3 import PPO

from idm_env.envs.pettingzoo import parallel_env

ring = {"task": "ring", "controlled": 2, "max_cycles": 200, "warmup": 300}
vector = supersuit.concat_vec_envs_v1(
    supersuit.pettingzoo_env_to_vec_env_v1(parallel_env(**ring)), 4, num_cpus=0, base_class="stable_baselines3"
)
model = PPO("MlpPolicy", vector, n_steps=100, batch_size=400, policy_kwargs={"log_std_init": -2.0}, device="cpu")
model.learn(1600)

env = parallel_env(**ring)
observations, _ = env.reset(seed=1)
total = dict.fromkeys(env.agents, 0.0)
while env.agents:
    actions = {agent: model.predict(observations[agent], deterministic=True)[0] for agent in env.agents}
    observations, rewards, *_ = env.step(actions)
    for agent, reward in rewards.items():
        total[agent] += reward
print("return of each agent:", {agent: round(value, 1) for agent, value in total.items()})
assert len(total) == 2
