"""Whatever a user gives, bad numbers, hostile files, a full disk or Ctrl-C: one line, and at once."""

from __future__ import annotations

import gzip
import math
import os
import re
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import Any, get_args, get_type_hints

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings, strategies as st

import idm_env  # noqa: F401
from agents import apg, common
from agents.policy import Policy
from idm_env import effects, validation
from idm_env.cli import commands as cli
from idm_env.data import sizes, synthetic
from idm_env.envs import window
from idm_env.envs.batch import Batch
from idm_env.envs.pettingzoo import parallel_env
from idm_env.envs.settings import settings as settings_of
from idm_env.model_file import load_environment, load_model
from idm_env.tasks import KeywordError
from tests.commands import refused, typed
from tests.data.tables import platoon

QUICK = settings(max_examples=60)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of a leader and a follower."""
    path = tmp_path_factory.mktemp("data") / "data.csv"
    synthetic.generate(2, runs=2, followers=1, seconds=30.0)[0].table.drop("gap_m").write_csv(path)
    return path


# -- files of effects ------------------------------------------------------------------------------------------------

ENDINGS = {
    "exits": "import sys; sys.exit(0)",
    "exits without a word": "raise SystemExit",
    "raises what is no Exception": "class Odd(BaseException): pass\nraise Odd('a' * 5000)",
    "raises": "raise RuntimeError('two\\nlines')",
    "ends a generator": "raise GeneratorExit",
    "is no Python": "def (",
    "divides": "1 / 0",
    "exits when its class is made": """
import sys
from dataclasses import dataclass
from typing import ClassVar
from idm_env.effects import IDM
@dataclass(frozen=True)
class X(IDM):
    kind: ClassVar[str] = "odd"
    def __post_init__(self):
        sys.exit(0)
""",
    "exits when it is asked": """
import sys
from dataclasses import dataclass
from typing import ClassVar
from idm_env.effects import IDM
@dataclass(frozen=True)
class X(IDM):
    kind: ClassVar[str] = "odder"
    def accelerate(self, scene, driver, p):
        sys.exit(0)
""",
}
USES: dict[str, tuple[object, ...]] = {
    "explain --effects": ("explain", "DATA", "--effects", "FILE:X"),
    "explain --base": ("explain", "DATA", "--base", "FILE:X"),
    "fit --base": ("fit", "DATA", "--starts", "1", "--base", "FILE:X"),
    "fit --lane-changes": ("fit", "DATA", "--lane-changes", "--base", "FILE:X"),
    "simulate --base": ("simulate", "DATA", "--base", "FILE:X"),
    "simulate --model": ("simulate", "DATA", "--trust", "--model", "MODEL"),
    "effects --cite": ("effects", "MODEL", "--cite", "--trust"),
    "plot": ("plot", "ENVIRONMENT", "--trust", "--out", "OUT.png"),
    "several sets": ("explain", "DATA", "DATA", "--effects", "FILE:X"),
}


ASKED = "exits when it is asked"
PAIRS = [
    *zip(ENDINGS, USES, strict=True),
    *((ASKED, use) for use in ("fit --lane-changes", "simulate --model", "effects --cite", "plot")),
]
"""Every ending and every use once: all are read in one place; and, of one that reading does not meet, what differs."""


@pytest.fixture
def no_trust(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whom a test trusts is gone after it."""
    monkeypatch.setenv("IDM_ENV_TRUST", "0")


@pytest.mark.usefixtures("no_trust")
@pytest.mark.parametrize(("ending", "use"), PAIRS)
def test_a_file_of_effects_that_ends_the_process_is_one_line(data: Path, tmp_path: Path, ending: str, use: str) -> None:
    file, model, environment = (tmp_path / name for name in ("mine.py", "model.yaml", "environment.yaml"))
    file.write_text(ENDINGS[ending])
    model.write_text(f"effects: ['{file}:X', brakes]\n")
    environment.write_text(f"configures: environment\ntask: ring\nwarmup: 1\neffects: ['{file}:X']\n")
    paths = {
        "DATA": data,
        "FILE:X": f"{file}:X",
        "MODEL": model,
        "ENVIRONMENT": environment,
        "OUT.png": tmp_path / "a.png",
    }
    words = [paths.get(str(word), word) for word in USES[use]]
    if ending == ASKED and words[0] == "effects":
        assert typed(*words).returncode == 0  # it is not asked
        return
    line = refused(*words, *(() if {"--out", "--cite"} & set(words) else ("--out", tmp_path / "out")))
    if ending == ASKED and "--lane-changes" in words:  # these data have one lane, which is told before
        assert "no driver has a lane beside his own" in line
    else:
        assert "mine.py" in line or "odd" in line or "ended from within (SystemExit: 0)" in line
    assert not list(tmp_path.glob("out/report.*"))


