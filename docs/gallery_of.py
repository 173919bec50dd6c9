"""The gallery: every example with a title and a picture of what it computed.

``python docs/gallery_of.py [EXAMPLE ...]`` runs examples and draws docs/examples/EXAMPLE.png.
"""

from __future__ import annotations

import json
import re
import runpy
import shutil
import sys
from pathlib import Path

FIGURES = {
    "add_an_effect": """
params["fatigue"]["rate"] = torch.tensor(2e-3, dtype=torch.float64)
fresh, weary = (s.rollout(state, {}, params, steps=6000)[1].speed[:, 0].detach() for s in (plain, tired))
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(fresh, label="IDM"), axes.plot(weary, label="IDM with fatigue, k = 0.002 1/s")
axes.set(xlabel="step of 0.1 s", ylabel="speed (m/s)"), axes.legend()
""",
    "drifting_drivers": """
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(kept.speed.detach(), lw=0.8)
axes.set(xlabel="step of 0.1 s", ylabel="speed (m/s)", title="a platoon in which everybody drifts")
""",
    "filter_a_trajectory": """
one = both.sort(keys).partition_by("run_id", "vehicle_id")[0]
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(one["time_s"][1:], np.diff(one["position_m_noisy"]) / 0.1, lw=0.5, color="silver", label="differences")
axes.plot(one["time_s"], one["speed_mps"], label="truth")
axes.plot(one["time_s"], one["speed_mps_filtered"], label="filtered")
axes.set(xlabel="time (s)", ylabel="speed (m/s)"), axes.legend()
""",
    "fit_a_driver": """
rows = found.table()
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
ratio = [row["estimate"] / drivers[row["group"]][row["parameter"].split(".")[1]] for row in rows]
axes.plot(ratio, [row["parameter"].split(".")[1] for row in rows], "o", alpha=0.6)
axes.axvline(1.0, color="black", lw=0.7), axes.set(xlabel="estimate / truth")
""",
    "motorway": """
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(flow["inside"], label="on the road"), axes.plot(flow["travel"], label="travel time at the speed of now (s)")
axes.axvspan(300.0, 420.0, color="silver", alpha=0.5, label="the left lane is closed")
axes.set(xlabel="time (s)"), axes.legend()
""",
    "ring_gradient": """
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(returns, "o-"), axes.set(xlabel="update", ylabel="return of 200 steps", xticks=range(len(returns)))
""",
    "step_and_gradient": """
_, (left, right) = plt.subplots(1, 2, figsize=(7, 2.8), layout="constrained")
left.plot(kept.speed.detach()), left.set(xlabel="step of 0.1 s", ylabel="speed (m/s)")
right.bar(range(6), gradient), right.set(xlabel="vehicle", ylabel="metres per second of time gap")
""",
    "find_a_hidden_effect": """
_, (left, right) = plt.subplots(1, 2, figsize=(7, 2.8), layout="constrained")
left.bar(["IDM", "IDM with delay"], [before, after]), left.set(ylabel="RMSE of the gap, held out (m)")
right.errorbar([delay["estimate"]], [0], xerr=[[delay["estimate"] - delay["low"]], [delay["high"] - delay["estimate"]]],
               fmt="o", capsize=4, label="estimate, 95 % interval")
right.axvline(truth.effects["delay"], color="black", lw=0.8, label="truth")
right.set(xlabel="reaction time (s)", yticks=[]), right.legend()
""",
    "stabilise_a_ring": """
_, axes = plt.subplots(1, 2, figsize=(7, 2.8), sharey=True, layout="constrained")
for ax, drive, title in zip(axes, (None, policy), ("human drivers", "with the trained vehicle"), strict=True):
    seen, speeds = test.reset(seed=1)[0], []
    with torch.no_grad():
        for step in range(2500):
            seen = test.step(None if drive is None else drive(seen))[0]
            speeds.append(test.unwrapped.state.speed[0])
    ax.plot(torch.arange(2500) * 0.1, torch.stack(speeds), lw=0.4, color="C0")
    ax.set(xlabel="time (s)", title=title)
axes[0].set(ylabel="speed of every vehicle (m/s)")
""",
    "train_apg": """
lines = []
trained("follow", 12, shown=lines.append)
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot([float(line.rsplit(" ", 1)[1]) for line in lines], "o-", label="gradients through traffic, follow")
axes.axhline(float(human) / 1000, color="black", lw=0.8, label="human drivers")
axes.set(xlabel="update", ylabel="mean reward of a step"), axes.legend()
""",
    "train_approach": """
_, (left, right) = plt.subplots(1, 2, figsize=(7, 2.8), layout="constrained")
for name, (paid, burnt, _) in found.items():
    left.plot(np.sort(paid[0] - found["humans"][0][0]), label=name), right.plot(np.sort(burnt[0]), label=name)
left.set(xlabel="fresh episode, sorted", ylabel="vehicle-hours more than humans"), left.legend()
right.set(xlabel="fresh episode, sorted", ylabel="kg of CO2 in 600 s")
""",
    "train_merge": """
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
for name, paid in found.items():
    axes.plot(np.sort(-paid), label=name)
axes.set(xlabel="fresh episode of 600 s, sorted", ylabel="delay of all (vehicle-hours)"), axes.legend()
""",
    "train_pettingzoo": """
observations, _ = env.reset(seed=1)
earned = []
while env.agents:
    actions = {agent: model.predict(observations[agent], deterministic=True)[0] for agent in env.agents}
    observations, rewards, *_ = env.step(actions)
    earned.append(list(rewards.values()))
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(earned, lw=1.0, color="C0", label=[" and ".join(total), None])
axes.set(xlabel="step", ylabel="reward, the same for both"), axes.legend()
""",
    "train_rllib": """
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
ray.init("local", include_dashboard=False, log_to_driver=False, logging_level="ERROR")
for name, config in (("one agent", one_agent()), ("two agents", two_agents())):
    axes.plot(*zip(*train(config, 8), strict=True), "o-", label=name)
ray.shutdown()
axes.set(xlabel="steps of all rings", ylabel="mean reward of a step"), axes.legend()
""",
    "train_sb3": """
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot([episode["r"] for episode in model.ep_info_buffer], ".")
axes.set_yscale("symlog", linthresh=100.0)  # a crash costs thousands
axes.set(xlabel="episode of the training, the last 100 at most", ylabel="return of 200 steps")
""",
    "train_torchrl": """
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(*zip(*train(8), strict=True), "o-"), axes.set(xlabel="steps of all rings", ylabel="mean reward of a step")
""",
    "tune_an_agent": """
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
for one in found:
    rows = one.metrics_dataframe
    axes.plot(rows["cpu_seconds"], rows["score"], "o-", label=f"learning rate {one.config['learning_rate']:g}")
axes.set(xlabel="CPU time (s)", ylabel="score of the agents' test"), axes.legend()
""",
    "two_nodes": """
import io
import polars as pl
drivers = pl.read_csv(io.BytesIO(alone[1]))
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
names = [f"{run}, {vehicle}" for run, vehicle in drivers.select("run_id", "vehicle_id").rows()]
axes.barh(names, drivers["gap_rmse_m"]), axes.set(xlabel="RMSE of the gap of every driver, fitted on two nodes (m)")
""",
    "export_minari": """
_, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
for episode in again.iterate_episodes():
    axes.plot(episode.rewards, lw=1.0, label=f"episode {episode.id}")
axes.set(xlabel="step", ylabel="reward"), axes.legend()
""",
}
"""Of every example the code that draws what it computed, run after it."""

