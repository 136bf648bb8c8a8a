"""Traces laid over each other: zoom, filter with immediate effect, two cursors that tell their values."""

from collections.abc import Sequence

import numpy as np
from PySide6.QtGui import QKeySequence, QShortcut
from PySide6.QtWidgets import QCheckBox, QComboBox, QDoubleSpinBox, QSpinBox, QWidget

from dragrig.figures.palette import BLACK, CYCLE, PALE, VERMILLION, tint
from dragrig.looking import ShownTrace
from dragrig.window.plots.panel import Cursor, Panel
from dragrig.window.plots.pyramid import Pyramid
from dragrig.window.widgets import button, column, fill, label, row, table

MOST = 7
"""So many runs lie over each other at once, each with a colour of its own."""

_STEP = 0.2
_CURSOR_STEPS = 200


class Overlay(QWidget):
    """Draws runs; what the filter makes of them stands in the foreground, the raw trace behind it."""

    def __init__(self) -> None:
        super().__init__()
        self.traces: list[ShownTrace] = []
        self.top, self.below = Panel("Force", "mN"), Panel("Speed", "mm/s")
        self.top.hide_times()
        self.top.follow(self.below)
        self.channel = QComboBox()
        self.channel.addItems(["force"])
        self.channel.setAccessibleName("Channel")
        self.channel.currentTextChanged.connect(lambda _: self.draw())
        self.raw = QCheckBox("Ra&w")
        self.raw.setChecked(True)
        self.raw.toggled.connect(lambda _: self.draw())
        self.window_ms = QDoubleSpinBox()
        self.window_ms.setRange(1.0, 5000.0)
        self.window_ms.setValue(50.0)
        self.window_ms.setSuffix(" ms")
        self.window_ms.setKeyboardTracking(False)
        self.window_ms.setAccessibleName("Length of the filter's window")
        self.order = QSpinBox()
        self.order.setRange(0, 8)
        self.order.setValue(3)
        self.order.setAccessibleName("Order of the filter")
        self.fit = button(
            "Show a&ll", self.show_all, help_="Everything, from the first sample to the last", keys="Ctrl+0"
        )
        self.cursors = QCheckBox("&Cursors")
        self.cursors.toggled.connect(lambda shown: self._show_cursors(shown=shown))
        self.values = table(("Run", "At A", "At B", "B − A"))
        self.values.setAccessibleName("Values at the cursors")
        self.values.setMaximumHeight(170)
        self.values.hide()
        self._pyramids: dict[tuple[int, str, bool], Pyramid] = {}
        self._cursors = tuple(
            self.top.cursor(name, colour, lambda _: self._tell()) for name, colour in (("A", BLACK), ("B", VERMILLION))
        )
        controls = row(
            label("Channel"), self.channel, self.raw, label("Filter"), self.window_ms, label("order"), self.order, 1,
            self.cursors, self.fit,
        )  # fmt: skip
        layout = column(controls, self.top.widget, self.below.widget, self.values, margin=8)
        layout.setStretch(1, 3)
        layout.setStretch(2, 2)
        self.setLayout(layout)
        self._listen_to_keys()

    def show_traces(self, traces: Sequence[ShownTrace]) -> None:
        """Show runs in place of those before; where the same runs were shown, what is seen of them stays."""
        same = [one.path for one in traces] == [one.path for one in self.traces]
        self.traces = list(traces)
        self._pyramids = {}
        chosen = self.channel.currentText()
        names = list(dict.fromkeys(name for one in traces for name in one.channels)) or ["force"]
        self.channel.blockSignals(True)
        self.channel.clear()
        self.channel.addItems(names)
        self.channel.setCurrentText(chosen if chosen in names else names[0])
        self.channel.blockSignals(False)
        self.draw()
        if not same:
            self.show_all()

    def draw(self) -> None:
        """Draw the lines anew."""
        name = self.channel.currentText()
        for panel in (self.top, self.below):
            panel.forget_lines()
        unit = next((one.units.get(name, "") for one in self.traces), "")
        self.top.rename(name.replace("_", " ").capitalize(), unit)
        if self.raw.isChecked():
            for at, one in enumerate(self.traces):
                if name in one.channels:
                    colour = PALE if len(self.traces) == 1 else tint(CYCLE[at % MOST])
                    self._put(self.top, at, name, colour, 1.0, filtered=False)
        for at, one in enumerate(self.traces):
            colour = CYCLE[at % MOST]
            # A channel that no filter was made for is shown as it is.
            self._put(self.top, at, name, colour, 2.0, filtered=name in one.filtered)
            if "speed" in one.filtered:
                self._put(self.below, at, "speed", colour, 2.0, filtered=True)
        self.top.title(*((one.words, CYCLE[at % MOST]) for at, one in enumerate(self.traces)))
        for panel in (self.top, self.below):
            panel.redraw()
        self._tell()

    def show_all(self) -> None:
        """Show everything."""
        for panel in (self.below, self.top):
            panel.fit()

    def place_cursors(self, first_s: float, second_s: float) -> None:
        """Put the cursors somewhere."""
        for cursor, time_s in zip(self._cursors, (first_s, second_s), strict=True):
            cursor.place(time_s, visible=self.cursors.isChecked())

    def _listen_to_keys(self) -> None:
        first, second = self._cursors
        for keys, does in (
            ("Ctrl++", lambda: self.below.zoom(0.5)),
            ("Ctrl+-", lambda: self.below.zoom(2.0)),
            ("Ctrl+Left", lambda: self.below.pan(-_STEP)),
            ("Ctrl+Right", lambda: self.below.pan(_STEP)),
            ("Alt+Left", lambda: self._step(first, -1)),
            ("Alt+Right", lambda: self._step(first, 1)),
            ("Alt+Shift+Left", lambda: self._step(second, -1)),
            ("Alt+Shift+Right", lambda: self._step(second, 1)),
        ):
            QShortcut(QKeySequence(keys), self).activated.connect(does)
        self.fit.setToolTip("Everything, from the first sample to the last (Ctrl+0); Ctrl and + − ← → zoom and pan")
        self.cursors.setToolTip("Two times and their values; Alt and ← → move A, with Shift B")

    def _step(self, cursor: Cursor, way: int) -> None:
        if self.cursors.isChecked():
            low, high = self.top.shown()
            cursor.place(cursor.time_s + way * (high - low) / _CURSOR_STEPS)

    def _put(self, panel: Panel, at: int, name: str, colour: str, width: float, *, filtered: bool) -> None:
        trace = self.traces[at]
        source = trace.filtered if filtered else trace.channels
        if name not in source:
            return
        key = (at, name, filtered)
        if key not in self._pyramids:
            self._pyramids[key] = Pyramid()
            self._pyramids[key].append(source[name])
        panel.line("", colour, width).trace(self._pyramids[key], trace.rate_hz, trace.start_s)

    def _show_cursors(self, *, shown: bool) -> None:
        low, high = self.top.shown()
        self.place_cursors(*(low + share * (high - low) for share in (0.33, 0.67)))
        self.values.setVisible(shown)
        self._tell()

    def _tell(self) -> None:
        if not self.cursors.isChecked():
            return
        name = self.channel.currentText()
        first, second = (one.time_s for one in self._cursors)
        rows = [("time (s)", f"{first:.4f}", f"{second:.4f}", f"{second - first:.4f}")]
        for one in self.traces:
            values = one.filtered.get(name, one.channels.get(name))
            if values is not None:
                a, b = (_at(values, (time - one.start_s) * one.rate_hz) for time in (first, second))
                rows.append((f"{one.words}: {name} ({one.units.get(name, '')})", _said(a), _said(b), _said(b - a)))
        fill(self.values, rows)


def _at(values: "np.ndarray[tuple[int, ...], np.dtype[np.float32]]", place: float) -> float:
    index = round(place)
    return float(values[index]) if 0 <= index < len(values) else float("nan")


def _said(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "none"
