"""Small scenarios in both file formats: a road that forks, agents of all kinds."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from idm_env.data import womd_record

STEPS, PRESENT = 91, 10
TIME = 0.1 * (np.arange(STEPS) - PRESENT)


def straight(
    speed: float, start: tuple[float, float], heading: float = 0.0, accel: float = 0.0
) -> dict[str, np.ndarray]:
    """Position, heading and velocity of an agent that goes straight, with an acceleration from the present on."""
    later = np.maximum(TIME, 0.0)
    speeds = np.maximum(speed + accel * later, 0.0)
    along = np.concatenate([[0.0], np.cumsum(0.05 * (speeds[1:] + speeds[:-1]))])
    along = along - along[PRESENT]
    unit = np.array([np.cos(heading), np.sin(heading)])
    return {
        "position": np.array(start) + along[:, None] * unit,
        "heading": np.full(STEPS, heading),
        "velocity": speeds[:, None] * unit,
    }


def fork() -> list[tuple[int, np.ndarray, tuple[int, ...]]]:
    """Lane 1 along x to the origin; lanes 2 (straight on) and 3 (a left turn of 15 m radius) leave it."""
    angle = np.linspace(0, np.pi / 2, 20)
    bend = np.stack([15 * np.sin(angle), 15 - 15 * np.cos(angle)], axis=1)
    after = np.stack([np.full(40, 15.0), 15.0 + np.linspace(1, 60, 40)], axis=1)
    one = np.stack([np.linspace(-120, 0, 100), np.zeros(100)], axis=1)
    two = np.stack([np.linspace(0, 150, 120), np.zeros(120)], axis=1)
    return [(1, one, (2, 3)), (2, two, ()), (3, np.concatenate([bend, after]), ())]


def agents() -> list[tuple[str, dict[str, np.ndarray]]]:
    """A car before the fork, a pedestrian, a cyclist on the lane far behind, a car off the lanes."""
    return [
        ("vehicle", straight(10.0, (-40.0, 0.3))),
        ("pedestrian", straight(1.3, (5.0, 10.0), np.pi / 2)),
        ("cyclist", straight(4.0, (-100.0, -0.5))),
        ("vehicle", straight(3.0, (60.0, 30.0), 1.0)),
    ]


def as_json(
    wanted: list[int] | None = None, *, lanes: bool = True, invalid: int | None = None, signal: bool = False
) -> dict[str, Any]:
    """The scenario in the layout of Nocturne; without ``wanted`` there is no metadata, as in older files."""
    objects = []
    for number, (kind, motion) in enumerate(agents()):
        valid = np.ones(STEPS, bool)
        if number == invalid:
            valid[: PRESENT + 1] = False
        objects.append(
            {
                "id": number + 100, "type": kind, "length": 4.5, "width": 2.0, "valid": valid.tolist(),
                "position": [{"x": x, "y": y, "z": 0.0} for x, y in motion["position"].tolist()],
                "velocity": [{"x": x, "y": y} for x, y in motion["velocity"].tolist()],
                "heading": motion["heading"].tolist(),
            }
        )  # fmt: skip
    roads: list[dict[str, Any]] = [{"type": "stop_sign", "id": 50, "geometry": [{"x": 0.0, "y": 3.0, "z": 0.0}]}]
    for key, line, _ in fork() if lanes else ():
        roads.append({"type": "lane", "id": key, "geometry": [{"x": x, "y": y, "z": 0.0} for x, y in line.tolist()]})
    scene: dict[str, Any] = {
        "name": "fork.json",
        "scenario_id": "fork",
        "objects": objects,
        "roads": roads,
        # red when the present ends, green afterwards, which nobody may know
        "tl_states": {
            "2": {"state": ["go", "arrow_stop", "go"], "x": [0.0] * 3, "y": [0.0] * 3, "time_index": [0, PRESENT, 50]}
        }
        if signal
        else {},
    }
    if wanted is not None:
        scene["metadata"] = {"sdc_track_index": 0, "tracks_to_predict": [{"track_index": i} for i in wanted]}
    return scene


def as_record(wanted: list[int]) -> bytes:
    """The same scenario as one serialised scenario.proto, with lane connections and a limit of 30 mph."""
    message = womd_record.messages()["Scenario"]()
    message.scenario_id = "fork"
    message.timestamps_seconds.extend((0.1 * np.arange(STEPS)).tolist())
    message.current_time_index = PRESENT
    kinds = {"vehicle": 1, "pedestrian": 2, "cyclist": 3}
    for number, (kind, motion) in enumerate(agents()):
        track = message.tracks.add(id=number + 100, object_type=kinds[kind])
        for k in range(STEPS):
            (x, y), (vx, vy) = motion["position"][k], motion["velocity"][k]
            track.states.add(
                center_x=x, center_y=y, length=4.5, width=2.0, heading=motion["heading"][k], velocity_x=vx,
                velocity_y=vy, valid=True,
            )  # fmt: skip
    for key, line, exits in fork():
        feature = message.map_features.add(id=key)
        feature.lane.speed_limit_mph = 30.0
        feature.lane.exit_lanes.extend(exits)
        for x, y in line.tolist():
            feature.lane.polyline.add(x=x, y=y)
    sign = message.map_features.add(id=50)
    sign.stop_sign.position.x, sign.stop_sign.position.y = 0.0, 3.0
    sign.stop_sign.lane.append(1)
    for k in range(STEPS):
        light = message.dynamic_map_states.add().lane_states.add(lane=2, state=1 if k == PRESENT else 6)
        light.stop_point.x, light.stop_point.y = 0.0, 0.0
    for index in wanted:
        message.tracks_to_predict.add(track_index=index)
    return bytes(message.SerializeToString())


def frame(data: bytes) -> bytes:
    """Return one record of a TFRecord file."""
    head = struct.pack("<Q", len(data))
    return (
        head + struct.pack("<I", womd_record.masked_crc(head)) + data + struct.pack("<I", womd_record.masked_crc(data))
    )
