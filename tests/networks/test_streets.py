"""Networks of our own: their foes and priorities are netgenerate's, and laws of geometry."""

from __future__ import annotations

import subprocess
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from idm_env.roads import streets
from idm_env.roads.network import Network
from idm_env.roads.network_demand import Demand
from idm_env.roads.ways import Ways
from idm_env.tasks.junction import JunctionTask
from idm_env.tasks.network_task import NetworkTask
from idm_env.tasks.signals import SignalsTask

MANY = [
    Network.grid(2, 3), Network.grid(2, 2, control="priority"), Network.crossing(control="right_before_left"),
    Network.roundabout(3), Network.roundabout(5, radius=30.0), Network.figure_eight(), Network.crossing(control="none"),
]  # fmt: skip

FOES, YIELDS = attrgetter("foes"), attrgetter("yields")


@pytest.mark.parametrize("network", MANY)
def test_links_are_as_long_as_their_shapes_and_meet(network: Network) -> None:
    """A move's links end where the next begin; lengths are those of their lines."""
    for points, length in zip(network.shape, network.length, strict=True):
        assert np.linalg.norm(np.diff(points, axis=0), axis=1).sum() == pytest.approx(length)
    for start, end, path in zip(network.start, network.end, network.path, strict=True):
        (inner,) = path
        np.testing.assert_allclose(network.shape[start][-1], network.shape[inner][0], atol=1e-9)
        np.testing.assert_allclose(network.shape[end][0], network.shape[inner][-1], atol=1e-9)


def test_a_roundabout_goes_first_and_needs_no_signal() -> None:
    """Who enters yields to who stays on the ring, and to nobody else."""
    network = Network.roundabout(4)
    for m in range(len(network.start)):
        first = {network.move_name(f) for f in network.yields[m] if f >= 0}
        start, end = (network.edge[k[m]] for k in (network.start, network.end))
        assert first == ({f"ring{(int(start[2:]) - 1) % 4}_0→{end}_0"} if start.startswith("in") else set())
    assert not network.plans and not network.cautions()


