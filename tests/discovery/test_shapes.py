"""An effect in a state of the driver that the catalogue has no name for: found as a shape, and written as a file."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

from benchmarks import discovery as sets
from idm_env.data import synthetic
from idm_env.delay_buffer import PAST
from idm_env.discovery import Discovery, crossed, discover, found, model as terms, write_report
from idm_env.discovery.compare import ERRORS
from idm_env.discovery.march import PULSED, Catalogue
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.result import ParameterEstimate
from idm_env.effects import IDM, Brakes, Effect
from idm_env.effects.free import HISTORY, PER
from idm_env.effects.registry import read
from idm_env.fitting.job import fit_file
from idm_env.fitting.options import Options, Source
from idm_env.model_file import Model, load_model, save_model
from idm_env.reports.undecided import FOUND
from idm_env.roads import Lane
from idm_env.simulator import Simulator

pytestmark = pytest.mark.usefixtures("two_laws")

FEW = {"runs": 10, "followers": 2, "seconds": 120.0}


def hidden(kind: str, seed: int, monkeypatch: pytest.MonkeyPatch) -> Discovery:
    with monkeypatch.context() as patched:
        patched.setattr(synthetic, "Platoon", sets.outside(synthetic.Platoon, kind))
        trajectories, _ = synthetic.generate(seed, **FEW)  # type: ignore[arg-type]
    return discover(trajectories)


@pytest.fixture(scope="module")
def closing() -> Discovery:
    """Closing speeds count double above 2 m/s, for which the catalogue has no name."""
    with pytest.MonkeyPatch.context() as patched:
        return hidden("closing", 83, patched)


def test_an_effect_without_a_name_is_a_shape(closing: Discovery) -> None:
    report = closing.report
    assert report["verdict"] == "shape", report["sentence"]
    (entry,) = report["found"]
    assert entry["effect"] is None and entry["label"] == "time_gap curve over closing_speed"
    assert report["sentence"].startswith("The time gap is ") and "closing speed of" in report["sentence"]
    assert report["helps"]["horizon_rmse_m"]["verdict"] == "better"
    assert report["ceilings"]["smooth_function_gain"] >= entry["held_out_gain"] > 0.2
    # A straight line of closing speeds is another braking: nothing below 2 m/s, and then what counts twice.
    (first, distance, count) = closing.judgement.terms[0].knots
    height = {
        first + distance * i: p["estimate"] for i, p in zip(range(count), entry["parameters"].values(), strict=True)
    }
    assert max(abs(c) for x, c in height.items() if -2.0 < x < 2.0) < 0.06
    assert 0.15 < np.interp(3.0, list(height), list(height.values())) < 0.35
    assert report["error"]["after"]["horizon_rmse_m"] < 0.75 * report["error"]["before"]["horizon_rmse_m"]


def test_no_wrong_name_is_given_to_an_effect_in_two_states(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside a curve over one of them a bias of the gap and a curve over speed passed for findings."""
    report = hidden("speed x gap", 84, monkeypatch).report
    assert report["verdict"] == "shape", report["sentence"]
    assert [f["label"] for f in report["found"]] == ["time_gap curve over gap"]


def test_the_file_of_a_shape_is_the_model_that_was_judged(closing: Discovery, tmp_path: Path) -> None:
    """Its effect, among the candidates of discovery's loop, leaves the errors that the report has."""
    path = write_report(closing, tmp_path)[FOUND]
    effect = read(f"{path}:TimeGapOverClosingSpeed")()
    term = terms.simple(effect)
    base = closing.null.model
    model = Hypothesis((*base.terms, term), Catalogue((*base.named, effect), base.catalogue.base, located=False))
    records, kept = closing.records, closing.report["error"]["held_out_runs"]
    fold = crossed.folds_of(records.runs, kept, closing.report["seed"])
    values = crossed.values_of(closing.problem, closing.final, records.runs, fold)
    errors = crossed.crossed(records, model, values, fold).summary()
    after = closing.report["error"]["after"]
    assert {key: errors[key] for key in ERRORS} == pytest.approx({key: after[key] for key in ERRORS}, rel=0.02)
    estimates = [p["estimate"] for p in closing.report["found"][0]["parameters"].values()]
    assert [p.default for p in effect.declared] == estimates and all(p.null == 0.0 for p in effect.declared)


