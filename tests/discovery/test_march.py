"""The compiled loop does what the simulator does, for every effect that discovery can name or locate."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from idm_env.compiled.kernels import threads
from idm_env.compiled.scalar import library
from idm_env.discovery import march, model as terms
from idm_env.discovery.calibrate import first_prior
from idm_env.discovery.march import Catalogue
from idm_env.discovery.model import Hypothesis, Term
from idm_env.discovery.records import Records, Rows, whole, windows
from idm_env.discovery.solve import Problem
from idm_env.effects import CANDIDATES, IDM, Brakes, Replay
from idm_env.fitting.batch import Batch
from idm_env.fitting.problem import Problem as FitProblem
from idm_env.roads import Lane
from idm_env.simulator import Simulator

THETA = np.log([1.4, 1.8, 1.3, 2.2, 28.0])
STRENGTHS = {
    "delay": (0.46,), "lag": (0.5,), "second_leader": (0.3,), "leader_acceleration": (0.4,), "brake_light": (0.5,),
    "asymmetry": (0.3,), "power_limit": (9.0,), "drag": (6e-4,), "speed_dependent_gap": (4.0,), "memory": (0.7, 40.0),
    "follower": (0.15,), "dead_zone": (0.002,), "action_point": (0.3,), "lateral": (0.1,), "gap_bias": (1.2,),
    "speed_time_gap": (-0.3,), "set_point_asymmetry": (0.2,), "relaxation": (0.6, 12.0), "gap_stiffness": (0.6,),
    "leader_trend": (0.6, 5.0),
}  # fmt: skip


def places(records: Records) -> dict[str, tuple[Term, tuple[float, ...]]]:
    low, high = (float(f(records.signals[:, 18])) for f in (np.min, np.max))
    step = (high - low) / 6
    slopes = (0.02, -0.03, 0.04, 0.0, -0.01, 0.03, -0.02)
    middle = (low + 2 * step, low + 4 * step)
    bends = (0.0, 0.02, -0.01, 0.03, 0.0, 0.015, 0.0)
    return {
        "speed_profile": (
            terms.unknown_profile("speed_profile", low, step, 7, 0.0),
            (0.0, -0.4, -0.5, 0.1, -0.6, 0.0, -0.3),
        ),
        "curve_speed": (terms.known_profile("curve_speed", low, step, bends, 0.0), (2.5,)),
        "grade": (terms.unknown_profile("grade", low, step, 7, 0.0), slopes),
        "known grade": (terms.known_profile("grade", low, step, slopes, 0.0), (0.6,)),
        "speed_zone": (terms.placed("speed_zone", 0.6, *middle), (0.6, *middle)),
        "regime_shift": (terms.placed("regime_shift", 0.3, 40.0), (0.3, 40.0)),
        "T over places": (terms.interval("time_gap", "position", *middle, 0.4), (0.4, *middle)),
        "a and b over time": (terms.interval("accel_and_decel", "time", 30.0, 50.0, -0.3), (-0.3, 30.0, 50.0)),
        "push over speed": (terms.curve("acceleration", "speed", 0.0, 5.0, 5), (0.3, -0.2, 0.1, 0.2, -0.1)),
        "push over closing speed": (terms.curve("acceleration", "closing_speed", -1.0, 1.0, 3), (0.3, -0.2, 0.2)),
        "T over relative gap": (terms.curve("time_gap", "relative_gap", 0.6, 0.3, 4), (0.3, -0.2, 0.2, 0.1)),
        "T over gap by closing speed": (
            terms.curve("time_gap", "gap", 8.0, 8.0, 4, by="closing_speed"),
            (0.3, -0.2, 0.2, 0.1),
        ),
        "push over speed by gap": (
            terms.curve("acceleration", "speed", 5.0, 5.0, 3, by="relative_gap"),
            (0.3, -0.2, 0.2),
        ),
        "T over time since stop": (terms.curve("time_gap", "time_since_stop", 0.0, 30.0, 4), (0.4, 0.2, -0.2, 0.1)),
        "v0 over mean speed": (terms.curve("desired_speed", "mean_speed_90s", 2.0, 4.0, 4), (-0.3, -0.2, 0.2, 0.1)),
        "a and b over braking": (terms.curve("accel_and_decel", "braking_15s", 0.0, 0.5, 3), (-0.3, 0.4, 0.2)),
        "push over leader's braking": (terms.curve("acceleration", "lead_braking_15s", 0.0, 0.5, 3), (0.2, -0.3, 0.1)),
        "T over mean speed": (terms.curve("time_gap", "mean_speed_20s", 2.0, 4.0, 4), (-0.3, -0.2, 0.2, 0.1)),
        "push over phase": (terms.curve("acceleration", "time", 0.0, 4.0, 4, 16.0), (0.3, -0.2, 0.1, 0.2)),
    }


def simulated(records: Records, model: Hypothesis, values: np.ndarray) -> np.ndarray:
    """The gap of the simulator, on the samples that discovery keeps."""
    effects, numbers = terms.effects_of(model, values)
    simulator = Simulator(Lane(), (IDM(), Replay(), *effects, Brakes()), dt=records.dt, integration="midpoint")
    batch = Batch.stack(records.episodes, substeps=1)
    problem = FitProblem(
        simulator, batch, (), (), torch.zeros(len(batch), dtype=torch.long), ("all",), kernels=False
    )  # fmt: skip
    given = dict(zip((f"idm.{p.name}" for p in IDM.declared), np.exp(THETA), strict=True))
    given |= {f"{effect}.{name}": x for effect, p in numbers.items() for name, x in p.items()}
    rows = {name: torch.full((len(batch),), float(x), dtype=torch.float64) for name, x in given.items()}
    with torch.no_grad():
        return problem.simulate(rows).gap.numpy()[4::5].T


def twin(records: Records, model: Hypothesis, values: np.ndarray) -> np.ndarray:
    rows = whole(records)
    problem = Problem(rows, None, first_prior())
    theta = np.tile(THETA, (1, problem.groups, 1))
    return problem.predict(theta, model.fixed(values), np.zeros((1, 0)))[0][0]


def modelled(term: Term | None) -> Hypothesis:
    if term is not None and term.profile is not None:
        # A known profile takes the place of the one that would be searched.
        known = terms.known_effect(term)
        return Hypothesis((term,), Catalogue.of([known]))
    return Hypothesis(() if term is None else (term,))


def agrees(records: Records, model: Hypothesis, values: np.ndarray) -> np.ndarray:
    """Hold the loop to the simulator and return its gaps."""
    mine, reference = twin(records, model, values), simulated(records, model, values)
    valid = whole(records).valid
    count = min(mine.shape[1], reference.shape[1])
    worst = float(np.abs(mine[:, :count] - reference[:, :count])[valid[:, :count]].max())
    assert worst < 1e-9, worst
    return mine


def check(records: Records, term: Term | None, values: tuple[float, ...]) -> None:
    mine = agrees(records, modelled(term), np.array(values, float))
    if term is not None:
        without = twin(records, Hypothesis(), np.zeros(0))
        assert np.abs(mine - without)[whole(records).valid].max() > 0.01  # so that the parity is of something


def test_idm_alone(platoon: Records) -> None:
    check(platoon, None, ())


@pytest.mark.parametrize("name", sorted(STRENGTHS))
def test_effect(platoon: Records, name: str) -> None:
    check(platoon, terms.simple(name), STRENGTHS[name])


def test_places_and_times(platoon: Records) -> None:
    found = places(platoon)
    for term, values in found.values():
        check(platoon, term, values)
    assert set(STRENGTHS) | set(found) >= set(CANDIDATES)


def test_all_together(platoon: Records) -> None:
    model = Hypothesis(
        tuple(terms.simple(n) for n in ("delay", "leader_acceleration", "speed_dependent_gap", "drag", "asymmetry"))
    )
    agrees(platoon, model, np.array([0.3, 0.2, 2.0, 3e-4, 0.1]))


def test_windows_share_their_winding_up(platoon: Records) -> None:
    """A window behind others of its record ends where it ends when it is rolled out alone."""
    rows = windows(platoon)
    model, values = Hypothesis((terms.simple("memory"), terms.simple("delay"))), np.array([[0.7, 40.0, 0.46]])

    def ends(some: Rows) -> np.ndarray:
        problem = Problem(some, None, first_prior())
        return problem.predict(np.tile(THETA, (1, problem.groups, 1)), model, values)[0][0]

    together = ends(rows)
    for i in (1, 5, len(rows) - 1):
        pick = {name: getattr(rows, name)[[i]] for name in ("record", "start", "valid", "joined", "block")}
        assert np.array_equal(ends(replace(rows, **pick))[0], together[i])


def test_threads_change_no_bit(platoon: Records, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows are rolled out in as many threads as torch has, and none ends elsewhere, whoever winds up its memory."""
    problem, pieces, split = Problem(windows(platoon), None, first_prior()), list[tuple[int, int]](), threads.split
    model, values = Hypothesis((terms.simple("memory"), terms.simple("delay"))), np.array([[0.7, 40.0, 0.46]])

    def watched(run: Callable[[int, int], None], *how: int) -> None:
        split(lambda begin, end: (pieces.append((begin, end)), run(begin, end))[1], *how)

    monkeypatch.setattr(threads, "split", watched)
    ends = []
    for many in (1, 3):
        monkeypatch.setattr(threads, "count", lambda work, many=many: many)
        ends.append(problem.predict(np.tile(THETA, (1, problem.groups, 1)), model, values))
    assert np.array_equal(*ends) and len(pieces) == 7


