"""The clock of a training: counts its CPU seconds, evaluates, logs, and keeps the last and the best checkpoint."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from stable_baselines3.common.logger import Logger, configure
from tqdm import tqdm

from agents import common
from agents.common import Arguments
from agents.evaluate import as_judged, evaluate, score
from agents.policy import Policy


def make_logger(arguments: Arguments, done: int) -> Logger:
    """Return where figures go; a training resumed after ``done`` updates logs beside its beginning, not over it."""
    folder = arguments.out / "log" / (f"from{done}" if done else "")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return configure(str(folder), arguments.log.split(","))


class Monitor:
    """Told of every update; ``history`` holds one row per evaluation, with updates, steps and CPU seconds.

    ``with Monitor(…) as monitor:`` closes the log on every way out of a training. ``updates`` counts those that a
    policy has had: row 0 is of the policy before any, told by ``untrained``.

    CPU seconds count from ``began`` (a ``time.process_time()``): making the environments belongs to training, while
    evaluations, logs and checkpoints do not. ``best.pt`` is the trained checkpoint
    with the highest score (``evaluate.score``), the first of equals.
    """

    def __init__(self, agent: str, arguments: Arguments, began: float, saved: Mapping[str, Any] | None = None) -> None:
        self.agent, self.arguments = agent, arguments
        self.test = as_judged(arguments.environment, arguments.judged_in)
        self.last, self.best = arguments.out / "last.pt", arguments.out / "best.pt"
        arguments.out.mkdir(parents=True, exist_ok=True)
        saved = saved or {}
        done = int(saved.get("update", -1)) + 1
        self.logger = make_logger(arguments, done)
        self.history: list[dict[str, Any]] = list(saved.get("history", []))
        self.steps = int(saved.get("steps", 0))
        self.before = float(saved.get("cpu_seconds", 0.0))
        self._begin = began
        self._aside = 0.0
        self._bar = tqdm(total=arguments.updates, initial=done, desc=agent, disable=None, dynamic_ncols=True)

    @property
    def cpu_seconds(self) -> float:
        """CPU seconds of training so far, those before a resume included."""
        return self.before + time.process_time() - self._begin - self._aside

    def untrained(self, policy: Policy) -> None:
        """Evaluate and log a policy before its first update: what the test gives for nothing."""
        begin = time.process_time()
        row = self._evaluated(policy, 0, self.cpu_seconds)
        self._log(row, row)
        self._aside += time.process_time() - begin

    def _evaluated(self, policy: Policy, updates: int, spent: float) -> dict[str, Any]:
        row = {"updates": updates, "steps": self.steps, "cpu_seconds": spent, **evaluate(policy, self.test)}
        self.history.append(row)
        return row

    def _log(self, logged: Mapping[str, Any], row: Mapping[str, Any]) -> None:
        """Log figures, and print those of an evaluation, if there was one."""
        for key, value in logged.items():
            if isinstance(value, (int, float)):
                self.logger.record(key, float(value))
        self.logger.dump(self.steps)
        if row:
            shown = {k: v for k, v in row.items() if isinstance(v, (int, float)) and k not in ("updates", "steps")}
            words = ", ".join(f"{k} {v:.3g}" for k, v in shown.items())
            self._bar.write(f"{self.last}, after {row['updates']} updates: {words}")

    def after(
        self,
        update: int,
        steps: int,
        policy: Policy,
        training: Mapping[str, Any],
        figures: Mapping[str, float],
        keep: Callable[[], None] | None = None,
    ) -> bool:
        """Log an update that made ``steps`` environment steps, keep it, and return whether training goes on.

        ``training`` is kept in the checkpoint, and ``keep`` writes what an agent keeps beside it.
        """
        spent, self.steps = self.cpu_seconds, self.steps + steps
        over = update + 1 >= self.arguments.updates or 0.0 < self.arguments.cpu_seconds <= spent
        begin = time.process_time()
        row: dict[str, Any] = {}
        if over or (update + 1) % self.arguments.evaluate_every == 0:
            row = self._evaluated(policy, update + 1, spent)
        content = {**training, "update": update, "steps": self.steps, "cpu_seconds": spent, "history": self.history}
        content["arguments"] = common.choices(self.arguments)
        if keep is not None:
            keep()
        common.save(self.last, policy, self.agent, self.arguments.environment, content)
        if row and score(row) > max((score(r) for r in self.history[:-1] if r["updates"]), default=-float("inf")):
            common.save(self.best, policy, self.agent, self.arguments.environment, content)
        self._log({**figures, **row, "updates": update + 1, "steps": self.steps, "cpu_seconds": spent}, row)
        self._bar.update()
        self._bar.set_postfix({k: f"{v:.3g}" for k, v in figures.items()}, refresh=False)
        self._aside += time.process_time() - begin
        return not over

    def __enter__(self) -> Monitor:
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.close()
        self.logger.close()
