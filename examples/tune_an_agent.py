"""Search an agent's options with Ray Tune: trials of analytic policy gradients, judged by the agents' own test.

Run from a checkout, as `agents/` is no part of the package. `ray.init("HOST:PORT")` runs the same trials on a cluster.
"""

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import ray
from ray import tune

ROOT = Path(__file__).resolve().parents[1]
SPACE = {"learning_rate": tune.grid_search([1e-3, 3e-3])}


def trial(options: dict[str, Any]) -> None:
    """Train with the options of one trial, and report every evaluation: the score is that of the agents' own test."""
    sys.path.insert(0, str(ROOT))
    import torch

    from agents import apg, common
    from agents.evaluate import score

    torch.set_num_threads(1)
    arguments = common.load_agent(ROOT / "configs" / "ring-apg.yaml", apg.Arguments, "apg")
    arguments.out = Path("agent")  # Tune gives every trial a folder of its own
    for name, value in options.items():
        setattr(arguments, name, value)
    for row in apg.train(arguments):
        told = ("updates", "cpu_seconds", "speed_ratio", "speed_std", "passed")
        tune.report({"score": score(row), **{name: float(row[name]) for name in told}})


def search(folder: Path, space: dict[str, Any], **every: Any) -> tune.ResultGrid:
    """Run the trials of a space; `every` are options that all of them have."""
    tuner = tune.Tuner(
        tune.with_resources(trial, {"cpu": 1}),
        param_space={**every, **space},
        tune_config=tune.TuneConfig(metric="score", mode="max"),
        run_config=tune.RunConfig(storage_path=str(folder), name="ring", verbose=0),
    )
    return tuner.fit()


if __name__ == "__main__":
    ray.init("local", include_dashboard=False, log_to_driver=False, logging_level="ERROR", num_cpus=2)
    with tempfile.TemporaryDirectory() as place:
        # Two updates of few, young rings: enough to see it work. Without `small` a search finds something.
        young = {"task": "ring", "warmup": 100, "failsafe": 3.0}
        small = {"updates": 2, "count": 8, "window": 100, "environment": young}
        found = search(Path(place), SPACE, **small)
    ray.shutdown()
    for one in found:
        assert one.error is None, one.error
        print(f"learning_rate {one.config['learning_rate']:g}: score {one.metrics['score']:.3f}")
    print(f"best: learning_rate {found.get_best_result().config['learning_rate']:g}")
