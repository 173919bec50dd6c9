"""Other car-following laws than IDM are fitted, saved and simulated by the same machinery."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from idm_env.data import Episode, episodes, synthetic
from idm_env.effects import Brakes, base_named
from idm_env.fitting.evaluate import errors
from idm_env.fitting.fit import base_simulator, fit, own_names
from idm_env.fitting.job import fit_file, problem_of, simulate_file
from idm_env.fitting.options import Options, Source
from idm_env.model_file import Model, load_model


def driven_by(name: str, count: int) -> list[Episode]:
    """Return measured leaders, and behind them drivers of a law with its default parameters, without noise."""
    found = list(episodes(synthetic.generate(5, runs=2, followers=2, seconds=60.0, noise=0.0)[0]))[:count]
    problem, values, _ = problem_of(Model((base_named(name), Brakes())), found)  # type: ignore[arg-type]
    with torch.no_grad():
        simulated = problem.simulate(problem.rows(values, torch.zeros(0, dtype=values.dtype)))
    made = []
    for i, episode in enumerate(found):
        gap = torch.cat((problem.batch.gap[:1, i], simulated.gap[: len(episode) - 1, i])).numpy()
        speed = torch.cat((problem.batch.speed[:1, i], simulated.speed[: len(episode) - 1, i])).numpy()
        place = episode.leader.position_m - episode.leader.length_m - gap
        made.append(replace(episode, gap_m=gap, speed_mps=speed, position_m=place))
    return made


@pytest.mark.parametrize("name", ["fvdm", "gipps", "constant_time_gap"])
def test_a_law_is_recovered_from_its_own_drivers(name: str) -> None:
    """To a few millimetres where it is the right one; IDM is not."""
    made = driven_by(name, 2)
    rmse = {}
    for base in (name, "idm"):
        found = fit(made, by="all", simulator=base_simulator(base=base_named(base)), starts=2, iterations=40)
        assert found.names == own_names(found.problem.simulator)
        assert all(n.startswith(f"{base}.") for n in found.names)
        rmse[base] = float(errors(found.problem, found.own, found.shared)[0].gap_rmse.mean())
    assert rmse[name] < 0.02 and rmse[name] < 0.2 * rmse["idm"], rmse


def test_fit_and_simulate_take_a_base(tmp_path: Path) -> None:
    """``model.yaml`` names the law, and what it is simulated with has the error that was fitted."""
    file = tmp_path / "platoon.csv"
    table = synthetic.generate(1, runs=4, followers=2, seconds=60.0)[0].table
    table.select([c for c in table.columns if c not in ("gap_m", "gap_measured")]).write_csv(file)
    fitted = fit_file(Source(file), Options(starts=1, held_out=0.25, base="iidm"), tmp_path / "fit")
    assert "iidm.time_gap" in fitted["options"]["free"]
    assert "improved IDM fitted to" in (tmp_path / "fit" / "report.html").read_text()
    saved = load_model(tmp_path / "fit" / "model.yaml")
    assert [e.name for e in saved.effects] == ["iidm", "brakes"]
    again = simulate_file(Source(file, where="run_id=1"), tmp_path / "fit" / "model.yaml", tmp_path / "sim")
    assert again["error"]["gap_rmse_m"] < 1.0
    # The law of a saved model is fitted again, with its effects kept; a second one is refused.
    model = str(tmp_path / "fit" / "model.yaml")
    assert own_names(Options(model=model).simulator()[0])[0] == "iidm.max_accel"
    with pytest.raises(ValueError, match=r"has one\. Leave one of them out"):
        fit_file(Source(file), Options(model=model, base="gipps"), tmp_path / "two")
    plain = simulate_file(Source(file), None, tmp_path / "plain", base="gipps")
    assert plain["model"] == "gipps" and plain["error"]["gap_rmse_m"] > 1.0
    with pytest.raises(ValueError, match="either a model"):
        simulate_file(Source(file), None, tmp_path / "none")


@pytest.mark.parametrize("name", ["gips", "delay", "nothing"])
def test_what_is_no_law_is_refused_in_one_line(name: str) -> None:
    """With the nearest name and all there are."""
    with pytest.raises(ValueError, match=r"is no car-following law.*There are: idm, idm_plus"):
        base_named(name)
