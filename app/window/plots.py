"""Plots against time with limits and cursors, and bar charts; the only module that uses pyqtgraph."""

import html
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pyqtgraph
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QWidget

from dragrig.present.palette import BLACK, GREY, GRID, PAPER
from dragrig.window.trace_pyramid import TracePyramid
from dragrig.window.widgets import SMALL_PX

PlotValues = npt.NDArray[np.floating]
_MIN_COLUMNS = 200
_LEGEND_PER_LINE = 4
_AXIS_Z = -1000.0


class TimePlot:
    """A plot of one quantity against time, with its name written out and lines told apart by width and dashes too."""

    def __init__(self, quantity: str, unit: str, across: str = "Time (s)") -> None:
        self._plot = pyqtgraph.PlotWidget()
        item = self._plot.getPlotItem()
        style = {"color": BLACK, "font-size": f"{SMALL_PX}px"}
        item.setLabel("left", f"{quantity} ({unit})" if unit else quantity, **style)
        item.setLabel("bottom", across, **style)
        item.showGrid(x=True, y=True)
        item.hideButtons()
        for side in ("left", "bottom"):
            axis = item.getAxis(side)
            axis.enableAutoSIPrefix(False)
            axis.setPen(GREY)
            axis.setTextPen(BLACK)
            # Opaque: Qt draws a translucent line ten times slower than one that is not.
            axis.setTickPen(GRID)
            axis.setStyle(tickAlpha=255, maxTickLevel=0)
            axis.setZValue(_AXIS_Z)
        item.getAxis("left").setWidth(84)
        self._plot.setMinimumHeight(145)
        self._item = item
        self._lines: list[PlotLine] = []
        item.getViewBox().sigXRangeChanged.connect(lambda *_: self.redraw())

    @property
    def widget(self) -> QWidget:
        """The plot as a widget."""
        widget: QWidget = self._plot
        return widget

    def line(self, name: str, colour: str, width: float = 2.0, *, dashed: bool = False) -> "PlotLine":
        """Add a line."""
        style = Qt.PenStyle.DashLine if dashed else Qt.PenStyle.SolidLine
        pen = pyqtgraph.mkPen(colour, width=width, style=style)
        made = PlotLine(self._item.plot(pen=pen, name=name or None, connect="finite", skipFiniteCheck=False))
        self._lines.append(made)
        return made

    def title(self, *words: tuple[str, str]) -> None:
        """Write above the plot what its lines are, each word with its colour."""
        each = [f'<span style="color:{colour}">▬</span> {html.escape(word)}' for word, colour in words]
        lines = [" &nbsp; ".join(each[at : at + _LEGEND_PER_LINE]) for at in range(0, len(each), _LEGEND_PER_LINE)]
        self._item.setTitle("<br>".join(lines), size=f"{SMALL_PX}px", color=BLACK)
        height = 6 + 1.6 * SMALL_PX * max(len(lines), 1)
        self._item.titleLabel.setMaximumHeight(height)
        self._item.layout.setRowFixedHeight(0, height)

    def rename(self, quantity: str, unit: str) -> None:
        """Show another quantity."""
        style = {"color": BLACK, "font-size": f"{SMALL_PX}px"}
        self._item.setLabel("left", f"{quantity} ({unit})" if unit else quantity, **style)

    def forget_lines(self) -> None:
        """Take all lines away."""
        for line in self._lines:
            self._item.removeItem(line.drawn)
        self._lines = []

    def level(self, value: float, words: str, *, aside: bool = False) -> None:
        """Draw a limit across the plot; its words stand in the middle, or above it and aside."""
        line = pyqtgraph.InfiniteLine(
            pos=value,
            angle=0,
            pen=pyqtgraph.mkPen(GREY, width=1.5, style=Qt.PenStyle.DotLine),
            label=words,
            labelOpts={
                "color": GREY,
                "position": 0.85 if aside else 0.5,
                "anchors": [(0.5, 1.0)] * 2 if aside else None,
            },
        )
        self._item.addItem(line)

    def forget_levels(self) -> None:
        """Take limits away."""
        for one in list(self._item.items):
            if isinstance(one, pyqtgraph.InfiniteLine) and not one.movable:
                self._item.removeItem(one)

    def cursor(self, name: str, colour: str, moved: Callable[[float], None]) -> "PlotCursor":
        """Add an upright line that can be dragged; `moved` is told its time."""
        line = pyqtgraph.InfiniteLine(
            angle=90, movable=True, pen=pyqtgraph.mkPen(colour, width=2), hoverPen=pyqtgraph.mkPen(colour, width=4),
            label=name, labelOpts={"color": colour, "position": 0.94, "fill": PAPER},
        )  # fmt: skip
        line.setVisible(False)
        line.sigPositionChanged.connect(lambda *_: moved(float(line.value())))
        self._item.addItem(line, ignoreBounds=True)
        return PlotCursor(line)

    def follow(self, other: "TimePlot") -> None:
        """Show the same times as another plot."""
        self._item.setXLink(other._item)  # noqa: SLF001  # two of one kind

    def hide_times(self) -> None:
        """Leave the times to the plot below."""
        self._item.getAxis("bottom").setStyle(showValues=False)
        self._item.setLabel("bottom", "")
        self._plot.setMinimumHeight(80)

    def show_times(self, start: float, stop: float) -> None:
        """Show from when to when [s]."""
        if stop > start:
            self._item.setXRange(start, stop, padding=0.01)

    def fit(self) -> None:
        """Show everything."""
        ends = [line.ends for line in self._lines if line.ends is not None]
        if ends:
            self.show_times(min(end[0] for end in ends), max(end[1] for end in ends))
        self._item.enableAutoRange(axis="y")
        self.redraw()

    def zoom(self, factor: float) -> None:
        """Show a span of times so many times as long, about the same middle."""
        low, high = self.shown()
        half = 0.5 * factor * (high - low)
        self._item.setXRange(0.5 * (low + high) - half, 0.5 * (low + high) + half, padding=0)

    def pan(self, share: float) -> None:
        """Show later times, by a share of what is shown; earlier ones where it is negative."""
        low, high = self.shown()
        by = share * (high - low)
        self._item.setXRange(low + by, high + by, padding=0)

    def shown(self) -> tuple[float, float]:
        """Return from when to when [s] the plot shows."""
        low, high = self._item.getViewBox().viewRange()[0]
        return float(low), float(high)

    def redraw(self) -> None:
        """Bring every line to what is shown now; costs the same however long they are."""
        low, high = self.shown()
        columns = max(_MIN_COLUMNS, int(self._item.getViewBox().width()))
        for line in self._lines:
            line.redraw(low, high, columns)
        # Now: while it is painted, a new range would have it painted once more.
        self._item.getViewBox().updateAutoRange()


