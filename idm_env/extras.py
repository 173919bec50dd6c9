"""Which extra gives what the core does without: said in one line wherever it is missing."""

from collections.abc import Iterator
from contextlib import contextmanager

OF = dict.fromkeys(("google", "jinja2", "matplotlib", "polars", "pyarrow", "rich", "scipy", "typer", "yaml"), "data")
OF |= {"llvmlite": "kernels", "numba": "kernels", "pygame": "render", "ray": "ray", "stable_baselines3": "sb3"}
"""Module → the extra that installs it."""


@contextmanager
def needed(what: str) -> Iterator[None]:
    """Import in here what an extra installs: where it is missing the ImportError names ``what`` and the cure.

    Of one within another the outer has its say: a command is what somebody asked for, not the loop that it runs.
    """
    try:
        yield
    except ImportError as error:
        name = (error.name or "").partition(".")[0]
        if name not in OF:
            raise
        cure = f"Install it with: pip install 'idm-env[{OF[name]}]'"
        raise ImportError(f"{what} needs {name}. {cure}", name=name) from None
