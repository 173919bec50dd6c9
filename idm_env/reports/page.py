"""Reports' pages: one self-contained HTML page, pictures inside it, and files that are never half written."""

from __future__ import annotations

import base64
import io
import platform
import shlex
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from idm_env.extras import needed
from idm_env.jobs.storage import write_json, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SIMULATE = "simulate {data} --model {out}/model.yaml"
NEXT = {"plot": "fit {data}", "raw": "filter {data}", "simulate": "drift {data}", "lost": "plot {data}"}
NEXT |= dict.fromkeys(("filter", "reconstruct"), "fit {out}/trajectories.parquet")
NEXT |= dict.fromkeys(("fit", "each"), "explain {data}") | dict.fromkeys(("explain", "demo", "drift"), _SIMULATE)
"""Next command by command: "lost" of one without a model, "raw" of a fit to noisy positions."""

CONTROL = dict.fromkeys((*range(10), *range(11, 32), 127), " ")
"""What no font draws, but for the end of a line, is drawn as a space."""


class Asked(NamedTuple):
    """Command line of a user: the command, its files, and the options of reading them."""

    command: str = ""
    files: tuple[str, ...] = ()
    options: tuple[tuple[str, str], ...] = ()


_NOTHING = Asked()
ASKED: ContextVar[Asked] = ContextVar("ASKED", default=_NOTHING)


def next_command(out: Path) -> str:
    """Return the command line that goes on after the running one, which writes to ``out``; nothing without one."""
    command, files, options = ASKED.get()
    has_model = command not in ("fit", "explain", "demo", "drift") or (out / "model.yaml").exists()
    line = NEXT.get(command if has_model else "lost", "")
    unknown = {"filter": ("--place", "--where"), "plot": ("--place",)}.get(line.partition(" ")[0], ())
    words = (word for option in options if option[0] not in unknown for word in option)
    data = shlex.join([*(files or (f"{out}/platoon.csv",)), *words])
    return f"idm-env {line.format(data=data, out=shlex.quote(str(out)))}" if line else ""


@dataclass(frozen=True)
class Block:
    """One piece of a page: heading, paragraph, list, lights, figure, gallery, table or markup of one's own.

    ``narrow`` is the figure's picture for small screens, where it has one.
    """

    kind: str
    text: str = ""
    image: str = ""
    narrow: str = ""
    columns: tuple[str, ...] = ()
    rows: tuple[Any, ...] = ()


@dataclass(frozen=True)
class Cell:
    """A cell of a table: its text, the number that it is sorted by, if any, and whether it is set off as doubtful."""

    text: str
    value: float | None = None
    marked: bool = False


def table(rows: Sequence[Mapping[str, Any]], digits: Mapping[str, int] | None = None, first: bool = False) -> Block:
    """Return a table of rows by column name; floats with four significant digits, or ``digits`` behind the point.

    A reader sorts it by any column; a ``Cell`` says what its text is sorted by. ``first`` sets the first row off from
    the others.
    """
    names = tuple(rows[0] if rows else ())
    cells = tuple(tuple(_cell(row.get(name), (digits or {}).get(name)) for name in names) for row in rows)
    return Block("table", "first" if first else "", columns=names, rows=cells)


def _cell(value: Any, digits: int | None = None) -> dict[str, Any]:
    if not isinstance(value, Cell):
        words = ("no", "yes")[value] if isinstance(value, bool) else "" if value is None else str(value)
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        value = Cell(number(value, digits) if isinstance(value, float) else words, value if is_number else None)
    finite = value.value is not None and abs(value.value) < float("inf")
    has_value = {"number": value.value is not None, "value": value.value if finite else None}
    return {"text": value.text, **has_value, "marked": value.marked}


def number(value: float, digits: int | None = None) -> str:
    """Return a number as people read it: four significant digits, or ``digits`` behind the point; a dash for none."""
    if not abs(value) < float("inf"):
        return "–"
    if digits is not None:
        return f"{value:.{digits}f}"
    return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.4g}"


def shortened(items: Sequence[str], most: int = 100) -> list[str]:
    """Return the first ``most`` items, and how many there are more."""
    more = len(items) - most
    return [*items[:most], *([f"… and {more} more, in report.json."] if more > 0 else [])]


def picture(figure: Figure, caption: str, narrow: Figure | None = None) -> Block:
    """Return a matplotlib figure as a block; the picture travels inside the page. Figures are closed.

    ``narrow`` is shown instead where the screen is less than 600 pixels wide.
    """
    for each in (figure, narrow) if narrow is not None else (figure,):
        legible(each)
    return Block("figure", caption, _encoded(figure), narrow="" if narrow is None else _encoded(narrow))