def test_a_figure_eight_is_a_loop_of_two_loops() -> None:
    """4 r + 3 π r long (Wu et al. 2017), with or without a priority."""
    eight = Network.figure_eight(radius=30.0)
    assert eight.length.sum() == pytest.approx((4 + 3 * np.pi) * 30.0, rel=1e-3)
    assert [eight.move_name(m) for m in range(2)] == ["west_0→east_0", "east_0→west_0"]
    assert eight.yields.ravel().tolist() == [-1, 0] and eight.foes.ravel().tolist() == [1, 0]
    assert "neither goes first" in Network.figure_eight(control="none").cautions()[0]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Network.grid(0, 3), "rows = 0 must be at least 1"),
        (lambda: Network.grid(3, 27), "columns = 27 must be at most 26"),
        (lambda: Network.grid(2, 2, block=15.0), r"block = 15 m is outside"),
        (lambda: Network.grid(2, 2, control="sign"), "control = 'sign' is unknown. Did you mean 'signals'?"),
        (lambda: Network.crossing(green=0.0), r"green = 0 s is outside"),
        (lambda: Network.crossing(limit=-1.0), r"limit = -1 m/s is outside"),
        (lambda: Network.roundabout(8, radius=20.0), r"radius = 20 m is outside \[25"),
        (lambda: Network.figure_eight(radius=5.0), r"radius = 5 m is outside"),
        (lambda: Demand.by_turns(MANY[0], -1.0, 60.0), r"per_hour of .* = -1 1/h is outside"),
        (lambda: Demand.by_turns(MANY[0], {"A0B0": 60.0}, 60.0), "edge = 'A0B0' is unknown"),
        (lambda: Demand.by_turns(MANY[0], 60.0, 60.0, shares=(0, 0, 0)), "shares = .* must be three numbers"),
    ],
)
def test_numbers_that_allow_no_network_are_refused(make: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()  # type: ignore[operator]


def test_turns_have_their_shares_and_arrivals_their_rate() -> None:
    """The same seed draws the same; another rate on one edge changes nothing on the others."""
    network = Network.grid(3, 3)
    rates = dict.fromkeys(("left0A0", "bottom1B0", "top2C2"), 900.0)
    demand = Demand.by_turns(network, rates, 7200.0, seed=4, shares=(0.1, 0.7, 0.2))
    assert abs(len(demand.route) - 5400) < 4 * np.sqrt(5400)
    routes = demand.routes[demand.route]
    moves = network.move_of[routes[:, 1]]
    names = {0: 0.1, 1: 0.7, 2: 0.2}
    sides = np.array(Ways(network).sides)[moves]
    for side, share in names.items():
        assert np.isclose((sides == side).mean(), share, atol=0.02)
    again = Demand.by_turns(network, {**rates, "left1A1": 60.0}, 7200.0, seed=4, shares=(0.1, 0.7, 0.2))
    first = [network.edge[again.routes[r][0]] for r in again.route]
    np.testing.assert_array_equal(again.depart[np.array(first) != "left1A1"], demand.depart)


def test_who_turns_by_chance_does_not_turn_back() -> None:
    """Dead ends at which one can turn, as netgenerate's, bring the same vehicles as open ends."""
    plain, turning = (streets.grid(2, 2, 200.0, 150.0, 13.89, "signals", 1) for _ in range(2))
    for away in [name for name in turning.roads if name.endswith(("left0", "left1", "right0", "right1", "top0"))]:
        turning.join(away[2:], {(away, away[2:] + away[:2]): (0, 0)})
    open_ends, dead_ends = (Network._from_plain(each.tables()) for each in (plain, turning))
    assert len(dead_ends.start) == len(open_ends.start) + 5
    demands = [Demand.by_turns(network, 600.0, 600.0) for network in (open_ends, dead_ends)]
    ways = [[[network.names[k] for k in demand.routes[r] if k >= 0] for r in demand.route]
            for network, demand in zip((open_ends, dead_ends), demands, strict=True)]  # fmt: skip
    assert ways[0] == ways[1] and len(ways[0]) > 300
    kinds: list[type[NetworkTask]] = [SignalsTask, JunctionTask]
    for kind in kinds:
        counts = [kind(network=network, duration=60.0).vehicles for network in (open_ends, dead_ends)]
        assert counts[0] == counts[1]


@pytest.mark.parametrize("lanes", [1, 2, 3])
@pytest.mark.parametrize("kind", ["priority", "right_before_left", "traffic_light"])
def test_a_grid_is_netgenerates(kind: str, lanes: int, tmp_path: Path) -> None:
    """The same links, lengths of links, moves, foes, and yields where moves are open together; and plans.

    Of two oncoming left turns netgenerate lets either go first, by the order of its edges.
    """
    home = Path(pytest.importorskip("sumo", reason="SUMO is not installed: pip install eclipse-sumo").SUMO_HOME)
    words = "--grid --grid.x-number 3 --grid.y-number 2 --grid.length 200 --grid.attach-length 150 --no-turnarounds"
    out = tmp_path / "my.net.xml"
    tool = [home / "bin" / "netgenerate", *words.split(), "-L", str(lanes), "-j", kind, "-o", out]
    subprocess.run(tool, check=True, capture_output=True)
    theirs = Network.from_sumo(out)
    control = "signals" if kind == "traffic_light" else kind
    ours = Network.grid(2, 3, arm=150.0, control=control, lanes=lanes)
    moves = [{n.move_name(m): m for m in range(len(n.start))} for n in (theirs, ours)]
    assert moves[0].keys() == moves[1].keys() and len(moves[0]) == 6 * (8 + 4 * lanes)
    lengths = [{name: n.length[k] for k, name in enumerate(n.names) if not n.inner[k]} for n in (theirs, ours)]
    assert lengths[0] == pytest.approx(lengths[1], abs=0.01)
    for name, mine in moves[1].items():
        other = moves[0][name]
        pair = (theirs, other), (ours, mine)
        foes, yields = ([{n.move_name(f) for f in table(n)[m] if f >= 0} for n, m in pair] for table in (FOES, YIELDS))
        assert foes[0] == foes[1], name
        letters = (
            {f: ours.plans[ours.signal[m]].states[0][ours.index[m]] for f, m in moves[1].items()} if ours.plans else {}
        )
        apart = {f for f in foes[0] if letters and letters[f].lower() != letters[name].lower()}
        lefts = {f for f in foes[0] if letters.get(f) == "g" == letters.get(name)} or _lefts(ours, moves[1], name)
        assert yields[0] - apart - lefts == yields[1] - lefts, name
        inner = [n.length[n.path[m][n.path[m] >= 0]].sum() for n, m in pair]
        assert inner[0] == pytest.approx(inner[1], rel=0.03)
        if letters:
            assert ours.index[mine] == theirs.index[other]
    assert {plan.name: plan for plan in ours.plans} == {plan.name: plan for plan in theirs.plans}


def _lefts(network: Network, moves: dict[str, int], name: str) -> set[str]:
    """Return the moves that turn left, for one that does."""
    sides = Ways(network).sides
    return {other for other, m in moves.items() if sides[m] == 0} if sides[moves[name]] == 0 else set()
