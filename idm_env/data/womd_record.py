"""Official TFRecord files of scenarios, without TensorFlow: record framing, checksums, and a minimal message schema.

Only the fields that prediction needs are declared; protobuf skips all others. Field numbers are those of the published
``scenario.proto`` and ``map.proto`` of the Waymo Open Dataset.
"""

import struct
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from idm_env.data.errors import DataError
from idm_env.data.scenario import SHOWN, Agent, MapLane, Scenario, TrafficControl, check_scenario

MILE_PER_HOUR = 0.44704
_KIND = {1: "vehicle", 2: "pedestrian", 3: "cyclist", 4: "other"}
_MASK = 0xA282EAD8

MESSAGES: dict[str, tuple[tuple[str, int, str], ...]] = {
    "ObjectState": (
        ("center_x", 2, "double"), ("center_y", 3, "double"), ("length", 5, "float"), ("width", 6, "float"),
        ("heading", 8, "float"), ("velocity_x", 9, "float"), ("velocity_y", 10, "float"), ("valid", 11, "bool"),
    ),
    "Track": (("id", 1, "int32"), ("object_type", 2, "int32"), ("states", 3, "*ObjectState")),
    "MapPoint": (("x", 1, "double"), ("y", 2, "double")),
    "LaneCenter": (
        ("speed_limit_mph", 1, "double"), ("type", 2, "int32"), ("polyline", 8, "*MapPoint"),
        ("exit_lanes", 10, "*int64"),
    ),
    "StopSign": (("lane", 1, "*int64"), ("position", 2, "MapPoint")),
    "TrafficSignalLaneState": (("lane", 1, "int64"), ("state", 2, "int32"), ("stop_point", 3, "MapPoint")),
    "DynamicMapState": (("lane_states", 1, "*TrafficSignalLaneState"),),
    "MapFeature": (("id", 1, "int64"), ("lane", 3, "LaneCenter"), ("stop_sign", 7, "StopSign")),
    "RequiredPrediction": (("track_index", 1, "int32"), ("difficulty", 2, "int32")),
    "Scenario": (
        ("timestamps_seconds", 1, "*double"), ("tracks", 2, "*Track"), ("scenario_id", 5, "string"),
        ("dynamic_map_states", 7, "*DynamicMapState"), ("map_features", 8, "*MapFeature"),
        ("current_time_index", 10, "int32"), ("tracks_to_predict", 11, "*RequiredPrediction"),
    ),
}  # fmt: skip
"""Message → fields (name, number, type); ``*`` repeats."""