def legible(figure: Figure) -> None:
    """Let texts of a figure fall back to installed fonts with glyphs that the default font lacks; to be called last."""
    from matplotlib import rcParams
    from matplotlib.font_manager import FontProperties, findfont, fontManager, get_font
    from matplotlib.text import Text

    axes = [axis for panel in figure.axes for axis in (panel.xaxis, panel.yaxis)]
    for axis in axes:
        words = [label.get_text() for label in axis.get_ticklabels()]
        if words != (plain := [word.translate(CONTROL) for word in words]):
            axis.set_ticklabels(plain)
    ticks = [label for axis in axes for label in axis.get_ticklabels()]
    texts = [*ticks, *(text for text in figure.findobj(Text) if isinstance(text, Text))]
    for text in texts:
        text.set_text(text.get_text().translate(CONTROL))
    lacking = {ord(c) for text in texts for c in text.get_text() if not c.isspace()}
    lacking -= get_font(findfont(FontProperties())).get_charmap().keys()
    families = list(rcParams["font.family"])
    for entry in fontManager.ttflist if lacking else ():
        # Those draw boxes for everything, or bitmaps that matplotlib cannot scale.
        if not any(word in entry.name.lower() for word in ("last resort", "emoji")):
            glyphs = get_font(entry.fname).get_charmap().keys()
            families += [entry.name] * bool(lacking & glyphs)
            lacking -= glyphs
    if len(families) > len(rcParams["font.family"]):
        for text in texts:
            text.set_fontfamily(families)
        for panel in figure.axes:
            panel.tick_params(labelfontfamily=families)


def _encoded(figure: Figure) -> str:
    import matplotlib.pyplot as plt

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, bbox_inches="tight")
    plt.close(figure)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def figure(rows: int = 1, columns: int = 1, size: tuple[float, float] = (9.0, 3.4)) -> tuple[Figure, Any]:
    """Return a figure and its axes ([rows, columns] array) without a display; ImportError names the extra."""
    with needed("a report"):
        from matplotlib.figure import Figure
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def write_page(
    path: Path,
    title: str,
    blocks: Iterable[Block] = (),
    template: Path | None = None,
    filters: Mapping[str, Callable[..., str]] | None = None,
    **content: Any,
) -> None:
    """Write a self-contained HTML page of blocks, or of a ``template`` that extends ``page.html``, with its content."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    here = Path(__file__).with_name("page.html")
    template = template or here
    loader = FileSystemLoader([here.parent, template.parent])
    environment = Environment(autoescape=True, undefined=StrictUndefined, extensions=["jinja2.ext.do"], loader=loader)
    environment.filters |= filters or {}
    environment.globals["table_of"] = table
    page = environment.get_template(template.name).render(
        title=title, blocks=list(blocks), following=next_command(path.parent), **content
    )
    write_text(path, page)


def write_report(out: Path, title: str, template: Path, result: Mapping[str, Any], **content: Any) -> dict[str, Any]:
    """Write ``report.json`` and the page that shows it, ``report.html``, and return the report.

    The report is ``result`` between its schema and command, and the versions. The ``template`` reads it as ``r``.
    """
    report = {"schema": 1, "command": command_line(), **result, "versions": versions()}
    write_json(out / "report.json", report)
    write_page(out / "report.html", title, template=template, r=report, **content)
    return report


def account(repairs: Iterable[Any] = (), left_out: Iterable[Any] = (), bad_files: Iterable[str] = ()) -> str:
    """Return one line on the data: what was repaired and left out, by kind and number, and bad files by name.

    ``repairs`` and ``left_out`` are ``data.Repair``: what has a ``kind`` and a ``count``.
    """

    def count_kinds(items: Iterable[Any]) -> str:
        sums: Counter[str] = Counter()
        for item in items:
            sums[item.kind] += item.count
        return ", ".join(f"{kind} {count}" for kind, count in sums.most_common())

    names = list(bad_files)
    shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    files = f"{len(names)} bad file{'s' if len(names) > 1 else ''}: {shown}" if names else ""
    parts = (("repaired: ", count_kinds(repairs)), ("left out: ", count_kinds(left_out)), ("", files))
    summary = "; ".join(title + words for title, words in parts if words)
    return f"Data: {summary}." if summary else "Data: nothing was repaired or left out."


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    releases = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    for name in ("idm-env", "torch", "numpy", "polars", "scipy", "numba"):
        try:
            releases[name] = version(name)
        except PackageNotFoundError:
            releases[name] = "not installed"
    return releases


def command_line() -> str:
    """Return the command that is running, as a user would type it."""
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