# -- numbers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "flag", "value"),
    [
        ("fit", "--max-gap", "nan"),
        ("fit", "--max-gap", "-1"),
        ("fit", "--window", "0"),
        ("fit", "--window", "-1"),
        ("fit", "--window", "nan"),
        ("fit", "--dt", "nan"),
        ("fit", "--dt", "inf"),
        ("fit", "--min-seconds", "nan"),
        ("fit", "--ring-length", "nan"),
        ("fit", "--starts", "0"),
        ("fit", "--substeps", "1000000000000"),
        ("fit", "--seed", "-1"),
        ("fit", "--held-out", "nan"),
        ("fit", "--held-out", "2"),
        ("explain", "--seed", "99999999999999999999"),
        ("explain", "--ring-length", "0"),
        ("explain", "--effects", ","),
        ("explain", "--effects", ""),
        ("explain", "--known", " , "),
        ("simulate", "--window", "nan"),
        ("reconstruct", "--dt", "nan"),
        ("plot", "--seconds", "nan"),
        ("demo", "--seed", "-3"),
    ],
)
def test_a_bad_number_is_refused_by_the_name_of_its_flag(
    data: Path, tmp_path: Path, command: str, flag: str, value: str
) -> None:
    given = () if command == "demo" else (data,)
    more = ("--model", data) if command == "simulate" else ()
    line = refused(command, *given, *more, f"{flag}={value}", "--out", tmp_path / "out")
    assert line.startswith(f"error: {flag} = ") and not (tmp_path / "out").exists()


@pytest.mark.parametrize("value", ["nan", "1e400", "abc", "True", "1,2", "0x10", "[1]"])
def test_what_is_no_number_is_one_line_with_its_flag_and_value(data: Path, value: str) -> None:
    """As one word and as two; it was a usage line and three more, without the value."""
    for words in ([f"--seed={value}"], ["--seed", value]):
        done = typed("fit", data, *words)
        assert done.returncode == 2 and done.stderr.startswith(f"error: --seed = '{value}': ")
        assert done.stderr.count("\n") == 1, done.stderr


@pytest.mark.parametrize("words", [["--out="], ["--out", ""], ["--model", "  "], ["--base="], [""]])
def test_an_empty_value_is_refused(data: Path, words: list[str]) -> None:
    """As an unset variable of a shell leaves it; results went to the folder in which one stood."""
    assert "= '' is empty, as an unset variable is" in refused("fit", data, *words)


def test_every_number_of_the_command_line_is_checked_in_the_one_place() -> None:
    found = 0
    for command in cli.app.registered_commands:
        assert command.callback is not None
        for name, hint in get_type_hints(command.callback, include_extras=True).items():
            kind, *extras = get_args(hint) or (hint,)
            if {float, int} & {kind, *get_args(kind)}:
                found += 1
                assert extras and extras[0].callback is not None, f"{command.callback.__name__} {name}"
    assert found > 20


def test_a_picture_has_a_file_that_is_no_input(data: Path, tmp_path: Path) -> None:
    assert "is a folder" in refused("plot", data, "--out", tmp_path)
    assert "names no kind of picture" in refused("plot", data, "--out", tmp_path / "a.csv")
    link = tmp_path / "a.png"
    link.symlink_to(data)
    before = data.read_bytes()
    assert "is an input" in refused("plot", data, "--out", link)
    assert data.read_bytes() == before and link.is_symlink()


