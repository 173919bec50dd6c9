"""Who is controlled: a number, a fraction, everybody, or vehicles by name, in every task."""

import pytest

from idm_env.tasks import TASKS, make_task


@pytest.mark.parametrize("task", TASKS)
def test_everybody_who_can_be_is_all(task):
    everybody = make_task(task, controlled="all").agents
    assert len(everybody) > 1
    assert make_task(task, controlled=1.0).agents == everybody
    assert make_task(task, controlled=len(everybody)).agents == everybody
    with pytest.raises(ValueError, match=f"controlled = {len(everybody) + 1}"):
        make_task(task, controlled=len(everybody) + 1)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("fraction", [0.5, 0.34, 0.01])
def test_a_fraction_is_a_number_of_those(task, fraction):
    free = len(make_task(task, controlled="all").agents)
    expected = make_task(task, controlled=max(1, round(fraction * free)))
    assert make_task(task, controlled=fraction).agents == expected.agents


def test_recorded_leaders_are_never_among_all():
    assert make_task("follow", controlled="all").agents[0] > 0
    assert len(make_task("ring", controlled="all").agents) == 22


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("bad", [0.0, 1.5, -0.1, float("nan"), "every", True, 0, None])
def test_what_is_no_choice_is_told_with_the_rule(task, bad):
    with pytest.raises(ValueError, match=r"controlled = .*(number|fraction|at least 1)") as told:
        make_task(task, controlled=bad)
    assert "\n" not in str(told.value)
