"""Hooks of effects of one's own, watched: the results' kinds and shapes, and that inputs stay unchanged.

The package's effects are not watched: the laws of ``tests/laws`` hold them to the same.
"""

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from idm_env import compat
from idm_env.types import Driver, Motion, Scene, Wish, is_recording

RETURNS: dict[str, type] = {"perceive": Scene, "adapt": Driver, "driver": Driver, "place": Motion, "change": Wish}
RETURNS |= dict.fromkeys(("accelerate", "limit", "remember", "initial_memory", "room"), Tensor)
"""What the methods of an effect return that a step calls; a plain number stands for a tensor, too."""
MAY_BE_NONE = ("initial_memory", "room")


def watched(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
    """Return the method ``name`` of an effect, watched.

    It raises ValueError, in one line, for a result of the wrong kind or shape, for NaN made of numbers (but behind
    whoever is touched already), for a change of what is given in place, and for a look further back than ``looks_back``
    says. While a step is recorded, results are marked instead (``suspected``): a compiled step passes their NaN on.
    """

    @functools.wraps(method)
    def call(self: Any, *args: Any, **named: Any) -> Any:
        if named or torch.compiler.is_compiling() or compat.transforming():
            return method(self, *args, **named)
        who = f"effect '{self.name}': {type(self).__name__}.{name}"
        seen = [_Limited.of(x, self.looks_back, who) if isinstance(x, Scene) else x for x in args]
        leaves = dict(leaf for x in args for leaf in _leaves(x))
        recorded = is_recording() or any(hasattr(x, "suspected") for x in leaves.values())
        before = {k: x._version for k, x in leaves.items() if not recorded and not x.is_inference()}
        try:
            result = method(self, *seen)
        except (RuntimeError, TypeError, AttributeError, IndexError) as error:
            if recorded:
                raise
            raise ValueError(f"{who} fails: {' '.join(str(error).split())} ({type(error).__name__}).") from error
        if isinstance(result, Scene) and isinstance(result.history, _Limited):
            result = result._replace(history=result.history.past)
        results = {k: x for k, x in _leaves(result) if not any(x is other for other in leaves.values())}
        if recorded:
            for x in results.values():
                if hasattr(x, "suspected"):
                    x.suspected()
            return result
        changed = next((k for k, version in before.items() if leaves[k]._version != version), None)
        if changed is not None:
            raise ValueError(f"{who} changes {changed} in place, which others read, too. Return a new tensor.")
        if result is not None or name not in MAY_BE_NONE:
            _check(who, RETURNS[name], result, results, leaves)
        return result

    return call


def _leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every tensor, or its stand-in, with its name: ``leader.gap`` of a scene, a parameter's name."""
    if isinstance(tree, Tensor) or hasattr(tree, "suspected"):
        yield path or type(tree).__name__, tree
    elif isinstance(tree, Mapping):
        for key, x in tree.items():
            yield from _leaves(x, f"{path}.{key}" if path else str(key))
    elif isinstance(tree, tuple) and hasattr(tree, "_fields"):
        inner = path or type(tree).__name__.lower()
        for key, x in zip(tree._fields, tree, strict=True):
            if key != "history":
                yield from _leaves(x, f"{inner}.{key}")


def _check(who: str, kind: type, result: Any, results: Mapping[str, Any], leaves: Mapping[str, Tensor]) -> None:
    plain = isinstance(result, (int, float))
    if not isinstance(result, kind) and not (kind is Tensor and plain):
        raise ValueError(f"{who} returned {type(result).__name__}, and it must return {kind.__name__}.")
    others = ("scene.inputs", "scene.memory")
    room = torch.broadcast_shapes(*(x.shape for k, x in leaves.items() if not k.startswith(others)))
    for key, x in {"": torch.tensor(float(result))}.items() if plain else results.items():
        part = key.partition(".")[2]
        if not _fits(x.shape, room):
            raise ValueError(
                f"{who} returned {part or 'a tensor'} of shape {tuple(x.shape)} for vehicles of shape {tuple(room)}. "
                "Return one number for each vehicle."
            )
        if not x.is_floating_point() or not bool(x.isnan().any()):
            continue
        bad = x.isnan() & _judged(part.partition("_")[0], leaves)
        if not bool(bad.any()) or any(g.is_floating_point() and bool(g.isnan().any()) for g in leaves.values()):
            continue
        index = bad.expand(torch.broadcast_shapes(bad.shape, room)).nonzero()[0]
        vehicle, time = (f" for vehicle {int(index[-1])}" if len(index) else ""), leaves.get("scene.time")
        when = "" if time is None else f" at {float(time.reshape(-1)[0]):.4g} s"
        raise ValueError(
            f"{who} returned {part + ' ' if part else ''}nan{vehicle}{when}. Keep what it divides by, and takes roots "
            "or logarithms of, above 0."
        )


def _judged(side: str, leaves: Mapping[str, Tensor]) -> Tensor:
    """Return a mask of results that must be numbers: not where a gap is 0, of which many an equation has a root.

    Overlaps are told as crashes. Of a lane beside (``side``) only what exists counts.
    """
    counts = torch.ones((), dtype=torch.bool)
    for key, x in leaves.items():
        place = key.split(".")[1] if key.startswith(("scene.left.", "scene.right.")) else side
        if place == side and key.endswith((".gap", ".exists")):
            counts = counts & (x > 0)
    return counts


def _fits(shape: torch.Size, room: torch.Size) -> bool:
    try:
        return torch.broadcast_shapes(shape, room) == room
    except RuntimeError:
        return False


class _Limited:
    """A past into which one may look as far as ``looks_back`` says."""

    def __init__(self, past: Any, most: float, who: str) -> None:
        self.past, self._most, self._who = past, most, who

    @classmethod
    def of(cls, scene: Scene, most: float, who: str) -> Scene:
        """Return the scene with a past that is limited, if it has one."""
        return scene if scene.history is None else scene._replace(history=cls(scene.history, most, who))

    def at(self, scene: Scene, seconds: Any) -> Scene:
        """Return the scene of some seconds ago; ValueError for more than the effect's ``looks_back``."""
        allowed = self._most * (1.0 + 1e-6)
        if hasattr(seconds, "suspected"):
            torch.where(seconds > allowed, torch.nan, 0.0).suspected()  # type: ignore[attr-defined]
        elif (most := float(torch.as_tensor(seconds).detach().max())) > allowed:
            raise ValueError(
                f"{self._who} looks {most:g} s back, and its looks_back is "
                f"{self._most:g} s. Let looks_back return the most that it needs."
            )
        past: Scene = self.past.at(scene._replace(history=self.past), seconds)
        return past._replace(history=scene.history)

    def pushed(self, scene: Scene) -> Any:
        """Return the buffer after this step."""
        return self.past.pushed(scene)
