"""The catalogue of effects: a class in one of these files is tested by every law, documented and accepted in YAML.

``ALL`` has all by name, ``CANDIDATES`` are what discovery tries. ``register`` enters effects of one's own.
"""

import sys
from dataclasses import fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

from idm_env.effects.actions import *
from idm_env.effects.adaptation import *
from idm_env.effects.base import CarFollowing, Effect, hint_of
from idm_env.effects.bases import *
from idm_env.effects.free import *
from idm_env.effects.idm import *
from idm_env.effects.lane_changes import *
from idm_env.effects.limits import *
from idm_env.effects.neighbours import *
from idm_env.effects.network_rules import *
from idm_env.effects.noise import *
from idm_env.effects.perception import *
from idm_env.effects.place_speeds import *
from idm_env.effects.registry import enter, is_candidate, lives, module_at, read
from idm_env.effects.road_rules import *
from idm_env.effects.surroundings import *
from idm_env.effects.time_gaps import *
from idm_env.validation import nearest, shown

_FILES = (
    "idm bases limits actions perception neighbours surroundings adaptation time_gaps place_speeds noise free "
    "road_rules network_rules lane_changes"
)
ALL: dict[str, type[Effect]] = {
    effect.kind: effect
    for file in _FILES.split()
    for effect in vars(sys.modules[f"{__name__}.{file}"]).values()
    if isinstance(effect, type) and issubclass(effect, Effect) and effect.__module__ == f"{__name__}.{file}"
    if effect.kind
}
"""Effects by name, in the order of their files."""

CANDIDATES: tuple[str, ...] = tuple(
    name
    for name, effect in ALL.items()
    if is_candidate(effect) and any(effect.wording) and not effect.draws and effect.sought != "never"
)
"""Effects that discovery may add to a model, by name: whatever a report has words for and that is no noise."""


BASES: tuple[str, ...] = tuple(name for name, effect in ALL.items() if issubclass(effect, CarFollowing))
"""Car-following laws, by name: a simulator has exactly one of them."""


PACKAGED = frozenset(ALL)
"""Names of the effects that come with the package."""


def register(effect: type[Effect]) -> type[Effect]:
    """Enter an effect of one's own in the catalogue of this process; returns it, so that it can decorate a class.

    Its name is then known to ``make``, to YAML and to discovery, which tries it like the package's candidates if a
    parameter has a null. ValueError if the name is taken.
    """
    return enter(effect, ALL)


def candidates() -> tuple[str, ...]:
    """Return ``CANDIDATES`` and the names of registered effects that can be absent."""
    return (*CANDIDATES, *(name for name, effect in ALL.items() if name not in PACKAGED and is_candidate(effect)))


def base_named(kind: str) -> CarFollowing:
    """Return the car-following law of this name (or ``my_file.py:MyLaw``), as its defaults make it.

    ValueError, in one line, for what is none.
    """
    law = make(kind) if ":" in kind or kind in ALL else None
    if not isinstance(law, CarFollowing):
        laws = [name for name, effect in ALL.items() if issubclass(effect, CarFollowing)]
        raise ValueError(f"base {shown(kind)} is no car-following law. There are: {', '.join(laws)}.")
    return law


def named(text: str) -> str:
    """Return the name in the catalogue of ``delay``, or of ``my_file.py:MyEffect``, which is registered for that."""
    return register(read(text)).kind if ":" in text else text


def describe(effect: Effect) -> str:
    """Return how a file names an effect's class: its name, or where it lives if the package has never seen it."""
    return effect.kind if effect.kind in PACKAGED else lives(type(effect))


def make(kind: str, **choices: object) -> Effect:
    """Build an effect from its name in ``ALL`` (or ``my_file.py:MyEffect``) and its static choices.

    ValueError names the nearest known one.
    """
    kind = named(kind)
    if kind not in ALL:
        raise ValueError(f"unknown effect {shown(kind)}.{nearest(str(kind), ALL)}")
    cls = ALL[kind]
    hints = get_type_hints(cls) if choices else {}
    choice_types = {field.name: hints[field.name] for field in fields(cls)} if choices else {}
    for choice, value in choices.items():
        if choice not in choice_types:
            raise ValueError(f"effect '{kind}' has no choice {shown(choice)}.{nearest(choice, choice_types)}")
        if not _fits(value, choice_types[choice]):
            hint = hint_of(cls.__dataclass_fields__[choice])
            raise ValueError(f"effect '{kind}': {choice} = {shown(value)} must be of the kind {hint}, and finite.")
    return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in choices.items()})  # type: ignore[arg-type]


def _fits(value: object, hint: Any) -> bool:
    """Tell whether a static choice is of the kind that its effect declares."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is tuple:
        return isinstance(value, (list, tuple)) and all(_fits(x, inner[0]) for x in value)
    if origin is Literal:
        return isinstance(value, str) and value in inner
    if inner:  # this or that
        return any(_fits(value, each) for each in inner)
    if isinstance(value, bool) or hint is bool:
        return isinstance(value, bool) and hint is bool
    if hint is float:
        return isinstance(value, (int, float)) and abs(value) <= sys.float_info.max
    return isinstance(value, hint)


__all__ = ["ALL", "BASES", "CANDIDATES", "DRIFTS", "CarFollowing", "Effect", "base_named", "candidates", "describe"]
__all__ += ["make", "module_at", "named", "register", "unspoken", *(effect.__name__ for effect in ALL.values())]
