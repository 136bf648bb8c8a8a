"""Matplotlib style of all figures, panels placed in inches, titles, curve labels that do not overlap."""

import threading
import warnings
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from matplotlib import colormaps, style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, fontManager
from matplotlib.text import Text
from matplotlib.textpath import TextPath
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from dragrig.present.palette import BLACK, BLUE, GREY, GRID, PAPER, PURPLE, VERMILLION
from dragrig.rig import AnyFloatArray, FloatArray

TITLE_PT: Final = 19.0
TEXT_PT: Final = 13.5
SMALL_PT: Final = 12.0
DPI: Final = 120

_FONT: Final = "DejaVu Sans"
"""Comes with matplotlib, so that pictures are alike everywhere."""
_FALLBACK_FONTS: Final = (
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

_RC_PARAMS: Final = {
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
def figure_style() -> Iterator[None]:
    """Hold matplotlib's settings at this house's for as long as something is drawn or saved.

    The settings are one per process: whoever draws holds a lock, and the caller's own are put back. A
    character that no font has is drawn as a box, without a word.
    """
    with (
        _RC_LOCK,
        style.context(["default", {**_RC_PARAMS, "font.family": _installed_fonts()}]),
        warnings.catch_warnings(),
    ):
        warnings.filterwarnings("ignore", message="Glyph .* missing from font", category=UserWarning)
        yield


@cache
def _installed_fonts() -> tuple[str, ...]:
    installed = set(fontManager.get_font_names())
    return (_FONT, *(font for font in _FALLBACK_FONTS if font in installed))


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure on an Agg canvas of its own, known to no window system."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI)
    FigureCanvasAgg(figure)
    return figure


def sequential_colours(count: int) -> tuple[str, ...]:
    """Return colours from dark to light for curves that follow one another, each dark enough for a line on white."""
    return tuple(to_hex(colour) for colour in colormaps["viridis"](np.linspace(0.0, 0.74, count)))


def text_width_in(text: str, size_pt: float) -> float:
    """Width [inch] that a text takes when drawn upright."""
    if not text.strip():
        return 0.0
    # The outline's points, its control points included, are quick to bound and hardly wider than the outline itself.
    points = np.asarray(TextPath((0, 0), text, size=size_pt, prop=FontProperties(family=_installed_fonts())).vertices)
    return float(np.ptp(points[:, 0])) / 72


LEGEND_IN = 0.36
"""Room that a row of words takes along the upper edge of a panel."""


_SWATCH_IN, _LEGEND_SPACING_IN = 0.38, 0.3
LABEL_IN = 0.8
"""From the axes to the label of its y axis."""


@dataclass(frozen=True, slots=True)
class PanelBox:
    """Where axes stand in a figure, in inches from its lower left corner."""

    left: float
    bottom: float
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class LineStyle:
    """How a line is drawn, the word that names it, and more about it for where there is room."""

    word: str
    colour: str
    width: float
    dashed: bool = False
    detail: str = ""


def add_panel(figure: Figure, place: PanelBox, share_x: Axes | None = None, share_y: Axes | None = None) -> Axes:
    """Add axes at a place."""
    width, height = figure.get_size_inches()
    rect = (place.left / width, place.bottom / height, place.width / width, place.height / height)
    return figure.add_axes(rect, sharex=share_x, sharey=share_y)


def panel_height_in(axes: Axes) -> float:
    """Height of the axes [inch]."""
    return float(axes.get_position().height * _figure_size_in(axes)[1])


def panel_width_in(axes: Axes) -> float:
    """Width of the axes [inch]."""
    return float(axes.get_position().width * _figure_size_in(axes)[0])


def _figure_size_in(axes: Axes) -> FloatArray:
    figure = axes.get_figure(root=True)
    assert figure is not None  # noqa: S101  # axes of this house are always in a figure; this tells the type checker
    return np.asarray(figure.get_size_inches())


def draw_line(axes: Axes, time: AnyFloatArray, value: AnyFloatArray, pen: LineStyle) -> None:
    """Draw a line, broken where it is NaN; a sample on its own between two breaks becomes a dot."""
    axes.plot(
        time,
        value,
        color=pen.colour,
        linewidth=pen.width,
        linestyle=(0, (5, 3)) if pen.dashed else "-",
        label=pen.word,
        solid_joinstyle="round",
    )
    breaks = np.flatnonzero(np.isnan(value))
    firsts, lasts = np.append(0, breaks + 1), np.append(breaks, value.size) - 1
    firsts, lasts = firsts[lasts >= firsts], lasts[lasts >= firsts]
    lone = firsts[time[firsts] == time[lasts]]
    if lone.size:
        axes.plot(time[lone], value[lone], ".", color=pen.colour, markersize=3 + pen.width)


def fit_y_range(axes: Axes, values: Sequence[AnyFloatArray], smallest_span: float, below_in: float = 0.1) -> None:
    """Choose the y range so that all values are inside, below a row of words and `below_in` above the foot."""
    finite = [one[np.isfinite(one)] for one in values]
    low = min((float(one.min()) for one in finite if one.size), default=0.0)
    high = max((float(one.max()) for one in finite if one.size), default=0.0)
    if high - low < smallest_span:
        middle = (high + low) / 2
        low, high = middle - smallest_span / 2, middle + smallest_span / 2
    tall = panel_height_in(axes)
    top, bottom = LEGEND_IN / tall, below_in / tall
    span = (high - low) / max(1 - top - bottom, 0.2)
    axes.set_ylim(low - bottom * span, low + (1 - bottom) * span)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=max(3, round(tall / 0.45)), steps=[1, 2, 5, 10]))