@given(st.recursive(st.integers() | st.floats() | st.text() | st.binary() | st.none(), st.lists, max_leaves=200))
def test_a_value_in_an_error_text_is_short(value: Any) -> None:
    assert len(validation.shown(value)) < 700 and "\n" not in validation.shown(value)


def test_a_value_in_an_error_text_is_short_however_it_grows() -> None:
    laughs: Any = "ha"
    for _ in range(30):
        laughs = [laughs] * 9
    for value in (laughs, 10**5000, "x" * 10**7, {"a": laughs}):
        assert len(validation.shown(value)) < 700


@pytest.mark.parametrize(
    "value", [math.nan, "abc", "", True, [1, 2], {}, 1j, b"1", np.array(1.0), torch.tensor(1.0), int]
)
@pytest.mark.parametrize(
    ("effect", "choice"), [(effects.IDM, "exponent"), (effects.Brakes, "width"), (effects.Curve, "number"),
                           (effects.Curve, "period"), (effects.Mobil, "every"), (effects.SpeedZone, "width")],
)  # fmt: skip
def test_a_choice_of_another_type_is_refused_where_an_effect_is_made(effect: Any, choice: str, value: Any) -> None:
    """All were taken, or ended in another library's words in the first step."""
    with pytest.raises(ValueError, match=rf"^{effect.kind}\.{choice} = .* must be of type "):
        effect(**{choice: value})


# -- environments ----------------------------------------------------------------------------------------------------


def test_too_many_environments_are_refused_with_the_memory_that_they_would_take() -> None:
    for count in (10**9, 10**15):
        with pytest.raises(ValueError, match=rf"num_envs = {count} would take about [\d,]+ GB, and cpu has"):
            gym.make_vec("DiffIDM-v0", num_envs=count)


def test_a_window_that_no_memory_holds_is_refused_before_its_first_step() -> None:
    env = gym.make("DiffIDM-v0", output="torch", warmup=0).unwrapped
    env.reset(seed=0)
    before = env.state
    with pytest.raises(ValueError, match=r"steps = 1000000000 would take about [\d,]+ GB, and cpu has .* at most \d+"):
        env.unroll(lambda seen: pytest.fail("a step was made"), 10**9)
    with pytest.raises(ValueError, match="must be at most 1000000000"):
        env.unroll(lambda seen: pytest.fail("a step was made"), 10**400)
    assert torch.equal(env.state.position, before.position)


@pytest.mark.parametrize(
    "given", [{"task": "highway", "vehicles": 1}, {"task": "merge", "trips": [{"depart": 1.0, "lane": 1}]}]
)
def test_a_vehicle_alone_sees_nobody(given: dict[str, Any]) -> None:
    env = gym.make("DiffIDM-v0", output="torch", **given).unwrapped
    seen, _ = env.reset(seed=0)
    for _ in range(3):
        seen = env.step(env.action_space.sample())[0]
    named = env.task.by_name(seen)
    nearby = [x for name, x in named.items() if name.endswith(("_0", "_1"))]
    assert len(nearby) == 8 and not any(bool(x.any()) for x in nearby), named


FLAT: tuple[Any, ...] = (math.nan, b"1", [None], {"a": 1}, 10**400, object(), np.array([1.0, 2.0]), "a\nb", 1 + 2j)


@pytest.mark.parametrize(
    "name", ["integration", "effects", "drivers", "config", "trusted", "controlled", "reward", "observation", "info"]
)
def test_a_flat_keyword_refuses_what_it_does_not_take(name: str) -> None:
    """Whatever type it is; what none of them takes, in one line, and not in words of a library."""
    wrong = []
    for value in FLAT:
        try:
            settings_of(**{name: value})
            wrong.append((value, "accepted"))
        except (ValueError, KeywordError) as error:
            if "\n" in str(error) or len(str(error)) > 400 or "ambiguous" in str(error):
                wrong.append((value, error))
        except Exception as error:
            wrong.append((value, repr(error)))
    assert not wrong


