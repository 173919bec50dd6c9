"""Scenarios of the Waymo Open Motion Dataset: agents over time, lanes, stop signs, signals; from JSON or TFRecord.

JSON is the layout of Nocturne and GPUDrive: ``objects`` with position, heading, velocity and valid per step, ``roads``
with geometry by type, ``metadata.tracks_to_predict``. TFRecord is the official ``scenario.proto`` (``womd_record.py``).
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from idm_env.data.errors import DataError

STEP_S = 0.1
PRESENT = 10
"""Step of the present where a file does not say: 11 steps of history, then the future."""
KINDS = ("vehicle", "pedestrian", "cyclist")


@dataclass(frozen=True, eq=False)
class Agent:
    """One agent; arrays are [T] or [T, 2], in m, rad and m/s, and mean nothing where ``valid`` is False."""

    id: int
    kind: str
    length: float
    width: float
    position: np.ndarray
    heading: np.ndarray
    velocity: np.ndarray
    valid: np.ndarray


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane's centre line [M, 2] in the direction of travel.

    ``exits`` are identifiers of the lanes that follow, None where the file does not tell them; ``speed_limit`` in m/s,
    NaN where unknown; ``bike`` marks lanes for bicycles.
    """

    id: int
    line: np.ndarray
    exits: tuple[int, ...] | None = None
    speed_limit: float = float("nan")
    bike: bool = False


@dataclass(frozen=True, eq=False)
class Control:
    """A stop sign or a signal at ``point`` [2]: what it shows at the present step, and the lanes that it is for.

    ``shows`` is ``sign``, or a signal's ``stop``, ``caution``, ``go`` or ``unknown``; a flashing stop is a sign, a
    flashing caution is go. ``lanes`` is empty where the file does not tell them (signs in JSON).
    """

    shows: str
    point: np.ndarray
    lanes: tuple[int, ...] = ()


SHOWN = ("unknown", "stop", "caution", "go", "stop", "caution", "go", "sign", "go")
"""What the states 0 to 8 of a signal in the official files mean here."""
_STATES = (
    "unknown", "arrow_stop", "arrow_caution", "arrow_go", "stop", "caution", "go", "flashing_stop", "flashing_caution",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scenario:
    """A scene: who, where and on which lanes. ``present`` is the step up to which the past is known."""

    id: str
    agents: tuple[Agent, ...]
    lanes: tuple[Lane, ...]
    to_predict: tuple[int, ...]
    present: int = PRESENT
    controls: tuple[Control, ...] = ()
    notes: tuple[str, ...] = field(default=())

    @property
    def steps(self) -> int:
        """Steps of history, present and future."""
        return len(self.agents[0].valid)


def scenarios(path: str | Path) -> Iterator[Scenario]:
    """Yield the scenarios of a JSON file (also gzipped) or of a TFRecord file.

    DataError, in one line, for a file that cannot be read; of a truncated TFRecord the whole records come first.
    """
    path = Path(path)
    if not path.exists():
        raise DataError(f"{path} does not exist; check the path.")
    if path.is_dir():
        raise DataError(f"{path} is a directory; name the scenario files in it.")
    name = path.name.lower()
    if name.endswith((".json", ".json.gz")):
        yield read_json(path)
    elif ".tfrecord" in name:
        from idm_env.data import womd_record

        yield from womd_record.read(path)
    else:
        raise DataError(f"{path.name} has an unknown extension; use .json, .json.gz or .tfrecord.")


def count(path: str | Path) -> int:
    """Return how many scenarios a file has, from the headers of its records; 1 where it cannot tell."""
    path = Path(path)
    if not path.is_file() or ".tfrecord" not in path.name.lower() or path.name.lower().endswith((".json", ".json.gz")):
        return 1
    from idm_env.data import womd_record

    return max(1, womd_record.count(path))


def read_json(path: str | Path) -> Scenario:
    """Return the scenario of one JSON file. DataError if it is no such file."""
    path = Path(path)
    opener = gzip.open if path.name.lower().endswith(".gz") else open
    try:
        with opener(path, "rt", encoding="utf-8") as file:
            content = json.load(file)
    except (OSError, EOFError, ValueError, RecursionError) as error:
        raise DataError(f"{path.name} cannot be read ({str(error)[:120]}); is it complete JSON?") from None
    if not isinstance(content, dict) or not content.get("objects"):
        raise DataError(f"{path.name} has no 'objects'; it must be a scenario in the layout of Nocturne or GPUDrive.")
    try:
        return _scenario(content, path.name)
    except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError) as error:
        if isinstance(error, DataError):
            raise
        text = f"{path.name} lacks what a scenario needs ({type(error).__name__}: {error}); is it in Nocturne's layout?"
        raise DataError(text) from None


