"""Every file that a command writes is read back, also where identifiers hold signs that no terminal shows."""

from __future__ import annotations

import json
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import polars as pl
import pytest

from idm_env.data import load
from idm_env.fitting import sumo
from idm_env.fitting.job import fit_file, simulate_file
from idm_env.fitting.options import Options, Source
from idm_env.model_file import load_model
from tests.data.tables import platoon

ODD = {1: "=1\u00a0+1", 2: "a\u00a0b\x01", 3: "x\u200b\u2028<b>&\"'", 4: "t\t" + 600 * "d"}
"""No-break, zero-width and line-separating signs, a control code, a formula, markup, and a name without end."""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of fit and simulate."""
    folder = tmp_path_factory.mktemp("odd")
    names = pl.col("vehicle_id", "leader_id").replace_strict(ODD, default=None, return_dtype=pl.String)
    platoon(vehicles=4).with_columns(names).write_csv(folder / "odd.csv")
    source = Source(folder / "odd.csv")
    fit_file(source, Options(starts=1), folder / "fit")
    sumo.write(folder / "fit" / "vtypes.add.xml", load_model(folder / "fit" / "model.yaml"))
    simulate_file(source, folder / "fit" / "model.yaml", folder / "simulate")
    return folder


def files(folder: Path, ending: str) -> Iterator[Path]:
    found = sorted(folder.rglob(f"*{ending}"))
    assert found
    return iter(found)


def test_a_model_is_read_back_with_all_its_drivers(written: Path) -> None:
    assert set(load_model(written / "fit" / "model.yaml").drivers) == {f"a/{ODD[n]}" for n in (2, 3, 4)}
    report = json.loads((written / "simulate" / "report.json").read_text(encoding="utf-8"))
    assert report["fitted_on"]["episodes_fitted_on"] == 3


def test_tables_are_read_back_with_all_identifiers(written: Path) -> None:
    for path in files(written / "fit", ".csv"):
        assert set(pl.read_csv(path)["vehicle_id"]) == {ODD[n] for n in (2, 3, 4)}
    assert set(load(written / "odd.csv").table["vehicle_id"]) == set(ODD.values())
    for path in files(written, ".parquet"):
        assert pl.read_parquet(path).height


def test_pages_types_and_reports_are_what_their_extensions_say(written: Path) -> None:
    for path in files(written, ".xml"):
        names = [element.attrib["id"] for element in ElementTree.parse(path).getroot()]
        assert len(set(names)) == 4 and all(name.isprintable() for name in names)
    for path in files(written, ".json"):
        json.loads(path.read_text(encoding="utf-8"))
    for path in files(written, ".html"):
        HTMLParser().feed(path.read_text(encoding="utf-8"))


def test_keys_that_are_no_identifiers_stay_printable(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text('configures: model\neffects: [idm]\nparameters: {"idm\\x1b": {time_gap: 1.0}}\n')
    with pytest.raises(ValueError, match="must be printable"):
        load_model(tmp_path / "a.yaml")
