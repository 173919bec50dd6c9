"""An open catalogue: effects of one's own entered for this process, and where their classes live."""

import hashlib
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

from idm_env.effects.base import CarFollowing, Effect
from idm_env.jobs import import_file


def same_class(a: type[Effect], b: type[Effect]) -> bool:
    """Tell whether two classes are one, or one that was read twice."""
    return a is b or (a.__qualname__ == b.__qualname__ and _file(a) == _file(b))


def enter(effect: type[Effect], catalogue: dict[str, type[Effect]]) -> type[Effect]:
    """Enter a class among the known ones.

    ValueError for one without a name, with another's, or that cannot be made without arguments.
    """
    if not (isinstance(effect, type) and issubclass(effect, Effect)):
        raise ValueError(f"{effect!r} is no class of effects. Register the class, such as register(MyEffect).")
    if not effect.kind:
        raise ValueError(f'effect {effect.__name__} has no name. Give it one: kind = "my_effect".')
    taken = catalogue.get(effect.kind)
    if taken is not None and not same_class(taken, effect):
        raise ValueError(f"the name '{effect.kind}' of {effect.__name__} is that of {taken.__name__}. Give it another.")
    try:
        effect()
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise ValueError(
            f"effect '{effect.kind}' cannot be made without arguments ({_reason(error)}). Give its fields defaults."
        ) from None
    catalogue[effect.kind] = effect
    return effect


def is_candidate(effect: type[Effect]) -> bool:
    """Tell whether a search can switch an effect on and off: it has a null, and accelerations that it changes."""
    if issubclass(effect, CarFollowing) or effect.hook in ("place", "change"):
        return False
    return any(p.null is not None for p in effect().parameters)


def read(where: str) -> type[Effect]:
    """Return the class at ``my_file.py:MyEffect`` or ``my_package.my_module:MyEffect``.

    The file is run for that, unless this process has imported it. ValueError, in one line, where there is no such
    class, and for whatever the file raises, ``sys.exit()`` included.
    """
    module, effect = member(where, "effect")
    if not (isinstance(effect, type) and issubclass(effect, Effect)):
        mine = {k: v for k, v in vars(module).items() if isinstance(v, type) and v.__module__ == module.__name__}
        able = ", ".join(k for k, v in mine.items() if issubclass(v, Effect)) or "none"
        place, _, name = where.rpartition(":")
        raise ValueError(f"effect {where}: {place} has no class {name} of effects. It has: {able}.")
    return effect


def member(where: str, kind: str) -> tuple[ModuleType, object]:
    """Return the module at ``my_file.py:name`` and its member of that name, None for none.

    The file is run for that, unless this process has imported it. ValueError, in one line, for whatever it raises.
    """
    place, _, name = where.rpartition(":")
    try:
        module = module_at(place) or (_module_of(Path(place)) if place.endswith(".py") else import_module(place))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise ValueError(f"{kind} {where}: {place} cannot be read ({_reason(error)}).") from None
    return module, vars(module).get(name)  # a module's own __getattr__ may import


def module_at(place: str) -> ModuleType | None:
    """Return the module of a place if this process has run it; nothing is run for that."""
    if not place.endswith(".py"):
        return sys.modules.get(place)
    try:
        full = Path(place).resolve()
        if (module := sys.modules.get(_name_of(full))) is not None:
            return module
        for module in list(sys.modules.values()):
            file = getattr(module, "__dict__", {}).get("__file__") or ""
            if file.endswith(full.name) and not module.__name__.startswith(_PREFIX) and Path(file).resolve() == full:
                return module
    except (OSError, ValueError):  # no file, or no name of one
        pass
    return None


def lives(effect: type[Effect]) -> str:
    """Return the place of a class as ``read`` takes it; ValueError for one inside a function."""
    if "<locals>" in effect.__qualname__:
        raise ValueError(f"effect {effect.__name__} lives inside a function. Move it to the top of a file to save it.")
    module = effect.__module__
    if module != "__main__" and not module.startswith(_PREFIX):
        return f"{module}:{effect.__qualname__}"
    return f"{_file(effect)}:{effect.__qualname__}"


_PREFIX = "idm_env_effects_of_"


def _file(effect: type[Effect]) -> str:
    file = getattr(sys.modules.get(effect.__module__), "__file__", None)
    return str(Path(file).resolve()) if file else effect.__module__


def _module_of(path: Path) -> ModuleType:
    """Run a file once per process and text, and return it as a module."""
    full = path.resolve()
    return import_file.run(full, _name_of(full))


def _name_of(path: Path) -> str:
    return _PREFIX + hashlib.sha256(str(path).encode() + path.read_bytes()).hexdigest()[:16]


def _reason(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
