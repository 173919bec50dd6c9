"""The catalogue is open: an effect that the package has never seen is tried, found, saved and loaded."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from idm_env import effects as catalogue
from idm_env.data import Trajectories, synthetic
from idm_env.discovery import discover, march, model as terms, places
from idm_env.discovery.model import Hypothesis, simple
from idm_env.discovery.records import Records
from idm_env.effects import Effect
from idm_env.effects.registry import is_candidate
from idm_env.model_file import load_model, save_model
from idm_env.parameters import Parameter
from tests.discovery.test_march import agrees

pytestmark = pytest.mark.usefixtures("two_laws")

EXAMPLE = Path(__file__).parents[2] / "examples" / "add_an_effect.py"


@pytest.fixture(autouse=True)
def same_catalogue() -> Iterator[None]:
    """What a test registers is gone after it."""
    before = dict(catalogue.ALL)
    yield
    for name in set(catalogue.ALL) - set(before):
        del catalogue.ALL[name]


@dataclass(frozen=True)
class Mood(Effect):
    """Remembers the closing speed, looks half a second back and brakes for both: ``− c (m + v(t − 0.5 s)/100)``."""

    kind: ClassVar[str] = "mood"
    declared: ClassVar[tuple[Parameter, ...]] = (
        Parameter("gain", "c", "1/s", 0.2, -1.0, 1.0, null=0.0),
        Parameter("time", "τ", "s", 3.0, 0.5, 20.0, role="shape"),
    )
    scale: float = 100.0

    @property
    def looks_back(self) -> float:
        return 0.5

    def initial_memory(self, scene: Any, driver: Any, p: Any) -> Any:
        return scene.speed - scene.leader.speed

    def accelerate(self, scene: Any, driver: Any, p: Any) -> Any:
        before = scene.past(0.5 * torch.ones_like(scene.speed)).speed
        return -p["gain"] * (scene.memory[self.name] + before / self.scale)

    def remember(self, scene: Any, driver: Any, p: Any) -> Any:
        level = scene.memory[self.name]
        return level + (scene.speed - scene.leader.speed - level) * -torch.expm1(-scene.dt / p["time"])


@dataclass(frozen=True)
class Fussy(Effect):
    """Cannot be recorded: a Python ``if`` on a tensor."""

    kind: ClassVar[str] = "fussy"
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("gain", "c", "1", 0.2, -1.0, 1.0, null=0.0),)

    def accelerate(self, scene: Any, driver: Any, p: Any) -> Any:
        return p["gain"] if (scene.speed > 1.0) else 0.0 * scene.speed


def tired(seed: int, rate: float, runs: int = 10) -> Trajectories:
    """Trajectories of drivers who want to go slower and slower: v0 exp(−rate t), from the generator's own loop."""

    class Platoon(synthetic.Platoon):  # type: ignore[misc]
        def _rates(self, k: int, known: int, state: np.ndarray) -> np.ndarray:
            drivers = self.drivers
            time = (self.starts + k * self.step)[:, None]
            slower = drivers.desired_speed * np.exp(-rate * time)
            self.drivers = dataclasses.replace(drivers, desired_speed=slower)
            try:
                return super()._rates(k, known, state)
            finally:
                self.drivers = drivers

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "Platoon", Platoon)
        return synthetic.generate(seed, runs=runs, followers=3, seconds=120.0)[0]


def test_an_effect_of_ones_own_is_found_in_data_that_have_it(tmp_path: Path) -> None:
    """README's claim: from its class alone."""
    found = discover(tired(3, 0.004), effects=[f"{EXAMPLE}:Fatigue", "delay", "drag"], located=False)
    assert [f["effect"] for f in found.report["found"]] == ["fatigue"]
    assert found.report["found"][0]["parameters"]["rate"]["estimate"] == pytest.approx(0.004, rel=0.15)
    save_model(tmp_path / "model.yaml", found.models["model.yaml"])
    assert f"{EXAMPLE}:Fatigue" in (tmp_path / "model.yaml").read_text()
    del catalogue.ALL["fatigue"]
    again = load_model(tmp_path / "model.yaml")
    assert [e.kind for e in again.effects] == ["idm", "fatigue", "brakes"]


