"""What the bounds of merging drivers cost, and what gives it back: rules of ours, and SUMO's LC2013 on the same roads.

``python studies/2026-11-26-merging-floor/merging.py ours`` prints the rules, ``… sumo`` the peer (``libsumo``).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.bench.peers import started
from benchmarks.lanes import DEMANDS, stood

ROWS, SECONDS, WARM = 32, 600, 120
RULES = {
    "reach 300 m, as it was": {"mandatory_change.reach": 300.0},
    "reach 350 m": {"mandatory_change.reach": 350.0},
    "reach 400 m, as it is": {"mandatory_change.reach": 400.0},
    "reach 500 m": {"mandatory_change.reach": 500.0},
    "reach 400 m, of accepted gaps too": {"mandatory_change.reach": 400.0, "gap_acceptance.reach": 400.0},
    "300 m, floor 0.35 s": {"mandatory_change.reach": 300.0, "gap_acceptance.least_time_gap": 0.35},
    "300 m, floor 0.3 s": {"mandatory_change.reach": 300.0, "gap_acceptance.least_time_gap": 0.3},
    "300 m, braking up to 9 m/s²": {"mandatory_change.reach": 300.0, "gap_acceptance.hardest": 9.0},
    "300 m, nobody lets in": {"mandatory_change.reach": 300.0, "courtesy.weight": 0.0},
    "300 m, no zipper in yielding": {"mandatory_change.reach": 300.0, "courtesy.zipper": 0.0},
    "300 m, no turns": {"mandatory_change.reach": 300.0, "mandatory_change.turns": 0.0},
    "300 m, accepted time gap 0.5 T": {"mandatory_change.reach": 300.0, "gap_acceptance.closer": 0.5},
    "300 m, not calm": {"mandatory_change.reach": 300.0, "calm.coolness": 0.0},
}


class Edge(NamedTuple):
    """An edge between two nodes, from ``begin`` to ``end`` (m); its lane 0 is lane ``right`` of the whole road."""

    name: str
    begins: str
    ends: str
    lanes: int
    begin: float
    end: float
    right: int = 0


RAMP = (Edge("a", "n0", "n1", 2, 0, 400, 1), Edge("r", "n9", "n1", 1, 100, 400), Edge("b", "n1", "n2", 3, 400, 600),
        Edge("c", "n2", "n3", 2, 600, 900, 1))  # fmt: skip
DROP = (Edge("a", "n0", "n1", 4, 0, 400), Edge("b", "n1", "n2", 2, 400, 600, 1), Edge("c", "n2", "n3", 1, 600, 800, 1))
FLOWS = {
    "merge 2400 + 500": (RAMP, [("a", 0, 1200.0), ("a", 1, 1200.0), ("r", 0, 500.0)]),
    "merge 3000 + 800": (RAMP, [("a", 0, 1500.0), ("a", 1, 1500.0), ("r", 0, 800.0)]),
    "bottleneck 1900": (DROP, [("a", k, 475.0) for k in range(4)]),
}


def net(edges: Sequence[Edge]) -> str:
    """Return a straight road: lanes go on into the edges that follow where these have them, otherwise they end."""
    last = max(edge.end for edge in edges)
    parts = [f'<net version="1.16"><location netOffset="0,0" convBoundary="0,0,{last},20" '
             f'origBoundary="0,0,{last},20" projParameter="!"/>']  # fmt: skip
    for e in edges:
        lanes = "".join(
            f'<lane id="{e.name}_{k}" index="{k}" speed="60" length="{e.end - e.begin}" '
            f'shape="{e.begin},{3 * (k + e.right)} {e.end},{3 * (k + e.right)}"/>'
            for k in range(e.lanes)
        )
        parts.append(f'<edge id="{e.name}" from="{e.begins}" to="{e.ends}" priority="1">{lanes}</edge>')
    places = {node: at for e in edges for node, at in ((e.begins, e.begin), (e.ends, e.end))}
    connections = []
    for node, x in places.items():
        incoming = [e for e in edges if e.ends == node]
        links = [
            (a.name, i, b.name, i + a.right - b.right)
            for a in incoming for i in range(a.lanes)
            for b in edges if b.begins == node and b.right <= i + a.right < b.right + b.lanes
        ]  # fmt: skip
        connections += links
        none = "0" * len(links)
        asked = "".join(f'<request index="{k}" response="{none}" foes="{none}" cont="0"/>' for k in range(len(links)))
        arriving = " ".join(f"{e.name}_{k}" for e in incoming for k in range(e.lanes))
        parts.append(
            f'<junction id="{node}" type="{"priority" if links else "dead_end"}" x="{x}" y="0" incLanes="{arriving}" '
            f'intLanes="" shape="{x},0 {x},12 {x},6">{asked}</junction>'
        )
    parts += [
        f'<connection from="{a}" to="{b}" fromLane="{i}" toLane="{j}" dir="s" state="M"/>' for a, i, b, j in connections
    ]
    return "".join(parts) + "</net>"


def routes(flows: Sequence[tuple[str, int, float]]) -> str:
    """Return SUMO's traffic: IDM and LC2013 with the numbers of the open tasks, evenly spread, entering at 20 m/s."""
    kind = ('<vType id="t" carFollowModel="IDM" laneChangeModel="LC2013" length="5" accel="1.5" decel="2" tau="1.2" '
            'minGap="2" maxSpeed="30" speedFactor="1" speedDev="0"/>')  # fmt: skip
    roads = "".join(f'<route id="{edge}" edges="{edge} b c"/>' for edge in dict(flow[:2] for flow in flows))
    end = SECONDS + WARM
    each = "".join(
        f'<flow id="f{edge}{lane}" type="t" route="{edge}" begin="0" end="{end}" period="exp({hourly / 3600.0})" '
        f'departLane="{lane}" departSpeed="avg"/>'
        for edge, lane, hourly in flows
    )
    return f"<routes>{kind}{roads}{each}</routes>"


