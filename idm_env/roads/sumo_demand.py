"""SUMO's demand (``.rou.xml``): vehicles, trips by the quickest way and flows, as columns of ``Demand``.

All that is random (departures of a flow, types and routes of a distribution) is drawn here, by a counter under the key
of the seed and the element's id. Times in s, speeds in m/s, lengths in m. Source: SUMO's documentation, *Definition of
Vehicles, Vehicle Types, and Routes*.
"""

import math
import re
from bisect import bisect
from collections import Counter
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from statistics import NormalDist
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from idm_env import validation
from idm_env.roads import sumo_files
from idm_env.roads.network import Network, padded
from idm_env.roads.sumo_files import name, number, parsed, seconds, text
from idm_env.roads.ways import Route, Ways, arrivals, keyed

PARAMETERS = {"accel": "max_accel", "decel": "comfort_decel", "tau": "time_gap", "minGap": "min_gap"}
PARAMETERS |= {"maxSpeed": "desired_speed"}
"""SUMO's attribute → IDM's parameter: m/s², m/s², s, m, m/s."""
MOST_VEHICLES, VARIANTS = 5_000_000, 8
"""Most that are read, and over how many choices of lanes a route leads that several may take."""
Spread = tuple[float, float, float, float]
"""Mean, deviation and bounds of what share of limits vehicles drive."""
CAR = (5.0, 2.6, 4.5, 55.56)
CLASSES = dict.fromkeys(("private", "vip", "hov", "evehicle", "custom1", "custom2", "authority", "army", "taxi"), CAR)
CLASSES |= {"passenger": CAR, "emergency": (6.5, *CAR[1:]), "delivery": (6.5, *CAR[1:])}
CLASSES |= {"truck": (7.1, 1.3, 4.0, 36.11), "trailer": (16.5, 1.1, 4.0, 36.11), "bus": (12.0, 1.2, 4.0, 27.78)}
CLASSES |= {"coach": (14.0, 2.0, 4.0, 27.78), "motorcycle": (2.2, 6.0, 10.0, 55.56), "moped": (2.1, 1.1, 7.0, 16.67)}
"""Length, accel, decel and maxSpeed of SUMO 1.28 where a vType gives none; other classes are no cars."""
SPREADS = dict.fromkeys(("taxi", "delivery", "truck", "trailer", "coach"), 0.05)
SPREADS |= dict.fromkeys(("authority", "army", "emergency", "bus"), 0.0)
"""SUMO's speedDev of classes where it is not 0.1."""
READ = {"vType": {"id", "vClass", "carFollowModel", "length", "probability", "color", "guiShape", *PARAMETERS}}
READ["vType"] |= {"speedFactor", "speedDev"}
READ["vehicle"] = {"id", "type", "depart", "departSpeed", "route", "color"}
READ["trip"] = READ["vehicle"] | {"from", "to", "via"}
READ["flow"] = READ["trip"] | {"begin", "end", "number", "vehsPerHour", "perHour", "period", "probability"}
"""Attributes that are read, or that change nothing; all others are counted."""
ROUTES = {"route", "routeDistribution"}
"""Elements that are read inside of others."""
AS_IT_IS = {("departPos", "0"), ("departPos", "base"), ("delta", "4"), ("delta", "4.0")}
"""What is so without being said."""


def read_demand(network: Network, paths: Sequence[Path], seed: int, end: float) -> dict[str, Any]:
    """Return the columns of the demand of files of routes and types; ``end`` (s) is that of flows without one.

    ValueError, in one line that names the element, for one that cannot be used.
    """
    reader = _Reader(network, seed, end)
    for path in paths:
        for element in sumo_files.elements(path, ("routes", "additional")):
            reader.add(element)
    return reader.columns()


