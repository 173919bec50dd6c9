"""Recorded leaders for tasks: from trajectory files, or the project's own made-up trace."""

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from idm_env.effects import Control, Effect, Replay
from idm_env.effects.idm import equilibrium_gap
from idm_env.tasks.base import EnvState, Task
from idm_env.tasks.random import Draw
from idm_env.tasks.types import Maybe, Normals
from idm_env.types import Inputs, Params, Record

_TRACE_STREAM, _START_STREAM = 11, 12


class Leaders(NamedTuple):
    """Recorded leaders: ``motion`` (leaders, time, 3) holds position (m), speed (m/s), acceleration (m/s²).

    ``steps`` (leaders,) says how many time steps of each hold; the rest repeats the last one.
    """

    motion: np.ndarray
    steps: np.ndarray


def made_up_leader(dt: float, seconds: float = 600.0) -> Leaders:
    """Return the project's own leader in congested motorway traffic, from a formula and not from any measurement.

    A slow drift around 14 m/s and stop-and-go waves of 40–90 s whose depth swells and fades; speeds are 1–31 m/s and
    accelerations within about ±2 m/s². Ten minutes are enough for thousands of different starts.
    """
    fine = 10
    t = np.arange(int(seconds / dt) * fine + 1) * (dt / fine)
    drift = 14.0 + 3.0 * np.sin(2 * np.pi * t / 310.0 + 0.4) + 2.0 * np.sin(2 * np.pi * t / 173.0 + 2.0)
    swell = 0.55 + 0.45 * np.sin(2 * np.pi * t / 233.0 + 1.1)
    waves = 12.5 * np.sin(2 * np.pi * t / 71.0) + 4.5 * np.sin(2 * np.pi * t / 43.0 + 0.9)
    speed = drift + swell * waves + 0.5 * np.sin(2 * np.pi * t / 11.0)
    # A soft floor keeps the speed positive and the acceleration continuous where a wave stops the traffic.
    speed = np.logaddexp(0.0, 2.0 * speed) / 2.0
    position = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * (dt / fine))))
    motion = np.stack((position, speed, np.gradient(speed, dt / fine)), axis=-1)[::fine]
    return Leaders(motion[None], np.array([len(motion)]))


@lru_cache(maxsize=8)
def recorded_leaders(path: str, dt: float) -> Leaders:
    """Return every leader of a trajectory file that somebody follows, smoothed, on a clock of ``dt``.

    Raises:
        DataError: If the file cannot be used, or its step does not fit ``dt``.
    """
    from idm_env.data import episodes, load

    records = episodes(load(path), smooth=True, dt=dt)
    longest = max(len(e) for e in records)
    motion = np.zeros((len(records), longest, 3))
    for row, episode in zip(motion, records, strict=True):
        lead = episode.leader
        n = len(episode)
        row[:n] = np.stack((lead.position_m - lead.position_m[0], lead.speed_mps, lead.accel_mps2), axis=-1)
        row[n:] = row[n - 1]
    return Leaders(motion, np.array([len(e) for e in records]))


def starts(draw: Draw, steps: Tensor, wanted: int) -> tuple[Tensor, Tensor]:
    """Return a leader and a first step per environment, so that ``wanted`` steps remain where there are so many.

    ``steps`` [leaders] are those of every leader; both results are indices, shape ``(environments,)``. Leaders that
    are long enough are drawn alike; if none is, all are.
    """
    enough = steps > wanted
    choices = torch.nonzero(enough if bool(enough.any()) else steps > 1).squeeze(-1)
    trace = choices[(draw.uniforms(_TRACE_STREAM, 1, torch.float64).squeeze(-1) * len(choices)).long()]
    room = (steps[trace] - wanted).clamp_min(1)
    return trace, (draw.uniforms(_START_STREAM, 1, torch.float64).squeeze(-1) * room).long()


def head(motion: Tensor, active: Tensor) -> Record:
    """Return the replay of vehicle 0 from its motion at the end of the step, shape ``(n, 3)``."""
    position, speed, accel = motion.unsqueeze(-2).unbind(-1)
    return Record(position, speed, accel, active)


def queue(lead_position: Tensor, gaps: Tensor, length: float) -> Tensor:
    """Return positions of a queue behind a leader ``(n, 1)``; ``gaps`` are those of all but the first."""
    behind = lead_position - torch.cumsum(gaps + length, dim=-1)
    return torch.cat((lead_position, behind), dim=-1)


@dataclass(frozen=True, eq=False, kw_only=True)
class BehindHeadTask(Task):
    """A queue on one lane behind a head (vehicle 0) that is where its motion says, whatever is behind it."""

    machinery: ClassVar[tuple[Effect, ...]] = (Control(), Replay())
    first_free: ClassVar[int] = 1

    @abc.abstractmethod
    def _motion(self, episode: Mapping[str, Tensor], step: Tensor, dtype: torch.dtype) -> Tensor:
        """Return position, speed and acceleration of the heads at a step, shape ``(n, 3)``."""

    def _in_equilibrium(self, episode: Mapping[str, Tensor], params: Params) -> EnvState:
        """Return everybody at the speed of the head, and at the gap that keeps it."""
        base, like = self.simulator.base, self.like(params)
        step = torch.full((len(next(iter(episode.values()))),), -self.warmup, device=like.device)
        first = self._motion(episode, step, like.dtype)
        speed = first[:, 1:2].expand(-1, self.vehicles).contiguous()
        gaps = equilibrium_gap(base.driver(dict(params[base.name])), speed).expand_as(speed)[:, 1:]
        positions = queue(first[:, :1], gaps, self.vehicle_length)
        state = self.simulator.state(positions, speed, params, length=self.vehicle_length, step=step)
        return EnvState(state, episode)

    def inputs(self, world: EnvState, command: Maybe, normals: Normals, live: Maybe = None) -> Inputs:
        """Return the inputs of one step, with the head's motion at its end."""
        state = world.state
        first = self.constant("first", lambda: np.arange(self.vehicles) == 0, state.speed.device, torch.bool)
        replay = head(self._motion(world.episode, state.step + 1, state.speed.dtype), first)
        return {**super().inputs(world, command, normals, live), "replay": replay}
