"""The run under way: force raw and filtered, position, speed and phase, as curves and as numbers for a metre away."""

from math import ceil, floor, isfinite, log10
from threading import Thread

from PySide6.QtWidgets import QCheckBox, QLabel, QWidget

from dragrig.engine_host.live import Fresh
from dragrig.figures.palette import BLUE, GREEN, PALE, PURPLE
from dragrig.window.plots.panel import Panel
from dragrig.window.run.live_data import LiveRun, Reading, warm_up
from dragrig.window.widgets import card, column, label, row

LAST_S = 10.0
_WIDTHS = {"force": 175, "position": 200, "speed": 205, "phase": 185}
"""Of readings [px], so that the longest is seen whole."""


class LiveView(QWidget):
    """Draws what comes from the engine; keeps the run that was shown last until the next one begins."""

    def __init__(self) -> None:
        super().__init__()
        self.run: LiveRun | None = None
        self.title = label("No run yet: choose a plan, look at what it will do, and start.", "title")
        self.readings = {name: label("–", "reading") for name in ("force", "position", "speed", "phase", "time")}
        self.only_last = QCheckBox(f"Onl&y the last {LAST_S:g} s")
        self.only_last.toggled.connect(lambda _: self._draw())
        self.force = Panel("Force", "mN")
        self.position = Panel("Position", "mm")
        self.speed = Panel("Speed", "mm/s")
        for upper in (self.force, self.position):
            upper.hide_times()
            upper.follow(self.speed)
        self.force.title(("raw", PALE), ("filtered", BLUE))
        self._raw = self.force.line("raw", PALE, 1.0)
        self._filtered = self.force.line("filtered", BLUE, 2.5)
        self._position = self.position.line("", GREEN, 2.0)
        self._speed = self.speed.line("", PURPLE, 2.0)
        numbers = row(*(self._number(name, value) for name, value in self.readings.items()), 1)
        layout = column(
            row(self.title, 1, self.only_last), numbers, self.force.widget, self.position.widget, self.speed.widget,
            margin=8,
        )  # fmt: skip
        layout.setStretch(2, 6)
        layout.setStretch(3, 4)
        layout.setStretch(4, 5)
        self.setLayout(layout)
        Thread(target=warm_up, name="warm-up", daemon=True).start()

    def begin(self, words: str) -> None:
        """Say which run it is."""
        self.title.setText(words)

    def take(self, fresh: Fresh) -> None:
        """Show samples."""
        if self.run is None or self.run.serial != fresh.serial:
            self.run = LiveRun(fresh.serial, fresh.rate_hz)
            for line, values in (
                (self._raw, self.run.force),
                (self._filtered, self.run.filtered),
                (self._position, self.run.position),
                (self._speed, self.run.speed),
            ):
                line.trace(values, fresh.rate_hz)
        self.run.take(fresh)
        self._tell(self.run.latest)
        if self.isVisible():
            self._draw()

    def _draw(self) -> None:
        if self.run is None:
            return
        before = self.speed.shown()
        self.speed.show_times(*_times(self.run.latest.time_s, only_last=self.only_last.isChecked()))
        # A new range of times redraws all three, which are tied to each other.
        if self.speed.shown() == before:
            for panel in (self.force, self.position, self.speed):
                panel.redraw()

    def _tell(self, latest: Reading) -> None:
        for name, value, digits, unit in (
            ("force", latest.force_mN, 0, "mN"),
            ("position", latest.position_mm, 2, "mm"),
            ("speed", latest.speed_mm_s, 1, "mm/s"),
            ("time", latest.time_s, 1, "s"),
        ):
            self.readings[name].setText(f"{value:.{digits}f} {unit}".replace("-", "−") if isfinite(value) else "–")
        self.readings["phase"].setText(latest.phase or "–")

    def _number(self, name: str, value: QLabel) -> QWidget:
        value.setMinimumWidth(_WIDTHS.get(name, 120))
        value.setAccessibleName(name)
        return card(label(name.capitalize(), "faint"), value)


def _times(now_s: float, *, only_last: bool) -> tuple[float, float]:
    """Return what is to be shown; it goes on in steps, so that axes stand still to be read, and cost nothing."""
    step = 1.0 if only_last else 10.0 ** floor(log10(max(now_s, 1.0))) / 2
    end = step * ceil(max(now_s, step) / step)
    return (max(0.0, end - LAST_S) if only_last else 0.0), end
