"""Demand of a network: vehicles with departures, routes and kinds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from idm_env.roads.network import NONE, Array, Network
from idm_env.roads.sumo_demand import read_demand
from idm_env.roads.ways import draw_turns
from idm_env.validation import shown


@dataclass(frozen=True, eq=False)
class Demand:
    """A vehicle in each of n rows, in the order of departure (rows are sorted), and R routes between them.

    ``routes`` (R, H) are lists of links, those inside junctions included, filled with −1. A vehicle follows ``route``
    (n), is due at ``depart`` (n, s) at the beginning of its first link, asks there for ``speed`` (n, m/s), has
    ``length`` (n, m) and is of a ``kind`` (n): a row of ``kinds``, which map ``effect.parameter`` to a value. Those
    of files have ``names``; SUMO numbers those of flows in this way, too.

    ValueError, in one line, for numbers that no vehicle has.
    """

    routes: Array
    route: Array
    depart: Array
    speed: Array = field(default_factory=lambda: np.array(1e3))
    length: Array = field(default_factory=lambda: np.array(5.0))
    kind: Array = field(default_factory=lambda: np.array(0))
    kinds: tuple[Mapping[str, float], ...] = ({},)
    names: tuple[str, ...] = ()
    skipped: Mapping[str, int] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        routes, n = np.atleast_2d(np.asarray(self.routes, np.int32)), np.size(self.route)
        whole = {"route": len(routes), "kind": len(self.kinds)}
        columns: dict[str, Array] = {}
        for name in ("route", "depart", "speed", "length", "kind"):
            x = np.asarray(getattr(self, name), np.int32 if name in whole else float)
            columns[name] = np.broadcast_to(x.reshape(-1) if x.ndim else x, (n,))
        order = np.argsort(columns["depart"], kind="stable")
        object.__setattr__(self, "routes", routes)
        object.__setattr__(self, "names", tuple(self.names[i] for i in order) if self.names else ())
        for name, x in columns.items():
            object.__setattr__(self, name, x[order])
        for name, count in whole.items():
            for i in np.flatnonzero((columns[name] < 0) | (columns[name] >= count)):
                raise ValueError(f"vehicle {i}: {name} = {columns[name][i]} does not exist; there are {count}.")
        for name, low, high in (("depart", 0.0, np.inf), ("speed", 0.0, 1e3), ("length", 0.1, 100.0)):
            for i in np.flatnonzero(~((columns[name] >= low) & (columns[name] <= high))):
                raise ValueError(f"vehicle {i}: {name} = {columns[name][i]:g} must be from {low:g} to {high:g}.")

    @classmethod
    def from_sumo(cls, network: Network, *paths: str | Path, seed: int = 0, end: float = 3600.0) -> Demand:
        """Return the demand of SUMO's files of routes and types: vehicles, trips by the quickest way, and flows.

        Flows without an end last until ``end`` (s); ``skipped`` counts what was left out or changed. ValueError, in one
        line that names the element, for a file that cannot be used.
        """
        return cls(**read_demand(network, [Path(path) for path in paths], seed, end)).check(network)

    @classmethod
    def by_turns(
        cls, network: Network, per_hour: float | Mapping[str, float], seconds: float, *, seed: int = 0,
        shares: Sequence[float] = (0.2, 0.6, 0.2),
    ) -> Demand:  # fmt: skip
        """Return Poisson arrivals at every edge to which none leads, which turn left, go on or turn right by shares.

        ``per_hour`` is one rate for all, or one by edge (1/h); a journey ends where no edge follows. Nobody turns back,
        and an edge to which one can only turn back is one to which none leads. The same seed gives the same demand.
        ValueError for a rate, a share or an edge that cannot be.
        """
        return cls(**draw_turns(without_turns_back(network), per_hour, seconds, seed, shares)).check(network)

    def check(self, network: Network) -> Demand:
        """Return this demand. ValueError, in one line, for a route that does not connect, or moves never green."""
        links = len(network.names)
        pairs = network.follows[:, 0] * links + network.follows[:, 1]
        for r in np.unique(self.route):
            way = self.routes[r][self.routes[r] >= 0].astype(np.int64)
            if not len(way) or way.max() >= links or (self.routes[r][: len(way)] < 0).any():
                raise ValueError(f"route {r}: {shown(self.routes[r].tolist())} must be links from 0 to {links - 1}.")
            for i in np.flatnonzero(~np.isin(way[:-1] * links + way[1:], pairs)):
                a, b = (network.names[way[j]] for j in (i, i + 1))
                raise ValueError(f"route {r}: link '{b}' does not follow '{a}', nor is it the lane beside.")
            for k in way[:-1][(network.times(way[None])[0, :-1] == 0.0) & network.cramped[way[:-1]]]:
                a, length = network.names[k], network.length[k]
                raise ValueError(f"route {r}: link '{a}' ({length:g} m) is too short for a change at its limit.")
            if network.inner[way[0]] or network.inner[way[-1]]:
                raise ValueError(f"route {r}: must begin and end outside junctions.")
            for m in np.unique(network.move_of[way[network.inner[way]]]):
                if not network.ever_open(int(m)):
                    signal = network.plans[network.signal[m]].name
                    raise ValueError(f"route {r}: signal '{signal}' never shows green to move {network.move_name(m)}.")
        return self


def without_turns_back(network: Network) -> Network:
    """Return the network less the moves that turn by more than 170°, such as those at the dead ends of netgenerate."""
    pieces = [shape if len(shape) > 1 else np.zeros((2, 2)) for shape in network.shape or [()] * len(network.names)]
    first, last = (np.array([x[i + 1] - x[i] for x in pieces]) @ (1.0, 1.0j) for i in (0, -2))
    stays = np.abs(np.angle(first[network.end] * last[network.start].conj(), deg=True)) <= 170.0
    if stays.all():
        return network
    rows = np.append(np.where(stays, np.cumsum(stays) - 1, NONE), NONE)
    columns = {name: getattr(network, name)[stays] for name in ("start", "end", "path", "signal", "index")}
    return replace(network, **columns, **{name: rows[getattr(network, name)[stays]] for name in ("foes", "yields")})
