"""The catalogue of effects. One entry in ``ALL`` makes an effect tested by every law, documented, accepted in YAML
and a candidate in discovery.
"""  # noqa: D205

from __future__ import annotations

from dataclasses import fields

from idm_env.effects.actions import Control, Replay
from idm_env.effects.adaptation import LongMemory, RegimeShift, SpeedDependentGap, SpeedZone
from idm_env.effects.base import CarFollowing, Effect
from idm_env.effects.free import Curve, DriverCurve
from idm_env.effects.idm import IDM
from idm_env.effects.limits import ActionPoint, Asymmetry, Brakes, Lag, PowerLimit
from idm_env.effects.neighbours import BrakeLight, Follower, Lateral, LeaderAcceleration, SecondLeader
from idm_env.effects.noise import Noise
from idm_env.effects.perception import DeadZone, Delay, GapBias, ImaginedLeader
from idm_env.effects.surroundings import Drag, Grade
from idm_env.parameters import nearest

ALL: dict[str, type[Effect]] = {
    effect.kind: effect
    for effect in (
        IDM,
        Brakes,
        Control,
        Replay,
        Delay,
        Lag,
        SecondLeader,
        LeaderAcceleration,
        BrakeLight,
        Asymmetry,
        PowerLimit,
        Drag,
        SpeedDependentGap,
        LongMemory,
        Follower,
        DeadZone,
        ActionPoint,
        Grade,
        SpeedZone,
        RegimeShift,
        Lateral,
        GapBias,
        ImaginedLeader,
        Noise,
        Curve,
        DriverCurve,
    )
}

CANDIDATES: tuple[str, ...] = (
    "delay",
    "lag",
    "second_leader",
    "leader_acceleration",
    "brake_light",
    "asymmetry",
    "power_limit",
    "drag",
    "speed_dependent_gap",
    "memory",
    "follower",
    "dead_zone",
    "action_point",
    "grade",
    "speed_zone",
    "regime_shift",
    "lateral",
    "gap_bias",
)
"""Effects that discovery may add to a model, by name."""


def make(kind: str, **choices: object) -> Effect:
    """Build an effect from its name in ``ALL`` and its static choices; ValueError names the nearest known one."""
    if kind not in ALL:
        raise ValueError(f"unknown effect '{kind}'.{nearest(kind, ALL)}")
    cls = ALL[kind]
    known = [field.name for field in fields(cls)]
    for choice in choices:
        if choice not in known:
            raise ValueError(f"effect '{kind}' has no choice '{choice}'.{nearest(choice, known)}")
    return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in choices.items()})  # type: ignore[arg-type]


__all__ = [
    "ALL",
    "CANDIDATES",
    "IDM",
    "ActionPoint",
    "Asymmetry",
    "BrakeLight",
    "Brakes",
    "CarFollowing",
    "Control",
    "Curve",
    "DeadZone",
    "Delay",
    "Drag",
    "DriverCurve",
    "Effect",
    "Follower",
    "GapBias",
    "Grade",
    "ImaginedLeader",
    "Lag",
    "Lateral",
    "LeaderAcceleration",
    "LongMemory",
    "Noise",
    "PowerLimit",
    "RegimeShift",
    "Replay",
    "SecondLeader",
    "SpeedDependentGap",
    "SpeedZone",
    "make",
]