def test_a_model_may_name_the_file(closing: Discovery, tmp_path: Path) -> None:
    path = write_report(closing, tmp_path)[FOUND]
    own = tmp_path / "own.yaml"
    listed = f'[idm, "{path}:TimeGapOverClosingSpeed", brakes]'
    own.write_text(f"configures: model\nschema: 1\neffects: {listed}\n")
    given = load_model(own, trusted=True)
    assert [e.name for e in given.effects] == ["idm", "found_time_gap_over_closing_speed", "brakes"]
    assert [e.name for e in load_model(tmp_path / "model.yaml").effects][1] == "time_gap_over_closing_speed"


def written(term: terms.Term, heights: np.ndarray, kind: str, folder: Path) -> str:
    """Return ``file:Class`` of a curve that is written as a file, with its heights as estimates."""
    each = zip(term.parameters, heights, strict=True)
    told = {p.name: ParameterEstimate(p.symbol, float(x), 0.0, 1.0, p.unit) for p, x in each}
    (folder / FOUND).write_text(found.source([(term, told)], "A sentence."), encoding="utf-8")
    return f"{folder / FOUND}:{''.join(word.capitalize() for word in kind.split('_'))}"


EVERY = [*product(PULSED, [c for c in terms.STATES if c not in HISTORY], ("", *PER)), *product(PULSED, HISTORY, [""])]


@pytest.mark.parametrize(("what", "coordinate", "by"), [x for x in EVERY if x[1] != x[2]])
def test_every_shape_is_the_same_in_its_file_and_in_the_model(
    what: str, coordinate: str, by: str, tmp_path: Path
) -> None:
    term = terms.curve(what, coordinate, 0.5, terms.STATES[coordinate], 3, by=by)
    heights = np.array([0.3, -0.2, 0.4])
    of_file = read(written(term, heights, f"{what}_over_{coordinate}" + (f"_by_{by}" if by else ""), tmp_path))()
    of_model, numbers = terms.effects_of(Hypothesis((term,)), heights)
    random = np.random.default_rng(0)
    position = torch.from_numpy(np.cumsum(random.uniform(-40.0, -7.0, 60)))
    speed = torch.from_numpy(random.uniform(0.0, 6.0, 60))

    def accelerations(effects: tuple[Effect, ...], given: dict[str, dict[str, float]]) -> torch.Tensor:
        simulator = Simulator(Lane(), (IDM(), *effects, Brakes()))
        params = simulator.defaults(dtype=torch.float64)
        for effect, numbers in given.items():
            params[effect] = {k: torch.tensor(x, dtype=torch.float64) for k, x in numbers.items()}
        state = simulator.state(position, speed, params)
        after = simulator.step(state, {}, params)  # so that leaders have accelerations
        assert bool(effects) is bool(after.memory) or coordinate not in HISTORY
        held = torch.linspace(0.0, 2.0 * terms.STATES[coordinate], 60, dtype=torch.float64)  # a lively past
        memory = {k: held if k != PAST else x * held[:, None, None] for k, x in after.memory.items()}
        return simulator.acceleration(after._replace(memory=memory), {}, params)

    mine, theirs = accelerations((of_file,), {}), accelerations(tuple(of_model), numbers)
    assert torch.allclose(mine, theirs, rtol=0.0, atol=1e-9)
    assert (mine - accelerations((), {})).abs().max() > 1e-6


def phase(what: str) -> tuple[terms.Term, np.ndarray]:
    """Return a curve over the phase of a cycle of 6 s, and its heights."""
    term = terms.curve(what, "time", 0.0, 0.75, 8, 6.0, label=f"{what} over phase")
    return term, 0.4 * np.sin(np.arange(8.0))


