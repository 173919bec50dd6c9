"""Print the lowest versions that pyproject.toml allows of what users install, as constraints of pip.

    python .ci/lowest.py > build/lowest.txt

torch stays at the version of constraints.txt: no other build of it is small enough to be fetched for a test.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
USERS = ("data", "render", "sb3", "kernels", "ray")
"""Extras whose bounds are tried; those of dev and docs are for whoever has a checkout, and move with it."""


def declared() -> list[Requirement]:
    """Return what the package and the extras of users ask for."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = [*project["dependencies"], *(line for extra in USERS for line in project["optional-dependencies"][extra])]
    return [Requirement(line) for line in lines]


def lowest() -> list[str]:
    """Return ``name==version`` of every lower bound; ValueError for a requirement that has none."""
    pins = []
    for one in declared():
        if one.name == "torch":
            continue
        bound = re.search(r">=([\w.]+)", str(one.specifier))
        if bound is None:
            raise ValueError(f"'{one}' has no lower bound. Give the lowest version that passes the tests.")
        pins.append(f"{one.name}=={bound[1]}")
    return [*pins, (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()[-1]]


if __name__ == "__main__":
    print("\n".join(lowest()))
