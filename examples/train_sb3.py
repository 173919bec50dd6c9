"""Train with Stable-Baselines3: PPO through the adapter of the native vector, its monitor, saving and loading."""

import tempfile
from pathlib import Path

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

import idm_env  # registers DiffIDM-v0
from idm_env.envs.sb3 import SB3VecEnv

vector = gymnasium.make_vec("DiffIDM-v0", num_envs=32, task="ring", max_episode_steps=200)
env = VecMonitor(SB3VecEnv(vector))
model = PPO("MlpPolicy", env, n_steps=100, batch_size=800, gamma=0.999, policy_kwargs={"log_std_init": -2.0}, seed=0)
model.learn(4 * 3200)
print("episodes:", len(model.ep_info_buffer), "last return:", round(model.ep_info_buffer[-1]["r"], 1))

with tempfile.TemporaryDirectory() as folder:
    model.save(Path(folder) / "ring")
    again = PPO.load(Path(folder) / "ring")
observation = env.reset()
action, _ = again.predict(observation, deterministic=True)
print("actions of the saved policy:", action.shape, "idm_env", idm_env.__version__)
assert action.shape == (32, 1) and (action == model.predict(observation, deterministic=True)[0]).all()
