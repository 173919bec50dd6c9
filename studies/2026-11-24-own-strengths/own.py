"""Laws with strengths that are each driver's own, judged on all runs by cross-fitting; the README says what came out.

python studies/2026-11-24-own-strengths/own.py FOLDER "AstaZero, ACC" iidm+gap_stiffness+closing_gain+leader_trend ...
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from benchmarks.measured import cases
from idm_env.data import load
from idm_env.discovery import calibrate, crossed, judge, records, search
from idm_env.discovery import model as terms
from idm_env.discovery.compare import compare
from idm_env.discovery.discover import _split, prepare
from idm_env.discovery.march import Catalogue
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.search import Search
from idm_env.discovery.solve import Problem
from idm_env.effects import Effect, Relaxation, base_named, make
from idm_env.effects.base import P
from idm_env.effects.idm import equilibrium_gap
from idm_env.jobs.progress import silent
from idm_env.jobs.storage import Store
from idm_env.parameters import Parameter
from idm_env.types import Driver, Scene


@dataclass(frozen=True)
class OwnRelaxation(Relaxation):
    kind: ClassVar[str] = "own_relaxation"
    declared: ClassVar[tuple[Parameter, ...]] = (
        Parameter("strength", "β", "1", 0.5, 0.02, 0.95, null=0.02),
        Parameter("memory_time", "τ", "s", 15.0, 1.0, 200.0, role="shape"),
    )


@dataclass(frozen=True)
class SpeedPower(Effect):
    """T → T (v / (20 m/s))^(g − 1)."""

    kind: ClassVar[str] = "speed_power"
    rank: ClassVar[int] = 2
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("power", "g", "1", 1.0, 0.2, 4.0, null=1.0),)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        return driver._replace(time_gap=driver.time_gap * (scene.speed * 0.05).clamp(0.15, 2.0) ** (p["power"] - 1.0))


@dataclass(frozen=True)
class TwoBranches(Effect):
    """T → T k^(a_l/√(a_l² + 0.09 m²/s⁴))."""

    kind: ClassVar[str] = "two_branches"
    rank: ClassVar[int] = 2
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("factor", "k", "1", 1.0, 0.3, 3.0, null=1.0),)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        accel = scene.leader.accel
        branch = accel / torch.sqrt(accel * accel + 0.09) * scene.leader.present
        return driver._replace(time_gap=driver.time_gap * p["factor"] ** branch)


@dataclass(frozen=True)
class DeadBand(Effect):
    """No pull to one's own gap s_e within ± w of ln s: all of s* times exp(w tanh(ln(s/s_e)/w))."""

    kind: ClassVar[str] = "dead_band"
    rank: ClassVar[int] = 3
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("width", "w", "1", 0.1, 0.01, 1.5, null=0.01),)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        ratio = scene.leader.gap.clamp_min(0.1) / equilibrium_gap(driver, scene.speed)
        off = torch.log(ratio.clamp(0.05, 20.0))
        scale = 1.0 + (torch.exp(p["width"] * torch.tanh(off / p["width"])) - 1.0) * scene.leader.present
        return driver._replace(
            min_gap=driver.min_gap * scale,
            time_gap=driver.time_gap * scale,
            extra_gap=driver.extra_gap * scale,
            comfort_decel=driver.comfort_decel / (scale * scale),
        )


@dataclass(frozen=True)
class OwnFeed(Effect):
    """+ c a_l."""

    kind: ClassVar[str] = "own_feed"
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("share", "c", "1", 0.1, 0.005, 2.0, null=0.005),)

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        return p["share"] * scene.leader.accel * scene.leader.present


@dataclass(frozen=True)
class OwnLag(Effect):
    """The lag of the package with a strength that is never 0."""

    kind: ClassVar[str] = "own_lag"
    rank: ClassVar[int] = 5
    adds: ClassVar[bool] = False
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("lag", "τ", "s", 0.3, 0.01, 3.0, null=0.01),)

    def limit(self, accel: Tensor, scene: Scene, driver: Driver, p: P) -> Tensor:
        return accel + (scene.accel - accel) * (p["lag"] / (p["lag"] + scene.dt))


TRIED = {cls.kind: cls for cls in (OwnRelaxation, SpeedPower, TwoBranches, DeadBand, OwnFeed, OwnLag)}


def model_of(spec: str) -> Hypothesis:
    """Return the model of ``law+effect+...``, all strengths each driver's own."""
    base, *names = spec.split("+")
    own = tuple(TRIED[name]() if name in TRIED else make(name) for name in names)
    catalogue = Catalogue(own, base_named(base), located=False, personal=tuple(e.name for e in own))
    return Hypothesis(tuple(terms.personal(e) for e in own), catalogue)


def main(folder: Path, case: str, specs: list[str]) -> None:
    chosen = cases(folder)[case]
    everything = prepare(load(folder / chosen["file"]).where(chosen.get("where", ())), "driver")
    fit, kept = _split(everything, 0.25, 0)
    fold, rows = crossed.folds_of(everything.runs, kept, 0), records.windows(everything.of_runs(fit))
    bare = model_of("idm")
    problem = Problem(rows, search.first_noise(rows), calibrate.first_prior(bare.catalogue.own))
    searching, values = Search(problem, [], False, Store(None, "", False), silent, bare), search.starting_values(bare)
    searching.null(bare, judge.unweighed(rows.records, bare, values, problem.prior)[1], values)
    noise = searching.problem.noise
    assert noise is not None
    null = None
    for spec in ("idm", *specs):
        begin, each = time.process_time(), np.zeros((int(fold.max()) + 1, 0))
        whitened = None if null is None else null.whitened
        errors = crossed.crossed(everything, model_of(spec), each, fold, noise, whitened=whitened)
        null = errors if null is None else null
        told = [f"{c.ratio:.2f} ({c.low:.2f} … {c.high:.2f})" for c in compare(null, errors).values()]
        print(f"| {spec} | {' | '.join(told)} | {time.process_time() - begin:.0f} |", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])
