"""How loops and printed phases are compiled, all of them, and under which name their machine code is kept."""

from __future__ import annotations

import hashlib
import inspect
import platform
import re
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from idm_env import compat
from idm_env.compiled.kernels import SWITCHED_OFF
from idm_env.compiled.scalar.library import MachineCode
from idm_env.extras import needed

with needed("a compiled loop"):
    import llvmlite
    import numba
    from llvmlite import binding, ir
    from numba import types
    from numba.core import cgutils
    from numba.extending import intrinsic
if SWITCHED_OFF:
    raise ImportError("loops cannot be compiled while NUMBA_DISABLE_JIT is set. Unset it.")

Place = tuple[str, str]
STORE = MachineCode()
"""Where machine code is kept."""


@lru_cache(maxsize=1)
def _sources() -> str:
    """Return the digest of all files here, and of the compiler: numba inlines what a function calls into its code."""
    files = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    compiler = f"{numba.__version__} {llvmlite.__version__} {platform.python_version()}"
    return hashlib.sha256(files).hexdigest() + compiler


@lru_cache(maxsize=512)
def module_text(module: str) -> str:
    """Return the text of a module, printed or in a file."""
    return inspect.getsource(sys.modules[module])


def name_of(function: Callable[..., Any], options: dict[str, Any]) -> Callable[[str], str]:
    """Return what names a version of a function: by its own file, all files here, and options, by content."""
    code = function.__code__
    own = sorted((n, sorted(x) if isinstance(x, set) else x) for n, x in options.items())
    identity = f"{function.__module__} {function.__qualname__} {code.co_firstlineno} {own}"
    word = re.sub(r"\W", "_", function.__qualname__)[-60:]

    def name(version: str) -> str:
        parts = "\0".join((identity, module_text(function.__module__), _sources(), version))
        return f"{word}-{hashlib.sha256(parts.encode()).hexdigest()[:32]}"

    return name


def compiler(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a loop with these options of numba; its machine code is kept."""
    # Without its own word numba takes over the arithmetic of whoever happens to call a loop first.
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "fastmath": False} | options
    return lambda function: compat.compiled_loop(function, options, name_of(function, options), STORE, LINKS)


class _Symbols:
    """Loops that others call where they are: ``known`` are their places and the types of their arguments, by symbol."""

    def __init__(self) -> None:
        self.loops: dict[Place, Any] = {}
        self.known: dict[str, tuple[Place, tuple[Any, ...]]] = {}

    def enter(self, place: Place, kinds: tuple[Any, ...]) -> tuple[str, Any]:
        """Compile a loop for arguments of these types; return its symbol, and the type that it returns."""
        loop = self.loops[place]
        symbol = name_of(loop.py_func, loop.targetoptions)(str(kinds))
        address, returned = compat.address_of(loop, kinds)
        if symbol not in self.known:
            binding.add_symbol(symbol, address)
            self.known[symbol] = place, kinds
        return symbol, returned


LINKS = _Symbols()


def apart(function: Callable[..., Any]) -> Any:
    """Return a loop for others to call where it is, not as a part of them: so it is compiled once.

    numba puts whatever a function calls into its code, with all that this calls, and optimises all of it again.
    Python cannot call it.
    """
    place = function.__module__, function.__qualname__
    LINKS.loops[place] = compiler(no_cpython_wrapper=True, no_cfunc_wrapper=False)(function)

    def typed(*kinds: Any) -> Any:
        symbol, returned = LINKS.enter(place, kinds)

        def generate(context: Any, builder: Any, made: Any, arguments: Any) -> Any:
            kind = ir.FunctionType(context.get_value_type(returned), [context.get_value_type(x) for x in kinds])
            result = builder.call(cgutils.get_or_insert_function(builder.module, kind, symbol), arguments)
            return context.get_dummy_value() if returned == types.none else result

        return returned(*kinds), generate

    names = ", ".join(function.__code__.co_varnames[: function.__code__.co_argcount])
    return counted(function.__name__, names, typed)


def counted(name: str, names: str, typed: Callable[..., Any]) -> Any:
    """Return an intrinsic of that name whose arguments are ``names``: numba counts those of what it is given.

    ``typed`` gets their types, and returns a signature and who generates code.
    """
    room: dict[str, Any] = {"typed": typed}
    exec(f"def {name}(typing_context, {names}):\n    return typed({names})", room)
    return intrinsic(room[name])


def phase(signature: Any, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function to be called by its ``address``; its machine code is kept."""
    options = {"error_model": "numpy"} | options
    return lambda function: compat.compiled_callback(function, signature, options, name_of(function, options), STORE)