ROOT = Path(__file__).resolve().parents[1]


def draw(name: str) -> Path:
    """Run an example, then its drawing; return the picture."""
    import matplotlib.pyplot as plt
    from PIL import Image

    path = str(ROOT / "examples" / f"{name}.py")
    sys.argv = [path]
    made = runpy.run_path(path, run_name="__main__")
    exec(FIGURES[name], made | {"plt": plt})
    picture = ROOT / "docs" / "examples" / f"{name}.png"
    picture.parent.mkdir(exist_ok=True)
    plt.savefig(picture, dpi=100)
    plt.close("all")
    Image.open(picture).convert("RGB").quantize(48).save(picture, optimize=True)
    return picture


def examples(root: Path) -> None:
    """Copy the examples for the gallery, each with its first sentence as a title and its picture."""
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
        picture = f"examples/{path.stem}.png"
        thumbnail = f"# sphinx_gallery_thumbnail_path = {picture!r}\n\n"
        head = f'"""\n{title}\n{"=" * len(title)}\n\n{words}\n\n.. figure:: /{picture}\n"""\n\n{thumbnail}'
        (out / path.name).write_text(head + text[found.end() :], encoding="utf-8")
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
            made.append(f'"""\n{text}\n"""\n\n# sphinx_gallery_thumbnail_path = "first-hour.png"\n')
    return "\n\n".join(made) + "\n"


if __name__ == "__main__":
    for chosen in sys.argv[1:] or FIGURES:
        print(draw(chosen))