def test_its_loop_does_what_the_simulator_does(platoon: Records) -> None:
    """A memory, a look back and a static choice of an effect defined here, alone and among others."""
    own = Mood(scale=50.0)
    model = Hypothesis((simple(own),), march.Catalogue.of([own]))
    agrees(platoon, model, np.array([0.2, 4.0]))
    both = model.adding(simple("delay")).adding(simple("asymmetry"))
    agrees(platoon, both, np.array([0.2, 4.0, 0.33, 0.2]))


def test_what_cannot_be_tried_is_listed_with_its_reason() -> None:
    data = tired(4, 0.0, runs=2)
    found = discover(data, effects=[Fussy, "asymmetry"])
    row = next(c for c in found.report["candidates"] if c["effect"] == "fussy")
    assert row["note"].startswith("effect 'fussy' uses a Python `if`")
    with pytest.raises(ValueError, match=r"no candidate can be tried.*fussy.*Python `if`"):
        discover(data, effects=[Fussy])


def test_a_profile_that_the_loop_would_not_see_is_refused() -> None:
    @dataclass(frozen=True)
    class Slope(Effect):
        kind: ClassVar[str] = "slope"
        sought: ClassVar[Any] = "profile"
        declared: ClassVar[tuple[Parameter, ...]] = (Parameter("slope_0", "", "1", 0.1, -1.0, 1.0, null=0.0),)
        knots: tuple[float, ...] = (0.0, 1.0)

        def accelerate(self, scene: Any, driver: Any, p: Any) -> Any:
            return p["slope_0"] * scene.position

    why = march.why_not_recorded(Slope())
    assert why is not None and "does not read it by effects.places.curve" in why
    assert march.why_not_recorded(Mood()) is None


def test_a_registered_effect_is_a_candidate_and_names_are_not_taken_twice() -> None:
    assert catalogue.register(Mood) is Mood and catalogue.register(Mood) is Mood
    assert "mood" in catalogue.candidates() and "brakes" not in catalogue.candidates()
    assert march.default_catalogue().by_name["mood"] == Mood()

    @dataclass(frozen=True)
    class Other(Effect):
        kind: ClassVar[str] = "delay"

        def adapt(self, driver: Any, scene: Any, p: Any) -> Any:
            return driver

    with pytest.raises(ValueError, match="the name 'delay' of Other is that of Delay"):
        catalogue.register(Other)
    with pytest.raises(ValueError, match=r"has no class Nobody of effects\. It has: Fatigue"):
        catalogue.named(f"{EXAMPLE}:Nobody")


def test_whatever_has_no_place_or_time_to_be_tried_at_is_a_candidate_with_its_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(places, "scan", lambda *given, **options: None)
    trajectories, _ = synthetic.generate(5, runs=5, followers=2, seconds=60.0)
    report = discover(trajectories, effects=["regime_shift", "drag"]).report
    notes = {row["effect"]: row["note"] for row in report["candidates"]}
    assert notes["regime_shift"] == "no time in these data is covered for long enough to be tried"
    assert "covered" not in notes["drag"]


def test_a_profile_of_what_cannot_be_changed_by_place_is_refused(platoon: Records) -> None:
    class Mistaken(Mood):
        kind = "mistaken"
        sought = "profile"
        acts_on = "gap"

    assert "acts_on = 'gap'" in terms.testable(platoon, [Mistaken()])["mistaken"]


def test_a_class_that_no_search_can_use_is_refused_at_once() -> None:
    with pytest.raises(TypeError, match="Misspelt: sought = 'zone' is none of 'anywhere', 'profile'"):

        class Misspelt(Mood):
            sought = "zone"

    @dataclass(frozen=True)
    class Needy(Mood):
        kind: ClassVar[str] = "needy"
        needed: float = dataclasses.field(kw_only=True)

    with pytest.raises(ValueError, match="effect 'needy' cannot be made without arguments"):
        catalogue.register(Needy)

    class Swerve(Effect):
        kind = "swerve"
        declared = (Parameter("gain", "c", "1", 0.2, -1.0, 1.0, null=0.0),)

        def change(self, scene: Any, driver: Any, p: Any) -> Any:
            raise NotImplementedError

    assert "needy" not in catalogue.ALL and not is_candidate(Swerve)
