"""Names in any script on pictures: fonts of the machine that have the glyphs, otherwise a number for the name."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.ticker import Formatter

_UNFIT = ("last resort", "emoji")
"""Families that draw boxes for everything, or bitmaps that matplotlib cannot scale."""


def legible(figure: Figure, numbers: dict[str, str] | None = None) -> dict[str, str]:
    """Make every text of a figure drawable; to be called last, before it is saved.

    Characters that the font lacks are drawn with installed fonts that have them. A word with a character that no font
    has becomes a number, "#1"; the numbers and their words are returned, to be told where a browser chooses the font.
    ``numbers`` are those of another figure of the same names, which stay.
    """
    from matplotlib import rcParams
    from matplotlib.font_manager import FontProperties, findfont
    from matplotlib.text import Text

    axes = [axis for panel in figure.axes for axis in (panel.xaxis, panel.yaxis)]
    ticks = {axis: "".join(label.get_text() for label in axis.get_ticklabels()) for axis in axes}
    texts = [text for text in figure.findobj(Text) if isinstance(text, Text)]
    characters = {c for text in texts for c in text.get_text() if not c.isspace()}
    lacking = characters - _glyphs(findfont(FontProperties()))
    words = {word: number for number, word in (numbers or {}).items()}
    if not lacking:
        return numbers or {}
    families, nowhere = _families(frozenset(lacking))
    chain = [*rcParams["font.family"], *families]
    for text in texts:
        text.set_fontfamily(chain)
    for panel in figure.axes:
        panel.tick_params(labelfontfamily=chain)

    def numbered(text: str) -> str:
        def number(match: re.Match[str]) -> str:
            word = match[0]
            return words.setdefault(word, f"#{len(words) + 1}") if set(word) & nowhere else word

        return re.sub(r"[^\s/:,;()]+", number, text)

    if nowhere:
        for text in texts:
            text.set_text(numbered(text.get_text()))
        for axis, labels in ticks.items():
            if set(labels) & nowhere:  # drawing asks the formatter again
                axis.set_major_formatter(_after(numbered, axis.get_major_formatter()))
    return {number: word for word, number in words.items()}


def _after(change: Callable[[str], str], formatter: Formatter) -> Formatter:
    from matplotlib.ticker import FuncFormatter

    return FuncFormatter(lambda x, pos: change(formatter(x, pos)))


@lru_cache
def _families(lacking: frozenset[str]) -> tuple[list[str], set[str]]:
    """Return installed families that have these characters, as few as it goes, and the characters that none has."""
    from matplotlib.font_manager import fontManager

    rest = set(lacking)
    chosen: list[str] = []
    for entry in fontManager.ttflist:
        if not rest or any(word in entry.name.lower() for word in _UNFIT) or entry.name in chosen:
            continue
        if glyphs := rest & _glyphs(entry.fname):
            chosen.append(entry.name)
            rest -= glyphs
    return chosen, rest


@lru_cache(maxsize=4096)
def _glyphs(path: str) -> frozenset[str]:
    from matplotlib.ft2font import FT2Font

    try:
        return frozenset(map(chr, FT2Font(path).get_charmap()))
    except (OSError, RuntimeError):  # a font that cannot be read has no glyphs
        return frozenset()