def test_a_printed_loop_depends_on_no_number() -> None:
    """Neither the time step nor the length of a lap makes another text, which would be compiled again."""
    texts = {march.loop(Catalogue.of((), lap), dt).text for lap, dt in ((230.0, 0.1), (231.5, 0.1), (230.0, 0.04))}
    assert len(texts) == 1 and march.loop(Catalogue.of(), 0.1).text not in texts


def test_a_loop_is_compiled_once_whatever_its_arrays_are_views_of(platoon: Records) -> None:
    """Drivers of records and of some of them, parameters that vary and those that stand."""
    drag, values = Hypothesis((terms.simple("drag"),)), np.array([6e-4])
    for records in (platoon, platoon.some(np.arange(len(platoon.first)) > 2)):
        rows = whole(records)
        problem, theta = Problem(rows, None, first_prior()), np.tile(THETA, (1, len(records.groups), 1))
        problem.predict(theta, Hypothesis(), np.zeros((1, 0)))
        problem.predict(theta, drag, values[None])
        problem.predict(theta, drag.fixed(values), np.zeros((1, 0)))
    for catalogue in (drag.catalogue, drag.bare.catalogue):
        compiled = library.load("march", march.loop(catalogue, platoon.dt).text).march
        assert len(compiled.signatures) == 1, compiled.signatures


