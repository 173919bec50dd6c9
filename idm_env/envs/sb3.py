"""Stable-Baselines3: an adapter from the native vector environment to SB3's ``VecEnv``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from idm_env.envs.info import single_infos
from idm_env.extras import needed
from idm_env.validation import shown

with needed("SB3VecEnv"):
    from stable_baselines3.common.vec_env import VecEnv


class SB3VecEnv(VecEnv):
    """``SB3VecEnv(gym.make_vec("DiffIDM-v0", num_envs=64))``.

    SB3 resets within the step and expects the last observation of an episode in ``info["terminal_observation"]`` and,
    where it was cut off rather than ended, ``info["TimeLimit.truncated"]``. So the vector must be in mode
    ``"SameStep"``, the default, or ``"Disabled"``, in which case this adapter resets.
    Arrays have the shape ``(environments, …)``; rewards and dones are ``(environments,)``.

    Raises:
        ValueError: For a vector in mode ``"NextStep"`` or with torch output.
    """

    def __init__(self, vector_env: VectorEnv) -> None:
        mode = vector_env.metadata.get("autoreset_mode")
        if mode not in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED):
            raise ValueError(f"autoreset_mode = {mode} does not fit SB3. Make one with autoreset_mode='SameStep'.")
        settings = getattr(vector_env.unwrapped, "settings", None)
        if settings is not None and settings.output != "numpy":
            raise ValueError(f"output = '{settings.output}' does not fit SB3, which takes arrays. Use output='numpy'.")
        self.vector_env = vector_env
        self._same_step = mode is AutoresetMode.SAME_STEP
        self._actions: np.ndarray | None = None
        super().__init__(vector_env.num_envs, vector_env.single_observation_space, vector_env.single_action_space)

    def reset(self) -> np.ndarray:
        """Begin episodes in all environments, with the seeds of ``seed()`` if it was called."""
        options = self._options[0] if self._options and self._options[0] else None
        seeds = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        observation, info = self.vector_env.reset(seed=seeds, options=options)  # type: ignore[arg-type]
        self.reset_infos = single_infos(info, self.vector_env.num_envs)
        self._reset_seeds()
        self._reset_options()
        return np.asarray(observation)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step, and reset what ended; return observations, rewards, dones and one info per environment."""
        observation, reward, terminated, truncated, info = self.vector_env.step(self._actions)
        done = terminated | truncated
        infos = single_infos(info, self.vector_env.num_envs)
        if done.any():
            last = info["final_obs"] if self._same_step else observation
            final = single_infos(info["final_info"], self.vector_env.num_envs) if self._same_step else infos
            for i in np.flatnonzero(done).tolist():
                if self._same_step:
                    self.reset_infos[i], infos[i] = infos[i], final[i]
                infos[i]["terminal_observation"] = np.array(last[i])
                infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            if not self._same_step:
                observation, fresh = self.vector_env.reset(options={"reset_mask": done})
                begun = single_infos(fresh, self.vector_env.num_envs)
                self.reset_infos = [begun[i] if ended else self.reset_infos[i] for i, ended in enumerate(done)]
        return np.asarray(observation), np.asarray(reward, np.float32), done, infos

    def close(self) -> None:
        """Close the vector environment."""
        self.vector_env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the vector environment, once per environment."""
        owner = self.vector_env if hasattr(self.vector_env, attr_name) else self.vector_env.unwrapped
        return [getattr(owner, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the vector environment; it has no attributes of single environments."""
        self._all(indices, f"attribute '{attr_name}'")
        setattr(self.vector_env.unwrapped, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the vector environment once; return its result once per environment."""
        self._all(indices, f"method '{method_name}'")
        result = getattr(self.vector_env.unwrapped, method_name)(*method_args, **method_kwargs)
        return [result] * self.num_envs

    def _all(self, indices: Any, what: str) -> None:
        if indices is not None and len(set(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"{what} is the whole batch's, and indices = {shown(indices)} names a part. Leave it out.")

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: Any = None) -> list[bool]:
        """Return False for every environment: a native batch has no wrapped environments in it."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return a picture of every environment."""
        pictures: Any = self.vector_env.render()
        return list(pictures) if pictures is not None else [None] * self.num_envs
