"""Style and layout of all figures: header, y ranges, logarithmic axes, legends, labels that do not overlap."""

import threading
import warnings
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import pairwise
from typing import Final, Literal

import numpy as np
from matplotlib import colormaps, style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, fontManager
from matplotlib.gridspec import SubplotSpec
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.text import Annotation, Text
from matplotlib.textpath import TextPath
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from matplotlib.transforms import Bbox

from dragrig.analysis import printable
from dragrig.present.document import (
    BLACK,
    BLUE,
    DOUBLE_COLUMN_MM,
    GREY,
    GRID,
    PAPER,
    PURPLE,
    VERMILLION,
    FigureForm,
    current_figure_form,
)
from dragrig.rig import AnyFloatArray, FloatArray

TITLE_PT: Final = 19.0
TEXT_PT: Final = 13.5
SMALL_PT: Final = 12.0
DPI: Final = 120
PRINT_SCALE: Final = 0.5
"""Scale of figures in print: their letters, of 12 and 13.5 pt, become 6 and 6.8 pt, which journals take."""
MM_PER_INCH: Final = 25.4
MIN_SIDE_BY_SIDE_MM: Final = 120.0
"""Width in print that panels side by side need; where less is wanted, such a figure takes two columns."""

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
    "axes.titlelocation": "left",
    "axes.titlesize": TEXT_PT,
    "axes.titlepad": 8.0,
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
    "errorbar.capsize": 3.0,
    "legend.frameon": False,
    "legend.fontsize": SMALL_PT,
    "legend.loc": "upper left",
    "legend.borderpad": 0.25,
    "legend.borderaxespad": 0.2,
    "legend.handlelength": 1.8,
    "legend.columnspacing": 1.5,
    "figure.constrained_layout.w_pad": 0.1,
    "figure.constrained_layout.h_pad": 0.07,
    "figure.subplot.left": 0.09,
    "figure.subplot.right": 0.97,
    "figure.facecolor": PAPER,
    "savefig.facecolor": PAPER,
    "svg.hashsalt": "dragrig",
    "svg.fonttype": "path",
    # Journals refuse Type 3 fonts.
    "pdf.fonttype": 42,
    "text.usetex": False,
    "text.parse_math": False,
}

_RC_LOCK = threading.RLock()


@contextmanager
def figure_style() -> Iterator[None]:
    """Apply the style of all figures to matplotlib while something is drawn or saved.

    The settings are shared by all threads of a process, so a lock is held, and the caller's own are restored. A
    character that no font has is drawn as a box, without a warning.
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


MARGIN_IN: Final = 0.25
_BADGES = {"simulated": PURPLE, "hardware": BLUE, "external": GREY}

_LAYOUT_DECIMALS = 9
"""Decimals of the figure's width and height to which axes are placed: a billionth is far below a pixel."""


class LabelledLayout(ConstrainedLayoutEngine):
    """Constrained layout, after which labels that stand along an axis are moved until none covers another.

    The solver of the constraints adds them up in the order of their addresses in memory, so that the same figure comes
    out 1e-15 aside from one time to the next, enough for a line to fall on the next pixel. Rounding makes equal figures
    equal pictures.
    """

    def __init__(self, rect: tuple[float, float, float, float], form: FigureForm) -> None:
        super().__init__(rect=rect)
        self.form = form
        self.rows: list[tuple[Axes, Literal["x", "y"], list[Annotation]]] = []

    def execute(self, fig: Figure) -> None:
        """Lay the axes out, then their labels."""
        self._place_axes(fig)
        for axes, along, labels in self.rows:
            _spread_row(axes, 0 if along == "x" else 1, labels)

    def _place_axes(self, fig: Figure) -> None:
        super().execute(fig)
        for axes in filter(Axes.get_in_layout, fig.axes):
            axes.set_position(Bbox(np.round(axes.get_position(original=True).get_points(), _LAYOUT_DECIMALS)))
            axes.set_in_layout(True)  # what is placed by hand is not laid out again


