"""Private ground of libraries: what no public interface offers, in one file, with the reason and the versions tried.

A new version of a library that breaks something here breaks it in this file only. ``tests/test_structure.py`` holds
that no other file touches it.
"""

from __future__ import annotations

import inspect
import os
import pickle
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from types import CodeType
from typing import TYPE_CHECKING, Any, Protocol, TypeVar
from unittest.mock import patch

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing.process import BaseProcess

Function = Callable[..., Any]
Loaded = TypeVar("Loaded")


class CodeStore(Protocol):
    """Bytes by name: ``load`` reads what was saved, or returns None."""

    def load(self, name: str, reader: Callable[[bytes], Loaded]) -> Loaded | None: ...  # noqa: D102
    def save(self, name: str, content: bytes) -> None: ...  # noqa: D102


class SymbolTable(Protocol):
    """Compiled functions that others call by a symbol: ``known`` are what ``enter`` takes to enter each of them."""

    known: dict[str, tuple[Any, ...]]

    def enter(self, *symbol: Any) -> Any: ...  # noqa: D102


class _KeptCode:
    """Machine code of one function in a ``CodeStore``, in place of numba's own cache of it.

    Why: numba reads its index and data files whoever wrote them, fails for ever where one is damaged, gives two
    processes that save at once the code of each other's signatures, notices no change in a file whose functions are
    called, and reads its folder from a global setting. It offers no interface for another cache: this stands where
    ``numba.core.caching.FunctionCache`` would, and keeps what that keeps. Tried: numba 0.60.0 and 0.68.1.
    """

    cache_path = ""

    def __init__(self, name: Callable[[str], str], store: CodeStore, links: SymbolTable | None) -> None:
        self._name, self._store, self._links = name, store, links

    def load_overload(self, signature: Any, context: Any) -> Any:
        from numba.core.compiler import CompileResult

        context.refresh()
        name = self._name(f"{signature} {context.codegen().magic_tuple()}{_effort()}")

        def rebuilt(content: bytes) -> Any:
            calls, parts = pickle.loads(content)
            for call in calls:
                self._links.enter(*call)  # type: ignore[union-attr]
            return CompileResult._rebuild(context, *parts)

        return self._store.load(name, rebuilt)

    def save_overload(self, signature: Any, compiled: Any) -> None:
        from numba.core.serialize import dumps

        if compiled.library.has_dynamic_globals or not all(loop.can_cache for loop in compiled.lifted):
            return
        name = self._name(f"{signature} {compiled.codegen.magic_tuple()}{_effort()}")
        links = {} if self._links is None else self._links.known
        symbols = [f.name for f in compiled.library._final_module.functions if f.is_declaration] if links else []
        self._store.save(name, dumps(([links[s] for s in symbols if s in links], compiled._reduce())))

    def flush(self) -> None:
        """Nothing: what is stale has another name."""


def _effort() -> str:
    """Return what names code that is optimised less or more than usual (``NUMBA_OPT``): it is no other's."""
    from numba.core import config

    return "" if repr(level := vars(config)["OPT"]) == "_OptLevel(3)" else f" {level!r}"


def compiled_loop(
    function: Function, options: dict[str, Any], name: Callable[[str], str], store: CodeStore, links: SymbolTable
) -> Any:
    """Return a function compiled by ``numba.njit``, whose machine code is kept in a store.

    ``name`` makes a name of what tells one compiled version of the function from the others (types, machine). What it
    calls by a symbol of ``links`` is entered before its code is loaded.
    """
    import numba

    loop: Any = numba.njit(**options)(function)
    loop._cache = _KeptCode(name, store, links)
    return loop


def address_of(loop: Any, kinds: tuple[Any, ...]) -> tuple[int, Any]:
    """Return where a compiled loop begins for arguments of these types, as C calls it, and the type that it returns.

    Why: numba gives addresses of callbacks only, whose types stand in the text. Tried: numba 0.60.0 and 0.68.1.
    """
    loop.compile(kinds)
    code = loop.overloads[kinds]
    return code.library.get_pointer_to_function(code.fndesc.llvm_cfunc_wrapper_name), code.signature.return_type