def test_seeds_and_parameters_of_a_wrong_type_are_one_line() -> None:
    single, turns = gym.make("DiffIDM-v0", warmup=0).unwrapped, parallel_env(warmup=0)
    for value in (True, 1.5, "1", -1, [1], np.array([1, 2])):
        for reset in (single.reset, turns.reset):
            with pytest.raises(ValueError, match=r"^seed = .* must be (a whole number|at least 0)\.$"):
                reset(seed=value)
    for reset in (single.reset, turns.reset):
        reset(seed=np.int64(3))
    for parameters in (3, [], {"idm": 1}):
        with pytest.raises(ValueError, match="must be effect → name → tensor"):
            single.params = parameters


def test_what_is_empty_or_false_is_no_default() -> None:
    for name in ("task", "output", "device", "dtype", "autoreset_mode", "parameters", "randomise"):
        for value in ("", 0, [], False):
            with pytest.raises(ValueError, match=r"\A[^\n]{1,300}\Z"):
                gym.make("DiffIDM-v0", **{"disable_env_checker": True, name: value})


def test_without_its_compiler_steps_go_on_and_loops_say_so(data: Path) -> None:
    """NUMBA_DISABLE_JIT: torch steps after one warning, and commands that are loops end in one line."""
    code = (
        "import sys, gymnasium as gym, idm_env\n"
        "env = gym.make('DiffIDM-v0', warmup=0); env.reset(seed=0)\n"
        "for _ in range(2): env.step(env.action_space.sample())\n"
        "from idm_env.cli import commands as cli; cli.run()"
    )
    switched_off = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code, "filter", str(data), "--out", str(data.parent / "off")],
        env=switched_off, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    lines = done.stderr.splitlines()
    assert done.returncode == 1 and sum("the torch path runs" in line for line in lines) == 1, done.stderr
    assert lines[-1] == "error: loops cannot be compiled while NUMBA_DISABLE_JIT is set. Unset it."


LACKS = MemoryError(), RuntimeError("[enforce fail at alloc_cpu.cpp:127] DefaultCPUAllocator: can't allocate memory")