def test_what_has_no_name_ends_with_the_states_that_were_seen() -> None:
    """A residual over the state is nothing beyond them: held on, it drove free simulations away by tens of metres."""
    term = terms.curve("acceleration", "speed", 5.0, 5.0, 3)
    (effect,), numbers = terms.effects_of(Hypothesis((term,)), np.array([0.3, -0.2, 0.4]))
    simulator = Simulator(Lane(), (IDM(), effect, Brakes()))
    params = simulator.defaults(dtype=torch.float64)
    params[effect.name] = {k: torch.tensor(v, dtype=torch.float64) for k, v in numbers[effect.name].items()}
    bare = simulator.without(effect.name)
    added = {}
    for speed in (0.0, 2.5, 5.0, 15.0, 17.5, 20.0, 28.0):
        state = simulator.state(torch.zeros(1).double(), torch.tensor([speed]).double(), params)
        added[speed] = float(simulator.acceleration(state, {}, params) - bare.acceleration(state, {}, params))
    expected = {0.0: 0.0, 2.5: 0.15, 5.0: 0.3, 15.0: 0.4, 17.5: 0.2, 20.0: 0.0, 28.0: 0.0}
    assert added == pytest.approx(expected, abs=1e-12)
    # Places go on as they ended: a road does not stop being what it is.
    assert not terms.curve("time_gap", "position", 0.0, 100.0, 5).fades


TWO_CATALOGUES = """
import sys
import numpy as np
from idm_env.data import episodes, synthetic
from idm_env.discovery.march import Catalogue
from idm_env.discovery.model import Hypothesis, simple
from idm_env.discovery.records import gather
from idm_env.effects import make
from tests.discovery.test_march import twin

records = gather(episodes(synthetic.generate(11, runs=1, followers=1, seconds=30.0)[0], smooth=True))
for name in sys.argv[1:]:
    assert np.isfinite(twin(records, Hypothesis((simple(name),), Catalogue((make(name),))), np.array([0.0]))).any()
"""


def test_what_one_process_compiled_for_two_catalogues_serves_another(tmp_path: Path) -> None:
    """A kept loop names no printed file but its own: a process that prints only the second finds it whole."""
    kept = os.environ | {"IDM_ENV_CACHE": str(tmp_path / "printed"), "NUMBA_CACHE_DIR": str(tmp_path / "numba")}
    for names in (("drag", "gap_bias"), ("gap_bias",)):
        done = subprocess.run(
            [sys.executable, "-c", TWO_CATALOGUES, *names], env=kept, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr[-500:]
