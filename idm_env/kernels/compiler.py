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
from idm_env.extras import needed
from idm_env.scalar.library import MachineCode

with needed("a compiled loop"):
    import llvmlite
    import numba

_STORE = MachineCode()


@lru_cache(maxsize=1)
def _sources() -> str:
    """Return the digest of all files here, and of the compiler: numba inlines what a function calls into its code."""
    files = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    compiler = f"{numba.__version__} {llvmlite.__version__} {platform.python_version()}"
    return hashlib.sha256(files).hexdigest() + compiler


@lru_cache(maxsize=512)
def _text(module: str) -> str:
    return inspect.getsource(sys.modules[module])


def _name(function: Callable[..., Any], options: dict[str, Any]) -> Callable[[str], str]:
    """Return what names a version of a function: by its own file, all files here, and options, by content."""
    code = function.__code__
    said = f"{function.__module__} {function.__qualname__} {code.co_firstlineno} {sorted(options.items(), key=str)}"
    word = re.sub(r"\W", "_", function.__qualname__)[-60:]

    def name(version: str) -> str:
        parts = "\0".join((said, _text(function.__module__), _sources(), version))
        return f"{word}-{hashlib.sha256(parts.encode()).hexdigest()[:32]}"

    return name


def compiler(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a loop with these options of numba; its machine code is kept."""
    options = {"nogil": True, "error_model": "numpy"} | options
    return lambda function: compat.compiled_loop(function, options, _name(function, options), _STORE)


def phase(signature: Any, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function to be called by its ``address``; its machine code is kept."""
    options = {"error_model": "numpy"} | options
    return lambda function: compat.compiled_callback(function, signature, options, _name(function, options), _STORE)
