"""SUMO's demand is read as SUMO means it, and what is wrong with it is told in one line that names the element."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from idm_env.roads.network import Network
from idm_env.roads.network_demand import Demand

GRID = Network.grid(2, 2)


def read(text: str, folder: Path, network: Network = GRID, root: str = "routes") -> Demand:
    """Return the demand of the elements of a file."""
    path = folder / "my.rou.xml"
    path.write_text(f"<{root}>{text}</{root}>", encoding="utf-8")
    return Demand.from_sumo(network, path, seed=3)


def edges(demand: Demand, vehicle: int, network: Network = GRID) -> list[str]:
    """Return the edges of a vehicle's route."""
    links = demand.routes[demand.route[vehicle]]
    return [network.edge[k] for k in links if k >= 0 and not network.inner[k]]


WAY = "left0A0 A0B0 B0right0"


def test_vehicles_trips_and_flows(tmp_path: Path) -> None:
    """In order of departure; a trip takes the quickest way, a flow's vehicles are evenly in time."""
    demand = read(
        '<vType id="t" carFollowModel="IDM" vClass="truck" accel="1.1" tau="1.5" speedDev="0"/>'
        f'<route id="r" edges="{WAY}"/>'
        '<vehicle id="a" type="t" route="r" depart="0:01:40" departSpeed="max"/>'
        f'<vehicle id="b" depart="7.5" departSpeed="4"><route edges="{WAY}"/></vehicle>'
        '<trip id="c" from="left0A0" to="B1right1" via="A0A1" depart="20"/>'
        '<flow id="d" from="bottom1B0" to="B0B1" begin="30" end="60" vehsPerHour="360" departSpeed="speedLimit"/>',
        tmp_path,
    )
    assert demand.depart.tolist() == [7.5, 20.0, 30.0, 40.0, 50.0, 100.0]
    assert demand.speed.tolist() == [4.0, 0.0, 13.89, 13.89, 13.89, 13.89]
    assert demand.length.tolist() == [5.0] * 5 + [7.1]
    assert [" ".join(edges(demand, k)) for k in (0, 1, 2, 5)] == [
        WAY, "left0A0 A0A1 A1B1 B1right1", "bottom1B0 B0B1", WAY,
    ]  # fmt: skip
    truck = {"max_accel": 1.1, "comfort_decel": 4.0, "time_gap": 1.5, "min_gap": 2.5, "desired_speed": 36.11}
    assert demand.kinds[demand.kind[5]] == {f"idm.{key}": value for key, value in truck.items()}
    assert demand.skipped == {"vTypes of Krauss driven by IDM": 1}  # one for those without a type


@pytest.mark.parametrize(
    ("words", "rate"),
    [('period="exp(0.2)"', 0.2), ('probability="0.2"', 0.2), ('period="5"', 0.2), ('perHour="720"', 0.2)],
)
def test_flows_have_their_rate(words: str, rate: float, tmp_path: Path) -> None:
    """Within four standard errors of a Poisson process; drawn alike by the same seed, whatever else the file says."""
    flow = f'<flow id="f" from="left0A0" to="B0right0" begin="100" end="20100" {words}/>'
    demand = read(flow, tmp_path)
    assert abs(len(demand.route) - 20000 * rate) < 4 * np.sqrt(20000 * rate)
    assert demand.depart.min() >= 100.0 and demand.depart.max() < 20100.0
    other = read(f'<trip id="o" from="left1A1" to="A1B1" depart="1e6"/>{flow}', tmp_path)
    np.testing.assert_array_equal(other.depart[:-1], demand.depart)


def test_types_and_routes_of_distributions_are_drawn_by_their_shares(tmp_path: Path) -> None:
    demand = read(
        '<vType id="a" length="4" carFollowModel="IDM" speedDev="0"/>'
        '<vTypeDistribution id="d" vTypes="a" probabilities="1">'
        '<vType id="b" length="8" carFollowModel="IDM" speedDev="0" probability="3"/></vTypeDistribution>'
        '<routeDistribution id="r"><route id="x" edges="left0A0 A0B0" probability="0.1"/>'
        '<route edges="left0A0 A0A1" probability="0.4"/></routeDistribution>'
        '<flow id="f" type="d" route="r" begin="0" end="4000" number="4000"/>'
        '<vehicle id="v" type="b" route="x" depart="9"/>',
        tmp_path,
    )
    assert np.isclose((demand.length == 8.0).mean(), 0.75, atol=0.03)
    short = [edges(demand, k)[-1] == "A0B0" for k in range(len(demand.route))]
    assert np.isclose(np.mean(short), 0.2, atol=0.03)
    assert demand.skipped == {}


