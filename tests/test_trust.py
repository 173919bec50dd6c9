"""A file of others runs no Python unasked, whichever way it is read; what is trusted says what it runs."""

from __future__ import annotations

import ast
import hashlib
import os
import pickle
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_type_hints

import gymnasium as gym
import pytest
import torch
import yaml

from agents import apg, classical, common, distil, evaluate, shac
from idm_env.cli import commands as cli
from idm_env.data import synthetic
from idm_env.effects import ALL
from idm_env.envs.pettingzoo import parallel_env
from idm_env.jobs import executor, trust
from idm_env.jobs.progress import OnProgress
from idm_env.model_file import load_environment, load_model
from idm_env.tasks import make_task
from tests.commands import run

ROOT = Path(__file__).resolve().parents[1]
EVIL = """
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from idm_env import Effect, Parameter

Path({mark!r}).touch()

@dataclass(frozen=True)
class Evil(Effect):
    kind: ClassVar[str] = {kind!r}
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("gain", "k", "1", 0.0, -1.0, 1.0, null=0.0),)

    def accelerate(self, scene, driver, p):
        return p["gain"] * scene.speed
"""


class Planted:
    """A folder with YAML files that name a class in a planted file, which leaves a mark where it is run."""

    def __init__(self, folder: Path, kind: str) -> None:
        self.folder, self.mark = folder, folder / "it-ran"
        self.name = f"evil_{hashlib.sha256(str(folder).encode()).hexdigest()[:8]}"
        file = folder / f"{self.name}.py"
        file.write_text(EVIL.format(mark=str(self.mark), kind=self.name))
        self.place = f"{file if kind == 'file' else self.name}:Evil"
        effects = ["idm", self.place, "brakes"]
        single = {"drivers": {"run1/2": {"idm": {"time_gap": 1.2}}}}
        self.model = self.yaml("model", configures="model", effects=effects, **single)
        self.environment = self.yaml("environment", configures="environment", task="ring", effects=[self.place])

    def yaml(self, stem: str, **content: Any) -> Path:
        """Write a YAML file."""
        path = self.folder / f"{stem}.yaml"
        path.write_text(yaml.safe_dump(content), encoding="utf-8")
        return path

    def agent(self, **content: Any) -> list[str]:
        """Return the options of an agent with a file of this content."""
        path = self.yaml("agent", configures="agent", agent="apg", **content)
        return ["--config", str(path), "--out", str(self.folder / "out"), "--updates", "1"]

    def data(self) -> Path:
        """Write two runs of a leader and a follower, on a lane."""
        path = self.folder / "data.csv"
        table = synthetic.generate(2, runs=2, followers=1, seconds=30.0)[0].table.drop("gap_m")
        table.with_columns(lane=1).write_csv(path)
        return path

    def checkpoint(self, folder: str = "out") -> Path:
        """Write an agent's checkpoint whose environment names the place."""
        path = self.folder / folder / "last.pt"
        task = make_task(**SMALL)
        policy = common.Policy(len(task.bounds.names), (4,))
        common.save(path, policy, "apg", SMALL, {"update": 0})
        content = torch.load(path, weights_only=True)
        content["environment"]["effects"] = {self.place}  # a set is read as a list is
        torch.save(content, path)
        return path