def sumo(name: str, seed: int) -> tuple[float, float, float] | None:
    """Return vehicles out and brakings beyond 8 m/s² an hour, and the longest stand (s), of one seed."""
    edges, flows = FLOWS[name]
    options = ["--step-method.ballistic", "--collision.action", "none", "--seed", str(seed)]
    with started(net(edges), routes(flows), *options) as libsumo:
        if libsumo is None:
            return None
        out = events = 0
        longest, stands, brakes = 0.0, dict[str, float](), set[str]()
        for step in range((WARM + SECONDS) * 10):
            libsumo.simulationStep()
            if step < WARM * 10:
                continue
            out += libsumo.simulation.getArrivedNumber()
            hard = set()
            for car in libsumo.vehicle.getIDList():
                stands[car] = stands.get(car, 0.0) + 0.1 if libsumo.vehicle.getSpeed(car) < 0.5 else 0.0
                longest = max(longest, stands[car])
                if libsumo.vehicle.getAcceleration(car) < -8.0:
                    hard.add(car)
            events += len(hard - brakes)
            brakes = hard
        return out * 3600.0 / SECONDS, events * 3600.0 / SECONDS, longest


def main(which: str) -> None:
    """Print one row for each road and rule, or each road in SUMO."""
    for name, (kind, keywords) in DEMANDS.items():
        if which == "sumo":
            found = [row for seed in range(1, 9) if (row := sumo(name, seed))]
            columns = list(zip(*found, strict=True))
            print(
                f"| {name} | LC2013 | {max(columns[2]):.0f} | {sum(columns[0]) / 8:.0f} | {sum(columns[1]) / 8:.1f} |"
            )
            continue
        for rule, changed in RULES.items():
            row = stood(kind(parameters=changed, **keywords), ROWS, SECONDS)
            events = sum(row.emergencies) / ROWS
            print(
                f"| {name} | {rule} | {max(row.longest):.0f} | {row.out:.0f} | {events:.1f} | {row.left[0]:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1])
