"""Pages that are made from the code at every build: tasks, effects, commands, API; examples: gallery_of.py.

``python docs/made_from_code.py`` draws the pictures of docs/jobs/: what the commands' reports show of generated data.
"""

from __future__ import annotations

import dataclasses
import html
import inspect
import re
import textwrap
from functools import lru_cache
from pathlib import Path
from typing import Any

import gallery_of
import torch

ROOT = Path(__file__).resolve().parents[1]
JOBS = ("explain", "fit", "filter", "reconstruct", "predict", "simulate")
MODULES = {
    "core": ("Simulate", ("simulator", "types", "parameters", "roads")),
    "effects": ("Effects", ("effects",)),
    "environments": ("Environments", ("envs.gym", "envs.vector", "envs.pettingzoo", "metrics")),
    "tasks": ("Tasks", ("tasks",)),
    "data": ("Read and generate data", ("data", "data.episode", "data.synthetic", "model_file")),
    "fitting": ("Calibrate", ("fitting.fit", "fitting.job", "fitting.options")),
    "discovery": (
        "Find what a model lacks",
        ("discovery.discover", "discovery.finish", "discovery.sets", "drift.forecast"),
    ),
    "trajectories": ("Filter, reconstruct, predict", ("trajectories.files", "prediction.files")),
    "work": (
        "Long work, pictures and reports",
        (
            "reports.plot",
            "reports.diagrams",
            "reports.page",
            "jobs.executor",
            "jobs.storage",
            "jobs.shards",
            "jobs.progress",
        ),
    ),
}
"""Pages of the reference by job, those that everything else needs first."""


def write(folder: Path) -> None:
    """Write all of them under ``folder/generated``, only what changed, so that a second build is quick."""
    out = folder / "generated"
    for name in ("pictures", "tasks", "api"):
        (out / name).mkdir(parents=True, exist_ok=True)
    pages = {
        **environments(), "features.md": features(), "effects.md": effects(out / "pictures"), "commands.md": commands(),
        **api(),
    }  # fmt: skip
    for name, text in pages.items():
        path = out / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    gallery_of.examples(ROOT)


# -- environments ----------------------------------------------------------------------------------------------------


def environments() -> dict[str, str]:
    """Return the page of every task by its name, and their index, ``environments.md``."""
    from idm_env.tasks import TASKS

    lines = [
        "# Tasks", "",
        '`gymnasium.make("DiffIDM-v0", task=NAME, …)`; `make_vec` for a native batch; `idm_env.envs.pettingzoo` for '
        "one agent per controlled vehicle. Every task has a page with its picture, spaces, observation, reward, ends "
        "and keywords.", "",
    ]  # fmt: skip
    pages = {}
    for name, cls in TASKS.items():
        pages[f"tasks/{name}.md"] = "\n".join(_environment(name, cls)) + "\n"
        lines += [f"**[{name}](tasks/{name}.md).** {_described(cls)[0]}", "", f"![{name}](../tasks/{name}.png)", ""]
    lines += [
        "## Keywords of every task", "", "Each is a keyword of `make`, and may stand in YAML.", "",
        *_keywords(_base(TASKS["ring"]), None), "", "```{toctree}", ":hidden:", "",
        *(f"tasks/{name}" for name in TASKS), "```",
    ]  # fmt: skip
    return pages | {"environments.md": "\n".join(lines) + "\n"}


def _base(cls: type) -> type:
    return next(c for c in cls.__mro__ if c.__name__ == "Task")


def _environment(name: str, cls: Any) -> list[str]:
    from idm_env import _task_id

    first, parts = _described(cls)
    if not any("Reward" in part for part in parts):  # what its kind says holds for it
        kind = next(c for c in cls.__mro__[1:] if "Reward, " in (c.__doc__ or ""))
        parts += [_described(kind)[0], *_described(kind)[1]]
    lines = [f"# {name}", "", first, "", f"![After 40 s without commands](../../tasks/{name}.png)", ""]
    if (ROOT / "docs" / "tasks" / f"{name}.gif").exists():
        agent = "APG" if name == "replay" else "the searched rule"
        lines += [f"![Human drivers, and {agent} below as an agent](../../tasks/{name}.gif)", ""]
        lines += [
            f"*Six times as fast: human drivers beside the searched rule (`python docs/task_pictures.py {name}`).*",
            "",
        ]
    # Observation, reward and end are looked for, so each has a paragraph of its own.
    lines += [re.sub(r"(?<=[.)]) (?=Reward[ ,]|Terminated )", "\n\n", paragraph) + "\n" for paragraph in parts]
    lines += [
        f'```text\nenv = gymnasium.make("{_task_id(name)}")  # or "DiffIDM-v0", task="{name}"\n```',
        "",
        *_faces(name),
    ]
    own = _keywords(cls, _base(cls))
    if own:
        lines += ["## Keywords", "", *own]
    return [*lines, "Those that every task has: [tasks](../environments.md#keywords-of-every-task).", ""]


