"""Names in scripts that the default font lacks: no warning of a missing glyph, and nobody's name is lost."""

from __future__ import annotations

import io
import warnings

import numpy as np
import polars as pl
import pytest

from idm_env.reports import fonts, page
from idm_env.reports.diagrams import space_time

NAMES = ["東京/車両一", "Москва", "도로", "ถนน", "सड़क", "شارع", "plain", "\U0001f697"]


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


def test_names_of_any_script_are_drawn_without_a_warning() -> None:
    """On any machine, whatever fonts it has; a name that none can draw is told in the caption."""
    block = drawn(NAMES)
    _, nowhere = fonts._families(frozenset("車"))
    assert ("車両一" in block.text) == bool(nowhere)
    assert "plain" not in block.text and "Москва" not in block.text  # DejaVu has Cyrillic


def test_a_name_that_no_font_has_becomes_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same number for the same name, in titles and at ticks; the page says whose it is."""
    monkeypatch.setattr(fonts, "_families", lambda lacking: ([], set(lacking)))
    caption = drawn(["東京/車両一", "車両二"]).text
    assert all(f": {word}" in caption for word in ("東京", "車両一", "車両二")) and caption.count("#") == 3
    figure, axes = page.figure()
    axes[0, 0].set_title("東京: 車両一")
    axes[0, 0].set_xticks([0, 1], ["車両一", "b"])
    said = fonts.legible(figure)
    title = axes[0, 0].get_title()
    assert set(said.values()) == {"東京", "車両一"}
    assert [said[part] for part in title.split(": ")] == ["東京", "車両一"]
    figure.canvas.draw()
    labels = [label.get_text() for label in axes[0, 0].get_xticklabels()]
    assert [said.get(labels[0]), labels[1]] == ["車両一", "b"]


def test_a_name_has_one_number_in_the_wide_and_the_narrow_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fonts, "_families", lambda lacking: ([], set(lacking)))
    titles = []
    for title in ("東京 車両一", "車両二 東京"):
        figure, axes = page.figure()
        axes[0, 0].set_title(title)
        titles.append((figure, axes[0, 0]))
    caption = page.picture(titles[0][0], "Names.", titles[1][0]).text
    said = dict(part.split(": ") for part in caption.removeprefix("Names. ").removesuffix(".").split(", "))
    assert [" ".join(said[n] for n in axes.get_title().split()) for _, axes in titles] == ["東京 車両一", "車両二 東京"]


def test_space_time_diagrams_have_titles_of_any_script() -> None:
    """The file's name is the title."""
    table = pl.DataFrame(
        {"vehicle_id": ["車"] * 3, "time_s": [0.0, 0.1, 0.2], "position_m": [0.0, 1.0, 2.0], "speed_mps": [10.0] * 3}
    )
    space_time(table, title="東京.csv").savefig(io.BytesIO())


def test_a_figure_in_the_default_font_is_left_as_it_is() -> None:
    """No other font, no number."""
    figure, axes = page.figure()
    axes[0, 0].set_title("gap (m), Δv, θ")
    assert fonts.legible(figure) == {}
    assert axes[0, 0].title.get_fontfamily() == ["sans-serif"]
