"""The wheel, built and listed: it carries the package, nothing else, and declares exactly what the package imports."""

from __future__ import annotations

import ast
import email
import importlib.metadata
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
NO_PART = ("__pycache__", "*.egg-info")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """Build from a copy, so that nothing is written into the checkout."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for folder in ("idm_env", "agents", "configs"):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns(*NO_PART))
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source)
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", out, source]
    subprocess.run(build, check=True)
    return zipfile.ZipFile(next(out.glob("*.whl")))


def requirements(wheel: zipfile.ZipFile) -> dict[str, set[str]]:
    """Return the names of the distributions that every extra asks for; '' is no extra."""
    name = next(n for n in wheel.namelist() if n.endswith(".dist-info/METADATA"))
    head = email.message_from_bytes(wheel.read(name))
    found: dict[str, set[str]] = {extra: set() for extra in ("", *(head.get_all("Provides-Extra") or []))}
    for line in head.get_all("Requires-Dist") or []:
        one = Requirement(line)
        for extra, names in found.items():
            with_extra = one.marker is not None and one.marker.evaluate({"extra": extra})
            if with_extra if extra else one.marker is None:
                names.add(canonicalize_name(one.name))
    return found


def imported(wheel: zipfile.ZipFile) -> list[set[str]]:
    """Return, for each module from outside that the package imports anywhere, the distributions that give it."""
    modules = set()
    for name in wheel.namelist():
        if name.endswith(".py"):
            for node in ast.walk(ast.parse(wheel.read(name))):
                if isinstance(node, ast.Import):
                    modules |= {alias.name.split(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                    modules.add(node.module.split(".")[0])
    outside = modules - set(sys.stdlib_module_names) - {"idm_env"}
    known = importlib.metadata.packages_distributions()
    return [{canonicalize_name(name) for name in known.get(module, [module])} for module in sorted(outside)]


def test_it_carries_every_file_of_the_package_and_nothing_beside_it(wheel: zipfile.ZipFile) -> None:
    """Agents and configurations are run from the checkout: a wheel must not claim names such as ``agents``."""
    files = {p.relative_to(ROOT).as_posix() for p in (ROOT / "idm_env").rglob("*") if p.is_file()}
    wanted = {name for name in files if "__pycache__" not in name}
    carried = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert carried == wanted


def test_it_declares_what_it_imports_and_no_extra_for_what_it_does_not_carry(wheel: zipfile.ZipFile) -> None:
    """Every import is a requirement, and every requirement of an extra for users is imported."""
    declared = {extra: names for extra, names in requirements(wheel).items() if extra not in ("dev", "docs", "all")}
    everything = set().union(*declared.values())
    undeclared = [names for names in imported(wheel) if not names & everything]
    assert not undeclared
    used = set().union(*imported(wheel))
    assert everything == used & everything


def test_it_works_where_there_is_no_checkout(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    """Installed into a fresh environment that sees the same libraries, but not an editable installation of this."""
    place = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", place], check=True)
    site = next(place.glob("lib/python*/site-packages"))
    # As plain paths: what is installed editable there is found by .pth files, which only a site's own folder reads.
    paths = [p for p in sys.path if "site-packages" in p]
    (site / "libraries.pth").write_text("\n".join(paths))
    install = [sys.executable, "-m", "pip", "--python", place / "bin" / "python", "install", "--quiet", "--no-deps"]
    subprocess.run([*install, str(wheel.filename)], check=True)
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"IDM_ENV_CACHE": str(tmp_path / "c")}

    def done(*command: object, **more: str) -> subprocess.CompletedProcess[str]:
        words = [str(part) for part in command]
        return subprocess.run(words, cwd=tmp_path, env=environment | more, text=True, capture_output=True)

    def call(*command: object, **more: str) -> str:
        told = done(*command, **more)
        assert told.returncode == 0, told.stderr
        return told.stdout

    python, command = place / "bin" / "python", place / "bin" / "idm-env"
    assert str(site) in call(python, "-c", "import idm_env; print(idm_env.__file__)")
    time = [0.1 * i for i in range(100)]
    rows = [f"{v},{t:.1f},{20 * t - 30 * v:.2f},1" for v in range(3) for t in time]
    (tmp_path / "my.csv").write_text("\n".join(["vehicle_id,time_s,position_m,lane", *rows]) + "\n")
    call(command, "plot", "my.csv", "--html", "--out", "drawn.png")  # its page is a file of the package
    assert "<svg" in (tmp_path / "drawn.html").read_text() or "canvas" in (tmp_path / "drawn.html").read_text()
    for typed, at, wanted in (("idm-env fi", "1", ["fit", "filter"]), ("idm-env fit --held", "2", ["--held-out"])):
        found = call(command, _IDM_ENV_COMPLETE="complete_bash", COMP_WORDS=typed, COMP_CWORD=at)
        assert found.split() == wanted
    refused = done(command, "bench")
    assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (1, "", 1)
    assert "bench needs a checkout" in refused.stderr
