"""Official TFRecord files of scenarios, without TensorFlow: record framing, checksums, and a minimal message schema.

Only the fields that prediction needs are declared (``scenario.json``); protobuf skips all others. Field numbers are
those of the published ``scenario.proto`` and ``map.proto`` of the Waymo Open Dataset.
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

SCHEMA = Path(__file__).with_name("scenario.json")
"""The fields that are read, as a file descriptor in protobuf's JSON."""


@lru_cache(maxsize=1)
def messages() -> dict[str, Any]:
    """Return the message classes by name. ImportError where protobuf is not installed."""
    from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory

    file = json_format.Parse(SCHEMA.read_text(encoding="utf-8"), descriptor_pb2.FileDescriptorProto())
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kinds = pool.FindFileByName(file.name).message_types_by_name
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
