"""Pages as a reader sees them: reports, and the site where ``make docs`` has built it, in headless Chromium."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from idm_env.data import synthetic
from idm_env.effects import ALL
from idm_env.fitting.job import fit_file, simulate_file
from idm_env.fitting.options import Options, Source
from idm_env.reports import diagrams, page
from idm_env.tasks import TASKS, make_task
from idm_env.trajectories.files import filter_file, reconstruct_file
from tests.browser import after, check, chromium

__all__ = ["chromium"]  # a fixture

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "build" / "site"


@pytest.fixture(scope="module")
def site() -> Path:
    """Skip, loudly, where the site was not built."""
    if not (SITE / "index.html").exists():
        warnings.warn("no site in build/site (make docs): its pages are not looked at", stacklevel=1)
        pytest.skip("no site")
    return SITE


def test_the_browser_sees_what_is_wrong(chromium: None, tmp_path: Path) -> None:
    """An error in the console, a request, a page too wide for a telephone; and no fault in a page that has none."""
    (tmp_path / "well.html").write_text("<!doctype html><body><p>well</p></body>")
    (tmp_path / "ill.html").write_text(
        '<!doctype html><body><p>x</p><div style="width:800px">wide</div><script>nowhere()</script>'
        '<img src="https://example.com/x.png"></body>'
    )
    told = check.wrong([tmp_path / "well.html", tmp_path / "ill.html"])
    assert len(told) == 3 and not any("well.html" in line for line in told)
    for words in (
        "nowhere is not defined",
        "asks the network for https://example.com",
        "808 px wide in a window of 400",
    ):
        assert any(words in line for line in told)


def test_reports_are_well(chromium: None, tmp_path: Path) -> None:
    """Those of fit, simulate, filter, reconstruct, of several sets, and the page of a plot, made by the commands."""
    made, _ = synthetic.generate(3, runs=2, followers=2, seconds=20.0)
    data = tmp_path / "a-file-with-a-name-that-is-too-long-to-be-broken-anywhere.csv"
    made.table.drop("gap_m", "gap_measured").write_csv(data)
    fit_file(Source(data), Options(starts=1, substeps=1), tmp_path / "fit")
    simulate_file(Source(data), tmp_path / "fit" / "model.yaml", tmp_path / "simulate")
    filter_file(data, tmp_path / "filter", baselines=False)
    pl.read_csv(data).gather_every(10).write_csv(tmp_path / "sparse.csv")
    reconstruct_file(tmp_path / "sparse.csv", tmp_path / "reconstruct", baselines=False)
    pages = [tmp_path / name / "report.html" for name in ("fit", "simulate", "filter", "reconstruct")]
    panels, _ = diagrams.panels(made), np.zeros(1)
    diagrams.write_html(tmp_path / "diagram.html", panels, "diagram")
    rows = [{f"column {i} of a table that is wide": f"{i}" * 12 for i in range(14)} for _ in range(3)]
    page.write_page(tmp_path / "wide.html", "wide", [page.Block("lead", "x"), page.table(rows)])
    assert check.wrong([*pages, tmp_path / "diagram.html", tmp_path / "wide.html"]) == []


def test_a_click_on_a_heading_sorts(chromium: None, tmp_path: Path) -> None:
    """By number, not by text, what is not there last; a second click turns the order round."""
    rows = [{"name": name, "gap": gap} for name, gap in (("b", 10.0), ("c", float("nan")), ("a", 9.0), ("d", -1.0))]
    page.write_page(tmp_path / "page.html", "page", [page.table(rows)])
    order = "[...document.querySelectorAll('tbody tr')].map(r => r.cells[0].textContent.trim()).join('')"
    for clicks, wanted in (((), "bcad"), ((1,), "dabc"), ((1, 1), "badc"), ((1, 0), "abcd")):
        script = "".join(f"document.querySelectorAll('th')[{i}].click();" for i in clicks)
        seen = after(tmp_path / "page.html", f"{script}document.title = 'ORDER ' + {order};")
        assert re.findall(r"ORDER (\w+)</title>", seen) == [wanted]


def test_links_of_the_site_lead_somewhere(site: Path) -> None:
    """And to the place that they name."""
    assert check.dead(site) == []


def test_all_pages_of_the_site_are_well(site: Path, chromium: None) -> None:
    """No error, no request, no sideways scroll, wide and narrow."""
    pages = [path for path in sorted(site.rglob("*.html")) if "_static" not in path.parts]
    assert len(pages) > 50 and check.wrong(pages) == []


def test_a_dead_link_is_seen(tmp_path: Path) -> None:
    """A page that is not there, and a place on a page that is."""
    (tmp_path / "a.html").write_text(
        '<a href="b.html">b</a><a href="#there">c</a><p id="here"></p><a href="a.html#here">'
    )
    assert [line.split("leads to ")[1].split(",")[0] for line in check.dead(tmp_path)] == ["b.html", "#there"]


def test_effects_have_one_equation_each_and_options_their_hyphens(site: Path) -> None:
    """Typeset, in the prose or above it, and all effects in the index by behaviour."""
    page = (site / "generated" / "effects.html").read_text(encoding="utf-8")
    sections = dict(re.findall(r'<section id="effect-([\w-]+)">(.*?)</section>', page, re.DOTALL))
    catalogue = {name: cls for name, cls in ALL.items() if cls.__module__.startswith("idm_env.")}  # no other test's
    assert set(sections) == {name.replace("_", "-") for name in catalogue} and "&lt;span" not in page
    for name, cls in catalogue.items():
        section = sections[name.replace("_", "-")]
        shown = re.findall(r'<(?:p|span) class="eq">(.*?)</(?:p|span)>', section)
        assert len(shown) == len(set(shown)) >= bool(cls.equation), name
        assert "<blockquote" not in section and f'href="#effect-{name.replace("_", "-")}"' in page
    commands = (site / "generated" / "commands.html").read_text(encoding="utf-8")
    assert "--lane-changes" in commands and "–lane-changes" not in commands


def test_the_reference_is_divided_by_job(site: Path) -> None:
    """No page of it is too long to search, and the core comes first."""
    pages = sorted((site / "generated" / "api").glob("*.html"))
    assert len(pages) > 5 and max(page.stat().st_size for page in pages) < 500_000
    assert (site / "generated" / "api.html").read_text(encoding="utf-8").split('href="api/')[1].startswith("core.html")


def test_a_newcomer_finds_in_two_clicks_what_is_asked_most(site: Path) -> None:
    """Observation, one's own csv, an effect's equation, a task of one's own, training, limits, how to cite."""
    near = links(site, "index.html")
    near |= {link for first in near for link in links(site, first)}
    for place, words in (
        *((f"generated/tasks/{name}.html", make_task(name).bounds.names[-1]) for name in TASKS),
        ("jobs/files.html", "position_m"),
        ("generated/effects.html", "speed-dependent gap"),
        ("architecture.html", "Add a task"),
        ("jobs/train.html", "train_apg.py"),
        ("limits.html", "A GPU pays from"),
        ("cards.html", "CITATION.cff"),
    ):
        assert place in near and words in (site / place).read_text(encoding="utf-8")


def links(site: Path, page: str) -> set[str]:
    """Return the pages of the site to which one leads."""
    read = check._Links()
    if page.endswith(".html"):
        read.feed((site / page).read_text(encoding="utf-8"))
    there = [link.split("#")[0] for link in read.links if not re.match(r"\w+:|#", link)]
    return {(site / page).parent.joinpath(link).resolve().relative_to(site.resolve()).as_posix() for link in there}
