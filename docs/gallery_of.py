"""The gallery: every example with a title, a small picture, and a figure of its own or of what it does."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

FIGURES = {
    "add_an_effect": ("generated/pictures/delay.png", """
params["fatigue"]["rate"] = torch.tensor(2e-3, dtype=torch.float64)
fresh, weary = (s.rollout(state, {}, params, steps=6000)[1].speed[:, 0].detach() for s in (plain, tired))
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(fresh, label="IDM"), axes.plot(weary, label="IDM with fatigue, k = 0.002 1/s")
axes.set(xlabel="step of 0.1 s", ylabel="speed (m/s)"), axes.legend()
"""),
    "drifting_drivers": ("generated/pictures/wander.png", """
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(kept.speed.detach(), lw=0.8)
axes.set(xlabel="step of 0.1 s", ylabel="speed (m/s)", title="a platoon in which everybody drifts")
"""),
    "filter_a_trajectory": ("filtering.png", """
one = both.sort(keys).partition_by("run_id", "vehicle_id")[0]
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(one["time_s"][1:], np.diff(one["position_m_noisy"]) / 0.1, lw=0.5, color="silver", label="differences")
axes.plot(one["time_s"], one["speed_mps"], label="truth")
axes.plot(one["time_s"], one["speed_mps_filtered"], label="filtered")
axes.set(xlabel="time (s)", ylabel="speed (m/s)"), axes.legend()
"""),
    "fit_a_driver": ("generated/pictures/fit-0.png", """
rows = found.table()
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
ratio = [row["estimate"] / drivers[row["group"]][row["parameter"].split(".")[1]] for row in rows]
axes.plot(ratio, [row["parameter"].split(".")[1] for row in rows], "o", alpha=0.6)
axes.axvline(1.0, color="black", lw=0.7), axes.set(xlabel="estimate / truth")
"""),
    "ring_gradient": ("tasks/ring.png", """
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(returns, "o-"), axes.set(xlabel="update", ylabel="return of 200 steps", xticks=range(len(returns)))
"""),
    "step_and_gradient": ("tasks/platoon.png", """
_, (left, right) = plt.subplots(1, 2, figsize=(7, 2.8), layout="constrained")
left.plot(kept.speed.detach()), left.set(xlabel="step of 0.1 s", ylabel="speed (m/s)")
right.bar(range(6), gradient), right.set(xlabel="vehicle", ylabel="metres per second of time gap")
"""),
    "find_a_hidden_effect": ("discovery_gaps.png", "Gaps that IDM leaves, and IDM with the effect that was found."),
    "stabilise_a_ring": ("agents.png", "A trained vehicle takes over at 300 s, and the waves are gone."),
    "train_apg": ("agents_follow.png", "What agents make of the leader of ``follow``."),
    "train_pettingzoo": ("tasks/platoon.png", "Several vehicles may be agents."),
    "train_rllib": ("tasks/ring.png", "The task: one vehicle of 22 in a stop-and-go wave."),
    "train_sb3": ("tasks/ring.png", "The task: one vehicle of 22 in a stop-and-go wave."),
    "train_torchrl": ("tasks/ring.png", "The task: one vehicle of 22 in a stop-and-go wave."),
    "tune_an_agent": ("agents_survival.png", "How soon trainings solve their tests, by algorithm."),
    "two_nodes": ("generated/pictures/fit-0.png", "What every part of the work makes: fitted drivers."),
    "export_minari": ("tasks/follow.png", "The task whose episodes are exported."),
}  # fmt: skip
"""Of every example its small picture, and code that draws one after it, or a caption where it is not run here."""


def examples(root: Path) -> None:
    """Copy the examples for the gallery, each with its first sentence as a title and a picture."""
    out = root / "build" / "examples"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    (out / "README.rst").write_text("Examples\n========\n\nEach runs by itself: ``python examples/NAME.py``.\n")
    for path in sorted((root / "examples").glob("*.py")):
        text = path.read_text(encoding="utf-8")
        found = re.match(r'"""(.*?)"""\n', text, re.DOTALL)
        assert found, path
        words = " ".join(found[1].split())
        first = re.match(r"[^:.]{1,60}(?=: )", words)
        title = first[0] if first else path.stem.replace("_", " ").capitalize()
        picture, more = FIGURES[path.stem]
        shown = "" if "\n" in more else f"\n\n.. figure:: /{picture}\n\n   {more}"
        thumbnail = f"# sphinx_gallery_thumbnail_path = {picture!r}\n\n"
        head = f'"""\n{title}\n{"=" * len(title)}\n\n{words}{shown}\n"""\n\n{thumbnail}'
        drawn = f"\n# %%\n# A picture of it.\nimport matplotlib.pyplot as plt\n{more}" if not shown else ""
        (out / path.name).write_text(head + text[found.end() :] + drawn, encoding="utf-8")
    (out / "first_hour.py").write_text(_script(root / "examples" / "first_hour.ipynb"), encoding="utf-8")


def _script(notebook: Path) -> str:
    """Return a notebook as the gallery takes it: words as comments in reStructuredText, code as it is."""
    cells = [(cell["cell_type"], "".join(cell["source"])) for cell in json.loads(notebook.read_text("utf-8"))["cells"]]
    made = []
    for kind, text in cells:
        if kind == "code":
            made.append(text)
            continue
        text = re.sub(r"`([^`]+)`", r"``\1``", text)
        text = re.sub(r"^# (.*)$", lambda m: f"{m[1]}\n{'=' * len(m[1])}", text, flags=re.MULTILINE)
        text = re.sub(r"^## (.*)$", lambda m: f"{m[1]}\n{'-' * len(m[1])}", text, flags=re.MULTILINE)
        if made:
            made.append("# %%\n" + "\n".join(f"# {line}".rstrip() for line in text.splitlines()) + "\n")
        else:
            made.append(f'"""\n{text}\n"""\n\n# sphinx_gallery_thumbnail_path = "tasks/follow.png"\n')
    return "\n\n".join(made) + "\n"
