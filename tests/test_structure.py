"""Imports point one way, and ``import idm_env`` stays light."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from datetime import date
from functools import cache
from pathlib import Path
from types import FrameType

import pytest
from hypothesis import HealthCheck, settings

import idm_env

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "idm_env"

ALLOWED = {
    "types": set(),
    "validation": set(),
    "extras": set(),
    "compat": set(),
    "backends": set(),
    "parameters": {"types", "validation"},
    "effects": {"compat", "types", "parameters", "validation", "jobs.import_file"},
    "roads": {"types", "validation"},
    "delay_buffer": {"types"},
    "step": {"types", "parameters", "effects", "roads", "delay_buffer"},
    "multilane": {"types", "roads", "step"},
    "simulator": {"compat", "types", "parameters", "step", "multilane", "backends"},
    "compiled": {
        "extras", "types", "effects", "roads", "delay_buffer", "step", "simulator", "backends", "validation",
        "multilane", "compat", "jobs.import_file",
    },
    "jobs": {"compat", "extras"},
    "reports": {"extras", "jobs"},
    "model_file": {
        "extras", "types", "parameters", "validation", "effects", "roads", "simulator", "jobs.storage", "jobs.trust",
    },
    "data": {"extras"},
    "fitting": {
        "types", "parameters", "effects", "roads", "simulator", "compiled", "data", "model_file", "reports", "metrics",
        "validation", "jobs", "extras", "multilane",
    },
    "drift": {
        "types", "parameters", "effects", "roads", "simulator", "compiled", "data", "model_file", "fitting", "jobs",
        "reports", "extras",
    },
}  # fmt: skip
"""What a part may import of the package; parts that are not named may import anything but what FORBIDDEN says."""

ROOMS = {
    "tools": {"compat", "extras", "jobs", "reports", "plot"},
    "traffic": {
        "types", "validation", "parameters", "effects", "roads", "delay_buffer", "step", "multilane", "simulator",
        "backends", "metrics", "model_file",
    },
    "compiled": {"compiled"},
    "measured data": {"data", "trajectories", "fitting", "drift", "discovery", "prediction"},
    "learning": {"tasks", "envs", "wrappers"},
    "faces": {"cli"},
}  # fmt: skip
"""The rooms of the house from the ground up, with what is in each; docs/architecture.md shows them."""

FORBIDDEN = {
    "tasks": {"envs", "fitting", "discovery", "wrappers"},
    "envs": {"fitting", "discovery", "wrappers"},
    "discovery": {"tasks", "envs", "wrappers"},
}
OUTSIDE = {"gymnasium": {"envs", "wrappers", "__init__"}, "pettingzoo": {"envs"}, "stable_baselines3": {"envs"}}


@cache
def parsed(path: Path) -> ast.Module:
    """Return the tree of a file, read once."""
    return ast.parse(path.read_text())


@cache
def imports(path: Path, typing: bool = False) -> set[str]:
    """Return the modules that a file imports, wherever in it; those that only a type checker reads if ``typing``.

    Of ``from package import module`` that is the module, since whoever imports a module runs its packages anyway.
    """
    names = set()
    tree = parsed(path)
    unread = set() if typing else {
        each
        for node in ast.walk(tree) if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for part in node.body for each in ast.walk(part)
    }  # fmt: skip
    for node in ast.walk(tree):
        if node in unread:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            full = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= full & MODULES.keys()
            names |= {node.module} if full - MODULES.keys() else set()
    return names


FILES = sorted(PACKAGE.rglob("*.py"))
MODULES = {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for p in FILES}


def misplaced(path: Path) -> set[str]:
    """Return what a file imports and may not."""
    mine = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    found = imports(path)
    names = {name.removeprefix("idm_env.") for name in found if name.startswith("idm_env.")}
    wrong = {name for name in names if name.split(".")[0] in FORBIDDEN.get(mine, set()) - {mine}}
    if mine in ALLOWED:
        wrong |= {name for name in names if not {name, name.split(".")[0]} & (ALLOWED[mine] | {mine})}
    return wrong | {name for name in found if mine not in OUTSIDE.get(name.split(".")[0], {mine})}


def test_imports_point_one_way() -> None:
    """As the design's layout says; gymnasium, pettingzoo and stable-baselines3 only at the faces."""
    assert {str(path.relative_to(PACKAGE)): wrong for path in FILES if (wrong := misplaced(path))} == {}