@pytest.mark.parametrize(
    ("words", "mean", "deviation"),
    [
        ('speedFactor="normc(1.1,0.2,0.4,1.8)"', 1.1, 0.2),
        ('speedFactor="0.9"', 0.9, 0.1),
        ('speedFactor="norm(1,0.3)" speedDev="0.05"', 1.0, 0.05),
        ('vClass="truck"', 1.0, 0.05),
        ('speedFactor="1.2" speedDev="0"', 1.2, 0.0),
        ('speedFactor="normc(1,5,0.9,1.1)"', 1.0, 0.2 / 12**0.5),
    ],
)
def test_limits_are_driven_by_shares_of_the_given_spread(
    words: str, mean: float, deviation: float, tmp_path: Path
) -> None:
    """Within four standard errors, drawn alike by the same seed; departures and routes are those without a spread."""
    flow = '<flow id="f" type="t" from="left0A0" to="B0right0" begin="0" end="9000" period="exp(0.4)"/>'
    demand, plain, other = (
        read(f'<vType id="t" carFollowModel="IDM" {more}/>{flow}', tmp_path) for more in (words, 'speedDev="0"', words)
    )
    factor, again = (
        np.array([d.kinds[k].get("link_limit.factor", 1.0) for k in d.kind.tolist()]) for d in (demand, other)
    )
    np.testing.assert_array_equal(factor, again)
    np.testing.assert_array_equal(demand.depart, plain.depart)
    assert abs(factor.mean() - mean) <= 4.0 * deviation / len(factor) ** 0.5 + 1e-9
    assert abs(factor.std() - deviation) <= 0.06 * deviation + 1e-9
    assert demand.skipped == {}


