"""The command ``network``: a network and demand of SUMO in; travel times, queues, a map and an animation out."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import torch

from idm_env.effects import IDM, Brakes
from idm_env.effects.network_rules import LinkLimit, StopLine
from idm_env.extras import needed
from idm_env.jobs import storage
from idm_env.jobs.progress import OnProgress, silent
from idm_env.multilane import junctions
from idm_env.reports import page
from idm_env.reports.diagrams import COLOURS
from idm_env.roads.network import Network
from idm_env.roads.network_demand import Demand
from idm_env.simulator import Simulator
from idm_env.types import mapped

TABLES = ("links", "trips", "over_time")
WRITTEN = ("report.json", "report.html", "map.png", "animation.gif", *(f"{name}.csv" for name in TABLES))
SAMPLE_S, PERIOD_S, KEPT_S = 5.0, 60.0, 300.0
"""Links are counted, rows of ``over_time.csv`` are written, and an interrupted run goes on, every so many seconds."""
PATIENCE_S = 3600.0
"""Without ``seconds``, for so long after the last departure vehicles may be on their way (s)."""
FRAMES = 120
"""Pictures of an animation at most."""
COUNTS = ("time_s", "due", "inside", "arrived", "queued", "halting", "mean_speed_mps")

Frame = tuple[float, torch.Tensor, torch.Tensor, torch.Tensor]
"""A time (s), and of vehicles then on the network links, positions (m) and speeds (m/s), ``[vehicles]`` each."""


def simulate_network(
    net: Path, routes: Sequence[Path], out: Path, *, seconds: float | None = None, seed: int = 0, resume: bool = False,
    on_progress: OnProgress = silent,
) -> dict[str, Any]:  # fmt: skip
    """Return the report of traffic on a network for ``seconds`` (s), by default until all have arrived; write it.

    ``resume`` goes on with an interrupted run. ValueError, in one line, for files that cannot be used.
    """
    with storage.results(out, WRITTEN, [net, *routes]):
        on_progress("reading", 0, 0, net.name)
        _empty_map(network := Network.from_sumo(net))  # refused before hours of traffic
        demand = Demand.from_sumo(network, *routes, seed=seed, **({} if seconds is None else {"end": seconds}))
        mark = storage.fingerprint(net, *routes, seconds, seed)
        store = storage.Store(out / storage.UNFINISHED / "network", mark, resume)
        traffic = _Traffic(network, demand)
        traffic.run(float(demand.depart.max()) + PATIENCE_S if seconds is None else seconds, store, on_progress)
        tables = traffic.tables()
        for name, rows in tables.items():
            storage.write_csv(out / f"{name}.csv", rows)
        on_progress("drawing", 0, 0, "")
        figure = draw_map(network, tables["links"])
        storage.write(out / "map.png", lambda part: figure.savefig(part, dpi=150))
        storage.write(out / "animation.gif", lambda part: animate(network, traffic.frames).save(part, "pillow"))
        result = traffic.summary(tables["trips"])
        blocks = [page.Block("lead", result["sentence"]), page.picture(figure, "Mean speed as a share of the limit.")]
        queues = tables["links"].sort("mean_halting", descending=True).head(20)
        for title, rows in (("Over time", tables["over_time"]), ("Longest queues", queues)):
            blocks += [page.Block("heading", title), page.table(rows.to_dicts())]
        notes = *result["cautions"], *(f"{what}: {count}" for what, count in result["skipped"].items())
        blocks += [page.Block("heading", "Data"), page.Block("list", rows=notes or ("Nothing was left out.",))]
        page.write_page(out / "report.html", f"Traffic on {net.name}", blocks)
        report = {"schema": 1, "command": page.command_line(), **result, "versions": page.versions()}
        storage.write_json(out / "report.json", report)
        store.remove()
        return report


class _Traffic:
    """Simulation of a demand on a network, with the counts of links and of all vehicles over time."""

    def __init__(self, network: Network, demand: Demand) -> None:
        self.network, self.demand = network, demand
        # At amber SUMO's drivers stop where their own decel is enough; a network has one such number.
        decel = min(demand.kinds[k]["idm.comfort_decel"] for k in np.unique(demand.kind))
        self.simulator = Simulator(network, (IDM(), StopLine(most_decel=min(decel, 9.0)), LinkLimit(), Brakes()))
        self.params = junctions.of_kinds(self.simulator.defaults(), demand)
        self.state = junctions.travelling(self.simulator, demand, self.params)
        self.sums = torch.zeros(3, len(network.names), dtype=torch.float64)  # of vehicles, halting, speeds
        self.samples, self.stride = 0, 1
        self.periods: list[list[float]] = []
        self.frames: list[Frame] = []

    def run(self, end: float, store: storage.Store, progress: OnProgress) -> None:
        """Simulate until ``end`` (s), or until all have arrived."""
        if (saved := store.get("state")) is not None:
            leaves = iter(saved.pop("state"))
            self.state = mapped(lambda _: next(leaves), self.state)
            vars(self).update(saved)
        steps, arrived, each = max(1, round(end / SAMPLE_S)), -1, round(SAMPLE_S / self.simulator.dt)
        while self.samples < steps and arrived < len(self.demand.route):
            self.state, _ = self.simulator.rollout(self.state, {}, self.params, each, keep=None)
            self.samples += 1
            time, links = self.samples * SAMPLE_S, junctions.by_link(self.network, self.state)
            self.sums += torch.stack((links.vehicles, links.halting, links.vehicles * links.speed)).double()
            due, inside, arrived, queued = (int(x) for x in junctions.counts(self.state))
            if time % PERIOD_S == 0 or arrived == len(self.demand.route):
                speed = float((links.vehicles * links.speed).sum()) / max(inside, 1)
                self.periods.append([time, due, inside, arrived, queued, float(links.halting.sum()), speed])
            self._add_frame(time)
            progress("simulating", self.samples, steps, f"{time:.0f} s, {inside} inside, {arrived} arrived")
            if time % KEPT_S == 0:
                content = {name: getattr(self, name) for name in ("sums", "samples", "stride", "periods", "frames")}
                leaves = list[torch.Tensor]()
                mapped(leaves.append, self.state)  # type: ignore[arg-type]
                store.put("state", content | {"state": leaves})

    def _add_frame(self, time: float) -> None:
        """Keep where everybody is; of too many frames every other one goes."""
        assert self.state.lanes is not None and self.state.present is not None
        here = self.state.present > 0
        if self.samples % self.stride == 0:
            links, positions, speeds = (x[here] for x in (self.state.lanes.lane, self.state.position, self.state.speed))
            self.frames.append((time, links, positions, speeds))
        if len(self.frames) > FRAMES:
            self.frames, self.stride = self.frames[1::2], 2 * self.stride

    def tables(self) -> dict[str, pl.DataFrame]:
        """Return tables of links, of trips, and of counts over time; times in s, speeds in m/s."""
        network, demand = self.network, self.demand
        vehicles, halting, speed = self.sums.numpy()
        links: dict[str, Any] = {"link": network.names, "edge": network.edge, "length_m": network.length}
        links |= {"limit_mps": network.limit, "mean_vehicles": vehicles / self.samples}
        links["mean_halting"] = halting / self.samples
        links["mean_speed_mps"] = [s / n if n else None for s, n in zip(speed.tolist(), vehicles.tolist(), strict=True)]
        ways, dt = junctions.journeys_of(self.state), self.simulator.dt
        used = [row[row >= 0] for row in demand.routes]
        ends = (("from", 0), ("to", -1))
        trips: dict[str, Any] = {"id": demand.names}
        trips |= {name: [network.edge[used[r][k]] for r in demand.route] for name, k in ends}
        trips["due_s"] = demand.depart
        for name, steps in (("entered_s", ways.entered), ("arrived_s", ways.left)):
            trips[name] = [k * dt if k >= 0 else None for k in steps.tolist()]
        trips["travel_time_s"] = junctions.travel_time(self.simulator, self.state).double().numpy()
        trips["free_time_s"] = network.times(demand.routes).sum(1)[demand.route]
        over_time = pl.DataFrame(self.periods, schema=COUNTS, orient="row")
        return dict(zip(TABLES, (pl.DataFrame(links), pl.DataFrame(trips), over_time), strict=True))

    def summary(self, trips: pl.DataFrame) -> dict[str, Any]:
        """Return the numbers of the whole run, and a sentence of them."""
        arrived, seconds = trips.drop_nulls("arrived_s"), self.samples * SAMPLE_S
        numbers: dict[str, Any] = {"vehicles": len(trips), "arrived": len(arrived), "seconds": seconds}
        numbers |= {name: arrived[name].mean() for name in ("travel_time_s", "free_time_s")}
        numbers["deadlocked"] = int(junctions.deadlocked(self.simulator, self.state, self.params))
        sentence = f"{len(arrived)} of {len(trips)} vehicles arrived within {seconds:.0f} s"
        if len(arrived):
            mean, free = numbers["travel_time_s"], numbers["free_time_s"]
            sentence += f", after {mean:.1f} s on average; at the limits their routes take {free:.1f} s"
        if numbers["deadlocked"]:
            sentence += f"; {numbers['deadlocked']} wait for one another for ever"
        skipped, cautions = {**self.network.skipped, **self.demand.skipped}, self.network.cautions()
        account = ", ".join(f"{what} {count}" for what, count in skipped.items()) or "nothing was left out"
        account = f"Data: {account}." + (f" {len(cautions)} cautions, the first: {cautions[0]}" if cautions else "")
        return {"sentence": f"{sentence}.", "account": account, **numbers, "skipped": skipped, "cautions": cautions}


def _empty_map(network: Network) -> tuple[Any, Any, Any]:
    """Return a figure, its axes and the colours of speeds. ValueError for a link without a shape."""
    with needed("a map"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.colors import LinearSegmentedColormap
        from matplotlib.figure import Figure
    for name, shape in zip(network.names, network.shape, strict=True):
        if len(shape) < 2:
            raise ValueError(f"link '{name}' has no shape, and a map needs one. Give every lane a shape.")
    points = np.concatenate(network.shape)
    (left, low), (right, high) = points.min(0), points.max(0)
    wide, tall = max(right - left, 1.0), max(high - low, 1.0)
    figure = Figure(figsize=(8.0, float(np.clip(7.0 * tall / wide, 2.0, 9.0))), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.set(xlim=(left - 0.03 * wide, right + 0.03 * wide), ylim=(low - 0.03 * tall, high + 0.03 * tall))
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    return figure, axes, LinearSegmentedColormap.from_list("speed", COLOURS / 255.0)


def draw_map(network: Network, links: pl.DataFrame) -> Any:
    """Return a figure of all links, coloured by mean speed over limit; those that nobody used are grey."""
    figure, axes, colours = _empty_map(network)
    from matplotlib.collections import LineCollection

    share = (links["mean_speed_mps"].cast(pl.Float64) / links["limit_mps"]).fill_null(math.nan).to_numpy()
    order = np.argsort(np.isfinite(share), kind="stable")
    lines = LineCollection([network.shape[k] for k in order], linewidths=np.where(np.isfinite(share[order]), 2.5, 1.0))
    lines.set(array=np.ma.masked_invalid(share[order]), cmap=colours.with_extremes(bad="#c8c8c8"), clim=(0.0, 1.0))
    axes.add_collection(lines)
    figure.colorbar(lines, ax=axes, label="mean speed / limit")
    return figure


def animate(network: Network, frames: Sequence[Frame]) -> Any:
    """Return an animation of frames: each vehicle is a dot, red at standstill and green at the limit."""
    figure, axes, colours = _empty_map(network)
    from matplotlib.animation import FuncAnimation
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(network.shape, linewidths=1.0, colors="#d0d0d0"))
    dots = axes.scatter([], [], s=9, c=[], cmap=colours, vmin=0.0, vmax=float(network.limit.max()), zorder=3)
    figure.colorbar(dots, ax=axes, label="speed (m/s)")

    def picture(frame: Frame) -> tuple[Any]:
        time, links, positions, speeds = frame
        points = [_point(network, k, x) for k, x in zip(links.tolist(), positions.tolist(), strict=True)]
        dots.set(offsets=np.reshape(points, (-1, 2)), array=speeds.numpy())
        axes.set_title(f"{time:.0f} s", fontsize=10)
        return (dots,)

    return FuncAnimation(figure, picture, frames=list(frames), interval=100)


def _point(network: Network, link: int, position: float) -> list[float]:
    """Return where a place on a link is, x and y (m)."""
    shape = network.shape[link]
    way = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(shape, axis=0), axis=1))))
    place = position / network.length[link] * way[-1]
    return [float(np.interp(place, way, column)) for column in shape.T]
