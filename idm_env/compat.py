"""Private ground of libraries: what no public interface offers, in one file, with the reason and the versions tried.

A new version of a library that breaks something here breaks it in this file only. ``tests/test_structure.py`` holds
that no other file touches it.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

Function = Callable[..., Any]
Loaded = TypeVar("Loaded")


class Store(Protocol):
    """Bytes by name: ``load`` reads what was saved, or returns None."""

    def load(self, name: str, reader: Callable[[bytes], Loaded]) -> Loaded | None: ...  # noqa: D102
    def save(self, name: str, content: bytes) -> None: ...  # noqa: D102


class _KeptCode:
    """Machine code of one function in a ``Store``, in place of numba's own cache of it.

    Why: numba reads its index and data files whoever wrote them, fails for ever where one is damaged, gives two
    processes that save at once the code of each other's signatures, notices no change in a file whose functions are
    called, and reads its folder from a global setting. It offers no interface for another cache: this stands where
    ``numba.core.caching.FunctionCache`` would, and keeps what that keeps. Tried: numba 0.60.0 and 0.68.1.
    """

    cache_path = ""

    def __init__(self, name: Callable[[str], str], store: Store) -> None:
        self._name, self._store = name, store

    def load_overload(self, signature: Any, context: Any) -> Any:
        from numba.core.compiler import CompileResult

        context.refresh()
        name = self._name(f"{signature} {context.codegen().magic_tuple()}")
        return self._store.load(name, lambda kept: CompileResult._rebuild(context, *pickle.loads(kept)))

    def save_overload(self, signature: Any, compiled: Any) -> None:
        from numba.core.serialize import dumps

        if compiled.library.has_dynamic_globals or not all(loop.can_cache for loop in compiled.lifted):
            return
        name = self._name(f"{signature} {compiled.codegen.magic_tuple()}")
        self._store.save(name, dumps(compiled._reduce()))

    def flush(self) -> None:
        """Nothing: what is stale has another name."""


def compiled_loop(function: Function, options: dict[str, Any], name: Callable[[str], str], store: Store) -> Any:
    """Return a function compiled by ``numba.njit``, whose machine code is kept in a store.

    ``name`` makes a name of what tells one compiled version of the function from the others (types, machine).
    """
    import numba

    made: Any = numba.njit(**options)(function)
    made._cache = _KeptCode(name, store)
    return made


def compiled_callback(
    function: Function, signature: Any, options: dict[str, Any], name: Callable[[str], str], store: Store
) -> Any:
    """Return a function compiled as ``numba.cfunc`` does, with an ``address``; see ``compiled_loop``."""
    from numba.core import ccallback, sigutils

    made: Any = ccallback.CFunc(function, sigutils.normalize_signature(signature), locals={}, options=options)
    made._cache = _KeptCode(name, store)
    made.compile()
    return made
