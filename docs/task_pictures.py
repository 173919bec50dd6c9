"""Pictures of the tasks for README and the site, and of the teacher's page.

``python docs/task_pictures.py`` writes docs/tasks/TASK.png, docs/teach-diagram.png and docs/teach-wave.gif;
``python docs/task_pictures.py ring follow`` writes docs/tasks/TASK.gif of these: human drivers beside an agent, the
searched rule of ``python -m benchmarks.tasks``, in ``replay`` its APG. ``python docs/task_pictures.py curves`` trains
the first agent, and a gradient beside PPO, and writes docs/first-agent.png.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import gymnasium
from PIL import Image, ImageDraw, ImageSequence

import idm_env  # noqa: F401 (registers DiffIDM-v0)
from idm_env.envs.render import COLOURS_DRAWN, colour
from idm_env.tasks import TASKS

FOLDER = Path(__file__).resolve().parent / "tasks"
SECONDS, WIDTH = 40.0, 600
SHOWN, A_SECOND, LARGEST = 60, 6, 300_000
"""Seconds of an episode in a moving picture, at most, one picture each; how many are shown in a second; bytes."""


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


def film(name: str, act: Any, **keywords: Any) -> list[Image.Image]:
    """Return a picture for every second of an episode; ``act`` None is human driving."""
    env: Any = gymnasium.make("DiffIDM-v0", task=name, render_mode="rgb_array", **keywords)
    seen, _ = env.reset(seed=3)
    every, images = max(1, round(1.0 / env.unwrapped.task.step_time)), []
    for step in range(SHOWN * every):
        if step % every == 0:
            picture = Image.fromarray(env.render())
            images.append(picture.resize((picture.width // 2, picture.height // 2), Image.Resampling.LANCZOS))
        seen, _, terminated, truncated, _ = env.step(None if act is None else act(seen[None])[0])
        if terminated or truncated:
            break
    return images


def moving(name: str, folder: Path = FOLDER) -> Path:
    """Draw human drivers and an agent on the same episode, beside or above each other; return the file."""
    sys.path.insert(0, str(FOLDER.parents[1]))
    from benchmarks.tasks import GIVEN, SEEN, apg, rule, searched

    keywords = GIVEN.get(name, {})
    agent = (apg(name, 0), "scaled") if name == "replay" else (rule(name, searched(name)), SEEN)
    pairs = zip(film(name, None, **keywords), film(name, agent[0], observation=agent[1], **keywords), strict=False)
    frames = []
    for pair in pairs:
        wide, high = pair[0].size
        beside = wide == high
        frame = Image.new("RGB", (2 * wide, high + 16) if beside else (wide, 2 * (high + 16)), (244, 243, 238))
        for k, (picture, title) in enumerate(zip(pair, ("human drivers", "agent"), strict=True)):
            corner = (wide * k, 0) if beside else (0, (high + 16) * k)
            frame.paste(picture, (corner[0], corner[1] + 16))
            ImageDraw.Draw(frame).text((corner[0] + 6, corner[1] + 2), title, fill=(30, 32, 36))
        frames.append(frame)
    # One palette for all pictures: what does not change between two of them is then not written again.
    colours = [*COLOURS_DRAWN, *(colour(x, 19.0) for x in range(20)), (140, 140, 138)]
    palette = Image.new("P", (1, 1))
    palette.putpalette([part for each in colours for part in each])
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    path = folder / f"{name}.gif"
    path.unlink(missing_ok=True)
    while not path.exists() or path.stat().st_size > LARGEST:
        frames[0].save(path, save_all=True, append_images=frames[1:], duration=1000 // A_SECOND, loop=0, optimize=True)
        del frames[-3:]
    return path


def curves(folder: Path = FOLDER.parent) -> Path:
    """Train on the ring and on ``follow``, and draw what agents return as they learn; return the file."""
    sys.path.insert(0, str(FOLDER.parents[1]))
    import matplotlib.pyplot as plt

    from benchmarks.tasks import FRESH, apg, constant, curve, ppo, returns

    figure, panels = plt.subplots(1, 2, figsize=(8.0, 2.8), layout="constrained")
    for panel, task, learners in zip(panels, ("ring", "follow"), ({"PPO": ppo}, {"PPO": ppo, "APG": apg}), strict=True):
        for name, act in {"human drivers": None, "best constant": constant(task)}.items():
            level = float(returns(task, act, range(FRESH, FRESH + 16))[0].mean())
            panel.axhline(level, color="0.3", ls="-" if act is None else ":", lw=1.0, label=name)
        for name, learn in learners.items():
            panel.plot(*curve(task, learn).T, marker=".", label=name)
        panel.set(title=f"{task}, seed 0", xlabel="CPU time of training (s)", xlim=(0.0, None), ylim=(0.0, None))
        panel.legend(loc="lower right", fontsize=8)
    panels[0].set_ylabel("return, 16 fresh episodes")
    figure.savefig(folder / "first-agent.png", dpi=120)
    return folder / "first-agent.png"


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
    asked: Any = (curves() if name == "curves" else moving(name) for name in sys.argv[1:])
    for path in asked if sys.argv[1:] else [*pictures(), *teaching()]:
        print(path)