def _faces(name: str) -> list[str]:
    """Return spaces, observation, action, reward and ends of a task as it is by default."""
    import gymnasium

    env: Any = gymnasium.make("DiffIDM-v0", task=name)
    task = env.unwrapped.task
    lines = [
        "## Spaces", "",
        f"| | by default |\n| --- | --- |\n| observation | {_space(env.observation_space)} |\n"
        f"| action | {_space(env.action_space)} |", "",
        "## Observation", "",
        "Of each agent. An entry is divided by its scale, unless `observation=\"raw\"`.", "",
        "| entry | unit | divided by | lowest | highest |", "| --- | --- | --- | --- | --- |",
    ]  # fmt: skip
    lines += [_feature_row(each.name, each.feature) for each in task.observed]
    actions = ", ".join(f"`{c}`" for c in task.commands)
    low, high = task.command_limits
    return [
        *lines, "",
        "## Action", "",
        f"Per agent: {actions} in [−1, 1]; −1 and 1 command {low:g} and {high:g} m/s².", "",
        "## Reward", "",
        *_rewards(task), "",
        *_skill(name),
        "## Ends", "",
        f"An episode is terminated where vehicles touch, and truncated after {task.horizon} steps of "
        f"{task.step_time:g} s.", "",
    ]  # fmt: skip


def _rewards(task: Any) -> list[str]:
    """Return the terms of a task's rewards, with the bounds of a step."""
    from idm_env.tasks.reward_terms import Weighted

    lines = ["| `reward=` | a step pays | sum of |", "| --- | --- | --- |"]
    for name, terms in task.own_rewards.items():
        low, high = Weighted(tuple(terms.items())).reward_range
        lines.append(f"| `{name}` | {low:g} to {high:g} | {', '.join(f'{w:g} `{t.name}`' for t, w in terms.items())} |")
    return [*lines, "", "A crash ends the episode, and pays nothing more."]


def _space(space: Any) -> str:
    """Return a box in one line: its shape, and its bounds where one pair is all."""
    low, high = ({float(x) for x in bound.flat} for bound in (space.low, space.high))
    one = len(low) == len(high) == 1
    bounds = f"{low.pop():g}, {high.pop():g}, " if one else ""
    told = "" if one else "; bounds are those below, over their scales"
    return f"`Box({bounds}{space.shape}, {space.dtype})`{told}"


def _feature_row(name: str, feature: Any) -> str:
    return f"| `{name}` | {feature.unit or '–'} | {feature.scale:g} | {feature.low:g} | {feature.high:g} |"


def features() -> str:
    """Return the page of what every task may observe, and what it may be rewarded for."""
    from idm_env.tasks import FEATURES, REWARD_TERMS

    lines = [
        "# Features and reward terms", "",
        "Every task takes them by keyword and in YAML. Those of one's own: "
        "[add one](../architecture.md#add-a-feature-or-a-reward-term).", "",
        "## Features", "",
        '`observation={"features": ["speed", "gap"], "vehicles": 2}` takes both of the agent, and both of its leader '
        "as `speed_ahead_1` and `gap_ahead_1`. A vehicle without a leader is its own leader there.", "",
        "| feature | meaning | unit | divided by | lowest | highest |", "| --- | --- | --- | --- | --- | --- |",
    ]  # fmt: skip
    for name, each in FEATURES.items():
        row = _feature_row(name, each).replace(" | ", f" | {_meaning(each.read)} | ", 1)
        lines.append(row)
    lines += [
        "", "## Reward terms", "", '`reward={"speed": 0.2, "effort": -4.0}` pays the sum of weights times terms.', "",
        "| term | meaning | unit | lowest | highest |", "| --- | --- | --- | --- | --- |",
    ]  # fmt: skip
    for name, term in REWARD_TERMS.items():
        lines.append(f"| `{name}` | {_meaning(term.of)} | {term.unit or '–'} | {term.low:g} | {term.high:g} |")
    return "\n".join(lines) + "\n"


