"""Networks as SUMO's XML, for tests: what is written here is read by the package and by SUMO."""

from __future__ import annotations

from pathlib import Path

from idm_env.roads.network import Network


def net_xml(network: Network) -> str:
    """Return a ``.net.xml`` of a network of one lane an edge, whose moves are all of one junction."""
    lines = ["<net>"]
    for k, name in enumerate(network.names):
        function = ' function="internal"' if network.inner[k] else ""
        points = " ".join(f"{x:.2f},{y:.2f}" for x, y in network.shape[k]) if network.shape else ""
        lines.append(
            f'<edge id="{network.edge[k]}"{function}><lane id="{name}" index="0" length="{float(network.length[k])!r}" '
            f'speed="{float(network.limit[k])!r}" shape="{points}"/></edge>'
        )
    for plan in network.plans:
        phases = "".join(
            f'<phase duration="{d}" state="{s}"/>' for d, s in zip(plan.durations, plan.states, strict=True)
        )
        lines.append(f'<tlLogic id="{plan.name}" type="static" programID="0" offset="{plan.offset}">{phases}</tlLogic>')
    moves = range(len(network.start))
    paths = [[network.names[k] for k in row if k >= 0] for row in network.path]
    # The last part stands in intLanes, as netconvert writes it.
    inner = " ".join(path[-1] for path in paths)

    def bits(row: list[int]) -> str:
        return "".join("01"[m in row] for m in reversed(moves))

    requests = "".join(
        f'<request index="{m}" response="{bits(network.yields[m].tolist())}" foes="{bits(network.foes[m].tolist())}"/>'
        for m in moves
    )
    lines.append(f'<junction id="all" type="priority" incLanes="" intLanes="{inner}">{requests}</junction>')
    for m in moves:
        start, end = network.edge[network.start[m]], network.edge[network.end[m]]
        plan = network.plans[network.signal[m]].name if network.signal[m] >= 0 else None
        light = f' tl="{plan}" linkIndex="{network.index[m]}"' if plan else ""
        ways = f'from="{start}" to="{end}" fromLane="0" toLane="0" via="{paths[m][0]}"{light}'
        lines.append(f"<connection {ways}/>")
        for part, after in zip(paths[m], [*paths[m][1:], ""], strict=True):
            via = f' via="{after}"' if after else ""
            lines.append(f'<connection from="{part[:-2]}" to="{end}" fromLane="0" toLane="0"{via}/>')
    return "\n".join([*lines, "</net>"])


def write_net(path: Path, network: Network) -> Path:
    """Write a network, and return where."""
    path.write_text(net_xml(network), encoding="utf-8")
    return path
