"""Small pictures of the tasks for README and the site: ``python docs/task_pictures.py`` writes docs/tasks/TASK.png."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
from PIL import Image

import idm_env  # noqa: F401 (registers DiffIDM-v0)
from idm_env.tasks import TASKS

FOLDER = Path(__file__).resolve().parent / "tasks"
SECONDS, WIDTH = 40.0, 600


def pictures(folder: Path = FOLDER) -> list[Path]:
    """Draw every task after 40 s without commands; return the files."""
    folder.mkdir(exist_ok=True)
    written = []
    for name in TASKS:
        keywords: dict[str, Any] = {"warmup": 3000} if name == "ring" else {}
        env = gymnasium.make("DiffIDM-v0", task=name, render_mode="rgb_array", **keywords)
        env.reset(seed=1)
        for _ in range(round(SECONDS / env.unwrapped.task.simulator.dt)):
            _, _, terminated, truncated, _ = env.step(None)
            if terminated or truncated:
                break
        picture = Image.fromarray(env.render())
        width = WIDTH // 2 if picture.width == picture.height else WIDTH
        picture = picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)
        written.append(folder / f"{name}.png")
        picture.save(written[-1], optimize=True)
    return written


if __name__ == "__main__":
    for path in pictures():
        print(path)
