"""Options of ``fit`` and ``simulate``: how a file is read, and how a model is fitted."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from idm_env.data import LEADER_LOST_GAP_M, Episodes, Trajectories, episodes, load
from idm_env.data.episode import windows
from idm_env.data.folder import FolderSlice
from idm_env.data.names import Columns
from idm_env.data.recorders import on_one_clock
from idm_env.effects import Effect, Replay, base_named
from idm_env.fitting.fit import Method, base_simulator
from idm_env.fitting.problem import Loss, Objective
from idm_env.model_file import Model, load_model
from idm_env.roads import Lane
from idm_env.simulator import Integration, Simulator
from idm_env.types import Command, Record


@dataclass(frozen=True)
class Source:
    """How a file is read: see ``idm_env.data.load`` and ``episodes``.

    ``where`` (``column=value``, or several that must all hold) selects runs or drivers; ``window`` (s) cuts long
    episodes.
    """

    path: Path
    ring_length: float | None = None
    place: str | None = None
    layout: str = "auto"
    max_gap: float | None = LEADER_LOST_GAP_M
    min_seconds: float = 5.0
    dt: float | None = None
    smooth: bool = False
    window: float | None = None
    where: str | Sequence[str] | None = None
    columns: Columns = None

    def trajectories(self, share: FolderSlice | None = None) -> Trajectories:
        """Read and check the file, or a ``share`` of the folder; recorders whose clocks are apart are put on one."""
        if share is not None:
            read = share.trajectories(ring_length=self.ring_length, place=self.place)
        else:
            read = load(
                self.path, ring_length=self.ring_length, place=self.place, layout=self.layout, columns=self.columns
            )
        return on_one_clock(read if self.where is None else read.where(self.where))

    def episodes(self, trajectories: Trajectories) -> Episodes:
        """Return the drivers behind leaders, cut to windows where asked."""
        items = episodes(
            trajectories, min_seconds=self.min_seconds, max_gap=self.max_gap, smooth=self.smooth, dt=self.dt
        )
        if self.window is None:
            return items
        return Episodes(tuple(windows(items, self.window)), items.left_out)


@dataclass(frozen=True)
class Options:
    """How a model is fitted, as in ``idm_env.fitting.fit.fit``; ``held_out``: ``column=value`` or a share of runs."""

    by: str = "driver"
    held_out: str | float | None = None
    objective: Objective = "spacing"
    relative: bool = False
    loss: Loss = "rmse"
    method: Method = "lm"
    integration: Integration = "ballistic"
    starts: int = 4
    seed: int = 0
    substeps: int | None = None
    model: str | None = None
    base: str | None = None

    def simulator(self) -> tuple[Simulator, dict[str, float]]:
        """Return the simulator to calibrate and the parameters that stay.

        That is the car-following law ``base`` (None: IDM), or a saved model, whose effects are kept.
        ValueError for a law beside a model that has one.
        """
        saved = saved_model(self.model, self.base)
        if saved is None:
            return base_simulator(base=base_named(self.base or "idm"), integration=self.integration), {}
        simulator = Simulator(Lane(), behind_records(saved), dt=saved.dt, integration=saved.integration)
        others = {effect: own for effect, own in saved.parameters.items() if effect != simulator.base.name}
        return simulator, {f"{effect}.{name}": float(x) for effect, own in others.items() for name, x in own.items()}


def saved_model(model: str | None, base: str | None) -> Model | None:
    """Return the model of a file, None where none is named. ValueError where a law is named beside it."""
    if model is not None and base is not None:
        raise ValueError(f"base = '{base}', and the model {model} has one. Leave one of them out.")
    return None if model is None else load_model(Path(model))


def behind_records(model: Model) -> tuple[Effect, ...]:
    """Return a model's effects with replayed leaders, without an agent's control."""
    effects = tuple(e for e in model.effects if e.takes is not Command)
    return effects if any(e.takes is Record for e in effects) else (*effects, Replay())