class _Reader:
    """Types, routes and vehicles of all files, in the order in which they stand."""

    def __init__(self, network: Network, seed: int, end: float) -> None:
        self.ways, self.limit, self.seed, self.end = Ways(network), network.limit.tolist(), seed, end
        self.skipped, self.variants = Counter[str](), VARIANTS if (network.left >= 0).any() else 1
        self.kinds: list[dict[str, float]] = []
        self.known: dict[str, dict[str, list[tuple[float, Any]]]] = {"vType": {}, "route": {}}
        self.numbers: dict[Route, int] = {}
        self.rows: list[tuple[int, float, float, float, int, str]] = []
        self.drivers: dict[tuple[int, float], int] = {}
        self.ids: set[str] = set()

    def add(self, element: Element) -> None:
        """Take one element; what is neither traffic of cars nor said of it is counted."""
        kind = element.tag.removesuffix("Distribution")
        if kind in self.known:
            text(element, "id")
            self._choices(element, kind)
        elif kind in ("vehicle", "trip", "flow"):
            self._add_vehicles(element)
        else:
            self.skipped[f"elements <{kind}>"] += 1

    def _choices(self, element: Element, kind: str, owner: str = "") -> list[tuple[float, Any]]:
        """Return the types or routes that an element stands for, each with its weight, and keep them by its id."""
        if element.tag == kind:
            make = self._type_of if kind == "vType" else self._route_of
            weight, many = number(element, "probability", 1.0, 0.0), self.variants if kind == "route" else 1
            pairs = [(weight, make(element, owner or name(element))) for _ in range(many)]
        else:
            keys = element.get(f"{kind}s", "").split()
            weights = element.get("probabilities", "1 " * len(keys)).split()
            if len(keys) != len(weights):
                raise ValueError(f"{name(element)}: {len(weights)} probabilities for {len(keys)} names. Give one each.")
            each = (parsed(word, element, "probabilities", 0.0) for word in weights)
            pairs = [(weight, self._named(kind, key, element)[0][1]) for key, weight in zip(keys, each, strict=True)]
            pairs += [pair for one in element.iter(kind) for pair in self._choices(one, kind, owner)]
        if not sum(weight for weight, _ in pairs) > 0.0:
            raise ValueError(f"{name(element)} has nothing of a probability above 0. Give it some.")
        if "id" in element.attrib:
            self.known[kind][element.attrib["id"]] = pairs
        return pairs

    def _named(self, kind: str, key: str, element: Element) -> list[tuple[float, Any]]:
        """Return the types or routes of a name; ValueError where there are none."""
        if key not in self.known[kind]:
            near = validation.nearest(key, self.known[kind])
            raise ValueError(f"{name(element)}: {kind} '{key[:60]}' is unknown.{near}")
        return self.known[kind][key]

    def _route_of(self, element: Element, owner: str) -> Route:
        if not (edges := text(element, "edges").split()):
            raise ValueError(f"{owner} has a route without edges. Give it some.")
        return self.ways.route_along(edges * int(number(element, "repeat", 1.0, 1.0)), owner)

    def _type_of(self, element: Element, owner: str) -> tuple[int, float, Spread] | None:
        """Return the row of ``kinds``, the length (m) and shares of limits of a type, None of one that is no car's."""
        self._count_unread(element)
        vehicle_class, law = element.get("vClass", "passenger"), element.get("carFollowModel", "Krauss")
        self.skipped[f"vTypes of {law} driven by IDM"] += law != "IDM"
        if vehicle_class not in CLASSES:
            return None
        length, *defaults = CLASSES[vehicle_class]
        standard = dict(zip(("accel", "decel", "maxSpeed", "tau", "minGap"), (*defaults, 1.0, 2.5), strict=True))
        kind = {f"idm.{PARAMETERS[key]}": number(element, key, standard[key], 0.0, above=True) for key in PARAMETERS}
        self.kinds += [kind] if kind not in self.kinds else []
        return self.kinds.index(kind), number(element, "length", length, 0.1), _spread(element, vehicle_class)

    def _count_unread(self, element: Element) -> None:
        for key in {*dict(element.attrib.items() - AS_IT_IS)} - READ[element.tag]:
            self.skipped[f"attribute {key} of {element.tag}"] += 1
        for child in element:
            self.skipped[f"elements <{child.tag}> of {element.tag}"] += child.tag not in ROUTES

    # -- vehicles ----------------------------------------------------------------------------------------------------

    def _add_vehicles(self, element: Element) -> None:
        """Add the rows of a vehicle, a trip or a flow."""
        self._count_unread(element)
        if (own := text(element, "id")) in self.ids:
            raise ValueError(f"{name(element)}: this id was given before. Give each vehicle, trip and flow its own.")
        self.ids.add(own)
        key = element.get("type", "DEFAULT_VEHTYPE")
        if key == "DEFAULT_VEHTYPE" and key not in self.known["vType"]:
            self._choices(Element("vType", id=key), "vType")
        types, routes = self._named("vType", key, element), self._routes_of(element)
        random, shares = keyed(self.seed, own), keyed(self.seed, f"{own} speedFactor")
        for count, depart in enumerate(self._departures(element, random) if routes else ()):
            one, route = _choose(types, random), _choose(routes, random)
            if one is None:
                self.skipped[f"vehicles of type {key}, which is no car's"] += 1
                continue
            if not route:
                self.skipped["vehicles that must change lanes on a link too short for it"] += 1
                continue
            speed = self._entry_speed(element, self.kinds[one[0]]["idm.desired_speed"], self.limit[route[0]], random)
            kind = self._driver(one[0], round(_draw_share(one[2], shares), 3))
            vehicle = f"{own}.{count}" if element.tag == "flow" else own
            self.rows.append((self.numbers.setdefault(route, len(self.numbers)), depart, speed, one[1], kind, vehicle))
            if len(self.rows) > MOST_VEHICLES:
                raise ValueError(f"{name(element)} brings more than {MOST_VEHICLES} vehicles. Give it fewer.")

    def _driver(self, kind: int, factor: float) -> int:
        """Return the row of ``kinds`` of those who are of a kind and drive a share of limits."""
        row = self.drivers.setdefault((kind, factor), len(self.kinds)) if factor != 1.0 else kind
        self.kinds += [self.kinds[kind] | {"link_limit.factor": factor}] if row == len(self.kinds) else []
        return row

    def _routes_of(self, element: Element) -> list[tuple[float, Route]]:
        """Return the routes of a vehicle, trip or flow with their weights; none between districts or junctions."""
        if own := [each for each in element if each.tag in ROUTES]:
            return self._choices(own[0], "route", name(element))
        if "route" in element.attrib:
            return self._named("route", element.attrib["route"], element)
        if {"from", "to"} <= element.attrib.keys():
            stops = [element.attrib["from"], *element.get("via", "").split(), element.attrib["to"]]
            many = self.variants if element.tag == "flow" else 1
            return [(1.0, self.ways.quickest(stops, name(element))) for _ in range(many)]
        if not any(key.startswith(("from", "to")) for key in element.attrib):
            raise ValueError(f"{name(element)} has no route. Give it a route, or from and to.")
        self.skipped[f"{element.tag}s between districts or junctions"] += 1
        return []

    def _departures(self, element: Element, random: np.random.Generator) -> Sequence[float]:
        """Return the departures of a vehicle, a trip or a flow (s)."""
        if element.tag != "flow":
            if element.get("depart") in ("triggered", "containerTriggered", "split", "now"):
                self.skipped[f"vehicles that depart when {element.get('depart')}"] += 1
                return []
            return [0.0 if element.get("depart") == "begin" else seconds(element, "depart")]
        begin, end = seconds(element, "begin", 0.0), seconds(element, "end", self.end)
        most = number(element, "number", math.inf, 0.0)
        hourly = next((key for key in ("vehsPerHour", "perHour") if key in element.attrib), None)
        if match := re.fullmatch(r"exp\((.+)\)", element.get("period", "")):
            element.set("period", match[1])
        if hourly or "period" in element.attrib:
            value = number(element, hourly or "period", None, 0.0, above=True)
            period = 3600.0 / value if hourly else 1.0 / value if match else value
        elif "probability" in element.attrib:
            period = 1.0 / min(number(element, "probability", None, 0.0, above=True), 1.0)
        elif most == math.inf:
            raise ValueError(f"{name(element)} has neither a number nor a rate. Give it vehsPerHour.")
        else:
            period = (end - begin) / max(most, 1.0)
        count = min(most, (end - begin) / period - 1e-9) if end > begin else 0.0
        if len(self.rows) + count > MOST_VEHICLES:
            raise ValueError(f"{name(element)} brings more than {MOST_VEHICLES} vehicles. Give it fewer.")
        if match:
            times = arrivals(1.0 / period, begin, end, random)
        elif not hourly and "period" not in element.attrib and "probability" in element.attrib:
            times = (begin + np.flatnonzero(random.random(math.ceil(end - begin)) * period < 1.0)).tolist()
        else:
            times = (begin + period * np.arange(math.ceil(count))).tolist()
        return times[: int(min(most, MOST_VEHICLES))]

    def _entry_speed(self, element: Element, most: float, limit: float, random: np.random.Generator) -> float:
        """Return the speed at the entry (m/s), by its number or SUMO's word for it."""
        word, fastest = element.get("departSpeed", "0"), min(most, limit)
        if word == "random":
            return fastest * random.random()
        return fastest if word.isalpha() else min(number(element, "departSpeed", 0.0, 0.0), fastest)

    def columns(self) -> dict[str, Any]:
        """Return the columns of ``Demand``."""
        names = "route", "depart", "speed", "length", "kind", "names"
        columns = dict(zip(names, zip(*self.rows, strict=True), strict=False))
        if not columns:
            raise ValueError("the files of demand have no vehicle. Give vehicles, trips or flows.")
        return columns | {"routes": padded(list(self.numbers)), "kinds": tuple(self.kinds), "skipped": +self.skipped}


