"""Doctor and citations: what does not work is named with its cure, what an effect is taken from is said."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import idm_env
from idm_env.cli import doctor
from idm_env.cli.answers import citations
from idm_env.effects import ALL, IDM, Brakes, Delay
from idm_env.model_file import Model, save_model

ROOT = Path(__file__).resolve().parents[1]


def test_a_machine_that_works_is_told_so(tmp_path: Path) -> None:
    """Every finding is one of three states, and what is not well has a cure, or needs none."""
    found = {finding.what: finding for finding in doctor.findings(tmp_path)}
    assert found["kernels"].state in ("ok", "missing") and found["results"].state == "ok"
    assert {"torch", "threads", "GPU", "cache of printed steps", "extra data"} <= set(found)
    for finding in found.values():
        assert finding.state in ("ok", "missing", "broken")
        assert finding.state != "broken" or finding.cure


def test_what_is_broken_is_named_with_its_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder that is a file, a kernel that raises, kernels switched off, more threads than processors."""
    (tmp_path / "file").write_text("")
    last = doctor.findings(tmp_path / "file" / "out")[-1]
    assert last.state == "broken" and "--out" in last.cure
    monkeypatch.setattr(doctor, "_compared", lambda: 1 / 0)
    assert doctor._kernels().state == "broken" and "ZeroDivisionError" in doctor._kernels().told
    monkeypatch.setenv("IDM_ENV_KERNELS", "0")
    assert doctor._kernels().state == "missing"
    monkeypatch.setattr("torch.get_num_threads", lambda: 4096)
    assert "OMP_NUM_THREADS" in doctor._threads().cure


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """By what it lacks."""
    monkeypatch.setattr(
        doctor, "requires", lambda _: ["numpy>=1", "polars>=1; extra == 'data'", "nosuch; extra == 'data'"]
    )
    found = doctor._extra("data")
    assert found.state == "missing" and found.told == "absent: nosuch" and "idm-env[data]" in found.cure


def test_every_effect_of_a_publication_cites_it_in_full() -> None:
    """Whoever is named with a year in a docstring's first lines stands in full in its sources."""
    for name, cls in ALL.items():
        told = re.findall(r"\b((?:19|20)\d\d)\b", (cls.__doc__ or "").split("::")[0])
        if told and name not in ("imagined",):
            assert cls.sources, f"{name} names a publication of {told} and has no sources"
        for source in cls.sources:
            assert re.search(r"\((?:19|20)\d\d\)", source) and source.endswith((".", *"0123456789"))
    lines = citations({"delay": Delay, "perception_noise": ALL["perception_noise"], "brakes": Brakes})
    assert len(lines) == 2 and lines[0].endswith("[delay, perception_noise]") and "brakes" in lines[1]


def test_a_model_s_citations_on_the_command_line(tmp_path: Path) -> None:
    """Those of its effects, no others."""
    save_model(tmp_path / "model.yaml", Model((IDM(), Delay(), Brakes())))
    call = [sys.executable, "-m", "idm_env", "effects", str(tmp_path / "model.yaml"), "--cite"]
    told = subprocess.run(call, capture_output=True, text=True, check=True).stdout
    assert "Hennecke" in told and "inaccuracies" in told and "Gipps" not in told


def test_the_citation_file_is_of_this_version() -> None:
    """And has what its format asks for."""
    content = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(content)
    assert content["version"] == idm_env.__version__ and content["license"] == "MIT"