def part_of(name: str) -> str:
    """Return the top-level package or module that a module is of."""
    return name.split(".")[1] if "." in name else "__init__"


def ways_up() -> set[str]:
    """Return the imports from a room to one above it, and the parts that are in no room."""
    level = {part: floor for floor, parts in enumerate(ROOMS.values()) for part in parts}
    pairs = {(name, other) for name, path in MODULES.items() for other in imports(path) & MODULES.keys()}
    up = {
        f"{a} -> {b}"
        for a, b in pairs
        if {part_of(a), part_of(b)} <= level.keys() and level[part_of(a)] < level[part_of(b)]
    }
    return up | ({part_of(name) for name in MODULES} - level.keys() - {"__init__", "__main__"})


@cache
def arrows() -> set[tuple[str, str]]:
    """Return which top-level part imports which, what only a type checker reads included."""
    pairs = {
        (part_of(name), part_of(other))
        for name, path in MODULES.items()
        for other in imports(path, typing=True) & MODULES.keys()
    }
    return {pair for pair in pairs if pair[0] != pair[1]}


def circles() -> set[frozenset[str]]:
    """Return the pairs of files that import each other by way of others, what only a type checker reads included."""
    below = {name: (imports(path, typing=True) & MODULES.keys()) - {name} for name, path in MODULES.items()}

    @cache
    def reached(name: str) -> frozenset[str]:
        seen: set[str] = set()
        ahead = list(below[name])
        while ahead:
            if (other := ahead.pop()) not in seen:
                seen.add(other)
                ahead += below[other]
        return frozenset(seen)

    return {frozenset((a, b)) for a in below for b in reached(a) if a != b and a in reached(b)}


def floors(part: str) -> int:
    """Return how many files of a package stand on each other at the most: the longest chain of imports within it."""
    mine = {name: path for name, path in MODULES.items() if part_of(name) == part}

    @cache
    def height(name: str) -> int:
        return 1 + max((height(other) for other in (imports(mine[name]) & mine.keys()) - {name}), default=0)

    return max(map(height, mine))


def high_packages() -> set[str]:
    """Return the packages of more than twelve floors, each with its number."""
    high = {part: floors(part) for part in {part_of(name) for name in MODULES}}
    return {f"{part}: {count}" for part, count in high.items() if count > 12}


def functions_of_many_parameters() -> set[str]:
    """Return the functions of more than twenty parameters, each with their number."""
    return {
        f"{path.relative_to(PACKAGE)} {node.name}: {count}"
        for path in FILES
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.FunctionDef)
        and (count := sum(isinstance(each, ast.arg) for each in ast.walk(node.args))) > 20
    }


def file_names_twice() -> set[str]:
    """Return the names of files that several packages have."""
    names = Counter(path.name for path in FILES)
    return {name for name, count in names.items() if count > 1 and name != "__init__.py"}


def set_by_hand() -> list[str]:
    """Return the places of code that the formatter leaves alone, once for each."""
    return [str(path.relative_to(PACKAGE)) for path in FILES for _ in range(path.read_text().count("# fmt: skip"))]


NETWORKS = (
    *(f"compiled/kernels/{name}.py" for name in ("networks", "network_loops", "network_rows")),
    *(f"roads/{name}.py" for name in ("network", "network_demand", "journeys", "streets", "ways")),
    *(f"roads/sumo_{name}.py" for name in ("demand", "files", "network")),
    *(f"tasks/{name}.py" for name in ("network_task", "signals", "junction")),
    *("multilane/junctions.py", "fitting/network_job.py"),
    *(f"envs/{name}.py" for name in ("faces", "network_faces")),
    "effects/network_rules.py",
)
"""Files that networks of roads brought."""


