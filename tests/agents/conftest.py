"""A small ring, and arguments of agents that train on it for a moment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from stable_baselines3.common.logger import Logger

from agents.monitor import make_logger

RING: dict[str, Any] = {
    "task": "ring", "vehicles": 8, "length": [60.0, 75.0], "warmup": 20, "warmup_pool": 8,
    "reward": {"speed": 0.2, "effort": -4.0, "tailgating": -5.0}, "shock": 0.0, "max_episode_steps": 60,
}  # fmt: skip


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """As agents run."""
    torch.set_num_threads(1)


@pytest.fixture
def ring() -> dict[str, Any]:
    """Keywords of a small ring."""
    return dict(RING)


@pytest.fixture
def quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Arguments of a short training; its evaluation is one that costs nothing."""
    monkeypatch.setattr("agents.monitor.evaluate", lambda policy, environment: PASSED)
    return {"environment": dict(RING), "out": tmp_path / "run", "updates": 4, "evaluate_every": 1, "hidden": (8, 8)}


PASSED: dict[str, Any] = {"speed_ratio": 1.0, "speed_std": 0.1, "time_gap": 1.0, "collisions": 0, "passed": True}


@pytest.fixture
def loggers(monkeypatch: pytest.MonkeyPatch) -> list[Logger]:
    """The loggers that trainings make; the files of one that is over must be closed."""
    made: list[Logger] = []

    def make(*given: Any) -> Logger:
        made.append(make_logger(*given))
        return made[-1]

    monkeypatch.setattr("agents.monitor.make_logger", make)
    monkeypatch.setattr("agents.imitation.make_logger", make)
    return made