class PlotLine:
    """A line of a panel: points given as they are, or a trace of any length."""

    def __init__(self, drawn: "pyqtgraph.PlotDataItem") -> None:
        self.drawn = drawn
        self._trace: TracePyramid | None = None
        self._rate_hz, self._start_s = 1.0, 0.0
        self._ends: tuple[float, float] | None = None

    @property
    def ends(self) -> tuple[float, float] | None:
        """First and last time [s]."""
        if self._trace is not None and self._trace.count:
            return self._start_s, self._start_s + self._trace.count / self._rate_hz
        return self._ends

    def points(self, x: PlotValues, y: PlotValues) -> None:
        """Show points as they are."""
        self._trace = None
        self._ends = (float(x[0]), float(x[-1])) if len(x) else None
        self.drawn.setData(x, y)

    def trace(self, values: TracePyramid, rate_hz: float, start_s: float = 0.0) -> None:
        """Show a trace, which may grow; `Panel.redraw` draws it."""
        self._trace, self._rate_hz, self._start_s = values, rate_hz, start_s

    def show(self, *, visible: bool) -> None:
        """Show or hide the line."""
        self.drawn.setVisible(visible)

    @property
    def visible(self) -> bool:
        """Whether the line is shown."""
        return bool(self.drawn.isVisible())

    def redraw(self, low_s: float, high_s: float, columns: int) -> None:
        """Draw what lies between two times."""
        if self._trace is None:
            return
        begin, end = ((one - self._start_s) * self._rate_hz for one in (low_s, high_s))
        # A sample beyond either side, so that lines reach the edges.
        place, values = self._trace.view(begin - 1, end + 1, columns)
        self.drawn.setData(self._start_s + place / self._rate_hz, values)


class PlotCursor:
    """An upright line that can be dragged."""

    def __init__(self, line: "pyqtgraph.InfiniteLine") -> None:
        self._line = line

    @property
    def time_s(self) -> float:
        """Where it stands."""
        return float(self._line.value())

    def place(self, time_s: float, *, visible: bool = True) -> None:
        """Put it somewhere."""
        self._line.setVisible(visible)
        self._line.setValue(time_s)

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return bool(self._line.isVisible())
