"""Does closing the loop pay in control? Policies trained on a plain and on a corrected model, judged in the truth.

    python benchmarks/agents_transfer.py [--out runs/transfer] [--seeds 10] [--executor processes --jobs 8]

Platoons are generated whose drivers react with a hidden delay. From the same data come plain IDM, calibrated, and the
model of ``discover``, which has the effect that it found; both are saved as ``model.yaml``. One APG policy per model
and seed is trained on a ring of that model, and a third kind on the truth itself. All are judged on rings of the
generated drivers, whose parameters and delay are known, also with a failsafe. What is done is kept and skipped.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch  # noqa: E402 (threads are set before torch starts)
from scipy.stats import mannwhitneyu  # noqa: E402

from agents import apg, common  # noqa: E402
from agents.classical import PISaturation, no_command  # noqa: E402
from agents.evaluate import evaluate_ring  # noqa: E402
from agents.rollout import FRESH, LENGTHS, Act  # noqa: E402
from benchmarks import workers  # noqa: E402
from idm_env.progress import OnProgress  # noqa: E402
from idm_env.tasks import make_task  # noqa: E402

Row = dict[str, Any]
EFFECT, STRENGTH, DATA_SEED = "delay", 0.5, 5
FAILSAFE = 3.0
HEAD = (
    "trained on", "seed", "worst speed ratio", "worst std (m/s)", "smallest time gap (s)", "collisions",
    "with a failsafe: ratio, std, collisions", "in its own model: ratio, std, collisions",
)  # fmt: skip
NAMES = ("max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed")
RING = {
    "task": "ring", "dt": 0.1, "integration": "ballistic", "noise": 0.2, "warmup": 750, "warmup_pool": 256,
    "tailgating": 5.0, "tailgating_below": 1.0, "max_command": 3.0,
}  # fmt: skip


def models(out: Path) -> dict[str, Any]:
    """Return the environments of plain, corrected and true drivers; models are written to ``out`` once."""
    from idm_env.config import save_model
    from idm_env.data import episodes, synthetic
    from idm_env.discovery import discover, write_report
    from idm_env.fitting.drivers import Estimates
    from idm_env.fitting.fit import fit
    from idm_env.fitting.job import model_of

    trajectories, truth = synthetic.generate(DATA_SEED, effect=EFFECT, strength=STRENGTH)
    plain, corrected = out / "plain.yaml", out / "corrected" / "model.yaml"
    out.mkdir(parents=True, exist_ok=True)
    if not plain.exists():
        save_model(plain, model_of(Estimates.of(fit(episodes(trajectories, max_gap=None, smooth=True), by="all"))))
    if not corrected.exists():
        write_report(discover(trajectories, seed=DATA_SEED), corrected.parent)
    drivers = truth.drivers[:22]
    return {
        "plain IDM": {**RING, "effects": str(plain)},
        "corrected model": {**RING, "effects": str(corrected)},
        "the truth": {
            **RING,
            "effects": [EFFECT],
            "parameters": {"idm": {name: drivers[name].to_list() for name in NAMES}, EFFECT: {EFFECT: STRENGTH}},
        },
    }


@dataclass(frozen=True)
class Training:
    """A policy to be trained: in which environment, with which seed, into which folder."""

    environment: Row
    seed: int
    out: Path

    def __str__(self) -> str:
        return str(self.out)


def train(part: Training, on_progress: OnProgress) -> None:
    """Train a policy, unless it is there."""
    if not (part.out / "done").exists():
        apg.train(
            apg.Arguments(
                environment=part.environment, out=part.out, seed=part.seed, updates=16, evaluate_every=1e9, explore=0.0
            )
        )
        (part.out / "done").touch()


def judge(act: Act | None, environment: dict[str, Any]) -> Row:
    """Return the figures on six lengths and five draws, from a take-over after the warm-up of the training on."""
    return evaluate_ring(act, environment, warmup=RING["warmup"], draws=FRESH)


def main() -> None:
    """Train what is missing, judge all in the truth, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/transfer"))
    parser.add_argument("--seeds", type=int, default=10)
    workers.add(parser)
    options = parser.parse_args()
    torch.set_num_threads(1)
    out = options.out.resolve()
    environments = models(out)
    parts = {
        name: [Training(where, seed, out / name.replace(" ", "-") / f"seed{seed}") for seed in range(options.seeds)]
        for name, where in environments.items()
    }
    with workers.of(options) as executor:
        deque(executor.map(train, [part for some in parts.values() for part in some]), 0)
    truth = environments["the truth"]
    guarded = {**truth, "failsafe": FAILSAFE}
    print("| " + " | ".join(HEAD) + " |\n|" + " --- |" * len(HEAD))
    show("human drivers", "", judge(None, truth), None, None)
    show("no command", "", judge(no_command, truth), judge(no_command, guarded), None)
    by_hand = (judge(PISaturation(make_task(**RING)), where) for where in (truth, guarded))
    show("PI with saturation", "", *by_hand, None)
    touched: dict[str, list[int]] = {}
    for name, environment in environments.items():
        for part in parts[name]:
            policy = common.load(part.out / "last.pt", "ring", "apg")[0]
            judged = [judge(policy, where) for where in (truth, guarded, environment)]
            show(name, str(part.seed), *judged)
            touched.setdefault(name, []).append(judged[0]["collisions"])
    for name, counts in touched.items():
        p = mannwhitneyu(touched["plain IDM"], counts).pvalue
        rings = len(counts) * len(FRESH) * len(LENGTHS)
        print(f"{name}: {sum(counts)} of {rings} rings with a collision, {len(counts)} seeds; Mann-Whitney p {p:.4f}")
    print(json.dumps({"effect": EFFECT, "strength": STRENGTH, "data_seed": DATA_SEED}))


def show(name: str, seed: str, r: Row, guarded: Row | None, own: Row | None) -> None:
    """Print one row: in the truth, there with a failsafe, and in the model of the training."""
    figures = f"{r['speed_ratio']:.3f} | {r['speed_std']:.2f} | {r['time_gap']:.2f} | {r['collisions']}"
    others = [f"{x['speed_ratio']:.3f}, {x['speed_std']:.2f}, {x['collisions']}" if x else "–" for x in (guarded, own)]
    print(f"| {name} | {seed} | {figures} | {others[0]} | {others[1]} |", flush=True)


if __name__ == "__main__":
    main()