def test_what_is_not_traffic_of_cars_is_counted(tmp_path: Path) -> None:
    demand = read(
        '<vType id="t" carFollowModel="IDM" delta="4" sigma="0" speedDev="0.1"><param key="k" value="1"/></vType>'
        '<vType id="walk" vClass="pedestrian"/>'
        '<person id="p"/><busStop id="s"/><trip id="z" fromTaz="1" toTaz="2" depart="0"/>'
        f'<vehicle id="w" type="walk" depart="0"><route edges="{WAY}"/></vehicle>'
        f'<vehicle id="v" type="t" depart="0" departLane="best"><route edges="{WAY}"/><stop lane="x"/></vehicle>'
        f'<vehicle id="u" depart="triggered"><route edges="{WAY}"/></vehicle>'
        f'<vehicle id="x" type="t" depart="3"><stop lane="x"/><route edges="{WAY}"/></vehicle>',
        tmp_path, root="additional",
    )  # fmt: skip
    assert len(demand.route) == 2
    assert demand.skipped == {
        "attribute sigma of vType": 1, "vTypes of Krauss driven by IDM": 2,
        "elements <person>": 1, "elements <busStop>": 1, "trips between districts or junctions": 1,
        "vehicles of type walk, which is no car's": 1, "attribute departLane of vehicle": 1,
        "elements <stop> of vehicle": 2, "elements <param> of vType": 1,
        "vehicles that depart when triggered": 1, "attribute fromTaz of trip": 1, "attribute toTaz of trip": 1,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the files of demand have no vehicle"),
        ('<vehicle id="v" depart="0"><route edges="left0A0 B0right0"/></vehicle>', "'left0A0' does not lead to"),
        ('<route id="r" edges="left0A0 A0Bo"/>', "edge 'A0Bo' has no lane for cars here. Did you mean 'A0B0'?"),
        ('<route id="r" edges=" "/>', '<route id="r"> has a route without edges'),
        ('<trip id="t" from="A0left0" to="B0B1" depart="0"/>', "\"t\">: no way leads from edge 'A0left0' to 'B0B1'"),
        ('<trip id="t" from="left0A0" to="B0B1"/>', '<trip id="t"> has no depart'),
        ('<trip id="t" from="left0A0" to="B0B1" depart="noon"/>', "depart = 'noon' must be a number of at least 0"),
        ('<trip id="t" from="left0A0" to="B0B1" depart="-5"/>', "\"t\">: depart = '-5' must be a number of at least 0"),
        ('<trip id="t" from="left0A0" to="B0B1" depart="0"/>' * 2, '<trip id="t">: this id was given before'),
        ('<vType id="car"/><trip id="t" type="cra" from="x" to="x"/>', "vType 'cra' is unknown. Did you mean 'car'?"),
        ('<vehicle id="v" route="r" depart="0"/>', "<vehicle id=\"v\">: route 'r' is unknown"),
        ('<vehicle id="v" depart="0"/>', '<vehicle id="v"> has no route'),
        ('<vType id="t" accel="0"/>', "<vType id=\"t\">: accel = '0' must be a number above 0"),
        ('<vType id="t" speedFactor="norm(1)x"/>', "speedFactor = 'norm(1)x' must be a number from 0.2"),
        ('<vType id="t" speedFactor="normc(3,0.1,0.2,2)"/>', "speedFactor = 'normc(3,0.1,0.2,2)' must be"),
        ('<vType id="t" speedDev="-1"/>', "<vType id=\"t\">: speedDev = '-1' must be a number of at least 0"),
        ('<vType id="t" length="long"/>', "<vType id=\"t\">: length = 'long' must be a number"),
        ('<vType/>', "<vType> has no id"),
        ('<flow id="f" from="left0A0" to="A0B0"/>', '<flow id="f"> has neither a number nor a rate'),
        ('<flow id="f" from="left0A0" to="A0B0" period="1e-9"/>', '<flow id="f"> brings more than 5000000 vehicles'),
        ('<flow id="f" from="left0A0" to="A0B0" period="exp(x)"/>', "<flow id=\"f\">: period = 'x' must be a number"),
        ('<vTypeDistribution id="d" vTypes="a b" probabilities="1"/>', "1 probabilities for 2 names"),
        ('<vTypeDistribution id="d" vTypes="a" probabilities="x"/>', "id=\"d\">: probabilities = 'x' must be a number"),
        ('<routeDistribution id="d"/>', '<routeDistribution id="d"> has nothing of a probability above 0'),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_in_one_line(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as error:
        read(text, tmp_path)
    assert "\n" not in str(error.value)


def test_a_move_that_never_has_green_is_refused_where_it_is_used(tmp_path: Path) -> None:
    from tests.networks.written import net_xml

    path = tmp_path / "my.net.xml"
    text = net_xml(Network.crossing())
    path.write_text(re.sub(r'state="(\w)\w', r'state="\1r', text), encoding="utf-8")
    network = Network.from_sumo(path)
    name = network.edge[network.end[1]]
    start = network.edge[network.start[1]]
    for to, refused in ((name, True), (network.edge[network.end[0]], False)):
        vehicle = f'<vehicle id="v" depart="0"><route edges="{start} {to}"/></vehicle>'
        if refused:
            with pytest.raises(ValueError, match=f"signal 'A0' never shows green to move {start}_0→{to}_0"):
                read(vehicle, tmp_path, network)
        else:
            assert len(read(vehicle, tmp_path, network).route) == 1


VALUES = st.sampled_from(["", "x", "-1", "0", "nan", "1e999", "t", "r", "left0A0", "exp(1)", "exp(-1)", "max"])
TEXT = (
    '<vType id="t" accel="2" length="5" speedFactor="1" vClass="bus"/>'
    '<route id="r" edges="left0A0 A0B0" probability="2"/>'
    '<vehicle id="v" type="t" route="r" depart="1" departSpeed="3"/><trip id="w" from="left0A0" to="A0B0" depart="2"/>'
    '<flow id="f" type="t" route="r" begin="0" end="50" period="5"/>'
    '<flow id="g" route="r" begin="0" end="9" number="5"/>'
)


@settings(max_examples=150)
@given(old=st.sampled_from(sorted(set(re.findall(r'\w+="[^"]*"', TEXT)))), value=VALUES, count=st.integers(1, 2))
def test_a_damaged_file_is_read_or_refused(
    old: str, value: str, count: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Whatever an attribute says: a demand, or one line."""
    try:
        demand = read(TEXT.replace(old, f'{old.partition("=")[0]}="{value}"', count), tmp_path_factory.mktemp("rou"))
        assert len(demand.route) <= 1000
    except ValueError as error:
        assert "\n" not in str(error) and len(str(error)) < 400
