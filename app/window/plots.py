"""Plots against time, or another quantity, with limits and cursors; the only module that uses pyqtgraph."""

import html
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import numpy.typing as npt
import pyqtgraph
from pyqtgraph.exporters import SVGExporter
from PySide6.QtCore import QEvent, QObject, QPoint, QRectF, QSize, Qt, Signal
from PySide6.QtGui import QImage, QPainter
from PySide6.QtWidgets import QMenu, QToolTip, QWidget

from dragrig.analysis import printable
from dragrig.present import BLACK, GREY, GRID, PAPER
from dragrig.window.trace_pyramid import TracePath, TracePyramid
from dragrig.window.widgets import SMALL_PX, ask_where, png_of, require_ending, save_picture, themed

PlotValues = npt.NDArray[np.floating]
_MIN_COLUMNS = 200
_AXIS_PX = 84
"""Width of the numbers and the label beside a plot."""
_LEAST_LEGEND_PX = 100
_LEGEND_MARK_LETTERS = 4
"""Room for the mark before an entry, and between entries."""
_AXIS_Z = -1000.0
_LETTER_PX = 0.62 * SMALL_PX
"""Width of a letter of an axis label, on average."""


def _as_html(text: str) -> str:
    """Return a text for pyqtgraph, which takes titles and labels of axes as HTML."""
    return html.escape(printable(text))


def _label_style() -> dict[str, str]:
    return {"color": themed(BLACK), "font-size": f"{SMALL_PX}px"}