def _spread(element: Element, vehicle_class: str) -> Spread:
    """Return a type's speedFactor, a number or ``normc(mean, deviation, low, high)``; speedDev goes first."""
    word = element.get("speedFactor", "1")
    parts = re.sub(r"^normc?\((.*)\)$", r"\1", word).split(",")
    try:
        values = [float(x) for x in parts] + [SPREADS.get(vehicle_class, 0.1), 0.2, 2.0][len(parts) - 1 :]
        mean, deviation, low, high = values
    except ValueError:
        mean = deviation = low = high = math.nan
    if not 0.05 <= low <= mean <= high <= 10.0:
        rule = "a number from 0.2 to 2, or normc(mean,deviation,low,high)"
        raise ValueError(f"{name(element)}: speedFactor = {validation.shown(word)} must be {rule}.")
    return mean, number(element, "speedDev", max(deviation, 0.0), 0.0), low, high


def _draw_share(spread: Spread, random: np.random.Generator) -> float:
    """Return one of normally distributed shares, of which those beyond the bounds are drawn again."""
    mean, deviation, low, high = spread
    if deviation < 1e-6 * mean:
        return mean
    law = NormalDist(mean, deviation)
    return law.inv_cdf(random.uniform(law.cdf(low), law.cdf(high)))


def _choose(pairs: list[tuple[float, Any]], random: np.random.Generator) -> Any:
    """Return one of several things by their weights."""
    sums = list(accumulate(weight for weight, _ in pairs))
    return pairs[bisect(sums, random.random() * sums[-1]) if len(pairs) > 1 else 0][1]