@pytest.mark.parametrize("error", LACKS, ids=lambda error: type(error).__name__)
def test_lack_of_memory_is_a_sentence(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def lacks(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(cli, "app", lacks)
    with pytest.raises(SystemExit):
        cli.run()
    cure = "Take fewer vehicles, runs or draws at a time, or free memory."
    assert capsys.readouterr().err == f"error: this needs more memory than there is. {cure}\n"
    env = gym.make_vec("DiffIDM-v0", num_envs=3, output="torch", warmup=0)
    env.reset(seed=0)
    monkeypatch.setattr(Batch, "_once", lacks)
    monkeypatch.setattr(window, "compiled", lacks)
    for act in (env.step, lambda _: env.unroll(torch.tanh, 2)):
        with pytest.raises(MemoryError, match=r"^num_envs = 3 of \d+ vehicles need more memory than cpu has"):
            act(None)


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz", "a.txt.gz", "a.zip", "a.parquet", "a.json.gz"])
def test_a_file_that_no_memory_holds_is_refused_by_its_unpacked_size(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However small it is packed: six gigabytes of rows alike are fifty megabytes of gz."""
    path, table = tmp_path / name, platoon(seconds=200.0)
    text = table.write_csv().encode()
    if name == "a.parquet":
        table.write_parquet(path)
    elif name == "a.zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
            file.writestr("a.csv", text)
    else:
        path.write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
    monkeypatch.setattr(sizes, "available", lambda: 16_000 * sizes.SHARE)
    said = refused("predict" if "json" in name else "fit", path, "--out", tmp_path / "out")
    assert re.search(rf"{name} holds .*GB or more, unpacked, and free memory .* at most 1.6e-05 GB", said)


def test_a_packed_file_without_a_line_is_refused_by_its_size(tmp_path: Path) -> None:
    """As one of zeros, of which a megabyte holds a gigabyte, or of a picture: not unpacked as a whole."""
    path = tmp_path / "a.csv.gz"
    path.write_bytes(gzip.compress(b"\0" * 10_000_001, 1))
    for command in ("fit", "filter"):
        said = refused(command, path, "--out", tmp_path / "out")
        assert "has a line of more than 10000000 characters; it is no table of rows" in said


def test_unknown_reset_options_are_refused() -> None:
    for env, known in (
        (gym.make("DiffIDM-v0").unwrapped, "state"),
        (gym.make_vec("DiffIDM-v0", num_envs=2), "reset_mask"),
    ):
        with pytest.raises(ValueError, match=rf"unknown reset option 'reset_maks'\..*{known}"):
            env.reset(options={"reset_maks": 1})
        with pytest.raises(ValueError, match="must be a mapping"):
            env.reset(options=[1])  # type: ignore[arg-type]
        env.reset(options={})


@pytest.mark.parametrize("kind", [torch.complex64, torch.bool])
def test_an_action_that_is_no_real_number_is_refused(kind: torch.dtype) -> None:
    for env, shape in ((gym.make("DiffIDM-v0"), (1,)), (gym.make_vec("DiffIDM-v0", num_envs=2), (2, 1))):
        env.reset(seed=0)
        for action in (torch.ones(shape, dtype=kind), torch.ones(shape, dtype=kind).numpy()):
            with pytest.raises(ValueError, match=rf"an action of type (torch\.)?{str(kind).split('.')[1]}"):
                env.step(action)
    turns = parallel_env()
    turns.reset(seed=0)
    with pytest.raises(ValueError, match=rf"an action of type {str(kind).split('.')[1]}"):
        turns.step({agent: torch.ones(1, dtype=kind).numpy() for agent in turns.agents})


# -- files -----------------------------------------------------------------------------------------------------------

LAUGHS = "a: &a [ha, ha, ha, ha, ha, ha, ha, ha, ha]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)
HOSTILE = {
    "laughs": f"{LAUGHS}effects: *i\n",
    "brackets": "effects: " + "[" * 100_000,
    "mappings": "a: " + "{a: " * 100_000,
    "indented": "\n".join(" " * i + "a:" for i in range(3000)),
    "400 digits": f"effects: [idm]\ndt: 1{'0' * 400}\n",
    "5000 digits": f"effects: [idm]\ndt: 1{'0' * 5000}\n",
    "base 60": "effects: [idm]\ndt: 1" + ":59" * 100_000,
    "integration": "effects: [idm]\nintegration: [euler]\n",
    "by": "effects: [idm]\nby: [a, b]\n",
    "no day": "effects: [idm]\ndt: 2001-99-99\n",
    "no number": "effects: [idm]\ndt: !!int ''\n",
    "complex key": "? [a]\n: 1\n",
    "number as key": "effects: [{effect: delay, 1: 2}]\n",
    "list as choice": "effects: [{effect: delay, max_delay: [1]}]\n",
    "text as choice": "effects: [{effect: delay, max_delay: ha}]\n",
    "effect is a list": "effects: [{effect: [delay]}]\n",
    "substeps": "effects: [idm]\nsubsteps: 1.0e+300\n",
    "substeps true": "effects: [idm]\nsubsteps: true\n",
    "schema": "effects: [idm]\nschema: [1]\n",
    "tag": "effects: !!python/object/apply:os.system [ls]\n",
    "zeros": "\0" * 1000,
    "long key": "x" * 1_000_000 + ": 1",
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("reader", ["model", "environment", "agent"])
def test_a_hostile_yaml_file_is_one_line(tmp_path: Path, name: str, reader: str) -> None:
    path = tmp_path / "model.yaml"
    head = {"model": "", "environment": "configures: environment\n", "agent": "configures: agent\nagent: apg\n"}[reader]
    text = HOSTILE[name]
    path.write_text(head + (text if reader == "model" else text.replace("effects: [idm]\n", "")))
    read = {
        "model": lambda: load_model(path),
        "environment": lambda: gym.make("DiffIDM-v0", **load_environment(path)),
        "agent": lambda: common.load_agent(path, apg.Arguments, "apg"),
    }[reader]
    with pytest.raises((ValueError, TypeError) if reader == "environment" else ValueError) as told:
        read()
    assert "\n" not in str(told.value) and len(str(told.value)) < 1000


def test_a_small_file_cannot_take_time_and_memory(data: Path, tmp_path: Path) -> None:
    """In a process of its own, which is ended if it does not end by itself."""
    path = tmp_path / "model.yaml"
    path.write_text(HOSTILE["laughs"])
    code = (
        "import resource, sys; from idm_env.cli import commands as cli\n"
        "from idm_env.fitting import job; sys.argv[0] = 'idm-env'\n"
        "def used(): usage = resource.getrusage(resource.RUSAGE_SELF); return usage.ru_utime, usage.ru_maxrss / 1e3\n"
        "before = used(); resource.setrlimit(resource.RLIMIT_CPU, (int(before[0]) + 30, int(before[0]) + 30))\n"
        "try: cli.run()\nfinally: print(used()[1] - before[1])"
    )
    given = ("simulate", data, "--model", path, "--out", tmp_path / "out")
    done = subprocess.run([sys.executable, "-c", code, *map(str, given)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1 and "aliases" in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr[-2000:]
    assert float(done.stdout) < 50.0  # MB


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.dates(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5) | st.integers(), inner, max_size=3),
    max_leaves=8,
)
KEYS = st.sampled_from(
    ["configures", "schema", "dt", "integration", "effects", "parameters", "by", "drivers", "substeps"]
)


@given(st.dictionaries(KEYS, VALUES, max_size=4))
@example({"parameters": {"\n": {"": None}}})
@QUICK
def test_any_model_is_read_or_refused_in_one_line(data: Path, tmp_path: Path, content: dict[str, Any]) -> None:
    import yaml

    path = tmp_path / "model.yaml"
    path.write_text(yaml.safe_dump({"effects": ["idm", "brakes"], **content}), encoding="utf-8")
    try:
        load_model(path)
    except ValueError as error:
        assert "\n" not in str(error)


TASK_KEYS = st.sampled_from(
    ["task", "length", "vehicles", "controlled", "parameters", "effects", "dt", "noise", "warmup", "output", "device",
     "dtype", "max_episode_steps", "render_mode", "autoreset_mode", "warmup_pool", "failsafe", 7]
)  # fmt: skip


@given(st.dictionaries(TASK_KEYS, VALUES, max_size=2))
@QUICK
def test_any_environment_is_made_or_refused_in_one_line(tmp_path: Path, content: dict[Any, Any]) -> None:
    import yaml

    path = tmp_path / "env.yaml"
    path.write_text(yaml.safe_dump({"configures": "environment", "warmup": 1, **content}), encoding="utf-8")
    done = typed("plot", path, "--seconds", 0.2, "--out", tmp_path / "a.png")
    assert done.returncode == 0 or (done.returncode == 1 and done.stderr.count("error: ") == 1), done.stderr


@given(st.binary(max_size=300) | st.text(alphabet="[]{}:,-&*!|>'\"#%@ \n\tab01.", max_size=200).map(str.encode))
@QUICK
def test_any_bytes_as_yaml_are_refused_in_one_line(data: Path, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "model.yaml"
    path.write_bytes(content)
    refused("plot", path, "--out", tmp_path / "a.png")


@given(
    st.sampled_from(["a.csv", "a.csv.gz", "a.parquet", "a.txt"]),
    st.binary(max_size=300) | st.binary(max_size=99).map(lambda b: b"PAR1" + b + b"PAR1")
    | st.text(alphabet="vehicle_id,time_sposition_m\n0123456789.-e\"", max_size=200).map(
        lambda text: b"vehicle_id,time_s,position_m\n" + text.encode()),
)  # fmt: skip
@QUICK
def test_any_bytes_as_data_are_refused_in_one_line(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    done = typed("plot", path, "--out", tmp_path / "a.png")
    assert done.returncode == 0 or (done.returncode == 1 and done.stderr.count("error: ") == 1), done.stderr


@given(
    st.binary(max_size=300) | st.just(b"[" * 100_000) | st.just(b'{"objects": ' * 50_000)
    | st.just(b'{"objects": [1' + b"0" * 5000 + b"]}")
    | st.recursive(st.none() | st.integers() | st.floats() | st.text(max_size=4), lambda x: st.lists(x, max_size=3)
                   | st.dictionaries(st.sampled_from(["position", "x", "y", "type", "valid", "geometry"]), x)).map(
        lambda x: __import__("json").dumps({"objects": [x], "roads": [x], "name": "a", "tl_states": x}).encode()),
)  # fmt: skip
@QUICK
def test_any_bytes_as_a_scenario_are_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    for name in ("a.json", "a.tfrecord"):
        path = tmp_path / name
        path.write_bytes(content)
        refused("predict", path, "--out", tmp_path / "out")
        assert not (tmp_path / "out" / "run.json").exists()


@pytest.mark.parametrize("command", ["filter", "fit"])  # simulate and reconstruct write by the same code
def test_a_full_disk_is_one_line(data: Path, tmp_path: Path, command: str) -> None:
    """Files cannot grow beyond a limit, which to a program is a full disk."""
    code = (
        "import resource, sys; from idm_env.cli import commands as cli\n"
        "cli.app([*sys.argv[1:-1], sys.argv[-1] + '-before'], standalone_mode=False)  # compiled loops are files too\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1200, 1200)); sys.argv[0] = 'idm-env'; cli.run()"
    )
    model = tmp_path / "model.yaml"
    model.write_text("effects: [idm, brakes]\n")
    more = ("--model", model) if command == "simulate" else ()
    given = map(str, (command, data, *more, "--out", tmp_path / "out"))
    done = subprocess.run([sys.executable, "-c", code, *given], capture_output=True, text=True, timeout=300)
    lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr[-3000:]
    assert len(lines) == 1 and "cannot be written" in lines[0] and "Free space" in lines[0], done.stderr[-3000:]
    assert not list((tmp_path / "out").rglob("*idm-env-part*"))


@pytest.mark.parametrize("seconds", [0.1, 0.4, 0.8, 1.4, 2.2])
def test_ctrl_c_while_modules_are_imported_is_one_line(data: Path, tmp_path: Path, seconds: float) -> None:
    given = ("-X", "importtime", "-m", "idm_env", "fit", data, "--out", tmp_path / "out")
    running = subprocess.Popen([sys.executable, *map(str, given)], stderr=subprocess.PIPE, text=True)
    assert running.stderr is not None
    for line in running.stderr:
        if line.split()[-1] == "idm_env.cli":  # the first import of the command itself
            break
    time.sleep(seconds)
    os.kill(running.pid, signal.SIGINT)
    _, words = running.communicate(timeout=120)
    said = [line for line in words.splitlines() if not line.startswith("import time:")]
    assert "Traceback" not in words and said and said[-1].startswith("interrupted"), words[-1500:]
    # Python ends by the signal itself where it met the interruption in code made from text; a shell says 130 to both.
    assert running.returncode in (130, -signal.SIGINT)


# -- checkpoints of agents -------------------------------------------------------------------------------------------


def test_a_hollow_checkpoint_of_an_agent_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "last.pt"
    policy = Policy(3)
    common.save(path, policy, "apg", {"task": "ring"}, {"update": 3})
    whole, content = path.read_bytes(), torch.load(path, weights_only=True)
    hollow: list[Any] = [{key: value for key, value in content.items() if key != name} for name in content]
    hollow += [
        {"schema": content["schema"]},
        {**content, "policy": {"made": {}, "state": {}}},
        {**content, "policy": {"made": 1}},
        [1],
    ]
    for broken in hollow:
        torch.save(broken, path)
        with pytest.raises(ValueError, match=r"broken.*without --resume") as told:
            common.load(path)
        assert "\n" not in str(told.value)
    for raw in (b"", whole[:-20], np.zeros(99).tobytes()):
        path.write_bytes(raw)
        with pytest.raises(ValueError, match=r"broken.*without --resume"):
            common.load(path)


@pytest.mark.parametrize(("name", "value"), [("learning_rate", "nan"), ("learning_rate", 0), ("clip", -1.0),
                                             ("cpu_seconds", ".inf")])  # fmt: skip
def test_a_number_of_an_agent_is_finite(tmp_path: Path, name: str, value: object) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(f"configures: agent\nagent: apg\n{name}: {value}\n")
    with pytest.raises(ValueError, match=rf"{name} = "):
        common.load_agent(path, apg.Arguments, "apg")
