"""The wheel, built and listed: it carries the package, nothing else, and declares exactly what the package imports."""

from __future__ import annotations

import ast
import email
import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import idm_env
from idm_env.extras import OF
from idm_env.tasks import TASKS

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
    """Agents and configurations are run from the checkout: a wheel must not claim names such as ``agents``.

    idm_env/README.md is for those who change the code, and have a checkout.
    """
    files = {p.relative_to(ROOT).as_posix() for p in (ROOT / "idm_env").rglob("*") if p.is_file()}
    wanted = {name for name in files if "__pycache__" not in name} - {"idm_env/README.md"}
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
    known = importlib.metadata.packages_distributions()
    for module, extra in OF.items():
        assert {canonicalize_name(name) for name in known[module]} & declared[extra]


def test_versions_agree(wheel: zipfile.ZipFile) -> None:
    """Of the package, of what is cited, and of the changelog's newest heading."""
    declared = Path(str(wheel.filename)).name.split("-")[1]
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    shown = re.search(r"Version (\S+)\.$", (ROOT / "docs" / "cards.md").read_text(), re.MULTILINE)
    assert cited is not None and newest is not None and shown is not None
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text())
    assert declared == idm_env.__version__ == cited[1] == newest[1] == recipe["package"]["version"] == shown[1]


def test_addresses_agree(tmp_path: Path) -> None:
    """All files state one address or none, and the command that writes it writes all of them."""
    spec = importlib.util.spec_from_file_location("address", ROOT / ".ci" / "address.py")
    assert spec is not None and spec.loader is not None
    address = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(address)
    stated = address.addresses(ROOT)
    assert len(set(stated.values())) == 1, stated
    for file in stated:
        (tmp_path / file).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / file, tmp_path / file)
    with pytest.raises(ValueError, match=r"example\.org is no https"):
        address.write(tmp_path, "https://example.org")
    assert address.addresses(tmp_path) == stated, "what is refused changes nothing"
    if stated["CITATION.cff"] is None:
        address.write(tmp_path, "https://github.com/owner/name")
        assert set(address.addresses(tmp_path).values()) == {"https://github.com/owner/name"}
        cell = "".join(json.loads((tmp_path / address.NOTEBOOK).read_text())["cells"][1]["source"])
        assert "git+https://github.com/owner/name" in cell and "wheel" not in cell
        compile(cell, "cell", "exec")


def test_the_conda_recipe_asks_for_what_the_wheel_asks_for(wheel: zipfile.ZipFile) -> None:
    """The same packages in the same lowest versions, torch by its name there, and extras as constraints."""
    head = email.message_from_bytes(wheel.read(next(n for n in wheel.namelist() if n.endswith(".dist-info/METADATA"))))
    declared = [Requirement(line) for line in head.get_all("Requires-Dist") or []]
    needs = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text())["requirements"]
    core = {
        canonicalize_name(one.name).replace("torch", "pytorch"): str(one.specifier)
        for one in declared
        if not one.marker
    }
    asked = dict(line.split(" ") for line in needs["run"])
    assert asked == {"python": head["Requires-Python"], **core}
    extras = {(one.name, str(one.specifier)) for one in declared}
    assert all(tuple(line.split(" ")) in extras for line in needs["run_constraints"])


def environment(wheel: zipfile.ZipFile, place: Path, *extras: str) -> Path:
    """Return the python of an environment with the wheel, what it declares for these extras, and nothing else."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", place], check=True)
    site = next(place.glob("lib/python*/site-packages"))
    declared = requirements(wheel)
    wanted = set[str]().union(*(declared[extra] for extra in ("", *extras)))
    linked: set[str] = set()
    while names := wanted - linked:
        for name in names:
            distribution = importlib.metadata.distribution(name)
            for line in distribution.requires or []:
                one = Requirement(line)
                if one.marker is None or one.marker.evaluate({"extra": ""}):
                    wanted.add(canonicalize_name(one.name))
            for top in {file.parts[0] for file in distribution.files or []} - {"..", "__pycache__"}:
                if not (site / top).exists() and not top.endswith(".pth"):
                    (site / top).symlink_to(str(distribution.locate_file(top)))
        linked |= names
    install = [sys.executable, "-m", "pip", "--python", place / "bin" / "python", "install", "--quiet", "--no-deps"]
    subprocess.run([*install, str(wheel.filename)], check=True)
    return place / "bin" / "python"


def call(*command: object, at: Path, code: int = 0, **more: str) -> subprocess.CompletedProcess[str]:
    """Run a command where neither the checkout nor its libraries are seen."""
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"IDM_ENV_CACHE": str(at / "cache")}
    done = subprocess.run([str(part) for part in command], cwd=at, env=clean | more, text=True, capture_output=True)
    assert done.returncode == code, done.stderr
    return done


@pytest.fixture(scope="module")
def core(wheel: zipfile.ZipFile, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the python of an environment without extras."""
    return environment(wheel, tmp_path_factory.mktemp("core"))


def test_without_extras_every_module_is_imported_or_names_its_extra(
    wheel: zipfile.ZipFile, core: Path, tmp_path: Path
) -> None:
    """One line of ImportError; what is not of an extra's subject is imported."""
    names = [name.removesuffix(".py").removesuffix("/__init__") for name in wheel.namelist() if name.endswith(".py")]
    (tmp_path / "modules.txt").write_text("\n".join(name.replace("/", ".") for name in names))
    (tmp_path / "run.py").write_text(IMPORTING)
    told = dict(line.split("\t") for line in call(core, "run.py", at=tmp_path).stdout.splitlines())
    assert told.keys() == {name.replace("/", ".") for name in names}
    for name, why in told.items():
        assert why == "imported" or re.search(r" needs [\w.]+\. Install it with: pip install 'idm-env\[\w+\]'$", why), (
            name, why,
        )  # fmt: skip
    assert {name.split(".")[1] for name, why in told.items() if why != "imported"} == OF_EXTRAS
    assert told["idm_env.envs.sb3"].endswith("[sb3]'") and told["idm_env.compiled.kernels.printed"].endswith(
        "[kernels]'"
    )


