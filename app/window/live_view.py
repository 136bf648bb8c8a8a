"""The run in progress: force raw and filtered, position, speed and phase, as curves and as large numbers."""

from dataclasses import dataclass
from math import ceil, floor, isfinite, log10
from threading import Thread

import numpy as np
import numpy.typing as npt
from PySide6.QtWidgets import QCheckBox, QLabel, QWidget

from dragrig.analysis import SavgolSettings, SavgolStream, default_filter_settings
from dragrig.engine_host import PHASE_NAMES, LiveSamples
from dragrig.present import BLUE, GREEN, PALE, PURPLE
from dragrig.window.plots import TimePlot
from dragrig.window.trace_pyramid import TracePyramid
from dragrig.window.widgets import card, column, label, row

MIN_BLOCK_S = 0.0005
"""Samples closer than this are stored as the min and max of blocks this long; the run file has them all."""


@dataclass(frozen=True, slots=True)
class LiveValues:
    """The latest values; filtered force and speed lag by half the filter's window."""

    time_s: float = 0.0
    force_mN: float = float("nan")
    position_mm: float = float("nan")
    speed_mm_s: float = float("nan")
    phase: str = ""


class LiveRun:
    """The traces of a run in progress."""

    def __init__(self, serial: int, rate_hz: float) -> None:
        self.serial, self.rate_hz = serial, rate_hz
        base = max(1, round(MIN_BLOCK_S * rate_hz))
        self.force, self.filtered, self.position, self.speed = (TracePyramid(base) for _ in range(4))
        settings = default_filter_settings(rate_hz)
        self._force = SavgolStream(rate_hz, settings)
        speed = SavgolSettings(settings.window_s, settings.window_samples, order=2, derivative=1)
        self._position = SavgolStream(rate_hz, speed)
        self.latest = LiveValues()

    def take(self, fresh: LiveSamples) -> None:
        """Append samples."""
        if fresh.missed:
            self._skip(fresh.missed)
        self.force.append(fresh.force)
        self.position.append(fresh.position)
        force = self._force.push(fresh.force, fresh.first_index)
        speed = self._position.push(fresh.position, fresh.first_index)
        self.filtered.append(force)
        self.speed.append(speed)
        self._update_latest(fresh, force, speed)

    def _skip(self, missed: int) -> None:
        lost = np.full(missed, np.nan, np.float32)
        for pyramid in (self.force, self.position):
            pyramid.append(lost)
        for pyramid, stream in ((self.filtered, self._force), (self.speed, self._position)):
            pyramid.append(stream.flush())
            pyramid.append(lost)

    def _update_latest(
        self, fresh: LiveSamples, force: npt.NDArray[np.float64], speed: npt.NDArray[np.float64]
    ) -> None:
        phase = int(fresh.phase[-1])
        self.latest = LiveValues(
            time_s=(fresh.first_index + len(fresh.force)) / self.rate_hz,
            force_mN=_last_finite(force, self.latest.force_mN),
            position_mm=_last_finite(fresh.position, self.latest.position_mm),
            speed_mm_s=_last_finite(speed, self.latest.speed_mm_s),
            phase=PHASE_NAMES[phase] if phase < len(PHASE_NAMES) else "",
        )


def _last_finite(values: npt.NDArray[np.floating], before: float) -> float:
    return float(values[-1]) if len(values) and np.isfinite(values[-1]) else before


def preload_filter() -> None:
    """Import the filter's libraries, which takes a second, before the first samples arrive."""
    stream = SavgolStream(1000.0, default_filter_settings(1000.0))
    stream.push(np.zeros(200))


RECENT_SPAN_S = 10.0
_READOUT_WIDTHS_PX = {"force": 175, "position": 200, "speed": 205, "phase": 185}
"""Minimum widths of the readings [px], for the longest values."""


class LiveView(QWidget):
    """Live traces and readings; the last run stays until the next one starts."""

    def __init__(self) -> None:
        super().__init__()
        self.run: LiveRun | None = None
        self.title = label("No run yet: choose a plan, check the preview, and start.", "title")
        self.readings = {name: label("–", "reading") for name in ("force", "position", "speed", "phase", "time")}
        self.only_last = QCheckBox(f"Onl&y the last {RECENT_SPAN_S:g} s")
        self.only_last.toggled.connect(lambda _: self._draw())
        self.force = TimePlot("Force", "mN")
        self.position = TimePlot("Position", "mm")
        self.speed = TimePlot("Speed", "mm/s")
        for upper in (self.force, self.position):
            upper.hide_times()
            upper.follow(self.speed)
        self.force.title(("raw", PALE), ("filtered", BLUE))
        self._raw = self.force.line("raw", PALE, 1.0)
        self._filtered = self.force.line("filtered", BLUE, 2.5)
        self._position = self.position.line("", GREEN, 2.0)
        self._speed = self.speed.line("", PURPLE, 2.0)
        numbers = row(*(self._reading(name, value) for name, value in self.readings.items()), 1)
        layout = column(
            row(self.title, 1, self.only_last),
            numbers,
            self.force.widget,
            self.position.widget,
            self.speed.widget,
            margin=8,
            stretch={2: 6, 3: 4, 4: 5},
        )
        self.setLayout(layout)
        Thread(target=preload_filter, name="warm-up", daemon=True).start()

    def begin(self, title: str) -> None:
        """Show the title of the run."""
        self.title.setText(title)

    def take(self, fresh: LiveSamples) -> None:
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
        self._show_readings(self.run.latest)
        if self.isVisible():
            self._draw()

    def _draw(self) -> None:
        if self.run is None:
            return
        before = self.speed.shown()
        self.speed.show_times(*_time_range(self.run.latest.time_s, only_last=self.only_last.isChecked()))
        # A new time range redraws all three plots, which share it.
        if self.speed.shown() == before:
            for panel in (self.force, self.position, self.speed):
                panel.redraw()

    def _show_readings(self, latest: LiveValues) -> None:
        for name, value, digits, unit in (
            ("force", latest.force_mN, 0, "mN"),
            ("position", latest.position_mm, 2, "mm"),
            ("speed", latest.speed_mm_s, 1, "mm/s"),
            ("time", latest.time_s, 1, "s"),
        ):
            self.readings[name].setText(f"{value:.{digits}f} {unit}".replace("-", "−") if isfinite(value) else "–")
        self.readings["phase"].setText(latest.phase or "–")

    def _reading(self, name: str, value: QLabel) -> QWidget:
        value.setMinimumWidth(_READOUT_WIDTHS_PX.get(name, 120))
        value.setAccessibleName(name)
        return card(label(name.capitalize(), "faint"), value)


def _time_range(time_s: float, *, only_last: bool) -> tuple[float, float]:
    """Return the time range to show; it grows in steps, so that the axis is mostly still and cheap to draw."""
    step = 1.0 if only_last else 10.0 ** floor(log10(max(time_s, 1.0))) / 2
    end = step * ceil(max(time_s, step) / step)
    return (max(0.0, end - RECENT_SPAN_S) if only_last else 0.0), end