def compiled_callback(
    function: Function, signature: Any, options: dict[str, Any], name: Callable[[str], str], store: CodeStore
) -> Any:
    """Return a function compiled as ``numba.cfunc`` does, with an ``address``; see ``compiled_loop``."""
    from numba.core import ccallback, sigutils

    callback: Any = ccallback.CFunc(function, sigutils.normalize_signature(signature), locals={}, options=options)
    callback._cache = _KeptCode(name, store, None)
    callback.compile()
    return callback


class Uncompiled:
    """Mixed into a ``TorchDispatchMode``: what it sees is not compiled, and nothing is imported to say so.

    Why: torch wraps such a mode so that its compiler leaves it alone, and imports the compiler for it, 2 CPU s, at the
    first operation. Tried: torch 2.13.0; older versions do not ask.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False


@contextmanager
def ray_at_home() -> Iterator[None]:
    """Let Ray, begun inside, listen on 127.0.0.1 only and ask everybody for its token.

    Why: Ray binds to all interfaces unless a node's address is 127.0.0.1, and turns that address, where it is asked for
    one, into that of the network. Only its switch for systems without clusters keeps it, which is read when ray is
    imported. Tried: Ray 2.60.0.
    """
    variables = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
    if "ray" not in sys.modules:  # later only those processes would hear of it that are begun now
        variables["RAY_AUTH_MODE"] = os.environ.get("RAY_AUTH_MODE", "token")
    with ExitStack() as stack:
        stack.enter_context(patch.dict(os.environ, variables))
        if (constants := sys.modules.get("ray._private.ray_constants")) is not None:
            stack.enter_context(patch.object(constants, "ENABLE_RAY_CLUSTER", False))
        yield


@contextmanager
def ray_elsewhere(attempts: int) -> Iterator[None]:
    """Let Ray, imported inside, ask a cluster a few times, a second apart. Why: else 20 times. Tried: Ray 2.60.0."""
    name = "RAY_NUM_REDIS_GET_RETRIES"
    with patch.dict(os.environ, {name: os.environ.get(name, str(attempts))}):
        yield


def references(thing: Any) -> int:
    """Return how many references to a thing there are, those of the question included.

    Why: memory that nobody holds is used again, and numpy does not say whether an array or a view of it is held. What
    the question adds differs between interpreters, so callers calibrate it. Tried: CPython 3.11.
    """
    return sys.getrefcount(thing)


def locals_of(code: CodeType) -> Mapping[str, Any] | None:
    """Return the local names of the nearest caller that runs a code, or None if there is none.

    Why: ``gymnasium.make`` keeps ``max_episode_steps`` for its own TimeLimit and tells the environment nothing.
    Tried: Gymnasium 1.2.2 and 1.4.0.
    """
    frame = inspect.currentframe()
    while frame is not None and frame.f_code is not code:
        frame = frame.f_back
    return None if frame is None else frame.f_locals


def processes_of(pool: ProcessPoolExecutor) -> list[BaseProcess]:
    """Return the processes of a pool, to end them.

    Why: before Python 3.14 (``terminate_workers``) a pool waits for the work that its processes have begun. Tried:
    CPython 3.11.
    """
    return list((pool._processes or {}).values())


def compile_error() -> tuple[type[Exception], ...]:
    """Return what ``torch.compile`` raises where it fails: without a C++ compiler, or at its eighth recompilation.

    Why: torch has no public names for them. Tried: torch 2.11.0 and 2.13.0.
    """
    from torch._dynamo import exc

    return exc.TorchDynamoException, getattr(exc, "FailOnRecompileLimitHit", exc.TorchDynamoException)


def transforming() -> bool:
    """Return whether ``torch.func`` (vmap, grad, jvp) is at work, whose tensors hold no numbers.

    Why: torch has no public name for it. Tried: torch 2.13.0.
    """
    import torch

    return bool(torch._C._are_functorch_transforms_active())


def tree_flatten(tree: Any) -> tuple[list[Any], Any]:
    """Return the leaves of nested tuples and mappings, and their form: a key, which can ``unflatten`` other leaves.

    Why: torch's trees, which it uses in ``torch.func`` and ``torch.cuda``, have no public name. Tried: torch 2.13.0.
    """
    from torch.utils import _pytree

    return _pytree.tree_flatten(tree)


def forward_mode() -> bool:
    """Return whether within ``torch.autograd.forward_ad.dual_level``.

    Why: torch has no public name for it. Tried: torch 2.13.0.
    """
    import torch

    return torch.autograd.forward_ad._current_level >= 0