PANEL_NAMES_IN: Final = 0.4
"""Room for the names above a column of panels."""
PANEL_FOOT_IN: Final = 0.6
"""Room for the numbers and the label of a time axis."""
PANEL_GAP_IN: Final = 0.15
"""Between panels with a time axis in common, and between columns."""
Y_LABEL_IN: Final = 0.36
"""Room for a y label beside its axis' numbers."""


class PanelLayout(LabelledLayout):
    """Columns of panels at places that follow from their heights and from the width of their y axes' numbers.

    Of all that stands around the panels only those numbers are measured, so that it takes a fraction of the time of
    constrained layout. Every column has room for names above it. The y labels of a column stand in line.
    """

    def _place_axes(self, fig: Figure) -> None:
        columns: dict[int, list[tuple[Axes, SubplotSpec]]] = {}
        for axes in fig.axes:
            spec = axes.get_subplotspec()
            if spec is not None:
                columns.setdefault(spec.get_topmost_subplotspec().colspan.start, []).append((axes, spec))
        width, height = fig.get_size_inches().tolist()
        left, foot, wide, tall = self.get()["rect"]
        numbers = {place: max(_y_numbers_in(axes) for axes, _ in stack) for place, stack in columns.items()}
        shares = {place: _width_share(stack[0][1]) for place, stack in columns.items()}
        margins = sum(numbers.values()) + Y_LABEL_IN * len(columns) + PANEL_GAP_IN * (len(columns) - 1)
        begin = left * width
        for place in sorted(columns):
            begin += numbers[place] + Y_LABEL_IN
            room = (wide * width - margins) * shares[place] / sum(shares.values())
            for axes, low, high in _stacked(columns[place], foot * height, (foot + tall) * height):
                corners = np.array([[begin / width, low / height], [(begin + room) / width, high / height]])
                axes.set_position(Bbox(np.round(corners, _LAYOUT_DECIMALS)))
                axes.set_in_layout(True)
                axes.yaxis.set_label_coords(-(numbers[place] + 0.12) / room, 0.5)
            begin += room + PANEL_GAP_IN


def _y_numbers_in(axes: Axes) -> float:
    """Width [inch] of the numbers of a y axis, with its ticks."""
    axes.yaxis.set_label_coords(0.0, 0.5)  # nearer than the numbers, and without a search for its place
    box = axes.yaxis.get_tightbbox()
    return 0.0 if box is None else max(float(axes.bbox.x0 - box.x0), 0.0) / DPI


def _width_share(spec: SubplotSpec) -> float:
    top = spec.get_topmost_subplotspec()
    return float(np.asarray(top.get_gridspec().get_width_ratios(), dtype=np.float64)[top.colspan.start])


def _stacked(
    stack: Sequence[tuple[Axes, SubplotSpec]], low_in: float, high_in: float
) -> Iterator[tuple[Axes, float, float]]:
    """Yield the panels of a column with their lower and upper ends [inch]; those of one grid stand close.

    The grids of a column are equally high.
    """
    grids = [spec.get_gridspec() for _, spec in stack]
    heights = [np.asarray(grid.get_height_ratios(), dtype=np.float64) for grid in grids]
    shares = [
        float(ratios[spec.rowspan.start] / ratios.sum() if grids.count(grid) > 1 else 1.0)
        for (_, spec), grid, ratios in zip(stack, grids, heights, strict=True)
    ]
    gaps = [PANEL_GAP_IN if upper is lower else PANEL_FOOT_IN + PANEL_GAP_IN for upper, lower in pairwise(grids)]
    room = high_in - low_in - PANEL_NAMES_IN - PANEL_FOOT_IN - sum(gaps)
    high = high_in - PANEL_NAMES_IN
    for (axes, _), share, gap in zip(stack, shares, [*gaps, 0.0], strict=True):
        low = high - room * share / sum(shares)
        yield axes, low, high
        high = low - gap


