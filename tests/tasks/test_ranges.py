"""Every number that a task takes has a range: what lies outside is one line, at once, and takes no memory."""

from __future__ import annotations

import dataclasses
import math
import resource
from fractions import Fraction
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401
from idm_env.effects.base import hint_of
from idm_env.envs.pettingzoo import parallel_env
from idm_env.roads import Lanes, lane_drop, on_ramp
from idm_env.tasks import TASKS, make_task
from idm_env.tasks.checks import ranges

HUGE = 10**400
ODD: tuple[Any, ...] = (
    math.nan,
    math.inf,
    -math.inf,
    HUGE,
    -HUGE,
    1e308,
    "no",
    "1",
    True,
    [],
    {},
    [1, 2, 3],
    1j,
    b"1",
    np.array(1.0),
    np.bool_(True),
    torch.tensor(1.0),
)
"""What no option takes that is a number."""
OWN = {"controlled", "max_command"}
"""Options that are more than a number, and that say themselves what they take."""


def refused(name: str, option: str, value: Any, **more: Any) -> str:
    with pytest.raises(ValueError) as told:
        make_task(name, **{option: value}, **more)
    text = str(told.value)
    assert "\n" not in text and len(text) < 300, text
    return text


@pytest.mark.parametrize("name", TASKS)
def test_every_option_that_is_a_number_has_a_range(name: str) -> None:
    """A new option without one fails here."""
    known = ranges(TASKS[name])
    for field in dataclasses.fields(TASKS[name]):
        kinds = set(hint_of(field).replace("|", " ").split())
        if kinds & {"int", "float"} and field.name not in OWN:
            assert field.name in known, field.name
            assert -math.inf < known[field.name].low < known[field.name].high < math.inf


@pytest.mark.parametrize("name", TASKS)
def test_what_lies_outside_is_one_line_and_takes_nothing(name: str) -> None:
    """Just outside, far outside, and no number at all; for all options that are numbers, or yes and no."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for option, found in ranges(TASKS[name]).items():
        beyond = (found.low - 1e-3, found.high * 1.001 + 1e-3) if not found.whole else (found.low - 1, found.high + 1)
        for value in (*beyond, 10**9 if found.high < 10**9 else 10**15, *ODD):
            assert refused(name, option, value).startswith(f"{option} = "), (option, value)
    for field in dataclasses.fields(TASKS[name]):
        if isinstance(field.default, bool):
            for value in ("no", "yes", 0, 1, None):
                assert refused(name, field.name, value) == f"{field.name} = {value!r} must be True or False."
    for steps in (0, 10**9 + 1, HUGE, 1e3, "1"):
        assert "max_episode_steps = " in refused(name, "max_episode_steps", steps)
    for command in (1e-9, 101.0, math.nan, HUGE, [-101.0, 1.0], [-1.0, math.inf]):
        assert refused(name, "max_command", command).startswith("max_command")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


def test_numbers_of_other_libraries_are_numbers_or_one_line() -> None:
    """Scalars of numpy and fractions are numbers; arrays and tensors without a dimension are none, nor lists."""
    for length in (np.float32(4.5), Fraction(9, 2)):
        assert type(make_task("ring", vehicle_length=length).vehicle_length) is float  # type: ignore[attr-defined]
    assert type(make_task("ring", vehicles=np.int64(9)).vehicles) is int
    for scalar in (np.array(1.0), torch.tensor(1.0)):
        for option in ("effects", "dt", "controlled", "noise"):
            assert refused("ring", option, scalar).startswith(f"{option} = ")


@pytest.mark.parametrize(
    ("name", "choices", "words"),
    [
        ("highway", {"seen": 10**9}, "seen = 1000000000 must be at most 1000"),
        ("highway", {"lanes_count": 10**9}, "lanes_count = 1000000000 must be at most 100"),
        ("highway", {"lanes_count": 1}, "lanes_count = 1 must be at least 2"),
        ("open_highway", {"lanes_count": 1}, "lanes_count = 1 must be at least 2"),
        ("open_highway", {"length": 1e12}, r"^length = 1e\+12 m must be at most 1e\+06"),
        ("merge", {"entry_speed": 1e6}, r"entry_speed = 1e\+06 m/s must be at most 70"),
        ("merge", {"inflow": 1e9}, r"^inflow = 1e\+09 vehicles an hour must be at most 100000"),
        ("merge", {"inflow": 1e5, "ramp_inflow": 1.0}, "vehicles = 120 leaves none for lane 0.* Take at least 100001"),
        ("ring", {"dt": 1e-9}, "dt = 1e-09 s must be at least 0.001"),
        ("highway", {"lane_commands": "no"}, "lane_commands = 'no' must be True or False"),
        ("highway", {"spread": 0.9, "parameters": {"idm.desired_speed": 60.0}}, "idm.desired_speed = .* is outside"),
    ],
)
def test_options_that_once_took_time_or_were_told_wrongly(name: str, choices: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words) as told:
        make_task(name, **choices)
    assert "\n" not in str(told.value)


def test_a_model_file_is_no_way_round(tmp_path) -> None:
    path = tmp_path / "model.yaml"
    path.write_text("effects: [idm, brakes]\ndt: 1.0e-9\n")
    for name in ("ring", "follow", "replay"):
        assert refused(name, "effects", str(path)).startswith("dt = 1e-09 s must be at least 0.001")


@pytest.mark.parametrize("make", [gym.make, gym.make_vec, lambda _, **choices: parallel_env(**choices)])
def test_what_no_memory_holds_is_refused_in_every_face(make: Any) -> None:
    """Options within their ranges, together."""
    everybody = {"task": "highway", "vehicles": 100_000, "length": 1e6, "controlled": "all", "seen": 1000}
    with pytest.raises(ValueError, match=r"would take about [\d,]+ GB, and cpu has .* Take fewer vehicles or agents"):
        make("DiffIDM-v0", **everybody)


@pytest.mark.parametrize(
    ("ends", "words"),
    [
        ((lane_drop(0, at=-100.0),), "lane 0 ends at -100 m, and begins at 0 m"),
        ((on_ramp(0, begin=-50.0, end=-10.0, entry=-100.0),), "lane 0 ends at -10 m"),
        ((lane_drop(0, at=100.0), lane_drop(1, at=200.0)), "all lanes of this road end"),
    ],
)
def test_a_road_goes_on(ends: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Lanes(2, length=500.0, ends=ends)


@pytest.mark.parametrize("value", [math.inf, True, 1j, HUGE, object(), len], ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("option", ["data", "runs", "model"])
def test_what_a_replay_is_of_has_a_type(option: str, value: Any) -> None:
    """Told by name and in one line; runs of no file are refused, too."""
    assert refused("replay", option, value).startswith(f"{option} = ")
    assert "Give data" in refused("replay", "runs", ["a"])
