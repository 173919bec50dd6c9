"""Discovery on top of another car-following law than IDM, and how laws compare on runs kept back."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch

from idm_env.data import synthetic
from idm_env.discovery import bases, discover, page, write_report
from idm_env.discovery.calibrate import first_prior
from idm_env.discovery.compare import ERRORS, Comparison
from idm_env.discovery.judge import Judged
from idm_env.discovery.march import Catalogue
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.records import Records, whole
from idm_env.discovery.solve import Problem
from idm_env.effects import ALL, BASES, Brakes, Replay, base_named
from idm_env.fitting.batch import Batch
from idm_env.fitting.problem import Problem as FitProblem
from idm_env.model_file import load_model
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from tests.discovery.conftest import Mixing


@pytest.mark.parametrize("name", [n for n in BASES if n != "idm"])
def test_the_loop_of_a_law_is_the_simulator(platoon: Records, name: str) -> None:
    """Within 1e-9 m, at the population's parameters."""
    law = base_named(name)
    rows, prior = whole(platoon), first_prior(law.declared)
    problem = Problem(rows, None, prior)
    model = Hypothesis((), Catalogue((), law, located=False))
    mine = problem.predict(np.tile(prior.centre, (1, problem.groups, 1)), model, np.zeros((1, 0)))[0][0]
    simulator = Simulator(Lane(), (law, Replay(), Brakes()), dt=platoon.dt, integration="midpoint")
    batch = Batch.stack(platoon.episodes, substeps=1)
    measured = FitProblem(simulator, batch, (), (), torch.zeros(len(batch), dtype=torch.long), ("all",), kernels=False)
    given = zip(law.declared, np.exp(prior.centre), strict=True)
    values = {f"{name}.{p.name}": torch.full((len(batch),), float(x), dtype=torch.float64) for p, x in given}
    with torch.no_grad():
        reference = measured.simulate(values).gap.numpy()[4::5].T
    count = min(mine.shape[1], reference.shape[1])
    assert float(np.abs(mine[:, :count] - reference[:, :count])[rows.valid[:, :count]].max()) < 1e-9


def assert_a_model_has_one_figure(report: dict[str, Any]) -> None:
    """Every error of a model is one number, in whichever table it stands."""
    own, *others = report["models"].values()
    null = report["models"].get("model_law.yaml") or report["models"].get("model_idm.yaml") or own
    told: dict[tuple[str, str], set[float]] = {}

    def tell(title: str, errors: dict[str, float]) -> None:
        for key in ERRORS:
            if key in errors:
                told.setdefault((title, key), set()).add(round(errors[key], 9))

    for row in report["bases"]:
        tell(row["title"], row)
    with_what = next((title for title in (own, *others) if title.startswith(f"{null} with ")), "")
    for title, side in ((null, "before"), (with_what, "after")):
        tell(title, report["error"][side])
        tell(title, {key: change[side] for key, change in report["helps"].items()})
    rungs, free = (list(report["ladder"][name].values()) for name in ("rungs_m", "free_m"))
    for title, place in ((null, 1), (with_what, 2)):
        tell(title, {"gap_rmse_m": free[place], "horizon_rmse_m": rungs[place]})
    assert len(told) > 3 * len(BASES) and {key: figures for key, figures in told.items() if len(figures) > 1} == {}


def test_effects_are_sought_on_the_law_of_the_data_too(tmp_path: Path) -> None:
    """IDM, which made the data, is better than the law that was to be completed; the hidden effect is found on it."""
    data = synthetic.generate(21, runs=8, followers=2, seconds=90.0, effect="leader_acceleration")[0]
    found = discover(data, effects=["leader_acceleration", "lag"], base="iidm")
    report = found.report
    assert report["verdict"] == "named" and [f["effect"] for f in report["found"]] == ["leader_acceleration"]
    assert report["found"][0]["parameters"]["gain"]["estimate"] == pytest.approx(0.4, rel=0.1)
    rows = report["bases"]
    assert rows[0]["base"] == "iidm" and {row["base"] for row in rows if not row["own"]} == set(BASES)
    assert rows[-1]["own"] == [name for name, effect in ALL.items() if effect.per_driver]
    assert "own strengths" in rows[-1]["title"]
    error = {row["base"]: row["gap_rmse_m"] for row in rows if not row["own"]}
    assert min(error, key=error.get) == "idm"  # type: ignore[arg-type]
    assert_a_model_has_one_figure(report)
    assert all(row["against"]["gap_rmse_m"]["ratio"] for row in rows[1:])
    together = report["completed"]["against"]["gap_rmse_m"]["ratio"]
    assert together == pytest.approx(report["error"]["after"]["gap_rmse_m"] / rows[0]["gap_rmse_m"])
    paths = write_report(found, tmp_path)
    saved = {name: load_model(path) for name, path in paths.items() if name.endswith(".yaml")}
    names = {name: {e.name for e in model.effects} - {"brakes"} for name, model in saved.items()}
    completed = {"idm", "leader_acceleration"}
    assert names == {"model.yaml": completed, "model_law.yaml": {"idm"}, "model_idm.yaml": {"iidm"}}
    text = paths["report.html"].read_text()
    assert report["sentence"].startswith("IDM predicts better than improved IDM") and report["reason"] is None
    assert "which IDM does not see" in report["sentence"] and "Against improved IDM, IDM with" in text


