"""Where errors are: everywhere if noise makes them, somewhere if an effect does."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from idm_env.discovery import ladder, tails, words
from idm_env.discovery.ladder import Agreement, Ladder
from idm_env.discovery.records import Records, windows
from idm_env.discovery.summary import unsure
from idm_env.discovery.verdict import Reason, Refusal, Verdict


def test_errors_somewhere_lie_together_and_it_is_told_where(platoon: Records) -> None:
    """Where leaders brake windows err five times as much; a driver who errs more as a whole does not count."""
    rows, random = windows(platoon), np.random.default_rng(0)
    noise = random.standard_normal(len(rows)) * (1.0 + rows.group)
    inside = rows.start[:, None] + np.arange(0, rows.steps, 5)
    braking = platoon.column("lead_accel")[inside].min(1) < -1.0
    assert 0.05 < braking.mean() < 0.4
    errors = np.where(braking, 5.0, 1.0) * noise
    assert tails.concentration(rows, errors) > tails.concentration(rows, noise) + 0.05
    worst = tails.worst(rows, errors)
    assert worst is not None and worst.where == "while the leader brakes" and worst.share > 0.8


def test_few_drivers_who_hold_the_error_are_named_and_no_noise_of_all(platoon: Records) -> None:
    """A sentence said that noise of all drivers would explain what few of them met."""
    rows = windows(platoon)
    few = np.unique(rows.group)[:3]
    names = tails.held_by(rows, np.where(np.isin(rows.group, few), 10.0, 0.1))
    assert len(names) == 2 and set(names) < {platoon.groups[group] for group in few}
    usual = told(0.5, 0.5)
    alike, uneven = (
        words.beside_noise(Verdict.UNDECIDED, "IDM", 0.56, 0.1, ladder_)
        for ladder_ in (usual, SimpleNamespace(**(vars(usual) | {"few": names})))
    )
    assert "Unsteady drivers" in alike and not any(name in alike for name in names)
    assert "Unsteady" not in uneven and f"2 of the drivers ({', '.join(names)})" in uneven


def told(
    p_scene: float,
    p_tails: float,
    p_sizes: float = 0.5,
    foreseen: float = 0.1,
    usual: float = 0.33,
    uneven: float = 1.4,
) -> Ladder:
    worst = tails.Worst("after a stop", 0.8, 0.3)
    made = SimpleNamespace(
        agreement=Agreement(0.01, p_scene, 39), tails=Agreement(0.42, p_tails, 39, usual), worst=worst,
        unsteady=(0.21, 4.0), uneven=uneven, sizes=Agreement(0.1, p_sizes, 39), past=Agreement(foreseen, 0.025, 39),
        few=(),
    )  # fmt: skip
    made.agrees = Ladder.agrees.fget(made)  # type: ignore[attr-defined]
    return made  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("ladder_", "verdict"),
    [
        (None, Verdict.UNDECIDED),  # nobody has asked
        (told(0.5, 0.6), Verdict.NONE),
        (told(0.1, 0.6), Verdict.UNDECIDED),  # not refused, and no likeness either
        (told(0.5, 0.1), Verdict.UNDECIDED),
        (told(0.5, 0.6, 0.1), Verdict.UNDECIDED),  # noise that grows with speed
        (told(0.5, 0.6, 0.5, 0.5), Verdict.UNDECIDED),  # a time gap that wanders
        (told(0.5, 0.6, uneven=4.9), Verdict.UNDECIDED),  # T longer after a stop, and few drivers stop: told as none
        (told(0.5, 0.01), Verdict.UNEXPLAINED),
        (told(0.5, 0.01, usual=0.38), Verdict.UNDECIDED),  # hardly ever by noise, and hardly more than by noise
    ],
)
def test_absence_is_a_claim_of_its_own(ladder_: Ladder | None, verdict: Verdict) -> None:
    """Over errors of 44 times the sensors' noise nothing is missing only where noise of drivers looks like them."""
    assert ladder.ALIKE > ladder.LEVEL
    found, refusal = unsure(ladder_, Refusal(Reason.NO_GAIN))
    assert found is verdict and (refusal.reason is Reason.TAILS) == (verdict is Verdict.UNEXPLAINED)
    text = words.beside_noise(found, "IDM", 4.4, 0.1, ladder_)
    assert "IDM leaves 4.4 m 5 s ahead, where sensors' noise is 0.1 m" in text
    assert ("Nothing is missing" in text) == (verdict is Verdict.NONE)
    if verdict is Verdict.UNDECIDED:
        assert text.startswith("IDM leaves") and text.endswith("so would an effect of a form that was not tried.")
        assert ("σ = 0.21 m/s² (memory 4 s)" in text) == (ladder_ is not None)
    if verdict is Verdict.UNEXPLAINED:
        assert "80% of it after a stop (30% of the time)" in text