def _meaning(function: Any) -> str:
    """Return the docstring of what reads a feature, as Markdown in a cell of a table."""
    text = " ".join(inspect.cleandoc(function.__doc__ or "").split()).removeprefix("Return ").rstrip(".")
    return text.replace("``", "`").replace("|", "\\|")


ROWS = {
    "human": "*Human* is `step(None)`.",
    "rule": "*Rule* is IDM's formula as commands, on open roads less a human's, its numbers found by returns alone.",
    "PPO": "*PPO* is the ten lines of README, the last policy of each seed.",
    "tuned PPO": "*Tuned PPO* has 64 environments, γ 0.98, λ 0.95, 128 × 128 units, a learning rate that falls "
    "from 0.001, and begins with a spread of commands of 0.37.",
    "APG": "*APG* are gradients through windows of traffic, the last policy of each seed.",
    "oracle": "*Oracle* is the rule with the numbers that are best in each of these episodes.",
    "planner": "*Planner*, in the first 64 episodes: every 20 s the one of four actions under which a copy of the "
    "world, with the arrivals to come and other drivers' noise, pays most in 200 s.",
}
"""What rows of a table of skill are."""


def _skill(name: str) -> list[str]:
    """Return the table of skill of a task, as ``benchmarks.tasks`` measured it; nothing where it was not."""
    rows = [line.split(",") for line in (ROOT / "docs" / "skill.csv").read_text(encoding="utf-8").splitlines()[1:]]
    mine = [row[1:] for row in rows if row[0] == name]
    if not mine:
        return ["## Skill", "", f"Not measured yet: `python -m benchmarks.tasks {name}`.", ""]
    from benchmarks.tasks import GIVEN, NOISY, SLOW, episodes_of

    told = " ".join(words for row, words in ROWS.items() if row in {line[0] for line in mine})
    if name in NOISY:
        told += f" *Broken down* are episodes that return less than {SLOW:g} of human drivers' upper quartile."
    with_keywords = "".join(f", `{keyword}={value}`" for keyword, value in GIVEN.get(name, {}).items())
    return [
        "## Skill", "", f"(return − human)/(best row − human), {episodes_of(name)} fresh episodes{with_keywords}, ± 95 "
        "% of the paired difference; none where no row is above human.", "",
        "| row | seed | return | skill | ± | crashes | broken down | CPU s |", f"|{' --- |' * 8}",
        *(f"| {' | '.join(row)} |" for row in mine), "",
        f"{told} `python -m benchmarks.tasks {name}`, 2026-11-27, one thread, no GPU.", "",
    ]  # fmt: skip


def _described(cls: Any) -> tuple[str, list[str]]:
    """Return the first sentence of a docstring and its paragraphs up to its arguments, as Markdown."""
    text = inspect.cleandoc(cls.__doc__ or "")
    text = re.split(r"\n\s*(?:Args|Raises|Attributes):\n", text)[0].replace("``", "`")
    paragraphs = [" ".join(p.split()) for p in text.split("\n\n") if p.strip()]
    return paragraphs[0], paragraphs[1:]


def _keywords(cls: Any, base: Any) -> list[str]:
    """Return the keywords of a task, or those that it has beside its base, with their defaults and meanings."""
    told = _arguments(cls)
    common = {} if base is None else _arguments(base)
    known = set() if base is None else {f.name for f in dataclasses.fields(base)}
    fields = [f for f in dataclasses.fields(cls) if f.name not in known or told.get(f.name) != common.get(f.name)]
    if not fields:
        return []
    lines = ["| keyword | default | meaning |", "| --- | --- | --- |"]
    for f in fields:
        default = "" if f.default is dataclasses.MISSING else f"`{f.default!r}`"
        meaning = told.get(f.name, "").replace("|", "\\|")
        lines.append(f"| `{f.name}` | {default} | {meaning} |")
    return [*lines, ""]


def _arguments(cls: Any) -> dict[str, str]:
    """Return what the docstrings of a class and its bases say of each argument, the class's own first."""
    told: dict[str, str] = {}
    for kind in reversed(cls.__mro__):
        found = re.search(r"\nArgs:\n(.*?)(?:\n\S|\Z)", inspect.cleandoc(vars(kind).get("__doc__") or ""), re.DOTALL)
        for name, meaning in re.findall(r"(?m)^    ?(\w+): ((?:.|\n(?!    ?\w+: ))*)", found[1] if found else ""):
            told[name] = " ".join(meaning.split()).replace("``", "`")
    return told


