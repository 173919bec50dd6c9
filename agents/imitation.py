"""Imitation of measured drivers: behaviour cloning, and cloning through the simulator.

* Behaviour cloning fits ``π_θ(o_t)`` to the measured acceleration of every sample by least squares: one step ahead.
* Cloning through the simulator drives π_θ behind the measured leaders, as in calibration, and follows the gradient of
  the spacing error through the whole rollout: ``min_θ Σ_rows √(1/T Σ_t (s_t(θ) − s_t)²)``. It starts from the cloned
  policy.

Both are judged as car-following models are: free simulation behind the measured leaders of held-out pairs, beside IDM
calibrated on the same training pairs. The policy is one for all drivers, without memory, as the pooled IDM is. It
observes what task ``follow`` gives, so the saved policy also drives there.

``python -m agents.imitation --config configs/i80-imitation.yaml --data FOLDER/ngsim_i80_pairs.parquet``
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor
from tqdm import tqdm

from agents import common
from agents.environments import task_of
from agents.monitor import make_logger
from agents.policy import Policy
from idm_env.data import Episode, Trajectories, episodes, load
from idm_env.data.episode import windows
from idm_env.effects import Control
from idm_env.fitting.batch import Batch
from idm_env.fitting.evaluate import pooled_errors
from idm_env.fitting.fit import base_simulator, fit
from idm_env.tasks import Task
from idm_env.tasks.follow import SEEN
from idm_env.types import Command

SCALES = tuple(each.scale for each in SEEN)
"""Of speed, leader's speed (m/s) and gap (m) in an observation, as in task ``follow``."""


