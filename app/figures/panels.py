"""Axes placed to the tenth of an inch, and the lines and words that go into them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from dragrig.figures.style import SMALL_PT, text_width_in
from dragrig.rig.arrays import AnyFloatArray, FloatArray

WORDS_IN = 0.36
"""Room that a row of words takes along the upper edge of a panel."""


_SWATCH_IN, _APART_IN = 0.38, 0.3
LABEL_IN = 0.8
"""From the axes to the label of its y axis."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where axes stand in a figure, in inches from its lower left corner."""

    left: float
    bottom: float
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class Pen:
    """How a line is drawn, the word that names it, and more about it for where there is room."""

    word: str
    colour: str
    width: float
    dashed: bool = False
    detail: str = ""


def add_panel(figure: Figure, place: Place, share_x: Axes | None = None, share_y: Axes | None = None) -> Axes:
    """Add axes at a place."""
    width, height = figure.get_size_inches()
    rect = (place.left / width, place.bottom / height, place.width / width, place.height / height)
    return figure.add_axes(rect, sharex=share_x, sharey=share_y)


def height_in(axes: Axes) -> float:
    """Height of the axes [inch]."""
    return float(axes.get_position().height * _size_in(axes)[1])


def width_in(axes: Axes) -> float:
    """Width of the axes [inch]."""
    return float(axes.get_position().width * _size_in(axes)[0])


def _size_in(axes: Axes) -> FloatArray:
    figure = axes.get_figure(root=True)
    assert figure is not None  # noqa: S101  # axes of this house are always in a figure; this tells the type checker
    return np.asarray(figure.get_size_inches())


def draw(axes: Axes, time: AnyFloatArray, value: AnyFloatArray, pen: Pen) -> None:
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


def fit_y(axes: Axes, values: Sequence[AnyFloatArray], smallest_span: float, below_in: float = 0.1) -> None:
    """Choose the y range so that all values are inside, below a row of words and `below_in` above the foot."""
    finite = [one[np.isfinite(one)] for one in values]
    low = min((float(one.min()) for one in finite if one.size), default=0.0)
    high = max((float(one.max()) for one in finite if one.size), default=0.0)
    if high - low < smallest_span:
        middle = (high + low) / 2
        low, high = middle - smallest_span / 2, middle + smallest_span / 2
    tall = height_in(axes)
    top, bottom = WORDS_IN / tall, below_in / tall
    span = (high - low) / max(1 - top - bottom, 0.2)
    axes.set_ylim(low - bottom * span, low + (1 - bottom) * span)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=max(3, round(tall / 0.45)), steps=[1, 2, 5, 10]))


def label_y(axes: Axes, text: str) -> None:
    """Write the quantity and unit beside the axes, as far from them in every panel."""
    axes.set_ylabel(text)
    axes.yaxis.set_label_coords(-LABEL_IN / width_in(axes), 0.5)


def write_words(axes: Axes, pens: Sequence[Pen]) -> None:
    """Name the lines along the panel's upper edge, each beside a piece of it."""
    wide, tall = width_in(axes), height_in(axes)
    words = [pen.word + pen.detail for pen in pens]
    if sum(text_width_in(word, SMALL_PT) + _SWATCH_IN + _APART_IN for word in words) > wide:
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
        x += _SWATCH_IN + text_width_in(word, SMALL_PT) + _APART_IN


def time_axis(axes: Axes, low: float, high: float) -> None:
    """Give the axes their time range; a range of no length is widened."""
    if not high > low:
        low, high = low - 0.5, high + 0.5
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=max(4, round(width_in(axes) / 0.8)), steps=[1, 2, 5, 10]))


def plain_log_x(axes: Axes, low: float, high: float) -> None:
    """Make the x axis logarithmic, with plain numbers at the decades, and at 2 and 5 where there are few of them."""
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    few = high / low < 2e3
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=30))
    axes.xaxis.set_minor_locator(LogLocator(subs=tuple(range(1, 10)), numticks=100))
    axes.xaxis.set_major_formatter(FuncFormatter(_plain_number))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _plain_number(value: float, place: int | None = None) -> str:
    del place
    return f"{value:g}"


def hide_time(axes: Axes) -> None:
    """Leave the tick labels to a panel below."""
    axes.tick_params(labelbottom=False)