def set_y_label(axes: Axes, text: str) -> None:
    """Write the quantity and unit beside the axes, as far from them in every panel."""
    axes.set_ylabel(text)
    axes.yaxis.set_label_coords(-LABEL_IN / panel_width_in(axes), 0.5)


def write_legend(axes: Axes, pens: Sequence[LineStyle]) -> None:
    """Name the lines along the panel's upper edge, each beside a piece of it."""
    wide, tall = panel_width_in(axes), panel_height_in(axes)
    words = [pen.word + pen.detail for pen in pens]
    if sum(text_width_in(word, SMALL_PT) + _SWATCH_IN + _LEGEND_SPACING_IN for word in words) > wide:
        words = [pen.word for pen in pens]
    y, x = 1 - 0.19 / tall, 0.12
    for pen, word in zip(pens, words, strict=True):
        axes.plot(
            [x / wide, (x + 0.3) / wide],
            [y, y],
            color=pen.colour,
            linewidth=max(pen.width, 1.6),
            linestyle=(0, (3, 1.5)) if pen.dashed else "-",
            transform=axes.transAxes,
        )
        axes.text((x + _SWATCH_IN) / wide, y, word, transform=axes.transAxes, va="center", fontsize=SMALL_PT)
        x += _SWATCH_IN + text_width_in(word, SMALL_PT) + _LEGEND_SPACING_IN


def set_time_range(axes: Axes, low: float, high: float) -> None:
    """Give the axes their time range; a range of no length is widened."""
    if not high > low:
        low, high = low - 0.5, high + 0.5
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=max(4, round(panel_width_in(axes) / 0.8)), steps=[1, 2, 5, 10]))


def set_log_x(axes: Axes, low: float, high: float) -> None:
    """Make the x axis logarithmic, with plain numbers at the decades, and at 2 and 5 where there are few of them."""
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    few = high / low < 2e3
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=30))
    axes.xaxis.set_minor_locator(LogLocator(subs=tuple(range(1, 10)), numticks=100))
    axes.xaxis.set_major_formatter(FuncFormatter(_tick_text))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _tick_text(value: float, place: int | None = None) -> str:
    del place
    return f"{value:g}"


def hide_time_labels(axes: Axes) -> None:
    """Leave the tick labels to a panel below."""
    axes.tick_params(labelbottom=False)


def spread_labels(centres: Sequence[float], widths: Sequence[float], low: float, high: float) -> FloatArray:
    """Move labels along a line, as little as possible, until none covers another.

    Parameters
    ----------
    centres, widths
        Where each label would like to be, in rising order, and the room it takes.
    low, high
        Ends of the line. Where the labels do not fit between them all, they run over `high`.

    Returns
    -------
    The labels' centres, shape `(K,)`. The sum of squared displacements is the smallest possible.
    """
    from scipy.optimize import isotonic_regression

    wanted, width = np.asarray(centres, dtype=float), np.asarray(widths, dtype=float)
    if wanted.size == 0:
        return wanted
    # Measured from where each would stand in a closed row, "no overlap" reads "never falling".
    row = np.concatenate(([0.0], np.cumsum((width[:-1] + width[1:]) / 2)))
    placed = np.asarray(isotonic_regression(wanted - row).x)
    first, last = low + width[0] / 2, high - width[-1] / 2 - row[-1]
    return np.asarray(np.clip(placed, first, max(first, last)) + row)