def lines_of_code() -> range:
    """Return a range as long as all but networks has lines of code: no docstrings, comments and blank lines."""
    return range(sum(code_lines(path) for path in FILES if str(path.relative_to(PACKAGE)) not in NETWORKS))


def lines_of_networks() -> range:
    """Return a range as long as networks have lines of code."""
    return range(sum(code_lines(PACKAGE / name) for name in NETWORKS))


STEP = (
    *(f"envs/{name}.py" for name in ("moves", "transition", "lane_transition", "values", "worlds", "past")),
    *(f"compiled/kernels/{name}.py" for name in ("rows", "row_text", "past_in_place")),
    *(f"compiled/kernels/{name}.py" for name in ("lane_changes", "lane_change_loops")),
)
"""Files to be read by whoever changes how an environment steps."""


def lines_behind_a_step() -> range:
    """Return a range as long as these files have lines of code; docs/architecture.md tells both numbers."""
    lines = range(sum(code_lines(PACKAGE / name) for name in STEP))
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert f"{len(lines)} lines in {len(STEP)} files" in " ".join(text.split()), len(lines)
    return lines


def code_lines(path: Path) -> int:
    """Return the lines of a file that have code on them."""
    documents: set[int] = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node, clean=False):
            documents |= set(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    silent = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    with path.open("rb") as file:
        tokens = [token for token in tokenize.tokenize(file.readline) if token.type not in silent]
    return len({line for token in tokens[1:] for line in range(token.start[0], token.end[0] + 1)} - documents)


def classes_named_twice() -> set[str]:
    """Return the names of public classes that several files have."""
    names = Counter(
        node.name
        for path in FILES
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    return {name for name, count in names.items() if count > 1}


def top_level() -> set[str]:
    """Return the modules beside the packages."""
    return {path.stem for path in PACKAGE.glob("*.py") if not path.name.startswith("__")}


@pytest.mark.parametrize(
    ("count", "most"),
    [
        (top_level, 12),
        (lambda: top_level() | {path.parent.name for path in PACKAGE.glob("*/__init__.py")}, 28),
        (arrows, 164),
        (circles, 0),
        (ways_up, 0),
        (classes_named_twice, 7),
        (lines_behind_a_step, 2234),
        (lines_of_code, 35028),
        (lines_of_networks, 3043),
        (functions_of_many_parameters, 15),
        (high_packages, 1),
        (file_names_twice, 25),
        (set_by_hand, 99),
    ],
    ids=lambda x: getattr(x, "__name__", None),
)
def test_the_package_fits_into_one_head(count: Callable[[], Collection[object]], most: int) -> None:
    """What has to be kept in mind is counted; a bound may be lowered, and not raised."""
    found = count()
    print(f"{len(found)} (at most {most})")
    assert len(found) <= most, sorted(map(str, found))[:1000]


@pytest.mark.parametrize(("several", "most"), [(False, 3), (True, 13)], ids=["one lane", "several lanes"])
def test_a_state_passes_few_hands_in_a_step(several: bool, most: int) -> None:
    """Returns of a state from one step of a busy road to the next; of lanes with entries, exits and slow changes."""
    import torch

    from idm_env import IDM, Brakes, Lane, Simulator, effects
    from idm_env.multilane import demand
    from idm_env.roads import Lanes, lane_drop
    from idm_env.types import State

    if several:
        road = Lanes(3, length=400.0, ends=(lane_drop(2, at=300.0),), duration=3.0)
        changes = (effects.Mobil(), effects.MandatoryChange(), effects.Courtesy())
        simulator = Simulator(road, (IDM(), *changes, effects.SpeedLimit(), Brakes()))
        params = simulator.defaults()
        state = demand.waiting(simulator, demand.trips(dict.fromkeys(range(3), 1500.0), 60.0), params)
    else:
        simulator = Simulator(Lane(), (IDM(), Brakes()))
        params = simulator.defaults()
        state = simulator.state(torch.tensor([60.0, 30.0, 0.0]), torch.full((3,), 12.0), params)
    returned: list[str] = []

    def look(frame: FrameType, event: str, value: object) -> None:
        if event == "return" and isinstance(value, State) and str(PACKAGE) in frame.f_code.co_filename:
            returned.append(frame.f_code.co_name)

    longest: list[str] = []
    for _ in range(300 if several else 3):
        returned.clear()
        sys.setprofile(look)
        try:
            state = simulator.step(state, {}, params)
        finally:
            sys.setprofile(None)
        longest = max(longest, list(returned), key=len)
    assert len(longest) == most, longest


def test_the_reference_has_a_page_of_modules_that_there_are() -> None:
    """docs/made_from_code.py names them as text."""
    text = (ROOT / "docs" / "made_from_code.py").read_text(encoding="utf-8")
    listed = next(
        ast.literal_eval(node.value)
        for node in ast.parse(text).body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "MODULES"
    )
    assert {f"idm_env.{name}" for _, names in listed.values() for name in names} <= MODULES.keys()


def test_no_file_imports_itself_by_way_of_others() -> None:
    """Imports within functions count: whoever reads one file of a circle has to read all of it."""
    below = {name: (imports(path) & MODULES.keys()) - {name} for name, path in MODULES.items()}
    while free := {name for name, needs in below.items() if not needs & below.keys()}:
        below = {name: needs for name, needs in below.items() if name not in free}
    assert not below, f"in or above a circle: {sorted(below)}"


@pytest.mark.parametrize("name", ["simulator.py", "step.py", "delay_buffer.py"])
def test_the_simulator_does_not_know_the_model(name: str) -> None:
    """The word IDM does not occur in the simulator: behaviour is effects."""
    text = (PACKAGE / name).read_text().replace("idm_env", "")
    assert "IDM" not in text.replace("Add IDM() or drop one", "") and "idm" not in text


@cache
def words_of(path: Path) -> set[str]:
    """Return what a file's code names: classes, and the words of its strings, docstrings left out."""
    tree = parsed(path)
    documents = {
        node.body[0].value
        for node in ast.walk(tree)
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and isinstance(node.body[0], ast.Expr)
    }
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and type(node.value) is str and node not in documents:
            found |= set(node.value.split("."))
        elif isinstance(node, (ast.Name, ast.Attribute, ast.alias)):
            name = getattr(node, "id", None) or getattr(node, "attr", None) or getattr(node, "name", "")
            found |= {name} if name[:1].isupper() else set()
    return found


WITHOUT_EFFECTS = [
    path for part in ("compiled", "envs", "step.py", "simulator.py", "delay_buffer.py")
    for path in (sorted((PACKAGE / part).rglob("*.py")) or [PACKAGE / part])
]  # fmt: skip


def test_what_runs_effects_knows_none_of_them() -> None:
    """So every effect, and one that the package has never seen, is stepped, compiled and differentiated alike."""
    from idm_env.effects import ALL

    # ``second_leader`` is also a field of every scene, ``follower`` of links.
    names = ({*ALL, *(cls.__name__ for cls in ALL.values())}) - {"second_leader", "follower"}
    assert {path: known for path in WITHOUT_EFFECTS if (known := words_of(path) & names)} == {}


def test_fitting_knows_no_candidate_by_name() -> None:
    """What is fitted comes from the effects' own parameters."""
    from idm_env.effects import ALL, CANDIDATES

    allowed = {"batch.py": {"second_leader", "lateral"}}  # inputs and neighbours that it cannot give
    names = {*CANDIDATES, *(ALL[name].__name__ for name in CANDIDATES)}
    files = sorted((PACKAGE / "fitting").glob("*.py"))
    assert {p: known for p in files if (known := words_of(p) & names - allowed.get(p.name, set()))} == {}


def test_discovery_knows_no_effect_by_name() -> None:
    """What is known of an effect stands beside its equation."""
    from idm_env.effects import CANDIDATES

    files = sorted((PACKAGE / "discovery").glob("*.py"))
    assert {path: known for path in files if (known := words_of(path) & set(CANDIDATES))} == {}


def test_a_path_is_never_taken_for_a_pattern() -> None:
    """polars reads ab.csv where a[b].csv is asked for, unless ``glob=False`` tells it that a path is a path."""
    readers = {f"pl.{verb}_{kind}" for verb in ("read", "scan") for kind in ("csv", "parquet", "ipc", "ndjson")}
    calls = [
        (path, node)
        for path in FILES
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and ast.unparse(node.func) in readers
    ]
    careless = [(path, node.lineno) for path, node in calls if "glob=False" not in ast.unparse(node)]
    assert len(calls) > 5 and not careless, careless


def named_in(cls: type) -> set[str]:
    """Return the files of the package, its own left out, that name a class."""
    own = Path(sys.modules[cls.__module__].__file__ or "")
    return {
        str(path.relative_to(PACKAGE))
        for path in FILES
        if path != own and re.search(rf"\b{cls.__name__}\b", path.read_text()) and cls.__name__ in words_of(path)
    }


def test_what_is_added_to_the_package_is_named_in_few_of_its_files() -> None:
    """An effect in none, a task in two: its class where tasks are listed, its name where ids are registered."""
    from idm_env.effects import ALL, CANDIDATES
    from idm_env.envs.network_faces import KINDS
    from idm_env.tasks import ON_NETWORKS, TASKS

    for name in CANDIDATES:
        assert named_in(ALL[name]) == set(), name
    assert ({*TASKS}, ON_NETWORKS) == ({*idm_env._TASKS}, idm_env._ON_NETWORKS)
    assert (*KINDS,) == ON_NETWORKS
    for task in TASKS.values():
        heirs = {str(Path(sys.modules[cls.__module__].__file__ or "").relative_to(PACKAGE)) for cls in TASKS.values()
                 if issubclass(cls, task)}  # fmt: skip
        assert named_in(task) - heirs == {"tasks/__init__.py"}, task


STUDIES = sorted(p for p in (ROOT / "studies").iterdir() if p.is_dir())


@pytest.mark.parametrize("folder", STUDIES, ids=lambda p: p.name)
def test_a_study_is_frozen_with_its_date_its_commit_and_its_outcome(folder: Path) -> None:
    """And with its script, or the commands of the checkout that make its tables, and all that it links to."""
    text = (folder / "README.md").read_text(encoding="utf-8")
    day = date.fromisoformat(folder.name[:10])
    assert f"\nDate: {day.day} {day:%B %Y}. " in text and re.search(r"\b[Cc]ommit:? [0-9a-f]{7}\b", text)
    assert "\n**Outcome.** " in text and "\n| --- |" in text.replace("|---|", "| --- |")
    names = re.findall(r"`python -m ((?:benchmarks|agents)\.\w+)", text)
    assert list(folder.glob("*.py")) or any((ROOT / f"{name.replace('.', '/')}.py").exists() for name in names)
    missing = [to for to in re.findall(r"\]\((?!http)([^)#]+)", text) if not (folder / to).exists()]
    assert not missing


def test_nobody_imports_a_study() -> None:
    """What is frozen is run at its commit."""
    folders = ("idm_env", "agents", "benchmarks", "examples", "tests")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    assert len(files) > 300
    assert not [path for path in files if re.search(r"^\s*(?:from|import) studies\b", path.read_text(), re.MULTILINE)]


PRIVATE = (
    r"getrefcount|_getframe|currentframe|\._processes|\btorch\._|forward_ad\._|numba\.config"
    r"|numba\.core(?!( import cgutils|\.typing\.templates import signature)$)"
)
"""Of libraries; numba documents those two for extensions of its own."""


def test_private_ground_of_libraries_stands_in_one_file() -> None:
    """So that a new version of a library breaks one file, which says why it stands there, and what was tried."""
    assert [p.name for p in FILES if re.search(PRIVATE, p.read_text(), re.MULTILINE)] == ["compat.py"]


def test_importing_the_package_imports_no_torch_and_registers_the_environment() -> None:
    """Quick to import, ready for gym.make."""
    code = (
        "import sys, idm_env, gymnasium; assert 'torch' not in sys.modules, 'torch'; "
        "assert 'DiffIDM-v0' in gymnasium.registry; idm_env.Simulator; assert 'torch' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_suite_has_one_profile_of_hypothesis() -> None:
    """A busy machine fails no property: no deadline, no check of how quickly examples are drawn, in any test."""
    whole = settings.default
    assert whole is not None and whole.deadline is None
    assert HealthCheck.too_slow in whole.suppress_health_check
    tests = [path for path in sorted((ROOT / "tests").rglob("*.py")) if path.name != "conftest.py"]
    own = [keyword.arg for path in tests for node in ast.walk(parsed(path))
           if isinstance(node, ast.Call) for keyword in node.keywords]  # fmt: skip
    assert len(own) > 1000 and not {"deadline", "suppress_health_check"} & set(own)


def contracts() -> Iterator[tuple[str, ast.FunctionDef, str]]:
    """Yield every public function with its place and all that is said of it: by itself, its classes and its module."""
    trees = {path: parsed(path) for path in FILES}
    classes = {node.name: node for tree in trees.values() for node in tree.body if isinstance(node, ast.ClassDef)}

    def lineage(cls: ast.ClassDef) -> Iterator[ast.ClassDef]:
        yield cls
        for base in cls.bases:
            above = classes.get(ast.unparse(base).split("[")[0].split(".")[-1])
            if above is not None and above is not cls:
                yield from lineage(above)

    for path, tree in trees.items():
        place, said = str(path.relative_to(PACKAGE)), ast.get_docstring(tree) or ""
        for node in tree.body:
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                yield place, node, f"{ast.get_docstring(node) or ''} {said}"
            elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                for method in (m for m in node.body if isinstance(m, ast.FunctionDef) and not m.name.startswith("_")):
                    above = [
                        ast.get_docstring(each) or "" for cls in lineage(node)
                        for each in (cls, *(m for m in cls.body if getattr(m, "name", "") == method.name))
                        if isinstance(each, (ast.ClassDef, ast.FunctionDef))
                    ]  # fmt: skip
                    yield place, method, f"{ast.get_docstring(method) or ''} {' '.join(above)} {said}"


def test_a_public_function_that_raises_says_what() -> None:
    """A command's docstring is its help, and its errors are lines for users; a hook without a body is abstract."""
    silent = []
    for place, function, said in contracts():
        raised = {
            ast.unparse(node.exc.func if isinstance(node.exc, ast.Call) else node.exc)
            for node in ast.walk(function) if isinstance(node, ast.Raise) and node.exc is not None
        }  # fmt: skip
        raised = {name for name in raised if name[:1].isupper()} - {"NotImplementedError"}
        if raised and not place.startswith("cli/") and not any(name in said for name in raised):
            silent.append((place, function.name, raised))
    assert not silent


SHAPE = (
    r"(?<!\w)\[(?![-−0]|[^\]]*\.\d)[^\]\"']*\]|``\([^)]*\)``|[Ss]hape|elementwise|\beach vehicle"
    r"|\b(?:per|one for|one per) (?:vehicle|row|driver)"
)
"""Brackets after a name are an element of it, and those from 0, a negative number or to a fraction an interval."""
WITHOUT_SHAPES = 0
"""Public functions with tensors or arrays of which nothing says a shape; the number may be lowered, and not raised."""


def test_public_functions_with_tensors_say_their_shapes() -> None:
    """In their docstring, that of their class or one above it, or once for a module."""
    silent = [
        (place, function.name) for place, function, said in contracts()
        if re.search(r"\b(?:Tensor|ndarray)\b", " ".join(
            ast.unparse(x) for x in (*(a.annotation for a in (*function.args.args, *function.args.kwonlyargs)),
                                     function.returns) if x
        )) and not re.search(SHAPE, said)
    ]  # fmt: skip
    assert len(silent) <= WITHOUT_SHAPES, silent


NO_NOUN = r"alone|asked|at|beside|drawn|found|given|kept|known|made|of|said|there|told|wanted|whose"
"""Participles and adverbs that say nothing of what a thing is."""


def bindings(path: Path) -> Iterator[str]:
    """Yield what functions bind, once for each around it; parameters of public ones are keywords that users know."""
    for function in ast.walk(parsed(path)):
        if isinstance(function, (ast.FunctionDef, ast.Lambda)):
            names = {n.id for n in ast.walk(function) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
            if isinstance(function, ast.Lambda) or function.name.startswith("_"):
                names |= {a.arg for a in ast.walk(function.args) if isinstance(a, ast.arg)}
            yield from names


def test_a_local_name_says_what_the_thing_is() -> None:
    """A list, a number or a sentence has a noun of the field, in agents and benchmarks too."""
    live = [*FILES, *(ROOT / "agents").glob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]
    assert [(p.name, name) for p in live for name in bindings(p) if re.fullmatch(NO_NOUN, name)] == []


RIDDLES = (
    r"_?(?:above|again|ahead|alone|along|around|asked|at|back|begun|behind|below|beside|between|beyond|by|chosen|counted|"
    r"drawn|driven|entered|found|given|here|imported|into|kept|known|led|made|now|of|off|on|placed|said|seen|taken|then|"
    r"there|told|touched|wanted|wished|with|within|without|written|stepping)"
)
"""Prepositions, adverbs and participles: a function is named by a verb, or by the noun that it returns."""
PRONOUN = re.compile(
    r"\b(?:of|for|to|by|with|from|behind|beside|and|or|than|that|returns?|tells?|says?),? (?:who|what|whose|whoever)\b"
    r"|^(?:who|what|whose|whoever)\b", re.IGNORECASE
)  # fmt: skip
"""A pronoun where the field has a noun, with a shape and a unit."""


def documented() -> Iterator[tuple[str, str, str]]:
    """Yield file, name and the first line of the docstring of every function, class and module."""
    for path in FILES:
        for node in ast.walk(parsed(path)):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
                first = (ast.get_docstring(node) or "").split("\n")[0]
                yield str(path.relative_to(PACKAGE)), getattr(node, "name", ""), first


def functions_named_by_riddles() -> list[str]:
    """Return functions whose names are neither a verb nor a noun, one entry each."""
    return [f"{place} {name}" for place, name, _ in documented() if re.fullmatch(RIDDLES, name)]


def sentences_without_a_noun() -> list[str]:
    """Return first lines of docstrings with a pronoun for a noun, one entry each."""
    return [f"{place} {name}: {first}" for place, name, first in documented() if PRONOUN.search(first)]


@pytest.mark.parametrize(
    ("offenders", "most"),
    [(functions_named_by_riddles, 133), (sentences_without_a_noun, 270)],
    ids=["names", "sentences"],
)
def test_names_and_docstrings_are_words_of_the_field(offenders: Callable[[], list[str]], most: int) -> None:
    """A bound may be lowered, and not raised."""
    found = offenders()
    print(f"{len(found)} (at most {most})")
    assert len(found) <= most, found[:20]