# -- effects ---------------------------------------------------------------------------------------------------------


def effects(pictures: Path) -> str:
    """Return the catalogue, each effect with its picture where a platoon shows it."""
    from idm_env.effects import ALL

    kinds: dict[str, dict[str, Any]] = {}
    for name, cls in ALL.items():
        kinds.setdefault(_kind(cls), {})[name] = cls
    lines = [
        "# Catalogue of effects", "", EQUATIONS, "",
        "Made from the classes: what stands here stands beside the equation. Pictures: the third driver of a platoon "
        "whose first brakes and accelerates again, plain (grey) and with the effect (blue); what an effect does not "
        "change is not drawn.", "",
        "| behaviour | effects |", "| --- | --- |",
    ]  # fmt: skip
    for kind, members in kinds.items():
        lines.append(f"| {kind} | {', '.join(f'[{_titled(n, c)}](#effect-{n})' for n, c in members.items())} |")
    for kind, members in kinds.items():
        lines += ["", f"## {kind}", ""]
        for name, cls in members.items():
            lines += _effect(name, cls, pictures)
    return "\n".join(lines) + "\n"


EQUATIONS = """<style>
.eq { font-family: "STIX Two Math", "Cambria Math", "Times New Roman", serif; font-size: 1.08em }
p.eq { margin: 1em 1.5em; line-height: 1.9; overflow-x: auto }
.eq sub, .eq sup { line-height: 0 }
</style>"""


def typeset(text: str) -> str:
    """Return an equation as HTML: variables in italics, indices and powers in their places."""
    text = re.sub(
        r"(?:Δ?[a-zA-Zα-ω]\u0302?|Δ)(?![a-zA-Zα-ω])(?<![a-zA-Zα-ω]{2})", r"<i>\g<0></i>", html.escape(text, quote=False)
    )
    for mark, tag in (("_", "sub"), (r"\^", "sup")):
        text = re.sub(rf"{mark}\(([^()]*)\)|{mark}(<i>.</i>|\w+)", rf"<{tag}>\1\2</{tag}>", text)
    text = re.sub(r"</i>(\d)", r"</i><sub>\1</sub>", text)
    for sign in "*[]_`|":  # Markdown reads what stands between tags
        text = text.replace(sign, f"&#{ord(sign)};")
    return text


def _inline(paragraph: str) -> str:
    """Return a paragraph with the equations among its code typeset."""

    def shown(found: re.Match[str]) -> str:
        code = found[1]
        equation = " " in code and not re.match(r"[A-Z]\w+\(", code)
        return f'<span class="eq">{typeset(code)}</span>' if equation else found[0]

    return re.sub("`([^`]+)`", shown, paragraph)


def _kind(cls: Any) -> str:
    """Return what drivers do in effects of one module: the first words of what it says of itself."""
    told = (inspect.getmodule(cls).__doc__ or "").strip().split("\n")[0]  # type: ignore[union-attr]
    return re.split(r" \(|[:,]|\.$", told)[0]


def _titled(name: str, cls: Any) -> str:
    return str(cls.title or name.replace("_", " "))


def _effect(name: str, cls: Any, pictures: Path) -> list[str]:
    effect = cls()
    title = _titled(name, cls)
    lines = [f"(effect-{name})=", f"### {title}", ""]
    lines += [f"`{name}`, class `idm_env.effects.{cls.__name__}`; hook `{cls.hook}`.", ""]
    paragraphs = []
    doc = inspect.cleandoc(cls.__doc__ or "").replace("``", "`")
    for paragraph in (part.strip("\n") for part in re.sub(r"\n?::\n", "\n", doc).split("\n\n")):
        if paragraph.startswith("    "):
            rows = [typeset(row) for row in textwrap.dedent(paragraph).splitlines()]
            paragraphs += [f'<p class="eq">{"<br>".join(rows)}</p>', ""]
        elif paragraph.strip():
            paragraphs += [_inline(" ".join(paragraph.split())), ""]
    if cls.equation and not any('class="eq"' in line for line in paragraphs):
        paragraphs[2:2] = [f'<p class="eq">{typeset(cls.equation)}</p>', ""]
    lines += paragraphs
    if effect.parameters:
        lines += [
            "| parameter | symbol | unit | default | lowest | highest | null |",
            "| --- | --- | --- | --- | --- | --- | --- |",
        ]
        for p in effect.parameters:
            null = "–" if p.null is None else f"{p.null:g}"
            lines.append(f"| `{p.name}` | {p.symbol} | {p.unit} | {p.default:g} | {p.low:g} | {p.high:g} | {null} |")
        lines.append("")
    if cls.looks_like:
        lines += [f"**Looks like** {', '.join(cls.looks_like)}. **Told by** {cls.told_by}.", ""]
    said = [text.replace("{law}", "IDM") for text in cls.wording]
    told = [f"*{text}* ({where} its null)" for text, where in zip(said, ("below", "above"), strict=True) if text]
    if told:
        lines += [f"In a report: {', '.join(told)}.", ""]
    lines += [f"Source: {source}\n" for source in cls.sources]
    if response(effect, pictures / f"{name}.png"):
        lines += [f"![Response with and without {title}](pictures/{name}.png)", ""]
    return lines


