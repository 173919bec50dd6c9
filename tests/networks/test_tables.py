"""What cannot be a network or a demand is told in one line that names it."""

from __future__ import annotations

from typing import Any

import pytest

from idm_env.roads.network import Network, Plan
from idm_env.roads.network_demand import Demand

LINKS = {"name": ["a", "x", "b", "c", "y"], "length": [100.0, 9.0, 80.0, 50.0, 8.0], "limit": [14.0] * 5}
LINKS["inner"] = [False, True, False, False, True]
MOVES = {"start": ["a", "c"], "end": ["b", "b"], "path": [["x"], ["y"]], "foes": [[1], [0]], "yields": [[], [0]]}
MOVES |= {"signal": ["s", None], "index": [0, None]}
PLANS = (Plan("s", (30.0, 3.0, 30.0), ("G", "y", "r")),)


def changed(table: dict[str, Any], column: str, row: int, value: Any) -> dict[str, Any]:
    """Return a table with another value."""
    return {**table, column: [value if i == row else x for i, x in enumerate(table[column])]}


@pytest.mark.parametrize(
    ("links", "moves", "plans", "text"),
    [
        (changed(LINKS, "length", 0, 0.5), MOVES, PLANS, r"link 'a': length = 0\.5 m must be at least 1 m\."),
        (changed(LINKS, "limit", 2, 0.0), MOVES, PLANS, r"link 'b': limit = 0 m/s must be above 0\."),
        ({k: [*v, v[0]] for k, v in LINKS.items()}, MOVES, PLANS, r"link 'a' is given twice"),
        (LINKS, changed(MOVES, "start", 0, "d"), PLANS, r"link 'd' does not exist"),
        (LINKS, changed(MOVES, "path", 0, ["b"]), PLANS, r"link 'b' of its path must be inside a junction"),
        (LINKS, changed(MOVES, "foes", 0, []), PLANS, r"must be another move, and have it as a foe"),
        (LINKS, {**MOVES, "foes": [[], []]}, PLANS, r"moves a→b and c→b merge, and must be foes"),
        (LINKS, changed(MOVES, "index", 0, 1), PLANS, r"state 'G' has 1 letters, and move a→b is shown number 1"),
        (LINKS, MOVES, (Plan("s", (30.0,), ("X",)),), r"signal 's': letter 'X' of a state is unknown"),
        (LINKS, MOVES, (Plan("s", (0.0,), ("G",)),), r"signal 's': durations \(0\.0,\) s must be numbers from 0 on"),
        ({**LINKS, "speed": [1.0]}, MOVES, PLANS, r"links have an unknown column 'speed'"),
    ],
)
def test_bad_tables_name_their_element(links: Any, moves: Any, plans: Any, text: str) -> None:
    """A wrong network never begins."""
    Network.from_tables(LINKS, MOVES, PLANS)
    with pytest.raises(ValueError, match=text) as error:
        Network.from_tables(links, moves, plans)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"routes": [[0, 2, -1]]}, r"route 0: link 'b' does not follow 'a'"),
        ({"routes": [[0, 1, -1]]}, r"route 0: must begin and end outside junctions"),
        ({"routes": [[0, 9, 2]]}, r"must be links from 0 to 4"),
        ({"route": [1]}, r"vehicle 0: route = 1 does not exist"),
        ({"depart": [-1.0]}, r"vehicle 0: depart = -1 must be from 0 to inf"),
        ({"length": [0.0]}, r"vehicle 0: length = 0 must be from 0\.1 to 100"),
        ({"kind": [1]}, r"vehicle 0: kind = 1 does not exist"),
    ],
)
def test_bad_demand_names_its_element(values: dict[str, Any], text: str) -> None:
    """A wrong demand never begins."""
    network = Network.from_tables(LINKS, MOVES, PLANS)
    right = {"routes": [[0, 1, 2]], "route": [0], "depart": [0.0]}
    Demand(**right).check(network)
    with pytest.raises(ValueError, match=text) as error:
        Demand(**{**right, **values}).check(network)
    assert "\n" not in str(error.value)


def test_a_move_in_use_must_be_green_at_some_time() -> None:
    """Nobody waits for ever, nor for a green of 0 s."""
    for durations, states in (((30.0, 3.0), ("r", "y")), ((0.0, 30.0), ("G", "r"))):
        network = Network.from_tables(LINKS, MOVES, (Plan("s", durations, states),))
        Demand([[3, 4, 2]], [0], [0.0]).check(network)
        with pytest.raises(ValueError, match=r"route 0: signal 's' never shows green to move a→b"):
            Demand([[0, 1, 2]], [0], [0.0]).check(network)


def test_what_may_block_itself_is_told() -> None:
    """Moves that yield in a circle, and foes of which neither goes first."""
    moves = {k: v for k, v in MOVES.items() if k not in ("signal", "index")}
    told = [Network.from_tables(LINKS, {**moves, "yields": y}).cautions() for y in ([[], [0]], [[1], [0]], [[], []])]
    assert told[0] == () and "yield in a circle" in told[1][0] and "neither goes first" in told[2][0]