def new_figure(
    width_in: float,
    height_in: float,
    title: str = "",
    subtitle: str = "",
    problem: str = "",
    backend: str = "",
    *,
    narrow: bool = False,
    layout: type[LabelledLayout] = LabelledLayout,
) -> Figure:
    """Return an empty figure on an Agg canvas of its own, known to no window system.

    Parameters
    ----------
    height_in
        Height below the header.
    title, subtitle
        The header, cut off where they are wider than the figure.
    problem
        What is wrong with the data shown, below the subtitle.
    backend
        Whether simulated, measured or foreign data are shown, for the figure's corner; by default the badge of the
        current `FigureForm`, whose width, where it has one, comes before `width_in`, and has no title and no badge.
    narrow
        Whether it fits a single column: it has no panels side by side.
    layout
        How its axes are placed: by constraints, or as columns of panels.
    """
    form = current_figure_form()
    backend = backend or form.badge
    if form.width_mm is not None:
        fits = narrow or form.width_mm >= MIN_SIDE_BY_SIDE_MM
        width_in = (form.width_mm if fits else DOUBLE_COLUMN_MM) / MM_PER_INCH / PRINT_SCALE
        title = subtitle = backend = ""
    header_in = 0.32 * bool(subtitle) + 0.32 * bool(problem) + (0.62 if title else 0.5 if backend else 0.0)
    height = height_in + header_in
    figure = Figure(figsize=(width_in, height), dpi=DPI)
    FigureCanvasAgg(figure)
    edge_x, edge_y = MARGIN_IN / width_in, MARGIN_IN / height
    figure.set_layout_engine(layout((edge_x, edge_y, 1 - 2 * edge_x, 1 - (header_in + 0.1) / height - edge_y), form))
    left, room_in, title_in = 1.4 * edge_x, width_in - 2.8 * MARGIN_IN, width_in - 2.8 * MARGIN_IN
    if backend:
        badge = {"boxstyle": "round,pad=0.45", "facecolor": _BADGES.get(backend, BLACK), "edgecolor": "none"}
        figure.text(1 - left, 1 - 0.43 / height, backend.upper(), fontsize=SMALL_PT, fontweight="bold", color="white",
                    ha="right", va="center", bbox=badge)  # fmt: skip
        title_in -= 1.15 * text_width_in(backend.upper(), SMALL_PT) + 0.4
    y_in = 0.5 if title else 0.82 if backend else 0.5
    for text, size_pt, weight, colour, room in (
        (title, TITLE_PT, "bold", BLACK, title_in),
        (subtitle, SMALL_PT, "normal", GREY, room_in),
        (problem, SMALL_PT, "bold", VERMILLION, room_in),
    ):
        if text:
            shown = shortened_to_width(text, size_pt, room, bold=weight == "bold")
            figure.text(left, 1 - y_in / height, shown, fontsize=size_pt, fontweight=weight, color=colour)
            y_in += 0.32
    return figure


def layout_of(figure: Figure | None) -> LabelledLayout:
    """Return the layout of a figure made by `new_figure`."""
    layout = figure.get_layout_engine() if figure is not None else None
    if not isinstance(layout, LabelledLayout):
        raise TypeError("a figure of new_figure() is needed")
    return layout


def lay_out(figure: Figure) -> None:
    """Apply a finished figure's layout, so that saving draws it once and not twice."""
    layout = figure.get_layout_engine()
    if layout is not None and figure.axes:
        layout.execute(figure)
        figure.set_layout_engine(None)


def sequential_colours(count: int) -> tuple[str, ...]:
    """Return colours from dark to light for a sequence of curves, all dark enough for a line on white."""
    return tuple(to_hex(colour) for colour in colormaps["viridis"](np.linspace(0.0, 0.74, count)))