_LABEL_LINE_IN = 0.24


@dataclass(frozen=True, slots=True)
class CurveLabel:
    """A name, the value that it stands beside, and its colour; `math` lets `$…$` be set as a formula."""

    value: float
    text: str
    colour: str
    math: bool = False


def label_curves(axes: Axes, labels: Sequence[CurveLabel], size_pt: float = TEXT_PT) -> None:
    """Write names along the right edge of the axes, each as near its value as the others let it be."""
    low, high = axes.get_ylim()
    wide, tall = panel_width_in(axes), panel_height_in(axes)
    rising = sorted(labels, key=lambda label: label.value)
    wanted = [(label.value - low) / (high - low) * tall for label in rising]
    places = spread_labels(wanted, [_LABEL_LINE_IN] * len(rising), 0.0, tall)
    for label, value, place in zip(rising, wanted, places, strict=True):
        moved = abs(place - value) > 0.03
        axes.annotate(
            label.text,
            xy=(1.0, value / tall),
            xytext=(1 + (0.32 if moved else 0.12) / wide, place / tall),
            xycoords="axes fraction",
            va="center",
            fontsize=size_pt,
            color=label.colour,
            annotation_clip=False,
            parse_math=label.math,
            arrowprops=_leader_line(label.colour) if moved else None,
        )


def _leader_line(colour: str) -> dict[str, object]:
    """Return a line that begins at the left edge of its name, so that it crosses no other's."""
    return {"arrowstyle": "-", "color": colour, "linewidth": 0.8, "relpos": (0, 0.5), "shrinkA": 1, "shrinkB": 2}


HEADER_IN = 1.0
"""Height of a header without trouble."""

_BADGES = {"simulated": PURPLE, "hardware": BLUE, "external": GREY}
_HEADER_LINE_IN = 0.3


def header_height_in(trouble: str) -> float:
    """Height of the header [inch]: trouble has a line of its own."""
    return HEADER_IN + (_HEADER_LINE_IN if trouble else 0.0)


def write_title(figure: Figure, left_in: float, title: str, subtitle: str) -> Text:
    """Write title and subtitle at the figure's upper edge, and return the subtitle."""
    width, height = figure.get_size_inches()
    left = left_in / width
    figure.text(left, 1 - 0.5 / height, title, fontsize=TITLE_PT, fontweight="bold", color=BLACK, va="baseline")
    return figure.text(left, 1 - 0.84 / height, subtitle, fontsize=SMALL_PT, color=GREY, va="baseline")


def write_problem(figure: Figure, left_in: float, trouble: str) -> None:
    """Write what is wrong below the subtitle, as much of it as fits."""
    width, height = figure.get_size_inches()
    figure.text(
        left_in / width,
        1 - (0.84 + _HEADER_LINE_IN) / height,
        shortened_to_width(trouble, SMALL_PT, width - left_in - 0.45),
        fontsize=SMALL_PT,
        fontweight="bold",
        color=VERMILLION,
        va="baseline",
    )


def write_badge(figure: Figure, backend: str) -> None:
    """Say in the figure's corner whether it shows simulated, measured or foreign data."""
    width, height = figure.get_size_inches()
    figure.text(
        1 - 0.45 / width,
        1 - 0.43 / height,
        backend.upper(),
        fontsize=SMALL_PT,
        fontweight="bold",
        color="white",
        ha="right",
        va="center",
        bbox={"boxstyle": "round,pad=0.45", "facecolor": _BADGES.get(backend, BLACK), "edgecolor": "none"},
    )


def shortened_to_width(text: str, size_pt: float, room_in: float) -> str:
    """Return the text on one line, cut off with an ellipsis where it would be wider than the room for it."""
    text = " ".join(text.split())
    bold = 1.15
    if bold * text_width_in(text, size_pt) <= room_in:
        return text
    kept = bisect_right(range(len(text)), room_in, key=lambda count: bold * text_width_in(text[:count] + "…", size_pt))
    return text[: kept - 1].rstrip() + "…"
