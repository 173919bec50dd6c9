"""Desired speeds by place are found on generated data where a column measures the bends."""

from __future__ import annotations

import dataclasses

import pytest

from idm_env.data import synthetic
from idm_env.discovery import discover

pytestmark = pytest.mark.usefixtures("two_laws")


def test_a_lateral_acceleration_is_found_where_the_path_is_measured() -> None:
    """And where it is not, the candidate says what it lacks."""
    data = synthetic.generate(31, runs=8, followers=2, seconds=150.0, effect="curve_speed")[0]
    found = discover(data, effects=["curve_speed", "drag"])
    assert [f["effect"] for f in found.report["found"]] == ["curve_speed"], found.report["sentence"]
    told = found.report["found"][0]["parameters"]["lateral_accel"]
    assert told["estimate"] == pytest.approx(2.0, rel=0.15) and told["unit"] == "m/s²"
    effect = found.model.effects[1]
    assert effect.name == "curve_speed" and max(map(abs, effect.profile)) > 0.01  # type: ignore[attr-defined]
    blind = dataclasses.replace(data, table=data.table.drop("curvature"))
    with pytest.raises(ValueError, match="curve_speed: the file has no column curvature"):
        discover(blind, effects=["curve_speed"])