@lru_cache(maxsize=4096)
def text_width_in(text: str, size_pt: float) -> float:
    """Width [inch] that a text takes when drawn upright."""
    text = printable(text)
    if not text.strip():
        return 0.0
    # The outline's points, its control points included, are quick to bound and hardly wider than the outline itself.
    points = np.asarray(TextPath((0, 0), text, size=size_pt, prop=FontProperties(family=_installed_fonts())).vertices)
    return float(np.ptp(points[:, 0])) / 72


LEGEND_IN = 0.36
"""Room that a row of words takes along the upper edge of a panel."""


@dataclass(frozen=True, slots=True)
class LineStyle:
    """Style of a line, its name, and a detail that is shown where there is room."""

    word: str
    colour: str
    width: float
    dashed: bool = False
    detail: str = ""


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


def panel_size_in(axes: Axes) -> tuple[float, float]:
    """Width and height of the axes [inch], before they are laid out only about."""
    return float(axes.bbox.width) / DPI, float(axes.bbox.height) / DPI


def fit_y_range(axes: Axes, values: Sequence[AnyFloatArray], smallest_span: float, below_in: float = 0.1) -> None:
    """Choose the y range so that all values are inside, below a row of words and `below_in` above the foot."""
    finite = [curve[np.isfinite(curve)] for curve in values]
    low = min((float(curve.min()) for curve in finite if curve.size), default=0.0)
    high = max((float(curve.max()) for curve in finite if curve.size), default=0.0)
    if high - low < smallest_span:
        middle = (high + low) / 2
        low, high = middle - smallest_span / 2, middle + smallest_span / 2
    _, tall = panel_size_in(axes)
    top, bottom = LEGEND_IN / tall, below_in / tall
    span = (high - low) / max(1 - top - bottom, 0.2)
    axes.set_ylim(low - bottom * span, low + (1 - bottom) * span)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=max(3, round(tall / 0.45)), steps=[1, 2, 5, 10]))


def write_legend(axes: Axes, pens: Sequence[LineStyle]) -> None:
    """Name the lines along the panel's upper edge, with their details where there is room."""
    words = [pen.word + pen.detail for pen in pens]
    if sum(text_width_in(word, SMALL_PT) + 0.6 for word in words) > panel_size_in(axes)[0]:
        words = [pen.word for pen in pens]
    handles = [
        Line2D([], [], color=pen.colour, linewidth=max(pen.width, 1.6), linestyle=(0, (3, 1.5)) if pen.dashed else "-")
        for pen in pens
    ]
    axes.legend(handles, words, ncols=len(pens))


def set_time_range(axes: Axes, low: float, high: float) -> None:
    """Give the axes their time range; a range of no length is widened."""
    if not high > low:
        low, high = low - 0.5, high + 0.5
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=max(4, round(panel_size_in(axes)[0] / 0.8)), steps=[1, 2, 5, 10]))


