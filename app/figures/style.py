"""How every picture looks: colours, type, sizes, and the axes they are drawn in."""

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Final

import numpy as np
from matplotlib import colormaps, style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, fontManager
from matplotlib.textpath import TextPath

from dragrig.figures.palette import (
    BLACK,
    BLUE,
    CYCLE,
    GREEN,
    GREY,
    GRID,
    ORANGE,
    PALE,
    PAPER,
    PURPLE,
    SKY,
    VERMILLION,
)

__all__ = [
    "BLACK",
    "BLUE",
    "CYCLE",
    "GREEN",
    "GREY",
    "ORANGE",
    "PALE",
    "PAPER",
    "PURPLE",
    "SKY",
    "VERMILLION",
]

TITLE_PT: Final = 19.0
TEXT_PT: Final = 13.5
SMALL_PT: Final = 12.0
DPI: Final = 120

_FONT: Final = "DejaVu Sans"
"""Comes with matplotlib, so that pictures are alike everywhere."""
_WIDER_FONTS: Final = (
    "Noto Sans CJK SC",
    "Noto Sans CJK JP",
    "Source Han Sans SC",
    "WenQuanYi Zen Hei",
    "Microsoft YaHei",
    "Yu Gothic",
    "Malgun Gothic",
    "PingFang SC",
    "Hiragino Sans",
    "Arial Unicode MS",
)
"""Asked, where installed, for characters of names and notes that the first font lacks."""

_RULES: Final = {
    "font.size": TEXT_PT,
    "text.color": BLACK,
    "axes.labelsize": TEXT_PT,
    "axes.labelcolor": BLACK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.facecolor": PAPER,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-5, 6),
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.labelsize": SMALL_PT,
    "ytick.labelsize": SMALL_PT,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": BLACK,
    "ytick.labelcolor": BLACK,
    "lines.linewidth": 2.2,
    "lines.solid_capstyle": "round",
    "figure.facecolor": PAPER,
    "savefig.facecolor": PAPER,
    "svg.hashsalt": "dragrig",
    "svg.fonttype": "path",
    "text.usetex": False,
    "text.parse_math": False,
}

_RC_LOCK = threading.RLock()


@contextmanager
def drawing() -> Iterator[None]:
    """Hold matplotlib's settings at this house's for as long as something is drawn or saved.

    The settings are one per process: whoever draws holds a lock, and the caller's own are put back. A
    character that no font has is drawn as a box, without a word.
    """
    with _RC_LOCK, style.context(["default", {**_RULES, "font.family": _fonts()}]), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from font", category=UserWarning)
        yield


@cache
def _fonts() -> tuple[str, ...]:
    installed = set(fontManager.get_font_names())
    return (_FONT, *(font for font in _WIDER_FONTS if font in installed))


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure on an Agg canvas of its own, known to no window system."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI)
    FigureCanvasAgg(figure)
    return figure


def sequence(count: int) -> tuple[str, ...]:
    """Return colours from dark to light for curves that follow one another, each dark enough for a line on white."""
    return tuple(to_hex(colour) for colour in colormaps["viridis"](np.linspace(0.0, 0.74, count)))


def text_width_in(text: str, size_pt: float) -> float:
    """Width [inch] that a text takes when drawn upright."""
    if not text.strip():
        return 0.0
    # The outline's points, its control points included, are quick to bound and hardly wider than the outline itself.
    points = np.asarray(TextPath((0, 0), text, size=size_pt, prop=FontProperties(family=_fonts())).vertices)
    return float(np.ptp(points[:, 0])) / 72