@pytest.mark.parametrize("what", PULSED)
def test_a_cycle_goes_by_the_clock_in_its_file_as_in_the_model(what: str, tmp_path: Path) -> None:
    """In a simulator, and in the compiled steps of an environment, over several cycles."""
    term, heights = phase(what)
    of_file = read(written(term, heights, f"{what}_over_phase", tmp_path))()
    of_model, numbers = terms.effects_of(Hypothesis((term,)), heights)
    position, speed = torch.arange(0.0, -300.0, -15.0, dtype=torch.float64), torch.linspace(2.0, 12.0, 20).double()

    def accelerations(*effects: Effect) -> torch.Tensor:
        simulator = Simulator(Lane(), (IDM(), *effects, Brakes()))
        params = simulator.defaults(dtype=torch.float64)
        params |= {
            effect.name: {k: torch.tensor(x, dtype=torch.float64) for k, x in numbers[effect.name].items()}
            for effect in effects if effect.name in numbers
        }  # fmt: skip
        state = simulator.state(position, speed, params)
        clock = torch.arange(0, 150, 4)
        return torch.stack([simulator.acceleration(state._replace(step=step), {}, params) for step in clock])

    mine = accelerations(of_file)
    assert torch.allclose(mine, accelerations(*of_model), rtol=0.0, atol=1e-9)
    assert torch.allclose(mine[:-15], mine[15:], rtol=0.0, atol=1e-9), "60 steps are a cycle"
    assert (mine.amax(0) - mine.amin(0)).max() > 0.05

    def speeds(effects: list[Effect], given: dict[str, dict[str, float]]) -> np.ndarray:
        ring = {"task": "ring", "vehicles": 8, "length": 160.0, "warmup": 0, "dtype": "float64"}
        env = gymnasium.make("DiffIDM-v0", **ring, effects=effects, parameters=given)
        env.reset(seed=3)
        return np.array([env.step(None)[0] for _ in range(90)])

    there = speeds([of_file], {})
    np.testing.assert_allclose(there, speeds(list(of_model), numbers), rtol=0.0, atol=1e-6)
    assert np.abs(there - speeds([], {})).max() > 1e-4


def test_a_fit_keeps_the_file_of_a_cycle(tmp_path: Path) -> None:
    """``fit --model``: drivers are fitted beside it, on the clock of the record."""
    term, heights = phase("time_gap")
    path = written(term, heights, "time_gap_over_phase", tmp_path)
    of_model, numbers = terms.effects_of(Hypothesis((term,)), heights)
    models = [Model((IDM(), read(path)(), Brakes())), Model((IDM(), *of_model, Brakes()), numbers)]
    data = tmp_path / "platoon.csv"
    synthetic.generate(1, runs=1, followers=1, seconds=40.0)[0].table.drop("gap_m", strict=False).write_csv(data)
    fitted = []
    for number, model in enumerate(models):
        save_model(tmp_path / f"{number}.yaml", model)
        options = Options(starts=1, model=str(tmp_path / f"{number}.yaml"))
        fit_file(Source(data), options, tmp_path / str(number))
        fitted.append(load_model(tmp_path / str(number) / "model.yaml"))
    assert fitted[0].effects[1].name == "found_time_gap_over_phase"
    mine, theirs = (model.parameters["idm"] for model in fitted)
    assert mine == pytest.approx(theirs, rel=1e-6)


@pytest.mark.parametrize(
    "place",
    [
        terms.interval("time_gap", "position", 700.0, 1000.0, 0.4),
        terms.curve("time_gap", "position", 0.0, 90.0, 4, 360.0),
    ],
    ids=["interval", "lap"],
)
def test_what_has_a_place_is_no_file(place: terms.Term) -> None:
    told = {p.name: ParameterEstimate(p.symbol, 0.1, 0.0, 1.0, p.unit) for p in place.parameters}
    assert found.source([(place, told)], "A sentence.") == ""
