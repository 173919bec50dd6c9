"""Every python block of README and of docs/ runs as it stands; blocks of one document share their names.

A block, python or yaml, whose first line is ``# file: NAME`` is also a file of that name in the folder in which the
document runs; every yaml block is one. Comments before a block: ``<!-- needs NAME -->`` leaves it out as long as
the package has no such name, ``<!-- not run: REASON -->`` always. Commands: see ``test_docs_commands.py``.
"""

from __future__ import annotations

import ast
import importlib
import json
import math
import re
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import polars as pl
import pytest
import torch

from benchmarks.tasks import teaches
from idm_env import IDM, Brakes, Lane, Replay, Simulator
from idm_env.data import synthetic
from idm_env.discovery.verdict import Verdict
from idm_env.model_file import Model, save_model
from idm_env.tasks import TASKS
from idm_env.types import Record
from tests.prediction import scenes

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs" / "jobs").glob("*.md"))]
INSIDE = ROOT / "idm_env" / "README.md"
BLOCK = re.compile(
    r"(?:<!-- (?P<marker>needs|not run):? (?P<told>[^\n]+?) -->\s*)?"
    r"^```(?P<kind>python|yaml)\n(?P<code>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)


class Block(NamedTuple):
    """A block: its first line, python or yaml, its marker and what that tells, and its text."""

    line: int
    kind: str
    marker: str
    told: str
    code: str


def blocks(path: Path) -> list[Block]:
    """Return every python and yaml block of a document."""
    text = path.read_text(encoding="utf-8")
    return [
        Block(
            text[: found.start("code")].count("\n") + 1,
            found["kind"],
            found["marker"] or "",
            found["told"] or "",
            found["code"],
        )
        for found in BLOCK.finditer(text)
    ]


def there_is(name: str) -> bool:
    """Tell whether the package has this name."""
    module, _, attribute = name.rpartition(".")
    return hasattr(importlib.import_module(module), attribute)


def my_csv(folder: Path) -> None:
    """Three platoons of a leader and two followers, with a hidden delay."""
    trajectories, _ = synthetic.generate(seed=4, runs=3, followers=2, seconds=40.0, effect="delay")
    trajectories.table.select("run_id", "vehicle_id", "leader_id", "time_s", "position_m", "speed_mps").write_csv(
        folder / "my.csv"
    )


def tired_csv(folder: Path) -> None:
    """Seven platoons whose drivers want to go slower by 0.3 % every second; 5 cm of noise."""
    fatigue = importlib.import_module("fatigue").Fatigue
    simulator = Simulator(Lane(), (IDM(), fatigue(), Brakes(), Replay()), dt=0.1)
    generator = torch.Generator().manual_seed(3)
    steps, tables = 1000, []

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    for run in range(7):
        params = simulator.defaults(dtype=torch.float64)
        params["fatigue"]["rate"] = torch.tensor(3e-3, dtype=torch.float64)
        params["idm"] = {name: x * torch.exp(0.1 * draw(4)) for name, x in params["idm"].items()}
        time = torch.arange(steps + 1, dtype=torch.float64) * 0.1
        phase = 6.28 * torch.rand(2, generator=generator, dtype=torch.float64)
        speed = 24.0 + 5.0 * torch.sin(time / 9.0 + phase[0]) + 4.0 * torch.sin(time / 23.0 + phase[1])
        position = 300.0 + torch.cumulative_trapezoid(speed, dx=0.1)
        accel = torch.gradient(speed, spacing=0.1)[0][1:]
        first = torch.tensor([True, False, False, False]).expand(steps, 4)
        leader = (x.unsqueeze(-1).expand(steps, 4) for x in (position, speed[1:], accel))
        start = 300.0 - 45.0 * torch.arange(4, dtype=torch.float64)
        state = simulator.state(start, torch.full((4,), float(speed[0]), dtype=torch.float64), params)
        _, kept = simulator.rollout(state, {"replay": Record(*leader, first)}, params, steps)
        for vehicle in range(4):
            tables.append(
                pl.DataFrame(
                    {
                        "run_id": f"run{run}",
                        "vehicle_id": vehicle,
                        "leader_id": vehicle - 1 if vehicle else None,
                        "time_s": time[1:].numpy(),
                        "position_m": (kept.position[:, vehicle] + 0.05 * draw(steps)).numpy(),
                        "length_m": 5.0,
                    },
                    schema_overrides={"leader_id": pl.Int64},
                )
            )
    pl.concat(tables).write_csv(folder / "tired.csv")


def result_model(folder: Path) -> None:
    """A saved model, as ``explain`` leaves one."""
    (folder / "result").mkdir()
    model = Model((IDM(), Brakes()), {"idm": {"time_gap": 1.2}})
    save_model(folder / "result" / "model.yaml", model)


def fit_model(folder: Path) -> None:
    """Drivers one by one, as ``fit --by driver`` leaves them."""
    (folder / "fit").mkdir()
    model = Model((IDM(), Brakes()), drivers={f"1/{i}": {"idm": {"time_gap": 1.1 + 0.2 * i}} for i in range(3)})
    save_model(folder / "fit" / "model.yaml", model)


def sparse_csv(folder: Path) -> None:
    """Two vehicles, a point a second."""
    table = synthetic.generate(seed=4, runs=1, followers=1, seconds=30.0)[0].table
    table.select("vehicle_id", "time_s", "position_m").gather_every(10).write_csv(folder / "sparse.csv")


def scene_json(folder: Path) -> None:
    """A scenario with two agents to predict."""
    (folder / "scene.json").write_text(json.dumps(scenes.as_json([0, 1])))


FILES = {
    "my.csv": my_csv, "result/model.yaml": result_model, "fit/model.yaml": fit_model, "tired.csv": tired_csv,
    "sparse.csv": sparse_csv, "scene.json": scene_json,
}  # fmt: skip
"""What blocks read, by the text that names it."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Work in an empty folder; modules read from there are gone afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.mark.slow
@pytest.mark.parametrize("path", [p for p in (*DOCUMENTS, INSIDE) if blocks(p)], ids=lambda p: p.stem)
def test_every_block_runs(path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, as somebody would type them, in a folder that has the files they read."""
    name = f"docs_{path.stem.replace('-', '_').lower()}"
    space = types.ModuleType(name)
    monkeypatch.setitem(sys.modules, name, space)
    made: set[str] = set()
    for line, kind, marker, told, code in blocks(path):
        if marker == "not run" or (marker == "needs" and not there_is(told)):
            continue
        if code.startswith("# file: "):
            (folder / code.splitlines()[0].removeprefix("# file: ")).write_text(code)
            importlib.invalidate_caches()
        if kind == "yaml":
            continue
        for file in [f for f in FILES if f in code and f not in made]:
            made.add(file)
            FILES[file](folder)
        exec(compile("\n" * (line - 1) + code, str(path), "exec"), space.__dict__)


def test_the_first_hour_runs(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The notebook, cell by cell, from another folder; it is kept without output."""
    monkeypatch.setenv("MPLBACKEND", "Agg")
    notebook = json.loads((ROOT / "examples" / "first_hour.ipynb").read_text(encoding="utf-8"))
    space = types.ModuleType("first_hour")
    monkeypatch.setitem(sys.modules, "first_hour", space)
    for number, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None
            exec(compile("".join(cell["source"]), f"cell {number}", "exec"), space.__dict__)
    told = capsys.readouterr().out
    assert "verdict: named, delay" in told
    human, agent = map(int, re.findall(r"return of an episode: human (\d+), agent (\d+)", told)[0])
    assert agent > human


def test_blocks_are_found_and_markers_give_a_reason() -> None:
    """No document's code escapes the test by how its fence is written."""
    assert blocks(ROOT / "docs" / "architecture.md")
    for path in (*DOCUMENTS, INSIDE):
        text = path.read_text(encoding="utf-8")
        assert text.count("```python") + text.count("```yaml") == len(blocks(path)), path.name
        assert all(b.code.startswith("# file: ") for b in blocks(path) if b.kind == "yaml"), path.name
        assert len(re.findall(r"^```", text, re.MULTILINE)) % 2 == 0, path.name
        assert len(re.findall("<!-- (?:needs|not run)", text)) == sum(bool(b.marker) for b in blocks(path)), path.name


@pytest.mark.parametrize("path", [*DOCUMENTS, INSIDE, ROOT / "CONTRIBUTING.md"], ids=lambda p: p.stem)
def test_files_that_documents_name_are_there(path: Path) -> None:
    """A file that was renamed or deleted is not sent to, and every link leads somewhere in a checkout."""
    text = path.read_text(encoding="utf-8")
    folders = "idm_env|tests|benchmarks|studies|examples|configs|agents|docs"
    named = set(re.findall(rf"\b((?:{folders})/[\w/.-]+\.\w+)", text))
    named |= {f"{path.parent.relative_to(ROOT)}/{link}" for link in re.findall(r"\]\((?!http|#)([^)#]+)", text)}
    missing = sorted(n for n in named if not (ROOT / n).exists())
    assert not missing, f"{path.name} names {missing}"


def sentences(path: Path) -> list[str]:
    """Return the sentences of a document's prose: no code, no tables, no headings, links as their text."""
    text = re.sub(r"^(```|:::).*?^\1$", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^(#|\|).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    parts = re.split(r"\n\s*\n|^- ", text, flags=re.MULTILINE)
    return [s for part in parts for s in re.split(r"(?<=[.:])\s+(?=[A-Z`*0-9])", " ".join(part.split())) if s]


def test_the_site_has_a_page_for_every_link_into_the_checkout() -> None:
    """docs/conf.py lets links to code lead to the pages that are made from it."""
    text = (ROOT / "docs" / "conf.py").read_text(encoding="utf-8")
    pages = ast.literal_eval(re.findall(r"^PAGES = (\{.*?^\})", text, re.MULTILINE | re.DOTALL)[0])
    assert all((ROOT / file).exists() for file in pages)
    linked = {
        (path.parent / link).resolve().relative_to(ROOT).as_posix()
        for path in DOCUMENTS if "docs" in path.parts
        for link in re.findall(r"\]\((\.\./[^)#]+)", path.read_text())
    }  # fmt: skip
    outside = {link for link in linked if not re.match("docs|studies", link)}
    pages = {file.rstrip("/") for file in pages}
    as_they_are = {"examples/motorway.py", "configs/motorway.yaml", "idm_env/README.md"}
    assert len(outside) > 5 and outside <= pages | as_they_are


WORDS = 15000
"""Of docs/: what a user needs. May be lowered, not raised; what was measured goes to studies/. README has 800."""


def test_the_documents_are_short() -> None:
    words = {str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").split()) for path in DOCUMENTS[1:]}
    print(sum(words.values()), words)
    assert sum(words.values()) <= WORDS, words


def test_the_first_pages_are_short() -> None:
    """A reader sees what the package is on one page, in sentences that are read once."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 120 and len(text.split()) <= 800
    assert (ROOT / "docs" / "ring.gif").stat().st_size <= 800_000
    assert all(path.stat().st_size <= 300_000 for path in (ROOT / "docs" / "tasks").iterdir())
    for name in ("README.md", "docs/index.md"):
        lengths = sorted((len(s.split()), s) for s in sentences(ROOT / name))
        assert lengths[len(lengths) // 2][0] <= 15 and lengths[-1][0] <= 35, f"{name}: {lengths[-1]}"


def test_seven_questions_are_answered_two_clicks_from_the_readme() -> None:
    """README leads to the first page of the site, and that to every answer, which has the words one looks for."""
    assert "](docs/index.md)" in (ROOT / "README.md").read_text(encoding="utf-8")
    first = (ROOT / "docs" / "index.md").read_text(encoding="utf-8").split("## Where to look")[1]
    rows = re.findall(r"^\| (.+\?) \| \[.+\]\(([^)#]+)#?([^)]*)\) \|$", first, re.MULTILINE)
    words = {
        "../idm_env/tasks/": "", "jobs/files.md": "position_m", "../idm_env/effects/": "",
        "architecture.md": "## Add a task", "jobs/train.md": "train_apg.py", "limits.md": "A GPU pays from",
        "cards.md": "## Cite",
    }  # fmt: skip
    assert [page for _, page, _ in rows] == list(words)
    for _, page, place in rows:
        if words[page]:  # the others are made with the site, and looked at there: test_pages.py
            text = (ROOT / "docs" / page).read_text(encoding="utf-8")
            assert words[page] in text and (not place or f"## {place.replace('-', ' ').capitalize()}" in text), page


def test_every_verdict_is_told_where_the_command_is() -> None:
    rows = re.findall(r"^\| `(\w+)` \| ", (ROOT / "docs/jobs/explain.md").read_text(), re.MULTILINE)
    assert sorted(rows) == sorted(verdict.value for verdict in Verdict)


def test_every_document_has_its_place_on_the_site() -> None:
    """Sphinx takes one that has none for an error, and so does this, at once."""
    text = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = {line for tree in re.findall(r"```\{toctree\}(.*?)```", text, re.DOTALL) for line in tree.split()}
    pages = {p.relative_to(ROOT / "docs").with_suffix("").as_posix() for p in DOCUMENTS if "docs" in p.parts}
    assert pages - {"index"} <= listed


def test_pages_of_tasks_are_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every table has as many cells in each row as in its head, and every page says what pays: so of all tasks."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    made = importlib.import_module("made_from_code")
    for name, text in made.environments().items():
        for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
            cells = {len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()}
            assert len(cells) == 1 and all(row.endswith("|") for row in table.splitlines()), (name, table)
        if name != "environments.md":
            assert re.search("^Reward[ ,]", text, re.MULTILINE), name


def test_every_example_has_a_picture_that_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """No grey placeholder in the gallery: of all examples, run there or not."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    names = {path.stem for path in (ROOT / "examples").glob("*.py")}
    assert set(importlib.import_module("gallery_of").FIGURES) == names
    assert {path.stem for path in (ROOT / "docs" / "examples").glob("*.png")} == names


def test_no_generated_table_has_an_empty_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of tasks, features and commands: every keyword, term and option has a default and a meaning."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    made = importlib.import_module("made_from_code")
    pages = {**made.environments(), "features.md": made.features(), "commands.md": made.commands()}
    empty = []
    for name, text in pages.items():
        below = False
        for line in text.splitlines():
            below = line.startswith("|") and (below or "---" in line)
            cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] if below else []
            empty += [f"{name}: {line}"] if "" in cells else []
    assert not empty, "\n".join(empty)


def test_the_table_of_skill_is_of_one_measure() -> None:
    """Humans are 0, and the best row of a task is 1; where nobody is better than they are there is no skill."""
    lines = (ROOT / "docs" / "skill.csv").read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines[1:]]
    assert {row[0] for row in rows} <= set(TASKS) and rows
    for task in {row[0] for row in rows}:
        skill = [(row[1], float(row[4].replace("–", "nan"))) for row in rows if row[0] == task]
        most = max((row for row in rows if row[0] == task), key=lambda row: float(row[3]))
        none = math.isnan(dict(skill)["human"])
        assert most[1] == "human" if none else dict(skill)["human"] == 0.0 and max(x for _, x in skill) == 1.0
    for task in ("ring", "follow", "platoon", "highway"):  # docs/environments.md says so
        assert teaches([row for row in rows if row[0] == task]), task
