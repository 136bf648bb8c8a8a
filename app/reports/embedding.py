"""Figures as part of a page."""

import io

from markupsafe import Markup
from matplotlib.figure import Figure

from dragrig.figures.saving import FORMATS
from dragrig.figures.style import drawing
from dragrig.reports.picture import Picture
from dragrig.reports.svg import inline_svg

__all__ = ["Picture", "embedded"]


def embedded(figure: Figure, shows: str, caption: str) -> Picture:
    """Return a figure as SVG, sharp at any size and on paper; the same figure gives the same SVG."""
    content = io.BytesIO()
    with drawing():
        figure.savefig(content, format="svg", metadata=FORMATS[".svg"])
    drawn = inline_svg(content.getvalue().decode("utf-8"), shows)
    return Picture(Markup(drawn.element), caption, drawn.glyphs)  # noqa: S704  # serialised by ElementTree
