"""Values that functions of one's own read beside their arguments, watched: recordings hold them as constants.

Watched by value, at every step: globals, names from other modules, what a closure holds, defaults, attributes of
``self`` and of classes, through functions that they call and through lists, dicts, objects, torch's modules, tensors
and arrays. Not seen: what is computed within other libraries (the standard one, too: files, clocks, the environment's
variables) and changes later; properties of other libraries' objects; names put together at run time
(``getattr(x, "ga" + "in")``); writes through ``.data`` or ``numpy()`` into tensors of more than 16 384 numbers.
"""

from __future__ import annotations

import contextlib
import dis
import functools
import operator
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from idm_env.compiled.scalar.record import Untraceable

_LIBRARIES = sys.stdlib_module_names | {"idm_env", "torch", "numpy", "numba"}
_PLAIN = (int, float, complex, str, bytes, np.generic, type(None), CodeType, BuiltinFunctionType)
_MOST = 1 << 14
"""Most values to watch, and most numbers of a tensor that are compared one by one."""
_PARTS: dict[Any, Sequence[str]] = {FunctionType: ("__code__", "__defaults__", "__kwdefaults__", "__closure__")}
_PARTS |= {CellType: ("cell_contents",), MethodType: ("__func__", "__self__"), partial: ("func", "args", "keywords")}
_PARTS |= {staticmethod: ("__func__",), classmethod: ("__func__",), property: ("fget",)}
_PARTS |= {functools.cached_property: ("func",)}
"""What is read of objects of Python's own types."""
_FIXED = {tuple, frozenset, partial, MethodType}
"""Types of which nobody can change what they hold."""

Look = Callable[[], Sequence[Any]]
"""Returns some values as they are now."""


class Reads:
    """The values that ``functions``, and the methods of objects of one's own (``owners``), read now.

    Raises:
        Untraceable: For more values than can be compared at every step.
    """

    def __init__(self, functions: Sequence[Any], owners: Sequence[Any]) -> None:
        own, names, count = [x for x in owners if not _foreign(type(x))], {"__call__", "__wrapped__"}, 0
        names.update(n for x in own for each in type(x).__mro__ if not _foreign(each) for n in vars(each))
        while count < len(names):  # code that is found later names attributes of what was found before
            count, self.watches = len(names), _watches([*functions, *own], names)

    def changed(self) -> bool:
        """Return whether anything is another one now."""
        # A loop: a generator would cost as much again.
        for look, then in self.watches:  # noqa: SIM110
            if not _same(look(), then):
                return True
        return False


def _same(now: Sequence[Any], then: Sequence[Any]) -> bool:
    return len(now) == len(then) and (
        all(map(operator.is_, now, then))
        or all(a is b or (type(a) is type(b) and isinstance(a, _PLAIN) and a == b) for a, b in zip(now, then))  # noqa: B905
    )


def _watches(roots: list[Any], names: set[str]) -> list[tuple[Look, Sequence[Any]]]:
    """Return the ways to look at everything in reach of some objects, with its values; add to ``names``."""
    seen, watches, count = dict[int, Any](), list[tuple[Look, Sequence[Any]]](), 0
    while roots:
        x = roots.pop()
        if id(x) in seen or isinstance(x, _PLAIN):
            continue
        seen[id(x)] = x
        for look in _looks(x, names):
            then = look()
            watches += [] if type(x) in _FIXED else [(look, then)]
            count += len(then)
            roots += then
        if count > _MOST:
            raise Untraceable(f"a function of one's own reads more than {_MOST} values")
    return watches


def _foreign(x: Any) -> bool:
    """Return whether a module, class or function is a library's."""
    name = x.__name__ if isinstance(x, ModuleType) else x.__module__
    return str(name).partition(".")[0] in _LIBRARIES


def _looks(x: Any, names: set[str]) -> Iterator[Look]:
    """Give the ways to look into an object, at attributes of these names; add those that a function names."""
    if isinstance(x, Tensor):
        yield partial(_content, x)
    elif isinstance(x, Mapping):
        yield lambda: [*x, *x.values()]
    elif isinstance(x, (list, tuple, set, frozenset, deque)):
        yield lambda: [*x]
    elif isinstance(x, (type, ModuleType)):
        yield from (partial(_own, each, names) for each in getattr(x, "__mro__", (x,)) if not _foreign(each))
    elif type(x) is FunctionType and _foreign(x):
        return
    elif type(x) in _PARTS:
        yield partial(_attributes, x, _PARTS[type(x)])
        yield from _read_by(x, names) if type(x) is FunctionType else ()
    else:  # torch's modules are read by torch's code, which names what it likes
        yield partial(_own, x, x.__dict__ if isinstance(x, nn.Module) else names)
        slots = {n for each in type(x).__mro__ for n in getattr(each, "__slots__", ())} & names
        yield partial(_attributes, x, ["__class__", *slots])
        with contextlib.suppress(TypeError, ValueError):  # an array, a number of ctypes
            if (view := memoryview(x)).nbytes <= 8 * _MOST:
                yield lambda: [view.tobytes()]


def _read_by(function: FunctionType, names: set[str]) -> Iterator[Look]:
    """Give the ways to look at what a function's code names; add the names."""
    codes, read = [function.__code__], set[str]()
    while codes:
        code = codes.pop()
        codes += [c for c in code.co_consts if isinstance(c, CodeType)]
        names.update(code.co_names, (c for c in code.co_consts if isinstance(c, str)))
        for each in dis.get_instructions(code):
            if each.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
                read.add(each.argval)
            elif each.opname == "IMPORT_NAME":
                yield partial(_named, sys.modules, {each.argval})
    yield partial(_named, function.__globals__, read)
    yield partial(_own, function, names)


def _named(held: Mapping[str, Any], names: set[str]) -> list[Any]:
    return [held.get(n) for n in names]


def _own(x: Any, names: Any) -> list[Any]:
    return [part for n, value in getattr(x, "__dict__", {}).items() if n in names for part in (n, value)]


def _attributes(x: Any, names: Sequence[str]) -> list[Any]:
    with contextlib.suppress(ValueError):  # a cell of a closure may be empty
        return [getattr(x, n, None) for n in names]
    return []


def _content(x: Tensor) -> list[Any]:
    own: list[Any] = [x.requires_grad, None if x.is_inference() else x._version, x.data_ptr()]
    if x.device.type == "cpu" and x.layout is torch.strided and x.numel() <= _MOST:
        own.append(x.detach().reshape(-1).view(torch.uint8).numpy().tobytes())
    return own