def _scenario(content: dict[str, Any], source: str) -> Scenario:
    agents = tuple(_agent(item, number) for number, item in enumerate(content["objects"]))
    lanes, controls, notes = [], [], []
    for number, road in enumerate(content.get("roads", ())):
        points = road.get("geometry", ())
        line = _xy(points if isinstance(points, list) else [points])
        if road.get("type") == "lane" and len(line) >= 2:
            bike = road.get("map_element_id") == 3
            lanes.append(Lane(int(road.get("id", number)), line, bike=bike))
        elif road.get("type") == "stop_sign" and len(line):
            controls.append(Control("sign", line[0]))
    controls += _signals(content.get("tl_states"))
    metadata = content.get("metadata") or {}
    chosen = metadata.get("tracks_to_predict")
    if chosen is None:
        wanted = tuple(i for i, agent in enumerate(agents) if agent.valid[PRESENT])
        notes.append("the file names no tracks_to_predict: every agent valid at the present step is predicted")
    else:
        wanted = tuple(int(item["track_index"]) if isinstance(item, dict) else int(item) for item in chosen)
    check_scenario(agents, wanted, PRESENT, source)
    name = str(content.get("scenario_id") or content.get("name") or source)
    return Scenario(name, agents, tuple(lanes), wanted, PRESENT, tuple(controls), tuple(notes))


def _signals(lights: Any) -> list[Control]:
    """Return the signals of ``tl_states``, lane → states over time, as they are at the present and not later."""
    found = []
    for key, light in (lights or {}).items():
        steps = [int(step) for step in light.get("time_index", range(len(light["state"])))]
        seen = [i for i, step in enumerate(steps) if step <= PRESENT]
        if not seen:
            continue
        last = max(seen, key=lambda i: steps[i])
        name = str(light["state"][last]).lower()
        shows = SHOWN[_STATES.index(name)] if name in _STATES else "unknown"
        lane = light.get("lane_id", key)
        lanes = (int(lane),) if str(lane).lstrip("-").isdigit() else ()
        found.append(Control(shows, np.array([float(light["x"][last]), float(light["y"][last])]), lanes))
    return found


def check_scenario(agents: tuple[Agent, ...], wanted: tuple[int, ...], present: int, source: str) -> None:
    """Raise DataError for tracks to predict that do not exist, and for a scenario that ends before its present."""
    wrong = [i for i in wanted if not 0 <= i < len(agents)]
    if wrong:
        raise DataError(f"{source}: track_index {wrong[0]} to predict is outside the {len(agents)} agents.")
    if len(agents[0].valid) <= present:
        raise DataError(f"{source}: {len(agents[0].valid)} steps end before the present step {present}.")


def _agent(item: dict[str, Any], number: int) -> Agent:
    valid = np.asarray(item["valid"], bool)
    position, velocity = _xy(item["position"]), _xy(item["velocity"])
    heading = np.asarray(item["heading"], float).reshape(-1)
    if not len(valid) == len(position) == len(velocity) == len(heading):
        raise KeyError(f"object {number} has arrays of different lengths")
    # invalid samples are filled with −10 000 in these files
    valid &= np.isfinite(position).all(1) & np.isfinite(velocity).all(1) & np.isfinite(heading)
    length, width = float(_last(item.get("length", 4.5))), float(_last(item.get("width", 2.0)))
    return Agent(
        int(item.get("id", number)), str(item["type"]).lower(), length, width, position, heading, velocity, valid
    )  # fmt: skip


def _last(value: Any) -> Any:
    """Return the last of sizes that a file gives per step, or the one that it gives once."""
    return value[-1] if isinstance(value, list) else value


def _xy(points: list[Any]) -> np.ndarray:
    return np.array([[float(p["x"]), float(p["y"])] for p in points], float).reshape(-1, 2)
