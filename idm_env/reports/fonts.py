"""Names in any script on pictures: matplotlib falls back to fonts of the machine that have the glyphs."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def legible(figure: Figure) -> None:
    """Let texts of a figure fall back to installed fonts with glyphs that the default font lacks; to be called last."""
    from matplotlib import rcParams
    from matplotlib.font_manager import FontProperties, findfont, fontManager, get_font
    from matplotlib.text import Text

    ticks = [label for panel in figure.axes for axis in (panel.xaxis, panel.yaxis) for label in axis.get_ticklabels()]
    texts = [*ticks, *(text for text in figure.findobj(Text) if isinstance(text, Text))]
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