def set_log_x(axes: Axes, low: float, high: float) -> None:
    """Make the x axis logarithmic, with plain numbers at the decades, and at 2 and 5 where there are few of them."""
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    few = high / low < 2e3
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=30))
    axes.xaxis.set_minor_locator(LogLocator(subs=tuple(range(1, 10)), numticks=100))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def spread_labels(centres: Sequence[float], widths: Sequence[float], low: float, high: float) -> FloatArray:
    """Move labels along a line, as little as possible, until none covers another.

    Parameters
    ----------
    centres, widths
        Wanted place of each label, in rising order, and its width.
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
    # Relative to labels packed without gaps, "no overlap" means "not decreasing".
    row = np.concatenate(([0.0], np.cumsum((width[:-1] + width[1:]) / 2)))
    placed = np.asarray(isotonic_regression(wanted - row).x)
    first, last = low + width[0] / 2, high - width[-1] / 2 - row[-1]
    return np.asarray(np.clip(placed, first, max(first, last)) + row)


@dataclass(frozen=True, slots=True)
class CurveLabel:
    """A name, the value it labels, and its colour; with `math`, `$…$` is typeset as a formula."""

    value: float
    text: str
    colour: str
    math: bool = False


def label_curves(axes: Axes, labels: Sequence[CurveLabel], size_pt: float = TEXT_PT) -> None:
    """Write names along the right edge of the axes, each as near its value as possible without overlap."""
    _add_label_row(axes, "y", labels, 1.0, 14, size_pt)


def label_times(axes: Axes, labels: Sequence[CurveLabel], edge: float, above_pt: float, *, boxed: bool = False) -> None:
    """Write names above a height of the axes [share of it], each as near its time as possible without overlap."""
    _add_label_row(axes, "x", labels, edge, above_pt, SMALL_PT, boxed=boxed)


def _add_label_row(
    axes: Axes,
    along: Literal["x", "y"],
    labels: Sequence[CurveLabel],
    edge: float,
    offset_pt: float,
    size_pt: float,
    *,
    boxed: bool = False,
) -> None:
    """Write labels in the middle of a row; the layout moves them, and hides the leader lines that are not needed."""
    above = along == "x"
    row = [
        axes.annotate(
            label.text,
            xy=(label.value, edge) if above else (edge, label.value),
            xycoords=("data", "axes fraction") if above else ("axes fraction", "data"),
            xytext=(0.5, offset_pt) if above else (offset_pt, 0.5),
            textcoords=("axes fraction", "offset points") if above else ("offset points", "axes fraction"),
            ha="center" if above else "left",
            va="center",
            fontsize=size_pt,
            color="white" if boxed else label.colour,
            annotation_clip=False,
            parse_math=label.math,
            zorder=6,
            bbox={"boxstyle": "round,pad=0.22", "facecolor": label.colour, "edgecolor": "none"} if boxed else None,
            arrowprops=None if boxed else _leader_line(label.colour, (0.5, 0.0) if above else (0.0, 0.5)),
        )
        for label in labels
    ]
    layout_of(axes.get_figure(root=True)).rows.append((axes, along, row))


def _leader_line(colour: str, anchor: tuple[float, float]) -> dict[str, object]:
    """Return a thin line from a label to its point; `anchor` is its start, in shares of the label's box."""
    line = {"arrowstyle": "-", "color": colour, "linewidth": 0.8}
    return {**line, "relpos": anchor, "patchA": None, "shrinkA": 3, "shrinkB": 0}


def _spread_row(axes: Axes, index: int, labels: Sequence[Annotation]) -> None:
    """Move labels along axis 0 or 1; the layout has measured them before."""
    low, length = axes.bbox.min[index], axes.bbox.size[index]
    rising = sorted(labels, key=lambda label: label.xy[index])
    points = [axes.transData.transform(label.xy)[index] - low for label in rising]
    wanted = np.clip(points, 0.0, length).tolist()
    extents = [Text.get_window_extent(label) for label in rising]
    gaps = [0.5 if label.get_bbox_patch() is None else 1.0 for label in rising]
    sizes = [
        box.width + gap * box.height if index == 0 else 1.1 * box.height for box, gap in zip(extents, gaps, strict=True)
    ]
    for label, point, place in zip(rising, wanted, spread_labels(wanted, sizes, 0.0, length), strict=True):
        text = list(label.xyann)
        text[index] = place / length
        label.xyann = (text[0], text[1])
        if label.arrow_patch is not None:
            label.arrow_patch.set_visible(abs(place - point) > 2.0)


def shortened_to_width(text: str, size_pt: float, room_in: float, *, bold: bool = False) -> str:
    """Return the text on one line, cut off with an ellipsis where it would be wider than the room for it."""
    text = printable(" ".join(text.splitlines()))
    room_in /= 1.15 if bold else 1.02
    if text_width_in(text, size_pt) <= room_in:
        return text
    length = bisect_right(range(len(text)), room_in, key=lambda count: text_width_in(text[:count] + "…", size_pt))
    return text[: length - 1].rstrip() + "…"
