"""The run in progress: force raw and filtered, position, speed and phase, as curves and as large numbers."""

import time
from dataclasses import dataclass
from math import ceil, floor, isfinite, log10
from threading import Thread

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QTimer
from PySide6.QtGui import QShowEvent
from PySide6.QtWidgets import QCheckBox, QWidget

from dragrig.analysis import SavgolSettings, SavgolStream, default_filter_settings
from dragrig.engine_host import PHASE_NAMES, IdleReading, LiveSamples
from dragrig.present import BLUE, GREEN, PALE, PURPLE, duration_text
from dragrig.window.plots import TimePlot
from dragrig.window.trace_pyramid import TracePyramid
from dragrig.window.widgets import ElidedLabel, column, label, row, scrolling, set_role

MIN_BLOCK_S = 0.0005
"""Samples closer than this are stored as the min and max of blocks this long; the run file has them all."""


@dataclass(frozen=True, slots=True)
class LiveValues:
    """The latest values, the position absolute; filtered force and speed lag by half the filter's window."""

    time_s: float = 0.0
    force_mN: float = float("nan")
    position_mm: float = float("nan")
    speed_mm_s: float = float("nan")
    phase: str = ""


class LiveRun:
    """The traces of a run in progress, whose positions are absolute: it begins at `start_mm`."""

    def __init__(self, serial: int, rate_hz: float, start_mm: float = 0.0) -> None:
        self.serial, self.rate_hz, self.start_mm = serial, rate_hz, start_mm
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
        self.position.append(fresh.position + np.float64(self.start_mm))
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
            position_mm=_last_finite(fresh.position + np.float64(self.start_mm), self.latest.position_mm),
            speed_mm_s=_last_finite(speed, self.latest.speed_mm_s),
            phase=PHASE_NAMES[phase] if phase < len(PHASE_NAMES) else "",
        )


def _last_finite(values: npt.NDArray[np.floating], before: float) -> float:
    return float(values[-1]) if len(values) and np.isfinite(values[-1]) else before


def preload_filter() -> None:
    """Import the filter's libraries, which takes a second, before the first samples arrive."""
    stream = SavgolStream(1000.0, default_filter_settings(1000.0))
    stream.push(np.zeros(200))


STALE_S = 1.0
"""A value that is older is shown with its age, and no longer in black."""
_AGE_INTERVAL_MS = 250
_NO_VALUE = "–"
_WIDEST = {"Force": "−8888 mN", "Position": "not homed", "Speed": "−888.8 mm/s"}
"""The readings, with the widest text of each."""
_LEAST_WIDTH_PX = 640


class RigReadings(QWidget):
    """Force, position and speed as large numbers on every page: live, or grey with their age, or gone."""

    def __init__(self) -> None:
        super().__init__()
        self.readings = {name: label(_NO_VALUE, "reading") for name in _WIDEST}
        for name, reading in self.readings.items():
            reading.setAccessibleName(name)
            reading.ensurePolished()
            reading.setMinimumWidth(reading.fontMetrics().horizontalAdvance(_WIDEST[name]))
        self.limits = ElidedLabel("", "faint")
        self.about = ElidedLabel("", "faint")
        self._taken_s: float | None = None
        self._live_about = ""
        force, position, speed = (row(label(name, "faint"), value) for name, value in self.readings.items())
        self.setLayout(row(force, position, self.limits, speed, self.about, stretch={4: 1}))
        # The layout would ask for the widest values at once, and the window with it be wider than a small screen.
        self.setMinimumWidth(_LEAST_WIDTH_PX)
        self._age = QTimer(self)
        self._age.timeout.connect(self.show_age)
        self._age.start(_AGE_INTERVAL_MS)

    def set_limits(self, lowest_mm: float, highest_mm: float) -> None:
        """Show the stage's limits beside the position."""
        self.limits.setText(f"{lowest_mm:g} to {highest_mm:g} mm")

    def show_values(
        self, force_mN: float | None, position_mm: float | None, speed_mm_s: float | None, about: str
    ) -> None:
        """Show values taken now; None is shown as no value, and `about` says what the rig does."""
        self._taken_s, self._live_about = time.monotonic(), about
        for name, value, digits, unit in (
            ("Force", force_mN, 0, "mN"), ("Position", position_mm, 2, "mm"), ("Speed", speed_mm_s, 1, "mm/s"),
        ):  # fmt: skip
            # Adding zero takes the sign off a rounded −0.
            known = value is not None and isfinite(value)
            text = f"{round(value, digits) + 0.0:.{digits}f} {unit}" if known and value is not None else _NO_VALUE
            self.readings[name].setText(text.replace("-", "−"))
        self.show_age()

    def end_motion(self, about: str) -> None:
        """Show no speed any more: nothing moves; force and position age until the next values."""
        self.readings["Speed"].setText(_NO_VALUE)
        self._live_about = about
        self.show_age()

    def clear(self, why: str) -> None:
        """Show no value, and why there is none."""
        self._taken_s, self._live_about = None, why
        for reading in self.readings.values():
            reading.setText(_NO_VALUE)
        self.show_age()

    def show_age(self) -> None:
        """Show how old the values are, if no longer live; without values the rig's doing alone stands there."""
        age_s = None if self._taken_s is None else time.monotonic() - self._taken_s
        old = age_s is not None and age_s > STALE_S
        if old:
            self.readings["Speed"].setText(_NO_VALUE)
        age = "" if age_s is None else f"{duration_text(age_s)} ago; " if old else "live: "
        self.about.setText(f"{age}{self._live_about}")
        for reading in self.readings.values():
            set_role(reading, "old reading" if old else "reading")


