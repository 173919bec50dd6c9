"""Functions that run in place of a simulator's repeated step: entered by name, looked up when a rollout begins.

A simulator is built below the compiled loops and does not know them. ``idm_env`` enters those that it has, as it
registers its environments: by text, so that nothing heavy is imported before it is used.
"""

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any

_entered: list[str] = []
_off: ContextVar[str | None] = ContextVar("idm_env_kernels_off", default=None)


def enter(place: str) -> None:
    """Enter a function by its place, ``package.module:function``; ``rollout`` has its arguments."""
    if place not in _entered:
        _entered.append(place)


@contextmanager
def off(reason: str = "switched off by kernels.off()") -> Iterator[None]:
    """Repeat the step itself in everything inside."""
    token = _off.set(reason)
    try:
        yield
    finally:
        _off.reset(token)


def switched_off() -> str | None:
    """Return why the step itself is repeated here, or None."""
    return _off.get()


def rollout(*call: Any) -> Any:
    """Return the result of the first function that takes this call; None where the step itself is to be repeated.

    The call is ``(simulator, state, inputs, params, steps, checkpoint_every, keep)``, as in ``Simulator.rollout``, and
    the result the last state with what is kept of all, or None.
    """
    if _off.get() is not None:
        return None
    for place in _entered:
        if (result := function(place)(*call)) is not None:
            return result
    return None


@cache
def function(place: str) -> Callable[..., Any]:
    """Return the function at a place."""
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)