@lru_cache(maxsize=1)
def messages() -> dict[str, Any]:
    """Return the message classes by name. ImportError where protobuf is not installed."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    kinds = descriptor_pb2.FieldDescriptorProto
    names = ("double", "float", "int32", "int64", "bool", "string")
    scalars = {name: getattr(kinds, f"TYPE_{name.upper()}") for name in names}
    file = descriptor_pb2.FileDescriptorProto(name="idm_env/scenario.proto", package="idm_env.womd", syntax="proto2")
    for name, fields in MESSAGES.items():
        message = file.message_type.add(name=name)
        for field, number, kind in fields:
            plain = kind.lstrip("*")
            entry = message.field.add(name=field, number=number)
            entry.label = kinds.LABEL_REPEATED if kind != plain else kinds.LABEL_OPTIONAL
            if plain in scalars:
                entry.type = scalars[plain]
            else:
                entry.type, entry.type_name = kinds.TYPE_MESSAGE, f".idm_env.womd.{plain}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kinds = {name: pool.FindMessageTypeByName(f"idm_env.womd.{name}") for name in MESSAGES}
    return {name: message_factory.GetMessageClass(kind) for name, kind in kinds.items()}


def read(path: str | Path) -> Iterator[Scenario]:
    """Yield the scenarios of a TFRecord file. DataError tells which record is truncated or damaged."""
    from google.protobuf.message import DecodeError

    path = Path(path)
    for number, data in enumerate(records(path)):
        message = messages()["Scenario"]()
        try:
            message.ParseFromString(data)
        except DecodeError:
            fault = f"{path.name}: record {number} is no scenario.proto"
            raise DataError(f"{fault}; use files of scenarios, not of tf.Examples.") from None
        yield _scenario(message, f"{path.name}, record {number}")


def records(path: Path) -> Iterator[bytes]:
    """Yield the records of a TFRecord file: length, its checksum, data, their checksum.

    DataError at the record that is truncated or whose checksum (masked CRC-32C) is wrong.
    """
    with path.open("rb") as file:
        number = 0
        while head := file.read(12):
            if len(head) < 12:
                raise DataError(f"{path.name} is truncated in the header of record {number}; copy it again.")
            length, check = struct.unpack("<QI", head)
            if masked_crc(head[:8]) != check:
                raise DataError(f"{path.name}: the header of record {number} is damaged; is it a TFRecord file?")
            data = file.read(length)
            tail = file.read(4)
            if len(data) < length or len(tail) < 4:
                have, need = len(data) + len(tail), length + 4
                raise DataError(f"{path.name} is truncated in record {number} ({have} of {need} bytes); copy it again.")
            if masked_crc(data) != struct.unpack("<I", tail)[0]:
                raise DataError(f"{path.name}: the data of record {number} are damaged (checksum); copy it again.")
            yield data
            number += 1


def count(path: Path) -> int:
    """Return the number of records in a TFRecord file by their lengths alone, up to where it ends or is damaged."""
    number, size = 0, path.stat().st_size
    with path.open("rb") as file:
        while len(head := file.read(12)) == 12 and masked_crc(head[:8]) == struct.unpack("<I", head[8:])[0]:
            number += 1
            if file.seek(struct.unpack("<Q", head[:8])[0] + 4, 1) >= size:
                break
    return number


@lru_cache(maxsize=1)
def _table() -> list[int]:
    """Return the byte table of CRC-32C (Castagnoli, reflected polynomial 0x82F63B78)."""
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = (byte >> 1) ^ (0x82F63B78 if byte & 1 else 0)
        table.append(byte)
    return table


def masked_crc(data: bytes) -> int:
    """Return TFRecord's masked CRC-32C."""
    table, crc = _table(), 0xFFFFFFFF
    for byte in data:
        crc = table[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    crc ^= 0xFFFFFFFF
    return (((crc >> 15) | (crc << 17)) + _MASK) & 0xFFFFFFFF


def _scenario(message: Any, source: str) -> Scenario:
    if not message.tracks:
        raise DataError(f"{source}: the scenario has no tracks; is it a file of scenarios?")
    agents = tuple(_agent(track) for track in message.tracks)
    lanes, controls = [], []
    for feature in message.map_features:
        if feature.HasField("lane") and len(feature.lane.polyline) >= 2:
            lane = feature.lane
            limit = lane.speed_limit_mph * MILE_PER_HOUR if lane.speed_limit_mph > 0 else float("nan")
            line = np.array([[p.x, p.y] for p in lane.polyline])
            lanes.append(MapLane(int(feature.id), line, tuple(lane.exit_lanes), limit, lane.type == 3))
        elif feature.HasField("stop_sign"):
            sign = feature.stop_sign
            controls.append(TrafficControl("sign", np.array([sign.position.x, sign.position.y]), tuple(sign.lane)))
    targets = tuple(int(item.track_index) for item in message.tracks_to_predict)
    present = int(message.current_time_index)
    # only the state at the present: later ones are the future
    for light in message.dynamic_map_states[present].lane_states if len(message.dynamic_map_states) > present else ():
        shows = SHOWN[light.state] if light.state < len(SHOWN) else "unknown"
        controls.append(TrafficControl(shows, np.array([light.stop_point.x, light.stop_point.y]), (int(light.lane),)))
    notes: tuple[str, ...] = ()
    if not targets:
        targets = tuple(i for i, agent in enumerate(agents) if agent.valid[present])
        notes = ("the record names no tracks_to_predict: every agent valid at the present step is predicted",)
    check_scenario(agents, targets, present, source)
    return Scenario(message.scenario_id or source, agents, tuple(lanes), targets, present, tuple(controls), notes)


def _agent(track: Any) -> Agent:
    states = track.states
    rows = np.array([[s.center_x, s.center_y, s.heading, s.velocity_x, s.velocity_y] for s in states]).reshape(-1, 5)
    valid = np.array([s.valid for s in states], bool) & np.isfinite(rows).all(1)
    size = next((s for s, good in zip(states, valid, strict=True) if good), None)
    kind, box = _KIND.get(track.object_type, "other"), (size.length, size.width) if size else (4.5, 2.0)
    return Agent(int(track.id), kind, float(box[0]), float(box[1]), rows[:, :2], rows[:, 2], rows[:, 3:], valid)