IMPORTING = """
import importlib
for name in open("modules.txt").read().split():
    try:
        importlib.import_module(name)
        print(name, "imported", sep="\\t")
    except ImportError as error:
        print(name, error, sep="\\t")
"""
OF_EXTRAS = {"cli", "compiled", "data", "discovery", "drift", "envs", "fitting", "jobs", "prediction", "trajectories"}
"""Parts of the package of which some module needs an extra (of ``envs``: Stable-Baselines3's face)."""

STEPPING = """
import gymnasium, idm_env, torch
from idm_env.envs.pettingzoo import parallel_env
from idm_env.extras import OF
from idm_env.tasks import TASKS
for task in TASKS:
    env = gymnasium.make("DiffIDM-v0", task=task)
    env.reset(seed=1)
    assert torch.isfinite(torch.as_tensor(env.step(env.action_space.sample())[1])).all()
    env = gymnasium.make_vec("DiffIDM-v0", num_envs=2, vectorization_mode="vector_entry_point", task=task)
    env.reset(seed=1)
    env.step(env.action_space.sample())
    env = parallel_env(task=task)
    env.reset(seed=1)
    env.step({name: env.action_space(name).sample() for name in env.agents})
    print(task)
"""


def test_without_extras_every_task_steps_in_every_face(core: Path, tmp_path: Path) -> None:
    """Gymnasium's single and vector environments and PettingZoo's, on the torch path: numba is not there."""
    (tmp_path / "run.py").write_text(STEPPING)
    assert call(core, "run.py", at=tmp_path).stdout.split() == list(TASKS)


ASKED = {
    "gymnasium.make('DiffIDM-v0', task='replay', data='a.csv').reset()": "data",
    "gymnasium.make('DiffIDM-v0', task='replay_lanes', data='a.csv').reset()": "data",
    "gymnasium.make('DiffIDM-v0', effects='model.yaml')": "data",
    "env = gymnasium.make('DiffIDM-v0', render_mode='rgb_array'); env.reset(); env.render()": "render",
}
ASKING = f"""
import gymnasium, idm_env
for what in {list(ASKED)}:
    try:
        exec(what)
        print("nothing")
    except ImportError as error:
        print(error)
"""


def test_what_wants_an_extra_says_which_in_one_line(core: Path, tmp_path: Path) -> None:
    """Arguments of an environment, and the command line."""
    for name in ("a.csv", "model.yaml"):
        (tmp_path / name).touch()
    told = call(core, "-c", ASKING, at=tmp_path).stdout + call(core.with_name("idm-env"), at=tmp_path, code=1).stderr
    extras = [*ASKED.values(), "data"]
    for line, extra in zip(told.splitlines(), extras, strict=True):
        assert line.endswith(f" Install it with: pip install 'idm-env[{extra}]'"), line


def of_core(example: Path) -> bool:
    """Whether an example imports the core's own libraries only, and of the package nothing of an extra."""
    core = {"gymnasium", "idm_env", "numpy", "pettingzoo", "torch", *sys.stdlib_module_names}
    names = re.findall(r"^ *(?:from|import) ([\w.]+)", example.read_text(), re.MULTILINE)
    parts = {name.split(".")[1] for name in names if name.startswith("idm_env.")}
    return {name.split(".")[0] for name in names} <= core and not parts & OF_EXTRAS


CORE_EXAMPLES = [path.stem for path in sorted((ROOT / "examples").glob("*.py")) if of_core(path)]
LONG = ("motorway", "stabilise_a_ring")
"""Examples that take half a minute each by torch: they are run here once, and with no extra but numba."""
SHORTER = {"train_apg": ("follow", "1")}


@pytest.mark.parametrize("name", [name for name in CORE_EXAMPLES if name not in LONG])
def test_examples_that_need_no_extra_run_without_them(core: Path, tmp_path: Path, name: str) -> None:
    """From another folder, as a user does."""
    assert call(core, ROOT / "examples" / f"{name}.py", *SHORTER.get(name, ()), at=tmp_path).stdout.strip()


def test_long_examples_run_with_no_extra_but_numba(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    """They are no part of tests/test_examples.py."""
    python, shared = environment(wheel, tmp_path / "environment", "kernels"), os.environ.get("IDM_ENV_CACHE", "")
    for name in LONG:
        done = call(python, ROOT / "examples" / f"{name}.py", at=tmp_path, IDM_ENV_CACHE=shared)
        assert name in CORE_EXAMPLES and done.stdout.strip()


def test_with_its_extra_the_command_runs_where_there_is_no_checkout(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    """A page that is a file of the package, and the words that a shell completes."""
    command = environment(wheel, tmp_path / "environment", "data").with_name("idm-env")
    rows = [f"{v},{0.1 * i:.1f},{2.0 * i - 30 * v:.2f},1" for v in range(3) for i in range(100)]
    (tmp_path / "my.csv").write_text("\n".join(["vehicle_id,time_s,position_m,lane", *rows]) + "\n")
    call(command, "plot", "my.csv", "--html", "--out", "drawn.png", at=tmp_path)
    assert 'id="diagram"' in (tmp_path / "drawn.html").read_text()
    for typed, at, wanted in (("idm-env fi", "1", ["filter", "fit"]), ("idm-env fit --held", "2", ["--held-out"])):
        asked = {"_IDM_ENV_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": at}
        assert call(command, at=tmp_path, **asked).stdout.split() == wanted
