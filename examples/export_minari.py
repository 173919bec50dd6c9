"""Export a data set that an agent made as Minari keeps them: ``pip install "minari[create,hdf5]"``, then run this."""

import os
import sys
import tempfile

os.environ.setdefault("MINARI_DATASETS_PATH", tempfile.mkdtemp())  # else it is kept among the user's

import gymnasium
import minari

import idm_env  # registers DiffIDM-v0

env = minari.DataCollector(gymnasium.make("DiffIDM/Follow-v0", max_episode_steps=200))
for seed in range(3):
    observation, _ = env.reset(seed=seed)
    ended = False
    while not ended:
        # A gap of 2 m and 1.5 s, at the leader's speed; observations are divided by their scales.
        speed, lead_speed, gap = observation * env.unwrapped.task.scales
        accel = 0.1 * (gap - 2.0 - 1.5 * speed) + 0.6 * (lead_speed - speed)
        action = env.action_space.low + 0.5 * (accel / 3.0 + 1.0) * (env.action_space.high - env.action_space.low)
        observation, _, terminated, truncated, _ = env.step(action.clip(-1.0, 1.0).astype("float32"))
        ended = terminated or truncated
data = env.create_dataset(
    "idm_env/follow/rule-v0", algorithm_name="linear rule", author="the idm_env developers",
    description=f"A driver of two gains behind a leader who stops and goes; idm_env {idm_env.__version__}.",
)  # fmt: skip
print(data.total_episodes, "episodes,", data.total_steps, "steps", file=sys.stdout)
again = minari.load_dataset("idm_env/follow/rule-v0")
assert [e.rewards.shape for e in again.iterate_episodes()] == [(200,)] * 3
