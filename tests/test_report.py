"""The page that all reports share: sortable tables, no network, no sideways scroll; and the line on data."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from idm_env.data import Repair
from idm_env.reports import page

ROWS = [
    {"driver": "b", "a (m/s²)": 10.0, "share": page.Cell("10 (5 %)", 10), "mark": page.Cell("3 ⊣", 3.0, True)},
    {"driver": "a", "a (m/s²)": 9.5, "share": page.Cell("9 (5 %)", 9), "mark": page.Cell("4", 4.0)},
    {"driver": "c", "a (m/s²)": float("nan"), "share": page.Cell("–", float("nan")), "mark": page.Cell("2", 2.0)},
]


def written(tmp_path: Path, *blocks: page.Block) -> str:
    page.write_page(tmp_path / "page.html", "A <title>", blocks)
    return (tmp_path / "page.html").read_text()


def test_a_table_is_sorted_by_values_not_by_words(tmp_path: Path) -> None:
    text = written(tmp_path, page.table(ROWS), page.table(ROWS[:1]))
    assert text.count('<th tabindex="0"') == 4  # a single row needs no sorting
    assert 'data-value="10.0"' in text and 'data-value="nan"' not in text
    assert re.search(r'class="number marked"[^>]*>3 ⊣<', text)
    assert "A &lt;title&gt;" in text and "http" not in text


@pytest.mark.skipif(not shutil.which("chromium"), reason="needs a browser to click in")
def test_a_click_sorts_and_no_page_scrolls_sideways(tmp_path: Path) -> None:
    """In a browser: numbers by value, down on the second click, what is not there last; at 1100 and 400 px."""
    many = [{f"column {i}": f"a long text in a cell {i}" if i % 3 else 0.123456 * i for i in range(9)}] * 2
    written(tmp_path, page.Block("lead", "x" * 200), page.table(ROWS), page.table(many))
    script = """<script>
    const order = () => [...document.querySelector("tbody").rows].map((r) => r.cells[0].textContent).join("");
    const heads = document.querySelectorAll("th"), said = [];
    for (const i of [0, 1, 1, 2, 3]) { heads[i].click(); said.push(order()); }
    document.title = said.join(" ") + " " + (document.documentElement.scrollWidth <= innerWidth);
    parent.postMessage(document.title, "*");
    </script></body>"""
    inner = tmp_path / "page.html"
    inner.write_text(inner.read_text().replace("</body>", script))
    for width in (1100, 400):
        outer = tmp_path / "outer.html"
        outer.write_text(
            f'<script>onmessage = (e) => {{ document.body.textContent = "said: " + e.data; }}</script>'
            f'<body><iframe src="page.html" style="width: {width}px; height: 600px; border: 0"></iframe></body>'
        )
        done = subprocess.run(
            [
                "chromium", "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync",
                "--disable-background-networking", "--disable-component-update", f"--user-data-dir={tmp_path / 'c'}",
                "--window-size=1300,900", "--virtual-time-budget=3000", "--dump-dom", outer.as_uri(),
            ],
            capture_output=True, text=True, timeout=120, check=True,
        )  # fmt: skip
        assert "said: abc abc bac abc cba true" in done.stdout, done.stdout[-300:]


def test_one_line_says_what_was_repaired_left_out_and_unreadable() -> None:
    assert page.account() == "Data: nothing was repaired or left out."
    repairs = [Repair("missing row", 2, ""), Repair("repeated", 1, ""), Repair("missing row", 3, "")]
    words = page.account(repairs, [Repair("too short", 4, "")], ["a.json", "b"])
    assert words == "Data: repaired: missing row 5, repeated 1; left out: too short 4; 2 bad files: a.json, b."
    assert page.account(bad_files=[f"{i}.json" for i in range(7)]).endswith("4.json and 2 more.")
    assert "\n" not in words
