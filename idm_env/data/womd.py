"""Scenarios of the Waymo Open Motion Dataset: agents over time, lanes, stop signs, signals; from JSON or TFRecord.

JSON is the layout of Nocturne and GPUDrive: ``objects`` with position, heading, velocity and valid per step, ``roads``
with geometry by type, ``metadata.tracks_to_predict``. TFRecord is the official ``scenario.proto`` (``womd_record.py``).
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from idm_env.data import womd_record
from idm_env.data.errors import DataError
from idm_env.data.scenario import PRESENT, SHOWN, Agent, MapLane, Scenario, TrafficControl, check_scenario
from idm_env.data.sizes import read_whole, unpacked

_STATES: tuple[str, ...] = ("unknown", "arrow_stop", "arrow_caution", "arrow_go", "stop", "caution", "go")
_STATES += ("flashing_stop", "flashing_caution")


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
        yield from womd_record.read(path)
    else:
        raise DataError(f"{path.name} has an unknown extension; use .json, .json.gz or .tfrecord.")


def count(path: str | Path) -> int:
    """Return how many scenarios a file has, from the headers of its records; 1 where it cannot tell."""
    path = Path(path)
    if not path.is_file() or ".tfrecord" not in path.name.lower() or path.name.lower().endswith((".json", ".json.gz")):
        return 1
    return max(1, womd_record.count(path))


def read_json(path: str | Path) -> Scenario:
    """Return the scenario of one JSON file. DataError if it is no such file."""
    path = Path(path)
    try:
        with unpacked(path) as file:
            content = json.loads(read_whole(file, path.name))
    except DataError:
        raise
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
            lanes.append(MapLane(int(road.get("id", number)), line, bike=bike))
        elif road.get("type") == "stop_sign" and len(line):
            controls.append(TrafficControl("sign", line[0]))
    controls += _signals(content.get("tl_states"))
    chosen = (content.get("metadata") or {}).get("tracks_to_predict")
    if chosen is None:
        targets = tuple(i for i, agent in enumerate(agents) if agent.valid[PRESENT])
        notes.append("the file names no tracks_to_predict: every agent valid at the present step is predicted")
    else:
        targets = tuple(int(item["track_index"]) if isinstance(item, dict) else int(item) for item in chosen)
    check_scenario(agents, targets, PRESENT, source)
    name = str(content.get("scenario_id") or content.get("name") or source)
    return Scenario(name, agents, tuple(lanes), targets, PRESENT, tuple(controls), tuple(notes))


def _signals(lights: Any) -> list[TrafficControl]:
    """Return the signals of ``tl_states``, lane → states over time, as they are at the present and not later."""
    signals = []
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
        signals.append(TrafficControl(shows, np.array([float(light["x"][last]), float(light["y"][last])]), lanes))
    return signals


def _agent(item: dict[str, Any], number: int) -> Agent:
    valid = np.asarray(item["valid"], bool)
    position, velocity = _xy(item["position"]), _xy(item["velocity"])
    heading = np.asarray(item["heading"], float).reshape(-1)
    if not len(valid) == len(position) == len(velocity) == len(heading):
        raise KeyError(f"object {number} has arrays of different lengths")
    # invalid samples are filled with −10 000 in these files
    valid &= np.isfinite(position).all(1) & np.isfinite(velocity).all(1) & np.isfinite(heading)
    length, width = float(_last(item.get("length", 4.5))), float(_last(item.get("width", 2.0)))
    kind = str(item["type"]).lower()
    return Agent(int(item.get("id", number)), kind, length, width, position, heading, velocity, valid)


def _last(value: Any) -> Any:
    """Return the last of sizes that a file gives per step, or the one that it gives once."""
    return value[-1] if isinstance(value, list) else value


def _xy(points: list[Any]) -> np.ndarray:
    return np.array([[float(p["x"]), float(p["y"])] for p in points], float).reshape(-1, 2)