def default_data() -> Path:
    """Return where the I-80 pairs are expected: in the folder IDM_ENV_DATA, or beside the checkout."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(os.environ.get("IDM_ENV_DATA", folder)) / "ngsim_i80_pairs.parquet"


@dataclass
class Arguments(common.Arguments):
    """Arguments of imitation; ``evaluate_every`` and ``clone`` have no meaning here.

    Args:
        data: Trajectory file of leader-follower pairs.
        only: Which rows to use, column=value; empty takes all.
        test: Which rows are held out, column=value.
        cloning_steps: Gradient steps of behaviour cloning.
        window: Length of the training rollouts (s).
    """

    environment: Annotated[dict[str, Any], tyro.conf.Suppress] = field(
        default_factory=lambda: {"task": "follow", "max_command": 4.0}
    )
    out: Path = Path("runs/imitation")
    data: Path = field(default_factory=default_data)
    only: str = "in_manifest=true"
    test: str = "split=test"
    cloning_steps: int = 2000
    window: float = 60.0


def observe(speed: Tensor, lead_speed: Tensor, gap: Tensor) -> Tensor:
    """Return the observations ``(…, 3)`` of speeds (m/s) and gaps (m), gaps from −10 to 1000 m as in task follow."""
    return torch.stack((speed / SCALES[0], lead_speed / SCALES[1], gap.clamp(-10.0, 1000.0) / SCALES[2]), dim=-1)


def simulate(policy: Policy, batch: Batch, task: Task) -> tuple[Tensor, Tensor]:
    """Return gap and speed of every driver at the samples after the first, ``(T − 1, rows)``, driven by the policy.

    Leaders are replayed as measured; the driver starts on its measured state; actions mean what they do in ``task``.
    Needs a batch without substeps.
    """
    plain = base_simulator(batch.dt)
    simulator = plain.adding(Control())
    params = simulator.defaults(dtype=batch.gap.dtype)
    state = batch.start(plain, params)
    slices = plain.slices(batch.inputs(plain), batch.steps)
    driver = torch.tensor([False, True])
    gaps, speeds = [], []
    for record in slices:
        seen = observe(state.speed[..., 1], state.speed[..., 0], state.gap[..., 1])
        command = Command(task.command(policy(seen)), driver)
        state = simulator.step(state, {**record, "control": command}, params)
        gaps.append(state.gap[..., 1])
        speeds.append(state.speed[..., 1])
    return torch.stack(gaps), torch.stack(speeds)


def spacing_error(gap: Tensor, batch: Batch) -> Tensor:
    """Return the root mean square spacing error of every row (m); the first sample, where it starts, counts as 0."""
    weight = batch.valid[1:]
    squares = ((gap - batch.gap[1:]) * weight).square().sum(0)
    # Of a row without any error the root has no gradient.
    return (squares / (weight.sum(0) + 1.0) + 1e-12).sqrt()


def judge(policy: Policy, items: Sequence[Episode], task: Task) -> dict[str, float]:
    """Return the errors of a policy on episodes, as ``idm_env.fitting.evaluate`` has them."""
    batch = Batch.stack(items, dtype=torch.float32, substeps=1)
    with torch.no_grad():
        gap, speed = simulate(policy, batch, task)
    weight = batch.valid[1:]
    error = spacing_error(gap, batch)
    speed_error = ((((speed - batch.speed[1:]) * weight).square().sum(0)) / (weight.sum(0) + 1.0)).sqrt()
    smallest = torch.where(weight > 0, gap, torch.inf).amin(0)
    return {
        "gap_rmse_m": float(error.mean()),
        "gap_rmse_median_m": float(error.median()),
        "speed_rmse_mps": float(speed_error.mean()),
        "collisions": int((smallest <= 0).sum()),
        "episodes": len(items),
    }


def calibrated(training: Sequence[Episode], test: Sequence[Episode]) -> dict[str, float]:
    """Return the errors of IDM, one parameter set for all drivers, calibrated on spacing."""
    result = fit(training, by="all")
    return pooled_errors(result.problem, result.own, result.shared, test).summary()


def split(a: Arguments) -> tuple[Sequence[Episode], Sequence[Episode]]:
    """Return training and held-out episodes. ValueError or DataError where there is no such file or split."""
    if not Path(a.data).is_file():
        raise ValueError(f"data = {a.data} is not a file. Give a trajectory file with --data.")
    trajectories: Trajectories = load(a.data)
    if a.only:
        trajectories = trajectories.where(a.only)
    training, test = trajectories.split(a.test)
    return episodes(training, max_gap=None), episodes(test, max_gap=None)


def samples(batch: Batch) -> tuple[Tensor, Tensor]:
    """Return every measured observation, and the acceleration to the next sample (m/s²)."""
    valid = batch.valid[1:] > 0
    seen = observe(batch.speed[:-1], batch.all_speed[:-1, :, 1], batch.gap[:-1])
    return seen[valid], ((batch.speed[1:] - batch.speed[:-1]) / batch.dt)[valid]


def cloned(a: Arguments, training: Sequence[Episode]) -> Policy:
    """Return the policy of behaviour cloning."""
    seen, accel = samples(Batch.stack(training, dtype=torch.float32, substeps=1))
    policy = Policy(len(SCALES), a.hidden)
    policy.mean.copy_(seen.mean(0))
    policy.scale.copy_(seen.std(0))
    common.clone(policy, seen, task_of(a.environment).action(accel), a.cloning_steps)
    return policy


def train(a: Arguments) -> list[dict[str, Any]]:
    """Return one row per model: IDM, behaviour cloning, cloning through the simulator; the last policy is saved."""
    torch.manual_seed(a.seed)
    training, test = split(a)
    task = task_of(a.environment)
    rows: list[dict[str, Any]] = [{"model": "IDM, calibrated on spacing", **calibrated(training, test)}]
    policy = cloned(a, training)
    rows.append({"model": "behaviour cloning", **judge(policy, test, task)})
    last, first, before = a.out / "last.pt", 0, 0.0
    optimiser = torch.optim.Adam(policy.parameters(), lr=a.learning_rate)
    if a.resume:
        trained, content = common.load(last, "follow", "imitation")
        policy.load_state_dict(trained.state_dict())
        saved = content["training"]
        optimiser.load_state_dict(saved["optimiser"])
        first, before = saved["update"] + 1, saved["cpu_seconds"]
    batch = Batch.stack(windows(training, a.window), dtype=torch.float32, substeps=1)
    began, spent = time.process_time() - before, before
    with closing(make_logger(a, first)) as logger, tqdm(range(first, a.updates), "imitation", disable=None) as bar:
        for update in bar:
            optimiser.param_groups[0]["lr"] = common.fall(a.learning_rate, update, a.updates)
            loss = spacing_error(simulate(policy, batch, task)[0], batch).mean()
            norm = common.descend(loss, policy.parameters(), optimiser, a.clip, update, last)
            spent = time.process_time() - began
            training_state = {"update": update, "cpu_seconds": spent, "optimiser": optimiser.state_dict()}
            common.save(last, policy, "imitation", a.environment, training_state)
            for name, value in (("rmse", float(loss.detach())), ("norm", norm), ("cpu_seconds", spent)):
                logger.record(name, value)
            logger.dump(update)
            bar.set_postfix(rmse=f"{float(loss.detach()):.3f}", norm=f"{norm:.2g}", refresh=False)
            if 0.0 < a.cpu_seconds <= spent:
                break
    rows.append({"model": "cloning through the simulator", **judge(policy, test, task), "cpu_seconds": spent})
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    """Train as the command line says, and print the table."""
    rows = common.command_line(train, Arguments, "imitation", argv)
    print("model | held-out spacing RMSE (m): mean | median | speed RMSE (m/s) | collisions | pairs")
    for r in rows:
        print(
            f"{r['model']} | {r['gap_rmse_m']:.3f} | {r['gap_rmse_median_m']:.3f} | {r['speed_rmse_mps']:.3f} "
            f"| {r['collisions']} | {r['episodes']}"
        )


if __name__ == "__main__":
    main()
