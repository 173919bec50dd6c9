"""Vehicles that somebody else moves: an agent's command, and a replayed record."""

from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.references import PUBLICATIONS
from idm_env.types import Command, Driver, Motion, Record, Scene


@dataclass(frozen=True)
class Control(Effect):
    """An agent's acceleration in place of the driver's, wherever its command is active.

    Input ``control``: a ``Command(accel, active)``. Power, lag and brakes still act on it. A ``careful`` command counts
    only as far as the driver himself would go: ``min(command, driver)``. One that is ``added`` counts beside him:
    ``command + driver``, so that no command is human driving (Johannink et al. 2019).
    """

    kind = "control"
    sources = (PUBLICATIONS["johannink_2019"],)
    takes = Command
    adds = False
    rank = 35
    careful: bool = False
    added: bool = False

    def limit(self, accel: Tensor, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the command where active."""
        command: Command = scene.input(self.name)
        command_accel = command.accel + accel if self.added else command.accel
        command_accel = torch.minimum(command_accel, accel) if self.careful else command_accel
        return torch.where(command.active, command_accel, accel)


@dataclass(frozen=True)
class Replay(Effect):
    """A recorded vehicle is not accelerated but placed, so nothing drifts, and no gradient flows into it.

    Input ``replay``: a ``Record``, holding the record at the end of the step.
    """

    kind = "replay"
    takes = Record

    def place(self, motion: Motion, scene: Scene, p: P) -> Motion:
        """Return the record where active."""
        record: Record = scene.input(self.name)
        return Motion(
            torch.where(record.active, record.position - scene.position, motion.displacement),
            torch.where(record.active, record.position, motion.position),
            torch.where(record.active, record.speed, motion.speed),
            torch.where(record.active, record.accel, motion.accel),
            motion.present if record.present is None else record.present,
            record.lane,
        )