DT, STEPS = 0.1, 450


@lru_cache(maxsize=1)  # that without an effect is every picture's
def _plain() -> Any:
    return _rolled(None)


def _platoon(added: Any) -> Any:
    """Return the motion of a platoon behind a leader who brakes; None where an effect takes what a lane has not."""
    try:
        return _plain() if added is None else _rolled(added)
    except (ValueError, KeyError, RuntimeError, TypeError):
        return None


def _rolled(added: Any) -> Any:
    from idm_env import IDM, Brakes, Lane, Replay, Simulator
    from idm_env.compiled.kernels import dispatch
    from idm_env.effects import CarFollowing
    from idm_env.types import Record

    vehicles = 4
    time = DT * torch.arange(STEPS + 1, dtype=torch.float64)
    speed = 18.0 - 9.0 * torch.exp(-(((time - 20.0) / 5.0) ** 2)) + 2.0 * torch.sin(time / 9.0)
    front = 300.0 + torch.cumulative_trapezoid(speed, dx=DT)
    accel = torch.gradient(speed, spacing=DT)[0]
    position = 300.0 - 32.0 * torch.arange(vehicles, dtype=torch.float64)
    first = (torch.arange(vehicles) == 0).expand(STEPS, vehicles)
    record = Record(*(x.unsqueeze(-1).expand(STEPS, vehicles) for x in (front, speed[1:], accel[1:])), first)
    following = added if isinstance(added, CarFollowing) else IDM()
    more = () if added is None or following is added else (added,)
    simulator = Simulator(Lane(), (following, *more, Brakes(), Replay()), dt=DT)
    params = simulator.defaults(dtype=torch.float64)
    for p in () if added is None else added.parameters:
        if p.null is not None and p.default == p.null:
            value = (*p.starts, 0.5 * (p.null + (p.high if abs(p.high) < 1e6 else p.null + 1.0)))[0]
            params[added.name][p.name] = torch.tensor(float(value), dtype=torch.float64)
    start = simulator.state(position, torch.full_like(position, float(speed[0])), params)
    inputs = simulator.drawn(start.gap, {"replay": record}, STEPS, seed=3)
    with dispatch.off():  # compiling each set of effects would take longer than all these steps
        return simulator.rollout(start, inputs, params, STEPS)[1]


def response(effect: Any, path: Path) -> bool:
    """Draw gap and speed of a driver with the effect and without it; False where there is nothing to see."""
    from matplotlib.figure import Figure

    if path.exists() and path.stat().st_mtime > Path(inspect.getfile(type(effect))).stat().st_mtime:
        return True
    if effect.hook == "change" or effect.name in ("replay", "brakes", "idm", "control", "imagined"):
        return False
    kept = [_platoon(None), _platoon(effect)]
    if kept[1] is None:
        return False
    if torch.equal(kept[0].gap[:, 2], kept[1].gap[:, 2]):
        return False
    figure = Figure(figsize=(8.0, 2.6), layout="constrained")
    for axis, name, unit in zip(figure.subplots(1, 2), ("gap", "speed"), ("gap (m)", "speed (m/s)"), strict=True):
        for rolled, colour, label in ((kept[0], "#9a9a9a", "plain"), (kept[1], "#0b5fa5", effect.name)):
            axis.plot(DT * torch.arange(1, STEPS + 1), getattr(rolled, name)[:, 2], color=colour, lw=1.4, label=label)
        axis.set(xlabel="time (s)", ylabel=unit)
        axis.grid(alpha=0.25)
    figure.axes[0].legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=90)
    return True


