"""Names in scripts that the default font lacks: no warning of a missing glyph, and nobody's name is lost."""

from __future__ import annotations

import io
import warnings
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from matplotlib import font_manager

from idm_env.reports import page
from idm_env.reports.diagrams import space_time


@pytest.fixture(autouse=True)
def glyphs_are_not_missing() -> object:
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*[Gg]lyph.*")
        yield


def drawn(names: list[str]) -> page.Block:
    """Names in a title, a legend, an annotation and as labels of ticks: all that our pictures have."""
    figure, axes = page.figure(2, 1)
    for i, name in enumerate(names):
        axes[0, 0].plot([0, 1], [i, i], label=name)
    axes[0, 0].legend()
    axes[0, 0].set_title(f"best: {names[0]}\nRMSE 1.00 m")
    axes[1, 0].annotate(names[0], (0.0, 0.0))
    axes[1, 0].set_xticks(np.arange(len(names)), [name[:14] for name in names], rotation=90)
    return page.picture(figure, "Names.")


def test_names_in_scripts_of_the_default_font_are_drawn_without_a_warning() -> None:
    """DejaVu has Cyrillic and Arabic; signs that no font has, such as a tab, are drawn as spaces."""
    assert drawn(["Москва", "شارع", "plain", "a\tb\x01"]).text == "Names."
    assert drawn(["a\tb\x01"]).text == "Names."


def test_a_name_that_the_default_font_lacks_is_drawn_with_one_that_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """In titles and at ticks; the first installed family with a glyph is taken, and one without is not."""
    figure, axes = page.figure()
    axes[0, 0].set_title("\ue0a0")  # of a private plane, so that no machine's fonts matter
    axes[0, 0].set_xticks([0, 1], ["\ue0a0", "b"])
    charmaps = {"plain.ttf": {97: 1}, "own.ttf": {0xE0A0: 1}, "later.ttf": {0xE0A0: 1}}
    default = font_manager.findfont(font_manager.FontProperties())
    monkeypatch.setattr(
        font_manager, "get_font", lambda name: SimpleNamespace(get_charmap=lambda: charmaps.get(name, {98: 1}))
    )
    entries = [SimpleNamespace(name=name.removesuffix(".ttf"), fname=name) for name in charmaps]
    monkeypatch.setattr(font_manager.fontManager, "ttflist", entries)
    assert default not in charmaps
    page.legible(figure)
    for text in (axes[0, 0].title, axes[0, 0].get_xticklabels()[0]):
        assert text.get_fontfamily() == ["sans-serif", "own"]


def test_space_time_diagrams_have_titles_of_any_script() -> None:
    """The file's name is the title."""
    table = pl.DataFrame(
        {"vehicle_id": ["М"] * 3, "time_s": [0.0, 0.1, 0.2], "position_m": [0.0, 1.0, 2.0], "speed_mps": [10.0] * 3}
    )
    space_time(table, title="Москва.csv").savefig(io.BytesIO())


def test_a_figure_in_the_default_font_is_left_as_it_is() -> None:
    """No other font."""
    figure, axes = page.figure()
    axes[0, 0].set_title("gap (m), Δv, θ")
    page.legible(figure)
    assert axes[0, 0].title.get_fontfamily() == ["sans-serif"]
