"""A file, or a text, as a module: run once per process."""

import importlib.abc
import importlib.util
import sys
from pathlib import Path
from types import ModuleType


class _Text(importlib.abc.ExecutionLoader):
    """Loads a module from a text, whatever the file of its name holds by now."""

    def __init__(self, path: Path, text: str) -> None:
        self._path, self._text = path, text

    def get_filename(self, name: str) -> str:
        return str(self._path)

    def get_source(self, name: str) -> str:
        return self._text


def run(path: Path, name: str, text: str | None = None) -> ModuleType:
    """Run a file and return it as the module ``name``; one that is there already is returned as it is.

    Where a ``text`` is given that is run, and ``path`` only says where it may be looked at.
    """
    if name in sys.modules:
        return sys.modules[name]
    loader = None if text is None else _Text(path, text)
    spec = importlib.util.spec_from_file_location(name, path, loader=loader)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
