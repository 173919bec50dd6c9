"""Imports point one way, and ``import idm_env`` stays light."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "idm_env"

ALLOWED = {
    "types": set(),
    "checks": set(),
    "keep": set(),
    "parameters": {"types", "checks"},
    "effects": {"types", "parameters", "checks"},
    "roads": {"types"},
    "kernels": {"types", "parameters", "effects", "roads", "simulator"},
    "history": {"types"},
    "simulator": {"types", "parameters", "checks", "effects", "roads", "history", "kernels", "compiled"},
    "compiled": {"types", "parameters", "simulator"},
    "fonts": set(),
    "report": {"fonts", "keep"},
    "progress": set(),
    "diagrams": {"report", "fonts"},
    "config": {"types", "parameters", "checks", "effects", "roads", "simulator", "keep"},
    "data": set(),
    "fitting": {
        "types", "parameters", "effects", "roads", "simulator", "kernels", "data", "config", "report", "metrics",
        "checks", "keep", "progress", "diagrams",
    },
}  # fmt: skip
"""What a part may import of the package; parts that are not named may import anything but what FORBIDDEN says."""

FORBIDDEN = {
    "tasks": {"envs", "fitting", "discovery", "wrappers"},
    "envs": {"fitting", "discovery", "wrappers"},
    "discovery": {"tasks", "envs", "wrappers"},
}
OUTSIDE = {"gymnasium": {"envs", "wrappers", "__init__"}, "pettingzoo": {"envs"}, "stable_baselines3": {"envs"}}


def imports(path: Path) -> set[str]:
    """Return the modules that a file imports, wherever in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


FILES = [p for p in PACKAGE.rglob("*.py") if p.name != "__pycache__"]


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_one_way(path: Path) -> None:
    """As the design's layout says; gymnasium, pettingzoo and stable-baselines3 only at the faces."""
    mine = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    found = imports(path)
    parts = {name.split(".")[1] for name in found if name.startswith("idm_env.")} - {mine}
    known = {p.name.removesuffix(".py") for p in PACKAGE.iterdir()}
    if mine in ALLOWED:
        assert (parts & known) <= ALLOWED[mine]
    assert not parts & FORBIDDEN.get(mine, set())
    for library, allowed in OUTSIDE.items():
        if any(name.split(".")[0] == library for name in found):
            assert mine in allowed, f"{library} belongs to {allowed}"


def test_the_simulator_does_not_know_the_model() -> None:
    """The word IDM does not occur in the simulator: behaviour is effects."""
    text = (PACKAGE / "simulator.py").read_text().replace("idm_env", "")
    assert "IDM" not in text.replace("Add IDM() or drop one", "") and "idm" not in text


@pytest.mark.parametrize("path", sorted((PACKAGE / "discovery").glob("*.py")), ids=lambda p: p.name)
def test_discovery_knows_no_effect_by_name(path: Path) -> None:
    """What is known of an effect stands beside its equation."""
    from idm_env.effects import CANDIDATES

    words = {
        word
        for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant) and type(node.value) is str
        for word in node.value.split(".")
    }  # fmt: skip
    assert not words & set(CANDIDATES)


def test_importing_the_package_imports_no_torch_and_registers_the_environment() -> None:
    """Quick to import, ready for gym.make."""
    code = (
        "import sys, idm_env, gymnasium; assert 'torch' not in sys.modules, 'torch'; "
        "assert 'DiffIDM-v0' in gymnasium.registry; idm_env.Simulator; assert 'torch' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
