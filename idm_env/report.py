"""What every report shares: one self-contained HTML page, pictures inside it, and files that are never half written."""

from __future__ import annotations

import base64
import io
import json
import os
import platform
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #1d2430; }
h1 { font-size: 1.7rem; margin-bottom: .2rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
p.lead { font-size: 1.1rem; } figure { margin: 1rem 0; } figure img { max-width: 100%; }
figcaption, .note { color: #566; font-size: .92rem; }
table { border-collapse: collapse; margin: .8rem 0; font-size: .92rem; display: block; overflow-x: auto; }
th, td { padding: .25rem .8rem .25rem 0; text-align: left; border-bottom: 1px solid #dde; vertical-align: top; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
table.first tbody tr:first-child { font-weight: 600; background: #eef5fb; }
.lights { display: grid; grid-template-columns: repeat(auto-fit, minmax(15rem, 1fr)); gap: .6rem; margin: 1rem 0; }
.light { border-left: .4rem solid #8a94a0; background: #f5f7f9; padding: .4rem .7rem; font-size: .92rem; }
.light b { display: block; } .light.better { border-color: #1a7f37; } .light.worse { border-color: #b42318; }
dl.terms { font-size: .88rem; color: #445; margin: .2rem 0 1.2rem; } dl.terms dt { font-weight: 600; float: left;
clear: left; margin-right: .4rem; } dl.terms dd { margin: 0 0 .2rem; }
@media (max-width: 600px) { figure { overflow-x: auto; } figure img.wide { max-width: none; width: 40rem; } }
.gallery { display: flex; flex-wrap: wrap; gap: 1rem; } .gallery figure { flex: 1 1 26rem; margin: 0; }
</style></head><body>
<h1>{{ title }}</h1>
{% for block in blocks %}
{% if block.kind == "heading" %}<h2>{{ block.text }}</h2>
{% elif block.kind == "lead" %}<p class="lead">{{ block.text }}</p>
{% elif block.kind == "note" %}<p class="note">{{ block.text }}</p>
{% elif block.kind == "text" %}<p>{{ block.text }}</p>
{% elif block.kind == "list" %}<ul>{% for item in block.rows %}<li>{{ item }}</li>{% endfor %}</ul>
{% elif block.kind == "figure" %}<figure><picture>{% if block.narrow %}<source media="(max-width: 600px)"
 srcset="{{ block.narrow }}">{% endif %}<img{% if not block.narrow %} class="wide"{% endif %}
 alt="{{ block.text }}" src="{{ block.image }}"></picture>
<figcaption>{{ block.text }}</figcaption></figure>
{% elif block.kind == "lights" %}<div class="lights">{% for name, state, words in block.rows %}
<div class="light {{ state }}"><b>{{ name }}: {{ state }}</b>{{ words }}</div>{% endfor %}</div>
{% elif block.kind == "terms" %}<dl class="terms">{% for name, meaning in block.rows %}
<dt>{{ name }}:</dt><dd>{{ meaning }}</dd>{% endfor %}</dl>
{% elif block.kind == "gallery" %}<div class="gallery">{% for item in block.rows %}<figure>
<img alt="{{ item.text }}" src="{{ item.image }}"><figcaption>{{ item.text }}</figcaption></figure>{% endfor %}</div>
{% elif block.kind == "table" %}<table{% if block.text %} class="{{ block.text }}"{% endif %}>
<thead><tr>{% for name in block.columns %}<th{% if block.rows and block.rows[0][loop.index0].number %} class="number"{%
endif %}>{{ name }}</th>{% endfor %}</tr></thead>
<tbody>{% for row in block.rows %}<tr>{% for cell in row %}<td{% if cell.number %} class="number"{% endif %}>{{
cell.text }} </td>{% endfor %}</tr>{% endfor %}</tbody></table>
{% endif %}{% endfor %}
</body></html>
"""


@dataclass(frozen=True)
class Block:
    """One piece of a page: a heading, a paragraph, a list, lights, terms, a figure, a gallery of figures or a table.

    ``narrow`` is the figure's picture for small screens, where it has one.
    """

    kind: str
    text: str = ""
    image: str = ""
    narrow: str = ""
    columns: tuple[str, ...] = ()
    rows: tuple[Any, ...] = ()


def heading(text: str) -> Block:
    """Return a section's heading."""
    return Block("heading", text)


def lead(text: str) -> Block:
    """Return the paragraph that says the result."""
    return Block("lead", text)


def text(words: str) -> Block:
    """Return a paragraph."""
    return Block("text", words)


def note(words: str) -> Block:
    """Return a paragraph in small print."""
    return Block("note", words)


def bullets(items: Iterable[str]) -> Block:
    """Return a list."""
    return Block("list", rows=tuple(items))


def table(
    rows: Sequence[Mapping[str, Any]],
    columns: Sequence[str] | None = None,
    *,
    digits: Mapping[str, int] | None = None,
    first: bool = False,
) -> Block:
    """Return a table of rows by column name; floats with four significant digits, or ``digits`` behind the point.

    ``first`` sets the first row off from the others.
    """
    names = tuple(columns or (rows[0] if rows else ()))
    cells = tuple(tuple(_cell(row.get(name), (digits or {}).get(name)) for name in names) for row in rows)
    return Block("table", "first" if first else "", columns=names, rows=cells)


def _cell(value: Any, digits: int | None = None) -> dict[str, Any]:
    if isinstance(value, bool):
        return {"text": "yes" if value else "no", "number": False}
    if isinstance(value, float) and not abs(value) < float("inf"):
        return {"text": "–", "number": True}
    if isinstance(value, float):
        return {"text": f"{value:.4g}" if digits is None else f"{value:.{digits}f}", "number": True}
    return {"text": "" if value is None else str(value), "number": isinstance(value, int)}


def shortened(items: Sequence[str], most: int = 100) -> list[str]:
    """Return the first ``most`` items, and how many there are more."""
    more = len(items) - most
    return [*items[:most], *([f"… and {more} more, in report.json."] if more > 0 else [])]


def lights(rows: Iterable[tuple[str, str, str]]) -> Block:
    """Return one light per (name, ``better``, ``same`` or ``worse``, words); the state is a word and a colour."""
    return Block("lights", rows=tuple(rows))


def terms(meanings: Mapping[str, str]) -> Block:
    """Return what the terms of a table mean, to stand under it."""
    return Block("terms", rows=tuple(meanings.items()))


def gallery(figures: Iterable[Block]) -> Block:
    """Return figures side by side, as many in a row as there is room for."""
    return Block("gallery", rows=tuple(figures))


def picture(figure: Figure, caption: str, narrow: Figure | None = None) -> Block:
    """Return a matplotlib figure as a block; the picture travels inside the page. Figures are closed.

    ``narrow`` is shown instead where the screen is less than 600 pixels wide.
    """
    return Block("figure", caption, _encoded(figure), narrow="" if narrow is None else _encoded(narrow))


def _encoded(figure: Figure) -> str:
    import matplotlib.pyplot as plt

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, bbox_inches="tight")
    plt.close(figure)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def figure(rows: int = 1, columns: int = 1, size: tuple[float, float] = (9.0, 3.4)) -> tuple[Figure, Any]:
    """Return a figure and its axes ([rows, columns] array) without a display; ImportError names the extra."""
    try:
        import matplotlib
    except ImportError:
        raise ImportError("reports need matplotlib. Install it with: pip install 'idm-env[data]'") from None
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")


def write_page(path: Path, title: str, blocks: Iterable[Block]) -> None:
    """Write a self-contained HTML page."""
    from jinja2 import Environment

    page = Environment(autoescape=True).from_string(_PAGE).render(title=title, blocks=list(blocks))
    write_text(path, page)


def write_json(path: Path, content: Any) -> None:
    """Write JSON; NaN and infinities, which JSON does not have, become null."""
    write_text(path, json.dumps(_finite(content), indent=1, ensure_ascii=False) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not abs(value) < float("inf"):
        return None
    return value


def write_text(path: Path, content: str) -> None:
    """Write a file in one piece: whoever is killed in between leaves the old one."""
    beside = path.with_name(path.name + ".part")
    beside.write_text(content, encoding="utf-8")
    os.replace(beside, path)


def output_folder(out: Path) -> Path:
    """Return ``out`` as a folder that exists; ValueError if a file is in the way."""
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file. Give --out a folder.")
    out.mkdir(parents=True, exist_ok=True)
    return out


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    found = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    for name in ("idm-env", "torch", "numpy", "polars", "scipy", "numba"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def command_line() -> str:
    """Return the command that is running, as a user would type it."""
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