# -- commands, API, examples -----------------------------------------------------------------------------------------


def commands() -> str:
    """Return every command with its options, as its help tells them."""
    from typer.main import get_command

    from idm_env.cli.commands import app

    group: Any = get_command(app)
    lines = [
        "# Commands", "", "<style>td:first-child code { white-space: nowrap }</style>", "",
        "`idm-env COMMAND --help` says the same. `idm-env --install-completion` makes bash, zsh, fish or PowerShell "
        "complete commands and options (a new shell has it); `idm-env --show-completion` prints what it would add.", "",
    ]  # fmt: skip
    for name, command in group.commands.items():
        lines += [f"## idm-env {name}", "", " ".join((command.help or "").split("\n\n")[0].split()), ""]
        lines += [" ".join(p.split()) + "\n" for p in (command.help or "").split("\n\n")[1:]]
        lines += ["| option | default | meaning |", "| --- | --- | --- |"]
        for p in command.params:
            if getattr(p, "hidden", False) or p.name == "help":
                continue
            argument = p.param_type_name == "argument"
            names = f"`{p.name.upper()}`" if argument else " ".join(f"`{o}`" for o in (*p.opts, *p.secondary_opts))
            default = "–" if p.default is None or callable(p.default) else f"`{p.default}`"
            meaning = (getattr(p, "help", None) or "").replace("|", "\\|")
            lines.append(f"| {names} | {default} | {meaning} |")
        lines.append("")
    return "\n".join(lines) + "\n"


def api() -> dict[str, str]:
    """Return the reference of the modules that people call, a page per job, and their index."""
    pages = {}
    index = ["API reference", "=============", "", "By job; what everything else needs comes first.", ""]
    index += [".. toctree::", "   :maxdepth: 2", ""]
    for page, (title, modules) in MODULES.items():
        lines = [title, "=" * len(title), ""]
        for name in modules:
            full = f"idm_env.{name}"
            lines += [full, "-" * len(full), "", f".. automodule:: {full}", "   :members:", ""]
        pages[f"api/{page}.rst"] = "\n".join(lines)
        index.append(f"   api/{page}")
    return pages | {"api.rst": "\n".join([*index, ""])}


def reports(folder: Path = ROOT / "docs" / "jobs") -> list[Path]:
    """Run the commands on small generated data, and keep a picture of each report; return the files."""
    import base64
    import tempfile

    from PIL import Image

    from idm_env.cli.commands import app
    from idm_env.data import synthetic
    from idm_env.effects import Wander
    from idm_env.fitting.job import fit_file, simulate_file
    from idm_env.fitting.options import Options, Source
    from idm_env.trajectories.files import filter_file, reconstruct_file

    ring = [str(ROOT / "configs" / "ring.yaml"), "--seconds", "600", "--out", str(folder / "plot.png")]
    app(["plot", *ring], standalone_mode=False)
    response(Wander(), folder / "wander.png")
    with tempfile.TemporaryDirectory() as place:
        out = Path(place)
        made, _ = synthetic.generate(3, runs=4, followers=2, seconds=60.0, noise=0.15)
        table = made.table.drop("gap_m", "gap_measured", "speed_mps")
        table.write_csv(out / "my.csv")
        table.gather_every(10).write_csv(out / "sparse.csv")
        source = Source(out / "my.csv", smooth=True)
        fit_file(source, Options(starts=1, substeps=1), out / "fit")
        simulate_file(source, out / "fit" / "model.yaml", out / "simulate")
        filter_file(out / "my.csv", out / "filter", baselines=False)
        reconstruct_file(out / "sparse.csv", out / "reconstruct", baselines=False)
        for name in ("fit", "simulate", "filter", "reconstruct"):
            page = (out / name / "report.html").read_text(encoding="utf-8")
            images = re.findall(r"data:image/png;base64,([^\"]+)", page)
            image = images[0] if name in ("fit", "simulate") else images[-1]
            (folder / f"{name}.png").write_bytes(base64.b64decode(image))
    written = [folder / f"{name}.png" for name in ("plot", "wander", "fit", "simulate", "filter", "reconstruct")]
    for path in written:
        Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)
    return written


if __name__ == "__main__":
    for picture in reports():
        print(picture)