@pytest.fixture
def planted(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Planted]:
    """Plant one; what a test runs of it is gone after it."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(trust.VARIABLE, "0")
    monkeypatch.setenv("IDM_ENV_KERNELS", "0")  # one step of it is enough
    known, modules = dict(ALL), set(sys.modules)
    yield Planted(tmp_path, getattr(request, "param", "file"))
    ALL.clear()
    ALL.update(known)
    for name in set(sys.modules) - modules:
        if "evil" in name or "idm_env_effects_of_" in name:
            del sys.modules[name]


def command(*words: str, of: str = "model") -> Callable[[Planted], None]:
    """Return the command line as a way: ``DATA`` and the file stand for their paths."""

    def way(p: Planted) -> None:
        code, told = run(*(p.data() if w == "DATA" else getattr(p, of) if w == "FILE" else w for w in words),
                         *(() if words[0] == "effects" else ("--out", p.folder / f"out{words[0]}.png")))  # fmt: skip
        lines = [line for line in told.splitlines() if line.startswith("error: ")]
        assert (code == 0) == (not lines) and len(lines) < 2 and "Traceback" not in told, told
        if lines:
            raise ValueError(lines[0])

    return way


def read_there(path: Path, on_progress: OnProgress) -> int:
    """Read a model in a worker."""
    return len(load_model(path).effects)


def elsewhere(p: Planted) -> None:
    with executor.opened("processes", 1) as workers:
        assert list(workers.map(read_there, [p.model])) == [(0, 3)]


def on_ray(p: Planted) -> None:
    """What a task of Ray does with its payload."""
    kind, found = executor._work(pickle.dumps((os.getcwd(), trust.permission(), read_there, p.model)))
    if kind != "done":
        raise found


def main(agent: Any, *more: str) -> Callable[..., None]:
    """Return an agent's command line as a function of its file's content or of its options."""

    def way(argv: list[str]) -> None:
        try:
            agent.main([*argv, *more])
        except SystemExit as end:
            assert str(end.code).startswith("error: "), end.code
            raise ValueError(str(end.code)) from None

    return way


SMALL = {"task": "ring", "vehicles": 6, "warmup": 1}
NESTED = {"configures": "environment", "task": "ring"}
WAYS: dict[str, Callable[[Planted], object]] = {
    "load_model": lambda p: load_model(p.model),
    "load_environment": lambda p: load_environment(p.environment),
    "make_task effects": lambda p: make_task("ring", effects=str(p.model)),
    "make_task drivers": lambda p: make_task("platoon", drivers=str(p.model)),
    "gym effects": lambda p: gym.make("DiffIDM-v0", effects=str(p.model)),
    "gym drivers": lambda p: gym.make("DiffIDM-v0", drivers=str(p.model)),
    "gym config": lambda p: gym.make("DiffIDM-v0", config=str(p.environment)),
    "gym config of a model": lambda p: gym.make("DiffIDM-v0", config=str(p.yaml("b", **NESTED, effects=str(p.model)))),
    "gym config of drivers": lambda p: gym.make("DiffIDM-v0", config=str(p.yaml("b", **NESTED, drivers=str(p.model)))),
    "gym config of a choice": lambda p: gym.make(
        "DiffIDM-v0", config=str(p.yaml("b", **NESTED, effects=[{"effect": p.place}]))
    ),
    "gym config that trusts itself": lambda p: gym.make(
        "DiffIDM-v0", config=str(p.yaml("b", **NESTED, trusted=True, effects=[p.place]))
    ),
    "gym config that says it in a mapping and trusts itself": lambda p: gym.make(
        "DiffIDM-v0", config=str(p.yaml("b", **NESTED, trusted={"a": 1}, effects=str(p.model)))
    ),
    "vector": lambda p: gym.make_vec("DiffIDM-v0", num_envs=2, config=str(p.environment)),
    "parallel": lambda p: parallel_env(config=str(p.environment)),
    "simulate": command("simulate", "DATA", "--model", "FILE"),
    "effects": command("effects", "FILE"),
    "cite": command("effects", "FILE", "--cite"),
    "plot": command("plot", "FILE", "--seconds", "1", of="environment"),
    "fit": command("fit", "DATA", "--starts", "1", "--model", "FILE"),
    "lane changes": command("fit", "DATA", "--lane-changes", "--model", "FILE"),
    "filter": command("filter", "DATA", "--model", "FILE"),
    "reconstruct": command("reconstruct", "DATA", "--model", "FILE"),
    "processes": elsewhere,
    "ray": on_ray,
    "agent": lambda p: main(apg)(p.agent(environment={"task": "ring", "effects": [p.place]})),
    "agent beside": lambda p: main(shac)([
        "--config", str(p.yaml("a", configures="agent", agent="shac", environment={"config": "environment.yaml"})),
        "--out", str(p.folder / "out"),
    ]),
    "agent judged": lambda p: main(apg)(
        p.agent(environment={"task": "ring"}, judged_in={"effects": [p.place]})
    ),
    "agent of a model": lambda p: main(apg)(p.agent(environment={"task": "ring", "effects": str(p.model)})),
    "agent that trusts itself": lambda p: main(apg)(
        p.agent(environment={"task": "ring", "trusted": True, "effects": [p.place]})
    ),
    "classical": lambda p: main(classical)(p.agent(environment={"task": "ring", "effects": [p.place]})[:2]),
    "teacher": lambda p: main(distil)(["--teacher", p.agent(environment={"effects": [p.place]})[1]]),
    "checkpoint": lambda p: common.load(p.checkpoint()),
    "evaluate": lambda p: main(evaluate)([str(p.checkpoint())]),
    "start": lambda p: main(apg)([*p.agent(environment=SMALL), "--start", str(p.checkpoint("b"))]),
    "resume": lambda p: (p.checkpoint(), main(apg)([*p.agent(environment={"task": "ring"}), "--resume"])),
}  # fmt: skip


@pytest.mark.parametrize(
    ("way", "planted"), [*((way, "file") for way in WAYS), ("load_model", "module"), ("cite", "module")],
    indirect=["planted"],
)  # fmt: skip
def test_no_way_of_reading_a_file_runs_the_code_that_it_names(way: str, planted: Planted) -> None:
    with pytest.raises(ValueError) as told:
        WAYS[way](planted)
    assert not planted.mark.exists() and planted.name not in sys.modules
    words = str(told.value)
    assert "\n" not in words
    if way.endswith("trusts itself"):
        assert "is not for a file to say. Say it yourself." in words
    else:
        assert planted.name in words and (".yaml: " in words or ".pt: " in words)
        assert "is not run unasked. Read it, then give --trust, trusted=True in Python, or IDM_ENV_TRUST=1." in words


TRUSTED: dict[str, Callable[[Planted], object]] = {
    "load_model": lambda p: load_model(p.model, trusted=True),
    "load_environment": lambda p: load_environment(p.environment, trusted=True),
    "make_task": lambda p: make_task("ring", effects=str(p.model), trusted=True),
    "gym": lambda p: gym.make("DiffIDM-v0", config=str(p.environment), trusted=True),
    "vector": lambda p: gym.make_vec("DiffIDM-v0", num_envs=2, drivers=str(p.model), trusted=True),
    "parallel": lambda p: parallel_env(config=str(p.environment), trusted=True),
    "simulate": command("simulate", "DATA", "--model", "FILE", "--trust"),
    "cite": command("effects", "FILE", "--cite", "--trust"),
    "plot": command("plot", "FILE", "--seconds", "1", "--trust", of="environment"),
    "agent": lambda p: common.parse(
        apg.Arguments, "apg", [*p.agent(environment={"config": "environment.yaml"}), "--trust"]
    ),
    "checkpoint": lambda p: (trust.always(), common.load(p.checkpoint())),
}


@pytest.mark.parametrize("way", TRUSTED)
def test_what_is_trusted_is_run_and_said(way: str, planted: Planted, caplog: pytest.LogCaptureFixture) -> None:
    planted.yaml("environment", **NESTED, effects=[planted.place], warmup=1)
    TRUSTED[way](planted)
    assert planted.mark.exists()
    said = [m for m in caplog.messages if m.startswith("runs ")]
    assert len(said) == 1 and planted.name in said[0] and (".yaml" in said[0] or ".pt" in said[0])


@pytest.mark.parametrize("way", ["load_model", "ray"])
def test_trust_holds_inside_and_in_workers(way: str, planted: Planted, monkeypatch: pytest.MonkeyPatch) -> None:
    with trust.trusting(), trust.trusting(False):
        WAYS[way](planted)
    assert planted.mark.exists() and not trust.permission()
    monkeypatch.setenv(trust.VARIABLE, "1")
    assert trust.permission()


def test_a_worker_trusts_whom_the_one_that_asks_trusts(planted: Planted) -> None:
    with trust.trusting():
        elsewhere(planted)
    assert planted.mark.exists() and not any(planted.name in name for name in sys.modules)


def test_what_the_user_gives_or_this_process_has_imported_is_free(planted: Planted) -> None:
    """He has said it, or it has run."""
    env = gym.make("DiffIDM-v0", effects=[planted.place], warmup=1)
    assert planted.mark.exists()
    planted.mark.unlink()
    found = [load_model(planted.model).effects[1], gym.make("DiffIDM-v0", config=str(planted.environment)).unwrapped]
    assert type(found[0]) is type(env.unwrapped.task.simulator.effects[2]) and not planted.mark.exists()
    assert [e.name for e in load_model(planted.yaml("plain", effects=["idm", planted.name])).effects][1] == planted.name


def test_a_driver_may_have_any_name(tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    path.write_text("effects: [idm, brakes]\ndrivers: {trusted: {idm: {time_gap: 1.2}}}\n")
    assert list(load_model(path).drivers) == ["trusted"]


def test_a_module_that_this_process_has_imported_is_not_run_again(planted: Planted) -> None:
    """Neither by its name nor by its file."""
    module = __import__(planted.name)
    planted.mark.unlink()
    for place in (planted.place, f"{planted.name}:Evil"):
        assert type(load_model(planted.yaml("m", effects=["idm", place])).effects[1]) is module.Evil
    assert not planted.mark.exists()


@pytest.mark.parametrize(
    "place", ["os:system", "idm_env:IDM2", "torch.hub:load", "a\0.py:X", ":X", "no_such:X", ".a:X"]
)
@pytest.mark.parametrize("trusted", [False, True])
def test_places_without_a_class_are_one_line(
    place: str, trusted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "model.yaml"
    path.write_text(yaml.safe_dump({"effects": ["idm", place]}))
    before = set(sys.modules)
    with pytest.raises(ValueError, match=r"model\.yaml: effect ") as told:
        load_model(path, trusted=trusted)
    assert "\n" not in str(told.value) and set(sys.modules) == before


def test_every_command_that_reads_a_model_can_be_told_to_trust_and_is_in_the_law() -> None:
    commands = {str(c.name or c.callback.__name__): get_type_hints(c.callback) for c in cli.app.registered_commands}  # type: ignore[union-attr]
    reads = {name for name, hints in commands.items() if "model" in hints} | {"plot"}
    assert reads == {name for name, hints in commands.items() if "trust" in hints} and len(reads) == 6
    assert reads <= set(WAYS)


READERS = {
    "yaml.load": {"model_file.py"},
    "yaml.parse": {"model_file.py"},
    "torch.load": {"jobs/storage.py", "agents/common.py", "agents/ppo.py"},
    "pickle.loads": {"jobs/executor.py", "compat.py"},
    "import_module": {"data/__init__.py", "__init__.py", "backends.py", "effects/registry.py"},
    "spec_from_file_location": {"jobs/import_file.py"},
    "exec": {"compiled/kernels/compiler.py", "compiled/kernels/emitted.py"},
}
"""What may run or build whatever a file says, and where: executors pickle for their own workers, caches are sealed."""
NEVER = re.compile(
    r"\b(pickle\.load|load_from_pkl|load_replay_buffer|VecNormalize\.load|joblib|cloudpickle\.loads?|dill|marshal|shelve|runpy"
    r"|allow_pickle|weights_only=False|yaml\.(full|unsafe)_load|UnsafeLoader|FullLoader|eval)\b"
)


def test_nothing_else_builds_what_a_file_says() -> None:
    found: dict[str, set[str]] = {}
    for path in [*sorted((ROOT / "idm_env").rglob("*.py")), *sorted((ROOT / "agents").glob("*.py"))]:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            called = ast.unparse(node.func)
            for name in READERS:
                if called == name or called.endswith("." + name):
                    found.setdefault(name, set()).add(str(path.relative_to(ROOT)).removeprefix("idm_env/"))
            assert not NEVER.search(called) or called.endswith(".eval"), f"{path}: {called}"
            if called == "torch.load":
                assert any(k.arg == "weights_only" and ast.unparse(k.value) == "True" for k in node.keywords), path
            assert not any(k.arg == "allow_pickle" for k in node.keywords), path
    assert found == READERS