class _StyleWatch(QObject):
    """Says when the colours of a widget have changed."""

    changed = Signal()

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Look at an event and leave it to the widget."""
        if event.type() is QEvent.Type.PaletteChange:
            self.changed.emit()
        return super().eventFilter(watched, event)


class TimePlot:
    """A plot of one quantity against time, or another; lines differ in width and dashes as well as colour."""

    def __init__(self, quantity: str, unit: str) -> None:
        # Its menu has number fields of its own, which ignore a decimal comma without a word.
        self._plot = pyqtgraph.PlotWidget(enableMenu=False)
        self.widget: QWidget = self._plot
        item = self._plot.getPlotItem()
        item.showGrid(x=True, y=True)
        item.hideButtons()
        for side in ("left", "bottom"):
            axis = item.getAxis(side)
            axis.enableAutoSIPrefix(False)
            # Opaque: Qt draws translucent lines ten times slower.
            axis.setStyle(tickAlpha=255, maxTickLevel=0)
            axis.setZValue(_AXIS_Z)
        item.getAxis("left").setWidth(_AXIS_PX)
        self._plot.setMinimumSize(200, 88)
        self._item = item
        self._legend: tuple[tuple[str, str], ...] = ()
        self._legend_lines: list[str] = []
        self.set_quantity(quantity, unit)
        item.getViewBox().sigResized.connect(lambda _: self._fit_texts())
        self.lines: list[PlotLine] = []
        self._together = [self]
        """The plots of the same times, from above."""
        self._plot.scene().sigMouseClicked.connect(self._offer_picture)
        watch = _StyleWatch(self._plot)
        watch.changed.connect(self._colour)
        self._plot.installEventFilter(watch)
        self._colour()
        self.set_x_quantity("Time", "s")
        self._empty, self._times_shown = False, True
        self._follow_data()
        item.getViewBox().sigXRangeChanged.connect(lambda *_: self.redraw())

    def line(
        self, name: str, colour: str, width: float = 2.0, *, dashed: bool = False, marked: bool = False
    ) -> "PlotLine":
        """Add a line, with a mark at each of its points or without."""
        style = Qt.PenStyle.DashLine if dashed else Qt.PenStyle.SolidLine
        pen = pyqtgraph.mkPen(themed(colour), width=width, style=style)
        marks = {"symbol": "o", "symbolSize": 9, "symbolBrush": pen.color(), "symbolPen": None} if marked else {}
        drawn = self._item.plot(pen=pen, name=name or None, connect="finite", skipFiniteCheck=False, **marks)
        made = PlotLine(drawn, colour)
        self.lines.append(made)
        return made

    def _colour(self) -> None:
        """Take the colours of the desktop, light or dark."""
        self._plot.setBackground(themed(PAPER))
        for side in ("left", "bottom"):
            axis = self._item.getAxis(side)
            axis.setPen(themed(GREY))
            axis.setTextPen(themed(BLACK))
            axis.setTickPen(themed(GRID))
            axis.setLabel(axis.labelText, **_label_style())
        for line in self.lines:
            pen = pyqtgraph.mkPen(line.drawn.opts["pen"])
            pen.setColor(pyqtgraph.mkColor(themed(line.colour)))
            line.drawn.setPen(pen)
            line.drawn.setSymbolBrush(pen.color())
        self._legend_lines = []
        self._fit_texts()

    def title(self, *entries: tuple[str, str]) -> None:
        """Write a legend above the plot: text and colour of each line."""
        self._legend = entries
        self._wrap_legend()

    def _fit_texts(self) -> None:
        self._label_fits()
        if self._legend:
            self._wrap_legend()

    def _wrap_legend(self) -> None:
        """Write as many entries on a line as there is room for."""
        room = max(self._plot.viewport().width() - _AXIS_PX, _LEAST_LEGEND_PX)
        lines: list[str] = []
        left = 0.0
        for text, colour in self._legend:
            entry = f'<span style="color:{themed(colour)}">▬</span> {_as_html(text)}'
            width = (len(text) + _LEGEND_MARK_LETTERS) * _LETTER_PX
            if lines and width <= left:
                lines[-1] += f" &nbsp; {entry}"
            else:
                lines.append(entry)
                left = room
            left -= width
        if lines == self._legend_lines:
            return
        self._legend_lines = lines
        self._item.setTitle("<br>".join(lines), size=f"{SMALL_PX}px", color=themed(BLACK))
        height = 6 + 1.6 * SMALL_PX * max(len(lines), 1)
        self._item.titleLabel.setMaximumHeight(height)
        # Or the plot could not become narrower than its legend is now.
        self._item.titleLabel.setMinimumWidth(0)
        self._item.layout.setRowFixedHeight(0, height)

    def set_quantity(self, quantity: str, unit: str) -> None:
        """Change the label of the vertical axis."""
        self._quantity, self._unit = quantity, unit
        self._label_fits()

    def set_x_quantity(self, quantity: str, unit: str) -> None:
        """Change the label of the horizontal axis."""
        self._item.setLabel("bottom", _as_html(f"{quantity} ({unit})" if unit else quantity), **_label_style())

    def name_places(self, names: Mapping[float, str]) -> None:
        """Name places of the horizontal axis, in place of its numbers."""
        self._item.getAxis("bottom").setTicks([list(names.items())])

    def clear(self) -> None:
        """Draw nothing; lines and limits stay."""
        for line in self.lines:
            line.points(np.zeros(0), np.zeros(0))
        self.redraw()

    def _label_fits(self) -> None:
        """Label the vertical axis with as much as a low plot has room for."""
        whole = f"{self._quantity} ({self._unit})" if self._unit else self._quantity
        room = self._item.getViewBox().height()
        fits = (text for text in (whole, self._unit) if len(text) * _LETTER_PX <= room)
        self._item.setLabel("left", _as_html(next(fits, "")), **_label_style())

    def remove_lines(self) -> None:
        """Remove all lines."""
        for line in self.lines:
            self._item.removeItem(line.drawn)
        self.lines = []

    def stage_limits(self, lowest_mm: float, highest_mm: float, *, in_view: bool = True) -> None:
        """Draw the limits of the stage, whose labels do not cover each other where they are close."""
        self.level(lowest_mm, "lower limit", at=0.88, in_view=in_view)
        self.level(highest_mm, "upper limit", at=0.12, in_view=in_view)

    def level(self, value: float, text: str, *, at: float = 0.5, above: bool = False, in_view: bool = True) -> None:
        """Draw a horizontal limit with a label at a share of its length, inwards of it or above.

        It is always shown, or without `in_view` only where the lines come near it; not while there are no lines.
        """
        line = pyqtgraph.InfiniteLine(
            pos=value,
            angle=0,
            pen=pyqtgraph.mkPen(themed(GREY), width=1.5, style=Qt.PenStyle.DotLine),
            label=text,
            labelOpts={
                "color": themed(GREY),
                "position": at,
                "anchors": [(0.5, 1.0)] * 2 if above else None,
            },
        )
        line.setVisible(not self._empty)
        self._item.addItem(line, ignoreBounds=not in_view)

    @property
    def levels(self) -> tuple[float, ...]:
        """The limits."""
        return tuple(float(line.value()) for line in self._level_lines())

    def remove_levels(self) -> None:
        """Remove all limits."""
        for line in self._level_lines():
            self._item.removeItem(line)

    def _level_lines(self) -> list[pyqtgraph.InfiniteLine]:
        return [item for item in self._item.items if isinstance(item, pyqtgraph.InfiniteLine) and not item.movable]

    def cursor(self, name: str, colour: str, moved: Callable[[float], None]) -> "PlotCursor":
        """Add a vertical line that can be dragged; `moved` is called with its time."""
        colour = themed(colour)
        line = pyqtgraph.InfiniteLine(
            angle=90, movable=True, pen=pyqtgraph.mkPen(colour, width=2), hoverPen=pyqtgraph.mkPen(colour, width=4),
            label=name, labelOpts={"color": colour, "position": 0.94, "fill": themed(PAPER)},
        )  # fmt: skip
        line.setVisible(False)
        line.sigPositionChanged.connect(lambda *_: moved(float(line.value())))
        self._item.addItem(line, ignoreBounds=True)
        return PlotCursor(line)

    def follow(self, leader: "TimePlot") -> None:
        """Show the same times as another plot."""
        self._item.setXLink(leader._item)  # noqa: SLF001  # another object of this class
        self._together = leader._together  # noqa: SLF001
        self._together.insert(len(self._together) - 1, self)

    def _offer_picture(self, click: "pyqtgraph.GraphicsScene.mouseEvents.MouseClickEvent") -> None:
        """Offer to save the picture at a click of the right button, which zooms where it is dragged."""
        if click.button() is not Qt.MouseButton.RightButton:
            return
        click.accept()
        menu = QMenu(self._plot)
        menu.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        for ending in _PICTURES:
            ask = partial(ask_where, self._plot, self._quantity, ending, self._save)
            menu.addAction(f"Save the picture as {ending.upper()} …", ask)
        menu.popup(click.screenPos().toPoint())

    def _save(self, path: str) -> None:
        QToolTip.showText(self._plot.mapToGlobal(QPoint()), save_picture(path, self.picture), self._plot)

    def picture(self, ending: str) -> bytes:
        """Return this plot and those of the same times, as they are on the screen, as a file of this ending.

        Raises `OutputError` for an ending that is neither svg nor png.
        """
        require_ending(ending, _PICTURES)
        shown = [plot._plot for plot in self._together if plot.widget.isVisible()]  # noqa: SLF001
        tops = [sum(above.height() for above in shown[:at]) for at in range(len(shown))]
        size = QSize(max(plot.width() for plot in shown), sum(plot.height() for plot in shown))
        if ending == "svg":
            parts = "".join(_svg_part(plot, top) for plot, top in zip(shown, tops, strict=True))
            return f'<svg xmlns="{_SVG}" viewBox="0 0 {size.width()} {size.height()}">{parts}</svg>'.encode()
        picture = QImage(size * _PNG_SCALE, QImage.Format.Format_RGB32)
        picture.setDevicePixelRatio(_PNG_SCALE)
        painter = QPainter(picture)
        for plot, top in zip(shown, tops, strict=True):
            plot.render(painter, QRectF(plot.rect().translated(0, top)), plot.rect())
        painter.end()
        return png_of(picture)

    def hide_times(self) -> None:
        """Hide the time axis; a plot below shows it."""
        self._times_shown = False
        self._item.getAxis("bottom").setStyle(showValues=False)
        self._item.setLabel("bottom", "")
        self._plot.setMinimumHeight(52)

    def show_times(self, start: float, stop: float) -> None:
        """Set the time range [s]."""
        if stop > start:
            self._item.setXRange(start, stop, padding=0.01)

    def fit(self) -> None:
        """Show all samples."""
        ends = [line.ends for line in self.lines if line.ends is not None]
        if ends:
            self.show_times(min(end[0] for end in ends), max(end[1] for end in ends))
        self._item.enableAutoRange(axis="y")
        self.redraw()

    def zoom(self, factor: float) -> None:
        """Scale the time range about its middle; below 1 zooms in."""
        low, high = self.shown()
        half = 0.5 * factor * (high - low)
        self._item.setXRange(0.5 * (low + high) - half, 0.5 * (low + high) + half, padding=0)

    def pan(self, share: float) -> None:
        """Shift the time range by a share of its length."""
        low, high = self.shown()
        shift = share * (high - low)
        self._item.setXRange(low + shift, high + shift, padding=0)

    def shown(self) -> tuple[float, float]:
        """Return the time range [s]."""
        low, high = self._item.getViewBox().viewRange()[0]
        return float(low), float(high)

    def redraw(self) -> None:
        """Redraw every line for the present time range, in a time independent of its length."""
        low, high = self.shown()
        columns = max(_MIN_COLUMNS, int(self._item.getViewBox().width()))
        for line in self.lines:
            line.redraw(low, high, columns)
        self._follow_data()
        # Now, not while painting: a new range would paint it twice.
        self._item.getViewBox().updateAutoRange()

    def _follow_data(self) -> None:
        """Show no numbers and no limits where nothing is drawn: they would be of nothing."""
        empty = all(line.ends is None for line in self.lines)
        if empty == self._empty:
            return
        self._empty = empty
        self._item.getAxis("left").setStyle(showValues=not empty)
        self._item.getAxis("bottom").setStyle(showValues=not empty and self._times_shown)
        for line in self._level_lines():
            line.setVisible(not empty)


_PICTURES = ("png", "svg")
_PNG_SCALE = 4
"""Dots of a saved picture per dot of the screen: about those of print."""
_SVG = "http://www.w3.org/2000/svg"


def _svg_part(plot: "pyqtgraph.PlotWidget", top: int) -> str:
    """Return a plot as a part of an SVG document, so far below its top."""
    whole: str = SVGExporter(plot.getPlotItem()).export(toBytes=True).decode().partition("?>")[2]
    place = f'<svg y="{top}" width="{plot.width()}" height="{plot.height()}" '
    # Its names are those of every other part.
    return whole.replace("<svg ", place, 1).replace("ViewBox_1", f"ViewBox_1_{top}")


class PlotLine:
    """A line of a plot: points, or a trace of any length."""

    def __init__(self, drawn: "pyqtgraph.PlotDataItem", colour: str) -> None:
        self.drawn, self.colour = drawn, colour
        self._trace: TracePyramid | None = None
        self._path: TracePath | None = None
        self._rate_hz, self._start_s = 1.0, 0.0
        self._ends: tuple[float, float] | None = None

    @property
    def ends(self) -> tuple[float, float] | None:
        """First and last time [s], or lowest and highest x."""
        if self._trace is not None and self._trace.count:
            return self._start_s, self._start_s + self._trace.count / self._rate_hz
        if self._path is not None:
            return self._path.ends
        return self._ends

    def points(self, x: PlotValues, y: PlotValues) -> None:
        """Show points."""
        self._trace = None
        self._ends = (float(x[0]), float(x[-1])) if len(x) else None
        self.drawn.setData(x, y)

    def trace(self, values: TracePyramid, rate_hz: float, start_s: float = 0.0) -> None:
        """Show a trace, which may grow; `TimePlot.redraw` draws it."""
        self._trace, self._rate_hz, self._start_s = values, rate_hz, start_s

    def path(self, path: TracePath) -> None:
        """Show a trace against another channel; `TimePlot.redraw` draws it."""
        self._path = path

    def redraw(self, low_s: float, high_s: float, columns: int) -> None:
        """Draw the trace between two times, or two x."""
        if self._path is not None:
            self.drawn.setData(*self._path.view(low_s, high_s, columns))
            return
        if self._trace is None:
            return
        begin, end = ((time_s - self._start_s) * self._rate_hz for time_s in (low_s, high_s))
        # A sample more on either side, so that the line reaches the edges.
        indices, values = self._trace.view(begin - 1, end + 1, columns)
        self.drawn.setData(self._start_s + indices / self._rate_hz, values)


class PlotCursor:
    """A vertical line that can be dragged."""

    def __init__(self, line: "pyqtgraph.InfiniteLine") -> None:
        self._line = line

    @property
    def time_s(self) -> float:
        """Position [s]."""
        return float(self._line.value())

    def place(self, time_s: float, *, visible: bool = True) -> None:
        """Move it."""
        self._line.setVisible(visible)
        self._line.setValue(time_s)
