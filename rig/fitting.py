"""Straight lines through calibration points, by least squares."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, sqrt

import numpy as np

from dragrig.config.errors import SettingsError

_FEWEST_LOADS = 3
_LARGEST_ERROR = 0.05
"""Part of the gain that its standard error may be; beyond, the readings do not follow what was applied."""


@dataclass(frozen=True, slots=True)
class Line:
    """A calibration: quantity = gain · raw + zero, with standard errors and the residuals' standard deviation."""

    gain: float
    gain_error: float
    zero: float
    zero_error: float
    residual: float
    points: int

    def at(self, raw: float) -> float:
        """Return the quantity that a raw value stands for."""
        return self.gain * raw + self.zero


def force_line(loads_mN: Sequence[float], volts: Sequence[float]) -> Line:
    """Fit force to volts, both of shape `(n,)`.

    Raises
    ------
    SettingsError
        For fewer than three distinct loads, and for volts that do not follow the loads.
    """
    require_loads(loads_mN)
    force, reading = np.asarray(loads_mN, float), np.asarray(volts, float)
    if not np.isfinite(reading).all() or np.ptp(reading) == 0:
        raise SettingsError("the readings do not change with the load: is the sensor connected, and the load on it?")
    (gain, zero), spread = np.polyfit(reading, force, 1, cov=True)
    gain_error, zero_error = np.sqrt(np.diag(spread))
    if gain_error > _LARGEST_ERROR * abs(gain):
        raise SettingsError(
            f"the readings do not follow the loads (gain {gain:.4g} ± {gain_error:.2g} mN/V): is each load on the "
            "sensor, and does it hang still?"
        )
    left = force - (gain * reading + zero)
    residual = sqrt(float(left @ left) / (len(force) - 2))
    return Line(float(gain), float(gain_error), float(zero), float(zero_error), residual, len(force))


def require_loads(loads: Sequence[float]) -> None:
    """Raise `SettingsError` for loads that make no line: not finite, or fewer than three distinct ones."""
    if not all(isfinite(load) for load in loads) or len(set(loads)) < _FEWEST_LOADS:
        raise SettingsError(
            f"weights {', '.join(f'{load:g}' for load in loads)}: a line needs at least {_FEWEST_LOADS} distinct loads."
        )


def encoder_line(travels_mm: Sequence[float], counts: Sequence[float]) -> Line:
    """Fit travel to counts through the origin, both of shape `(n,)`; one point has no errors and no residual.

    Raises
    ------
    SettingsError
        For counts that do not follow the travel.
    """
    travel, counted = np.asarray(travels_mm, float), np.asarray(counts, float)
    square = float(counted @ counted)
    if not travel.size or not np.isfinite(travel).all() or square == 0:
        raise SettingsError("the encoder counted nothing: look at its cable, and at hardware.card.encoder.")
    gain = float(travel @ counted) / square
    left = travel - gain * counted
    residual = sqrt(float(left @ left) / (len(travel) - 1)) if len(travel) > 1 else 0.0
    gain_error = residual / sqrt(square)
    if gain <= 0 or gain_error > _LARGEST_ERROR * gain:
        raise SettingsError(
            f"the counts do not follow the travel ({gain:.4g} ± {gain_error:.2g} mm per count): does the stage go all "
            "of it, and does the encoder count up where the stage goes up (hardware.card.encoder.reversed)?"
        )
    return Line(gain, gain_error, 0.0, 0.0, residual, len(travel))
