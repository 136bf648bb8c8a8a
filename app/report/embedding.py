"""Figures as data of a page."""

import base64
import io
from dataclasses import dataclass

from matplotlib.figure import Figure

from dragrig.figures.saving import FORMATS
from dragrig.figures.style import drawing


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure in a page: its data, what it shows for those who cannot see it, and its caption."""

    source: str
    shows: str
    caption: str


def embedded(figure: Figure, shows: str, caption: str) -> Picture:
    """Return a figure as SVG data, sharp at any size and on paper; the same figure gives the same data."""
    content = io.BytesIO()
    with drawing():
        figure.savefig(content, format="svg", metadata=FORMATS[".svg"])
    encoded = base64.b64encode(content.getvalue()).decode("ascii")
    return Picture(f"data:image/svg+xml;base64,{encoded}", shows, caption)
