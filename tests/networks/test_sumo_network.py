"""SUMO's networks are read as they are written; what is wrong with one is told in one line that names the element."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from idm_env.roads.network import Network, Plan
from tests.networks.written import net_xml, write_net

COLUMNS = ("length", "limit", "inner", "left", "right", "start", "end", "path", "foes", "yields", "signal", "index")


def same(one: Network, other: Network) -> None:
    """Compare all but shapes."""
    assert (one.names, one.edge, one.plans) == (other.names, other.edge, other.plans)
    for name in COLUMNS:
        a, b = (np.sort(getattr(x, name), -1) if name in ("foes", "yields") else getattr(x, name) for x in (one, other))
        np.testing.assert_array_equal(a, b, err_msg=name)


@st.composite
def networks(draw: st.DrawFn) -> Network:
    """Return a network of links and moves at random: nothing in it need make sense to a driver."""
    count, rows = draw(st.integers(2, 5)), draw(st.integers(1, 6))
    pairs = st.tuples(st.integers(0, count - 1), st.integers(0, count - 1))
    moves = draw(st.lists(pairs, min_size=1, max_size=rows, unique=True))
    numbers = st.floats(1.0, 500.0)
    links = {
        "name": [f"e{k}_0" for k in range(count)],
        "edge": [f"e{k}" for k in range(count)],
        "inner": [False] * count,
    }
    paths = []
    for m in range(len(moves)):
        paths.append([f":n_{m}_{part}_0" for part in range(draw(st.integers(1, 2)))])
        links["name"] += paths[-1]
        links["edge"] += [name[:-2] for name in paths[-1]]
        links["inner"] += [True] * len(paths[-1])
    for key in ("length", "limit"):
        links[key] = draw(st.lists(numbers, min_size=len(links["name"]), max_size=len(links["name"])))
    foes, yields = ([set[int]() for _ in moves] for _ in range(2))
    for i, (start, end) in enumerate(moves):
        for j, (other, to) in enumerate(moves[:i]):
            if (start != other and end == to) or draw(st.booleans()):
                foes[i].add(j)
                foes[j].add(i)
                yields[(i, j)[draw(st.integers(0, 1))]].add((j, i)[draw(st.integers(0, 1))])
    table = {"start": [f"e{a}_0" for a, _ in moves], "end": [f"e{b}_0" for _, b in moves], "path": paths}
    table |= {"foes": [sorted(x) for x in foes], "yields": [sorted(x - {i}) for i, x in enumerate(yields)]}
    table["signal"] = draw(st.lists(st.sampled_from([None, "a"]), min_size=len(moves), max_size=len(moves)))
    table["index"] = [None if signal is None else m for m, signal in enumerate(table["signal"])]
    letters = st.text("Ggryo", min_size=len(moves), max_size=len(moves))
    states = tuple(draw(st.lists(letters, min_size=1, max_size=3)))
    plans = [Plan("a", tuple(draw(st.floats(0.5, 90.0)) for _ in states), states, draw(st.floats(-50.0, 50.0)))]
    return Network.from_tables(links, table, plans if any(table["signal"]) else [])


@settings(max_examples=60)
@given(network=networks())
def test_what_is_written_is_read(network: Network, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = write_net(tmp_path_factory.mktemp("net") / "a.net.xml", network)
    same(Network.from_sumo(path), network)


def test_foes_of_which_one_alone_knows_are_mutual(tmp_path: Path) -> None:
    """As netgenerate --rand writes some junctions: the network is that of mutual foes, and this is counted."""
    network, path = Network.crossing(control="priority"), tmp_path / "a.net.xml"
    foes = re.findall(r' foes="([01]+)"', net_xml(network))
    last = foes[1].rindex("1")
    once = foes[1][:last] + "0" + foes[1][last + 1 :]
    path.write_text(net_xml(network).replace(f' foes="{foes[1]}"', f' foes="{once}"', 1))
    read = Network.from_sumo(path)
    same(read, network)
    assert read.skipped == {"foes made mutual": 1}


@pytest.mark.parametrize("control", ["signals", "priority", "right_before_left"])
def test_our_own_grids_are_read_back(control: str, tmp_path: Path) -> None:
    network = Network.grid(2, 3, control=control)
    if control == "signals":
        text = net_xml(network)
        index = {f'tl="{plan.name}"': 0 for plan in network.plans}
        assert all(word in text for word in index)
    same(Network.from_sumo(write_net(tmp_path / "a.net.xml", network)), network)
    packed = tmp_path / "a.net.xml.gz"
    packed.write_bytes(gzip.compress(net_xml(network).encode()))
    same(Network.from_sumo(packed), network)


TEXT = net_xml(Network.crossing())


def read(text: str, folder: Path) -> Network:
    """Return the network of a text."""
    path = folder / "my.net.xml"
    path.write_text(text, encoding="utf-8")
    return Network.from_sumo(path)


LANE = 'length="192.8" speed="13.89"'


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (TEXT, "no file of XML", "my.net.xml is no whole XML"),
        ("</net>", "", "my.net.xml is no whole XML"),
        (TEXT, "<routes/>", "my.net.xml begins with <routes>"),
        (TEXT, "<net/>", "my.net.xml has no lane for cars"),
        (LANE, 'length="-3" speed="13.89"', "link 'left0A0_0': length = -3 m must be at least 1 m"),
        (LANE, 'length="0.4" speed="13.89"', "link 'left0A0_0': length = 0.4 m must be at least 1 m"),
        (LANE, 'length="192.8" speed="0"', "link 'left0A0_0': limit = 0 m/s must be above 0"),
        (LANE, 'length="far" speed="13.89"', "<lane id=\"left0A0_0\">: length = 'far' must be a number"),
        (LANE, 'speed="13.89"', '<lane id="left0A0_0"> has no length'),
        ('state="rrr', 'state="', "signal 'A0': state 'GGgrrrGGg' has 9 letters, and move"),
        ('state="rrr', 'state="rrX', "signal 'A0': letter 'X' of a state is unknown"),
        ('duration="42.0"', 'duration="0"', "signal 'A0': durations"),
        ('<tlLogic id="A0"', '<tlLogic id="B"', 'tl="A0" has no tlLogic'),
        (' via=":A0_0_0"', "", "has no via: my.net.xml has no internal links"),
        ('<request index="0" response="0', '<request index="0" response="', '<junction id="all">: request 0 needs'),
        ('<request index="0"', '<request index="77"', '<junction id="all">: request 77 needs'),
        ('shape="0.00,', 'shape="0.00;', '<lane id="left0A0_0">: shape ='),
    ],
)
def test_what_is_wrong_is_told_in_one_line(old: str, new: str, words: str, tmp_path: Path) -> None:
    """Each names the element."""
    assert old in TEXT
    with pytest.raises(ValueError, match=re.escape(words)) as error:
        read(TEXT.replace(old, new, 1), tmp_path)
    assert "\n" not in str(error.value)


def test_what_cars_cannot_use_is_left_out_and_counted(tmp_path: Path) -> None:
    """Rail and foot lanes, crossings, signals for pedestrians only, and programs that a later one replaces."""
    rail = '<edge id="r" from="a" to="b"><lane id="r_0" index="0" allow="tram rail" length="9" speed="9"/></edge>'
    foot = '<edge id="f"><lane id="f_0" index="0" allow="pedestrian" length="9" speed="9"/></edge>'
    bus = '<edge id="g"><lane id="g_0" index="0" disallow="private passenger" length="9" speed="9"/></edge>'
    walk = '<edge id=":w" function="walkingarea"><lane id=":w_0" index="0" length="9" speed="9"/></edge>'
    light = '<tlLogic id="p" type="static"><phase duration="9" state="G"/></tlLogic>'
    again = '<tlLogic id="A0" type="actuated"><phase duration="9" state="GGGGGGGGGGGG"/></tlLogic>'
    link = '<connection from="r" to="r" fromLane="0" toLane="0"/>'
    network = read(
        TEXT.replace("</net>", light + again + link + "</net>").replace("<net>", "<net>" + rail + foot + bus + walk),
        tmp_path,
    )
    assert network.names == Network.crossing().names
    assert network.plans == (Plan("A0", (9.0,), ("G" * 12,)),)
    assert network.skipped == {
        "lanes closed to cars": 3,
        "edges that are a walkingarea": 1,
        "signals without a move for cars": 1,
        "signal programs replaced by a later one": 1,
        "signals of type actuated run by the clock": 1,
    }


def test_lanes_of_an_edge_stand_beside_one_another(tmp_path: Path) -> None:
    """The right lane first; a lane for others keeps them apart."""
    lane = '<lane id="e_{0}" index="{0}" length="100" speed="9" allow="{1}"/>'
    lanes = "".join(lane.format(k, "bus" if k == 2 else "all") for k in range(5))
    network = read(f'<net><edge id="e">{lanes}</edge></net>', tmp_path)
    assert network.names == ("e_0", "e_1", "e_3", "e_4") and set(network.edge) == {"e"}
    assert network.left.tolist() == [1, -1, 3, -1] and network.right.tolist() == [-1, 0, -1, 2]


ATTRIBUTES = sorted(set(re.findall(r'\w+="[^"]*"', TEXT)))


VALUES = ["", "x", "-1", "0", "nan", "1e999", "2", ":A0_1_0", "left0A0_0", None]


@settings(max_examples=150)
@given(old=st.sampled_from(ATTRIBUTES), value=st.sampled_from(VALUES), count=st.integers(1, 3))
def test_a_damaged_file_is_read_or_refused(
    old: str, value: str | None, count: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Whatever an attribute says: a network, or one line."""
    new = "" if value is None else f'{old.partition("=")[0]}="{value}"'
    try:
        read(TEXT.replace(old, new, count), tmp_path_factory.mktemp("net"))
    except ValueError as error:
        assert "\n" not in str(error) and len(str(error)) < 400
