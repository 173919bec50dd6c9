"""Trust in code that files name: a file with the place of a class names its author's code, run only if trusted."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

VARIABLE = "IDM_ENV_TRUST"
"""Set to 1: the code that files name is run, in this process and in those that it starts."""
_given: ContextVar[bool] = ContextVar("idm_env_trust", default=False)


def permission() -> bool:
    """Tell whether the code that files name may run."""
    return _given.get() or os.environ.get(VARIABLE) == "1"


def always() -> None:
    """Trust the files of this process from now on, and those of its workers."""
    os.environ[VARIABLE] = "1"


@contextmanager
def trusting(trusted: bool = True) -> Iterator[None]:
    """Trust the files that are read inside; ``False`` leaves it as it is. ValueError for any other value."""
    if not isinstance(trusted, bool):
        raise ValueError(f"trusted is of type {type(trusted).__name__}, and must be True or False.")
    token = _given.set(trusted or _given.get())
    try:
        yield
    finally:
        _given.reset(token)
