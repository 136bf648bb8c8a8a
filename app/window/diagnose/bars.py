"""Horizontal bars with their names and values written beside them."""

from collections.abc import Sequence

import pyqtgraph
from PySide6.QtWidgets import QWidget

from dragrig.figures.palette import BLACK, GREY


class Bars:
    """A bar for each name, the first on top, from 0 to 1."""

    def __init__(self) -> None:
        self._plot = pyqtgraph.PlotWidget()
        self._item = self._plot.getPlotItem()
        self._item.hideButtons()
        self._item.setMouseEnabled(x=False, y=False)
        self._item.setMenuEnabled(False)
        self._item.setXRange(0.0, 1.12, padding=0)
        self._item.setLabel("bottom", "Probability", color=BLACK)
        self._item.getAxis("bottom").setTicks([[(tenth / 10, f"{tenth / 10:g}") for tenth in range(0, 11, 2)]])
        self._item.getAxis("left").setTextPen(BLACK)
        self._item.getAxis("left").setPen(GREY)

    @property
    def widget(self) -> QWidget:
        """The bars as a widget."""
        widget: QWidget = self._plot
        return widget

    def show_bars(self, bars: Sequence[tuple[str, float, str, str]]) -> None:
        """Show bars: name, value, what stands beside it, colour."""
        self._item.clear()
        for at, (_, value, words, colour) in enumerate(bars):
            self._item.addItem(
                pyqtgraph.BarGraphItem(x0=0, y=[-at], height=0.62, width=[value], brush=colour, pen=colour)
            )
            text = pyqtgraph.TextItem(words, color=BLACK, anchor=(0, 0.5))
            text.setPos(value + 0.01, -at)
            self._item.addItem(text)
        self._item.getAxis("left").setTicks([[(-at, name) for at, (name, *_) in enumerate(bars)]])
        self._item.setYRange(-len(bars) + 0.4, 0.6, padding=0)
