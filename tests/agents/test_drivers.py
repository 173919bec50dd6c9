"""The study among other drivers, run for real on a few short rings; and which environments its kinds are."""

from __future__ import annotations

import json

import pytest

from agents import evaluate, reference
from agents.evaluate import kinds
from agents.rollout import ring_start
from benchmarks import agents_drivers

SHORT = {"warmup": 20, "warmup_pool": 2}
QUICK = {"count": 2, "window": 5, "updates": 1}


@pytest.fixture
def small(monkeypatch):
    for module in (evaluate, reference):
        monkeypatch.setattr(module, "STEPS", 120)
    monkeypatch.setattr(evaluate, "JUDGED", 60)
    two = lambda environment: dict(list(kinds(environment).items())[:2])  # noqa: E731 (a name for two patches)
    for module in (evaluate, agents_drivers):
        monkeypatch.setattr(module, "kinds", two)
    monkeypatch.setattr(agents_drivers, "FRESH", (1,))
    variants = {"as ever": (SHORT, QUICK), "drawn": ({**SHORT, **agents_drivers.DRAWN}, {**QUICK, "recurrent": 2})}
    monkeypatch.setattr(agents_drivers, "VARIANTS", variants)


def test_variants_are_trained_judged_and_kept_and_passers_of_the_test_beside_them(small, tmp_path, monkeypatch, capsys):
    row = {"row": "constants", "tried": 25, "passed": ["0.02 m/s²"]}
    kept = tmp_path / "benchmark" / "reference" / "failsafe-shock" / "row0" / "result.json"
    kept.parent.mkdir(parents=True)
    kept.write_text(json.dumps(row))
    out = tmp_path / "drivers"
    words = ["agents_drivers", "--only", "as ever", "drawn", "--seeds", "1", "--out", str(out), "--reference"]
    monkeypatch.setattr("sys.argv", [*words, str(tmp_path / "benchmark")])
    agents_drivers.main()
    first = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    told = [[cell.strip() for cell in line.split("|")[1:-1]] for line in first]
    names = [line[0] for line in told if len(line) == 10]
    assert names == ["trained among", "---", "IDM for all", "as ever", "drawn"]
    assert any(line[:2] == ["constants: 0.02 m/s²", "25"] and len(line) == 4 for line in told)
    # What is done is read, not done again.
    monkeypatch.setattr(agents_drivers.apg, "train", None)
    monkeypatch.setattr(agents_drivers, "evaluate_ring", None)
    monkeypatch.setattr(agents_drivers, "judge", None)
    agents_drivers.main()
    assert [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")] == first


def test_a_kind_of_drivers_is_what_its_name_says():
    made = kinds({"task": "ring", "parameters": {"idm": {"time_gap": 1.5}}})
    assert len(made) == 10
    for name, factor in (("time_gap −20 %", 0.8), ("time_gap +20 %", 1.2)):
        start = ring_start(made[name], (230.0,), 5)
        assert float(start.params["idm"]["time_gap"]) == pytest.approx(1.5 * factor)
        assert float(start.params["idm"]["max_accel"]) == 1.0