RECENT_SPAN_S = 10.0
_COUNTED_S = 100
"""A shorter rest is counted down in seconds."""


class LiveView(QWidget):
    """Live traces and readings; the last run stays until the next one starts."""

    def __init__(self) -> None:
        super().__init__()
        self.run: LiveRun | None = None
        self.title = ElidedLabel("No run yet. Start one on the left.", "title")
        self.readings = RigReadings()
        self._start_mm = 0.0
        self._recording = False
        self._rest = ""
        self._rest_s: float | None = None
        """Duration of the rest whose samples come; None in a run."""
        self._serial_before = 0
        """Serial of the samples that came before it."""
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
        layout = column(
            row(self.title, self.only_last, stretch={0: 1}),
            self.force.widget,
            self.position.widget,
            self.speed.widget,
            margin=8,
            stretch={1: 6, 2: 4, 3: 5},
        )
        self.setLayout(column(scrolling(layout)))
        Thread(target=preload_filter, name="warm-up", daemon=True).start()

    def showEvent(self, event: QShowEvent) -> None:
        """Draw what came while another tab was shown."""
        super().showEvent(event)
        self._draw()

    def set_limits(self, lowest_mm: float, highest_mm: float) -> None:
        """Show the stage's limits beside the position, and in its plot where they are in view."""
        self.readings.set_limits(lowest_mm, highest_mm)
        self.position.remove_levels()
        self.position.stage_limits(lowest_mm, highest_mm, in_view=False)

    def begin_session(self, title: str) -> None:
        """Show a title, and no longer the curves of the session before."""
        self.begin(title)
        self.run = None
        for panel in (self.force, self.position, self.speed):
            panel.clear()

    def begin(self, title: str) -> None:
        """Show a title."""
        self.title.setText(title)

    def begin_rest(self, name: str, rest_s: float, start_mm: float) -> None:
        """Show that the contact rests before a run that begins at an absolute position."""
        self._start_mm, self._recording = start_mm, True
        self._rest, self._rest_s = f"Rest before {name}", rest_s
        self._serial_before = 0 if self.run is None else self.run.serial
        self._count_down()

    @property
    def rest_left_s(self) -> float:
        """How long the contact rests still; 0 in a run."""
        begun_s = self.run.latest.time_s if self.run is not None and self.run.serial != self._serial_before else 0.0
        return max((self._rest_s or 0.0) - begun_s, 0.0)

    def _count_down(self) -> str:
        """Show and return how long the rest still is."""
        left_s = ceil(self.rest_left_s)
        left = f"{left_s} s to go" if left_s < _COUNTED_S else f"{duration_text(left_s)} to go"
        self.begin(f"{self._rest}: {left}")
        return left

    def begin_run(self, title: str, start_mm: float) -> None:
        """Show the title of a run that begins at an absolute position."""
        self.begin(title)
        self._start_mm, self._recording, self._rest_s = start_mm, True, None

    def end_run(self, title: str) -> None:
        """Show that the run is over: its curves stay, and its speed is no reading any more."""
        self.begin(title)
        self._recording, self._rest_s = False, None
        self.readings.end_motion("the run has ended")

    def show_idle(self, reading: IdleReading, doing: str) -> None:
        """Show force and position while nothing is acquired."""
        if self._recording:
            return
        about = "; ".join(filter(None, (doing, reading.problem)))
        if reading.force_mN is None:
            self.readings.clear(about)
            return
        self.readings.show_values(reading.force_mN, reading.position_mm, None, about)
        if reading.position_mm is None:
            self.readings.readings["Position"].setText("not homed")

    def take(self, fresh: LiveSamples) -> None:
        """Show samples."""
        if self.run is None or self.run.serial != fresh.serial:
            self.run = LiveRun(fresh.serial, fresh.rate_hz, self._start_mm)
            for line, values in (
                (self._raw, self.run.force),
                (self._filtered, self.run.filtered),
                (self._position, self.run.position),
                (self._speed, self.run.speed),
            ):
                line.trace(values, fresh.rate_hz)
        self.run.take(fresh)
        latest = self.run.latest
        about = f"{latest.phase}, {latest.time_s:.1f} s" if self._recording else "the run has ended"
        if self._rest_s is not None:
            about = f"rest, {self._count_down()}"
        speed_mm_s = latest.speed_mm_s if self._recording else None
        self.readings.show_values(latest.force_mN, latest.position_mm, speed_mm_s, about)
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


def _time_range(time_s: float, *, only_last: bool) -> tuple[float, float]:
    """Return the time range to show; it grows in steps, so that the axis is mostly still and cheap to draw."""
    step = 1.0 if only_last else 10.0 ** floor(log10(max(time_s, 1.0))) / 2
    end = step * ceil(max(time_s, step) / step)
    return (max(0.0, end - RECENT_SPAN_S) if only_last else 0.0), end
