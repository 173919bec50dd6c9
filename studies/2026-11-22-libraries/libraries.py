"""What agents of other libraries learn in these environments: the examples, run for longer, and their curves.

    python -m benchmarks.libraries torchrl tune                  # in .venv; tune takes ray[tune]
    build/rllib/bin/python -m benchmarks.libraries rllib agents  # in the environment that `make rllib` sets up
    python -m benchmarks.libraries picture                       # docs/libraries.png, and a table, of what was run

Each is one short training of one seed, with options nobody searched for: that they fit is shown, not which library is
better. ``torchrl`` and ``rllib`` are PPO with one agent, ``agents`` RLlib's with two, on the ring behind a failsafe, 16
rings, 500 steps an episode; rewards are those of training, with the noise that explores, which costs 4 mean|u| (0.26 at
first). ``tune`` is Ray Tune's search over analytic policy gradients.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PATHS = [str(ROOT), str(ROOT / "examples")]
sys.path[:0] = PATHS
KEPT = ROOT / "runs" / "libraries"
NAMES = {"torchrl": "TorchRL, PPO", "rllib": "RLlib, PPO", "agents": "RLlib, PPO, two agents"}


def run(name: str, updates: int) -> Any:
    """Return what an example gives: (steps, mean reward) of every update, or every evaluation of every trial."""
    if name == "torchrl":
        return importlib.import_module("train_torchrl").train(updates)
    import ray

    os.environ["PYTHONPATH"] = os.pathsep.join(PATHS)  # of workers, which import the example
    ray.init("local", include_dashboard=False, log_to_driver=False, logging_level="ERROR", num_cpus=2)
    try:
        if name == "tune":
            example = importlib.import_module("tune_an_agent")
            found = example.search(KEPT / "tune", example.SPACE, cpu_seconds=15.0)
            for one in found:
                if one.error is not None:
                    raise one.error
            return [{"options": one.config, "rows": one.metrics_dataframe.to_dict("records")} for one in found]
        example = importlib.import_module("train_rllib")
        return example.train(example.one_agent() if name == "rllib" else example.two_agents(), updates)
    finally:
        ray.shutdown()


def humans() -> float:
    """Return the mean reward of a step where all vehicles are left to their drivers."""
    import gymnasium

    import idm_env  # noqa: F401

    env = gymnasium.make_vec(
        "DiffIDM-v0", num_envs=64, task="ring", warmup=1000, failsafe=3.0, max_episode_steps=500, info="none"
    )
    env.reset(seed=1)
    rewards = [float(env.step(None)[1].mean()) for _ in range(500)]  # type: ignore[arg-type]
    return sum(rewards) / len(rewards)


def picture(path: Path) -> None:
    """Draw the curves of what was run, and print a table."""
    from matplotlib.figure import Figure

    tuned = (KEPT / "tune.json").exists()
    figure = Figure(figsize=(9.0 if tuned else 5.6, 3.4), layout="constrained")
    left, *others = figure.subplots(1, 1 + tuned, squeeze=False)[0]
    left.axhline(alone := humans(), color="#9a9a9a", ls="--", lw=1.2, label="left to its driver")
    print(f"| library | updates | steps | CPU s | reward, first | reward, last |\n{'| --- ' * 6}|")
    for name, label in NAMES.items():
        if not (KEPT / f"{name}.json").exists():
            continue
        kept = json.loads((KEPT / f"{name}.json").read_text())
        steps, rewards = zip(*kept["rows"], strict=True)
        left.plot([s / 1000 for s in steps], rewards, lw=1.6, label=label)
        print(f"| {label} | {len(steps)} | {steps[-1]} | {kept['cpu_s']:.0f} | {rewards[0]:.3f} | {rewards[-1]:.3f} |")
    print(f"Left to its driver, who commands nothing: {alone:.3f}.")
    left.set(xlabel="steps of all rings (thousands)", ylabel="mean reward of a step", ylim=(0.45, 1.05))
    for right in others:
        right.set(xlabel="CPU seconds of the trial", ylabel="score of the agents' test", title="Ray Tune, APG")
        print(f"\n| learning rate | updates | CPU s | best score | last score |\n{'| --- ' * 5}|")
        for trial in json.loads((KEPT / "tune.json").read_text())["rows"]:
            options, rows = trial["options"], trial["rows"]
            scores = [row["score"] for row in rows]
            label = f"learning rate {options['learning_rate']:g}"
            right.plot([row["cpu_seconds"] for row in rows], scores, lw=1.6, marker=".", label=label)
            last = rows[-1]
            cells = (label[14:], round(last["updates"]), f"{last['cpu_seconds']:.0f}", max(scores), scores[-1])
            print("| " + " | ".join(f"{c:.3f}" if isinstance(c, float) else str(c) for c in cells) + " |")
    for axis in (left, *others):
        axis.grid(alpha=0.25)
        axis.legend(frameon=False, fontsize=7.5)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run, or show."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="+", choices=[*NAMES, "tune", "picture"])
    parser.add_argument("--updates", type=int, default=30)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "libraries.png")
    arguments = parser.parse_args()
    KEPT.mkdir(parents=True, exist_ok=True)
    for name in arguments.what:
        if name == "picture":
            picture(arguments.out)
            continue
        began = time.process_time()
        rows = run(name, arguments.updates)
        kept = {"rows": rows, "cpu_s": time.process_time() - began}
        (KEPT / f"{name}.json").write_text(json.dumps(kept, default=float))
        print(f"{name}: {kept['cpu_s']:.0f} CPU s in this process", flush=True)


if __name__ == "__main__":
    main()