@pytest.mark.parametrize("effect", ["speed_time_gap", None])
def test_linear_controllers_have_their_law_and_what_it_lacks(effect: str | None, kinds: Mixing) -> None:
    """Without an effect it is said that none holds on that law either."""
    kinds(np.ones((8, 2), bool))
    data = synthetic.generate(33, runs=8, followers=2, seconds=90.0, effect=effect)[0]
    found = discover(data, effects=["speed_time_gap"])
    first, *details = found.report["sentence"], *found.report["details"]
    assert re.match(r"Linear constant time gap( without (feed forward|lag))? predicts better than IDM", first)
    assert bool(effect) != any(text.startswith("No effect added to it holds: ") for text in details)
    laws = [next(iter(model.effects)).name for model in found.models.values()]
    if effect:
        assert found.report["found"][0]["effect"] == effect and laws == [
            "constant_time_gap",
            "constant_time_gap",
            "idm",
        ]
        assert found.report["completed"]["against"]["gap_rmse_m"]["high"] < 0.5
        assert_a_model_has_one_figure(found.report)
        ablated = {row["title"]: row for row in found.report["bases"] if row["without"]}
        assert set(ablated) == {f"linear constant time gap without {part}" for part in ("feed forward", "lag")}
        assert {row["parameters"] for row in ablated.values()} == {8}, "a part that is left out is no parameter"
    else:
        assert found.report["reason"] == "law" and found.report["completed"] is None
        best = next(row for row in found.report["bases"] if row["title"] == found.report["models"]["model.yaml"])
        assert best["without"] and best["parameters"] == 8, "what the drivers lack is no part of the law"
        assert found.model.effects[0].name == "constant_time_gap"
        assert page.cards(found.result, "IDM")[0][1] == "better", "the first screen is of the law"


def error(ratio: float) -> dict[str, Comparison]:
    """Return how all errors compare with the null's, sure to within 1 %."""
    return dict.fromkeys(ERRORS, Comparison(1.0, ratio, ratio, ratio - 0.01, ratio + 0.01))


@pytest.mark.parametrize("ratio", [0.9, 1.1])
def test_what_the_parts_of_a_law_do_is_told_beside_it_where_another_law_is_the_best(
    ratio: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a law that predicts better 5 s ahead: else its parts do nothing that would have to be told."""
    asked: list[tuple[str, ...]] = []
    ratios = {"iidm": 0.5, "constant_time_gap": ratio}

    def judged(model: Hypothesis) -> Judged:
        asked.append(model.catalogue.without)
        return cast(Any, model.catalogue.base.kind)

    monkeypatch.setattr(bases, "compare", lambda _, kind, __: error(ratios.get(kind, 1.2)))
    laws = bases.compared(Hypothesis(), cast(Any, "idm"), judged, 0, lambda *_: None)
    assert bases.best_of(laws).law.kind == "iidm"
    assert [parts for parts in asked if parts] == ([("feed_forward",), ("lag",)] if ratio < 1.0 else [])


@pytest.mark.parametrize(
    ("better", "ratio", "tried"),
    [
        ([], 1.0, ["idm", "iidm"]),
        ([], 1.1, ["idm"]),
        ([("idm", True)], 1.1, ["idm", "iidm", "idm_plus"]),
        ([("iidm", True)], 1.0, ["idm", "iidm", "idm_plus"]),
        ([("gipps", False), ("idm", True)], 1.0, ["idm"]),
    ],
    ids=["no worse", "worse", "IDM's own help", "the best other's own help", "a law alone helps"],
)
def test_own_strengths_are_tried_on_the_best_law_alike_as_on_idm(
    better: list[tuple[str, bool]], ratio: float, tried: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """``ratio``: the errors of the improved IDM to IDM's, cross-fitted: those of the very data misled."""
    asked = []
    ratios = dict.fromkeys(better, 0.5) | {("iidm", False): ratio}

    def judged(model: Hypothesis) -> Judged:
        asked.append((model.catalogue.base.kind, bool(model.catalogue.personal)))
        return cast(Any, asked[-1])

    monkeypatch.setattr(bases, "compare", lambda _, law, __: error(ratios.get(law, 1.2)))
    bases.compared(Hypothesis(), cast(Any, "idm"), judged, 0, lambda *_: None)
    assert [kind for kind, personal in asked if personal] == tried
    assert {name for name in BASES if base_named(name).declared == base_named("idm").declared} == {
        "idm", "iidm", "idm_plus",
    }  # fmt: skip
