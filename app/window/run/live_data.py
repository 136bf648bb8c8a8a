"""Live samples on the screen's side: raw and filtered force, position, speed, ready to be drawn."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dragrig.analysis import SavgolSettings, SavgolStream, usual_settings
from dragrig.engine_host.live import Fresh
from dragrig.engine_host.messages import PHASE_NAMES
from dragrig.window.plots.pyramid import Pyramid

FINEST_S = 0.0005
"""Faster samples are kept as the least and the greatest of so long; the run file has every one."""


@dataclass(frozen=True, slots=True)
class Reading:
    """The latest values; force and speed as filtered, half a filter's window ago."""

    time_s: float = 0.0
    force_mN: float = float("nan")
    position_mm: float = float("nan")
    speed_mm_s: float = float("nan")
    phase: str = ""


class LiveRun:
    """One run as far as it has come."""

    def __init__(self, serial: int, rate_hz: float) -> None:
        self.serial, self.rate_hz = serial, rate_hz
        base = max(1, round(FINEST_S * rate_hz))
        self.force, self.filtered, self.position, self.speed = (Pyramid(base) for _ in range(4))
        settings = usual_settings(rate_hz)
        self._force = SavgolStream(rate_hz, settings)
        self._position = SavgolStream(rate_hz, _slope_of(settings.window_s, settings.window_samples))
        self.latest = Reading()

    def take(self, fresh: Fresh) -> None:
        """Take samples in."""
        if fresh.missed:
            self._skip(fresh.missed)
        self.force.append(fresh.force)
        self.position.append(fresh.position)
        force = self._force.push(fresh.force, fresh.first_index)
        speed = self._position.push(fresh.position, fresh.first_index)
        self.filtered.append(force)
        self.speed.append(speed)
        self._note(fresh, force, speed)

    def _skip(self, missed: int) -> None:
        nothing = np.full(missed, np.nan, np.float32)
        for pyramid in (self.force, self.position):
            pyramid.append(nothing)
        for pyramid, stream in ((self.filtered, self._force), (self.speed, self._position)):
            pyramid.append(stream.flush())
            pyramid.append(nothing)

    def _note(self, fresh: Fresh, force: npt.NDArray[np.float64], speed: npt.NDArray[np.float64]) -> None:
        place = int(fresh.phase[-1])
        self.latest = Reading(
            time_s=(fresh.first_index + len(fresh.force)) / self.rate_hz,
            force_mN=_last(force, self.latest.force_mN),
            position_mm=_last(fresh.position, self.latest.position_mm),
            speed_mm_s=_last(speed, self.latest.speed_mm_s),
            phase=PHASE_NAMES[place] if place < len(PHASE_NAMES) else "",
        )


def _slope_of(window_s: float | None, window_samples: int | None) -> SavgolSettings:
    return SavgolSettings(window_s, window_samples, order=2, derivative=1)


def _last(values: npt.NDArray[np.floating], before: float) -> float:
    return float(values[-1]) if len(values) and np.isfinite(values[-1]) else before


def warm_up() -> None:
    """Load what the filter needs, which takes a second, before the first samples come."""
    stream = SavgolStream(1000.0, usual_settings(1000.0))
    stream.push(np.zeros(200))
