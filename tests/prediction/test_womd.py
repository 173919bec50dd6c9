"""Readers of scenarios: JSON and TFRecord give the same scene; what is broken is named."""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path

import numpy as np
import pytest

from idm_env.data import DataError
from idm_env.data.womd import scenarios
from tests.prediction import scenes

womd_record = pytest.importorskip("idm_env.data.womd_record")
pytest.importorskip("google.protobuf", reason="protobuf is not installed")


def write_json(path: Path, **choices: object) -> Path:
    path.write_text(json.dumps(scenes.as_json(**choices)))  # type: ignore[arg-type]
    return path


def test_json_and_tfrecord_give_the_same_scene(tmp_path: Path) -> None:
    (tmp_path / "fork.tfrecord").write_bytes(2 * scenes.frame(scenes.as_record([0, 1])))
    with gzip.open(tmp_path / "fork.json.gz", "wt") as file:
        json.dump(scenes.as_json([0, 1], signal=True), file)
    (one,) = scenarios(tmp_path / "fork.json.gz")
    two, again = scenarios(tmp_path / "fork.tfrecord")
    assert two.id == one.id == again.id == "fork"
    assert one.to_predict == two.to_predict == (0, 1) and one.present == two.present == 10
    for a, b in zip(one.agents, two.agents, strict=True):
        assert (a.id, a.kind) == (b.id, b.kind)
        assert np.allclose(a.position, b.position) and np.allclose(a.velocity, b.velocity, atol=1e-5)
        assert np.allclose(a.heading, b.heading, atol=1e-6) and a.valid.all() and b.valid.all()
    assert [lane.id for lane in one.lanes] == [lane.id for lane in two.lanes] == [1, 2, 3]
    assert two.lanes[0].exits == (2, 3) and one.lanes[0].exits is None
    assert two.lanes[0].speed_limit == pytest.approx(13.41, abs=0.01) and np.isnan(one.lanes[0].speed_limit)
    for a, b in zip(one.controls, two.controls, strict=True):
        assert a.shows == b.shows and np.allclose(a.point, b.point)
    assert [(c.shows, c.lanes) for c in two.controls] == [("sign", (1,)), ("stop", (2,))]


def test_checksums_are_those_of_tensorflow() -> None:
    """CRC-32C of '123456789' is 0xE3069283 (RFC 3720); TFRecord rotates it by 15 bits and adds a constant."""
    crc = 0xE3069283
    assert womd_record.masked_crc(b"123456789") == (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF


def test_older_files_without_metadata_predict_everybody(tmp_path: Path) -> None:
    (scenario,) = scenarios(write_json(tmp_path / "old.json", invalid=2))
    assert scenario.to_predict == (0, 1, 3)
    assert "names no tracks_to_predict" in scenario.notes[0]


def test_a_truncated_record_is_named_after_the_whole_ones(tmp_path: Path) -> None:
    data = scenes.frame(scenes.as_record([0]))
    for cut, message in ((-10, "truncated in record 1"), (-len(data) + 5, "truncated in the header of record 1")):
        path = tmp_path / "cut.tfrecord"
        path.write_bytes((data + data)[:cut])
        found = []
        with pytest.raises(DataError, match=message):
            for scenario in scenarios(path):
                found.append(scenario)
        assert len(found) == 1


def test_damaged_files_are_named(tmp_path: Path) -> None:
    data = bytearray(scenes.frame(scenes.as_record([0])))
    data[100] ^= 1
    cases: dict[str, tuple[bytes, str]] = {
        "bits.tfrecord": (bytes(data), "data of record 0 are damaged"),
        "text.tfrecord": (b"this is no record at all", "header of record 0 is damaged"),
        "other.tfrecord": (scenes.frame(b"\xff\xff\xff"), "no scenario.proto"),
        "half.json": (b'{"objects": [', "cannot be read"),
        "empty.json": (b"{}", "has no 'objects'"),
        "wrong.json": (b'{"objects": [{"valid": [true]}]}', "lacks what a scenario needs"),
        "scene.xml": (b"", "unknown extension"),
    }
    for name, (content, message) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=message):
            list(scenarios(tmp_path / name))
    with pytest.raises(DataError, match="does not exist"):
        list(scenarios(tmp_path / "missing.json"))


def test_a_track_to_predict_must_exist(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="track_index 9 to predict is outside the 4 agents"):
        list(scenarios(write_json(tmp_path / "x.json", wanted=[9])))


def test_unknown_fields_are_skipped() -> None:
    """A record of the full schema has many fields more."""
    message = womd_record.messages()["Scenario"]()
    extra = struct.pack("<B", 99 << 3 & 0x7F | 0x80) + b"\x06" + b"\x2a"  # field 99, varint 42
    message.ParseFromString(scenes.as_record([0]) + extra)
    assert message.scenario_id == "fork"
