"""Pictures of the tasks for README and the site, and of the teacher's page.

``python docs/task_pictures.py`` writes docs/tasks/TASK.png, docs/teach-diagram.png and docs/teach-wave.gif.
"""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path
from typing import Any

import gymnasium
from PIL import Image, ImageSequence

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
        for _ in range(round(SECONDS / env.unwrapped.task.step_time)):
            _, _, terminated, truncated, _ = env.step(None)
            if terminated or truncated:
                break
        picture = Image.fromarray(env.render())
        width = WIDTH // 2 if picture.width == picture.height else WIDTH
        picture = picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)
        written.append(folder / f"{name}.png")
        picture.save(written[-1], optimize=True)
    return written


def teaching(folder: Path = FOLDER.parent) -> list[Path]:
    """Run the block of the teacher's page, and keep its pictures, the moving one in few colours; return the files."""
    code = re.findall(
        r"^```python\n(.*?)^```$", (FOLDER.parent / "teach.md").read_text("utf-8"), re.MULTILINE | re.DOTALL
    )
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)
        try:
            exec(code[0], {})
            still, moving = Image.open("diagram.png"), Image.open("wave.gif")
            frames = [f.convert("RGB").quantize(32, dither=Image.Dither.NONE) for f in ImageSequence.Iterator(moving)]
            written = [folder / "teach-diagram.png", folder / "teach-wave.gif"]
            still.quantize(64).save(written[0], optimize=True)
            frames[0].save(written[1], save_all=True, append_images=frames[1:], duration=200, loop=0)
        finally:
            os.chdir(before)
    return written


if __name__ == "__main__":
    for path in [*pictures(), *teaching()]:
        print(path)
