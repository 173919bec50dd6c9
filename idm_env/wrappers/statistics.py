"""Episode statistics and normalised observations for torch output: Gymnasium's own cannot carry gradients.

For vectors, of one environment too: the statistics are detached, what passes through keeps its graph.
"""

from typing import Any

import torch
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from torch import Tensor


class Moments:
    """Running mean and variance of rows, by Chan, Golub and LeVeque's parallel update (1979)."""

    def __init__(self, shape: tuple[int, ...], epsilon: float) -> None:
        self.mean = torch.zeros(shape, dtype=torch.float64)
        self.var = torch.ones(shape, dtype=torch.float64)
        self.count = epsilon
        self._epsilon = epsilon

    def update(self, rows: Tensor) -> None:
        """Take in rows, shape ``(n, …)``; their graph is not kept."""
        rows = rows.detach().to(dtype=torch.float64, device=self.mean.device)
        n = len(rows)
        total = self.count + n
        delta = rows.mean(0) - self.mean
        spread = self.var * self.count + rows.var(0, correction=0) * n + delta * delta * (self.count * n / total)
        self.mean, self.var, self.count = self.mean + delta * (n / total), spread / total, total

    def normalise(self, rows: Tensor) -> Tensor:
        """Return ``(x − mean) / √(var + ε)``, differentiable in x; rows have shape ``(n, …)``."""
        mean, scale = self.mean.to(rows), (self.var + self._epsilon).rsqrt().to(rows)
        return (rows - mean) * scale


class VectorNormalizeObservation(VectorWrapper):
    """Normalise the observations of a vector ``(environments, …)`` by running moments, ``final_obs`` included.

    ``update_running_mean = False`` freezes the moments. Observations have no unit any more.
    """

    update_running_mean = True

    def __init__(self, env: VectorEnv, epsilon: float = 1e-8) -> None:
        super().__init__(env)
        self.moments = Moments(env.single_observation_space.shape or (), epsilon)

    def reset(self, **keywords: Any) -> tuple[Tensor, dict[str, Any]]:
        """Reset, and return the normalised observations."""
        observation, info = self.env.reset(**keywords)
        return self._normalised(observation), info

    def _normalised(self, rows: Tensor) -> Tensor:
        if self.update_running_mean:
            self.moments.update(rows)
        return self.moments.normalise(rows)

    def step(self, actions: Any) -> tuple[Tensor, Any, Any, Any, dict[str, Any]]:
        """Step, and return the normalised observations with their graph."""
        observation, *rest, info = self.env.step(actions)
        if "final_obs" in info:
            mask = info["_final_obs"].unsqueeze(-1)
            info = {**info, "final_obs": torch.where(mask, self.moments.normalise(info["final_obs"]), 0.0)}
        return (self._normalised(observation), *rest, info)  # type: ignore[return-value]


class VectorRecordEpisodeStatistics(VectorWrapper):
    """Add ``info["episode"]``: returns ``r``, lengths ``l`` ``(environments,)``, valid where ``info["_episode"]``."""

    def __init__(self, env: VectorEnv) -> None:
        super().__init__(env)
        self._next_step = env.metadata.get("autoreset_mode") is AutoresetMode.NEXT_STEP
        self._sum = self._steps = self._over = torch.zeros(0)

    def reset(self, **keywords: Any) -> tuple[Tensor, dict[str, Any]]:
        """Reset, and count from zero in the environments that were reset."""
        observation, info = self.env.reset(**keywords)
        mask = (keywords.get("options") or {}).get("reset_mask")
        if mask is None or not len(self._sum):
            none = torch.zeros(self.num_envs, device=observation.device)
            self._sum, self._steps, self._over = none.double(), none.long(), none.bool()
        else:
            self._clear(torch.as_tensor(mask, device=observation.device))
        return observation, info

    def step(self, actions: Any) -> tuple[Tensor, Any, Any, Any, dict[str, Any]]:
        """Step, and count; rewards keep their graph, the statistics have none."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        self._sum = self._sum + reward.detach()
        self._steps = self._steps + 1
        if self._next_step:
            # The step after an end only resets: it belongs to neither episode.
            self._clear(self._over)
        self._over = terminated | truncated
        if bool(self._over.any()):
            total, steps = torch.where(self._over, self._sum, 0.0), torch.where(self._over, self._steps, 0)
            info = {**info, "episode": {"r": total, "l": steps}, "_episode": self._over.clone()}
            if not self._next_step:
                self._clear(self._over)
        return observation, reward, terminated, truncated, info

    def _clear(self, mask: Tensor) -> None:
        self._sum = torch.where(mask, 0.0, self._sum)
        self._steps = torch.where(mask, 0, self._steps)
