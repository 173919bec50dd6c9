"""A model is rolled among its own kind: waves grow and vehicles touch where they must, and the page says so."""

from __future__ import annotations

import pytest

from idm_env.discovery import words
from idm_env.discovery.rolled import FOLLOWERS, Rolled, roll
from idm_env.effects import IDM, Brakes, Effect, make
from idm_env.model_file import Model

NUMBERS = {"max_accel": 1.0, "comfort_decel": 1.5, "time_gap": 1.0, "min_gap": 2.0, "desired_speed": 30.0}


def drivers(*effects: Effect, parameters: dict[str, dict[str, float]] | None = None, **idm: float) -> Model:
    numbers = {"idm": NUMBERS | idm, **(parameters or {})}
    return Model((IDM(), *effects, Brakes()), numbers, integration="midpoint")


def test_waves_grow_with_idm_that_is_not_string_stable_and_fade_where_it_is() -> None:
    """a = 1, T = 1 at 10 m/s amplifies (Treiber, Kesting 2013, ch. 15); a = 3, T = 2 does not."""
    unstable, stable = roll(drivers(), 10.0), roll(drivers(max_accel=3.0, time_gap=2.0), 10.0)
    assert unstable is not None and stable is not None
    assert unstable.amplification > 1.5 and stable.amplification < 0.5
    assert unstable.crashed == stable.crashed == 0 and unstable.ring_s is stable.ring_s is None


def test_late_drivers_run_into_their_leaders_on_the_ring_and_behind_one_that_brakes() -> None:
    late = roll(drivers(make("delay"), parameters={"delay": {"delay": 1.0}}, max_accel=2.5, time_gap=0.5), 10.0)
    assert late is not None and late.crashed > 0 and late.ring_s is not None and 0.0 < late.ring_s < 120.0
    idm = roll(drivers(max_accel=2.5, time_gap=0.5), 10.0)
    assert idm is not None and idm.crashed == 0 and idm.ring_s is None
    (_, platoon, crash), (_, ring, when) = words.rolled({"model.yaml": late, "model_idm.yaml": idm})
    assert platoon == ring == "worse" and f"{late.crashed} run into their leader; IDM: " in crash
    assert when.startswith("collision after") and "no collision" in when
    assert [state for _, state, _ in words.rolled({"model.yaml": late})] == ["", ""]


@pytest.mark.parametrize(("model", "idm", "state"), [(1.2, 0.8, "worse"), (1.9, 1.2, ""), (0.9, 0.5, "")])
def test_waves_that_grow_where_idms_fade_are_worse(model: float, idm: float, state: str) -> None:
    rolls = {"model.yaml": Rolled(model, 0, None, 0.1), "model_idm.yaml": Rolled(idm, 0, None, 0.1)}
    assert [said for _, said, _ in words.rolled(rolls)] == [state, ""]


def test_drivers_of_the_model_take_turns_and_measured_inputs_are_refused() -> None:
    one, two = {"idm": {"time_gap": 0.8}}, {"idm": {"time_gap": 2.5}}
    model = drivers()
    mixed = Model(model.effects, model.parameters, drivers={"a": one, "b": two}, integration="midpoint")
    each = [roll(m, 10.0) for m in (mixed, drivers(time_gap=0.8), drivers(time_gap=2.5))]
    assert None not in each and each[0] not in each[1:]
    assert roll(drivers(make("lateral")), 10.0) is None and words.rolled({}) == []
    assert str(FOLLOWERS) in words.rolled({"model.yaml": Rolled(1.0, 0, None, 0.0)})[0][0]


@pytest.mark.parametrize("speed", [0.5, 35.0])
def test_no_speed_of_the_data_is_refused(speed: float) -> None:
    assert roll(drivers(), speed) is not None
