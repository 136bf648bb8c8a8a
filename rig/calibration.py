"""Calibration of force sensor and encoder: the line fitted to known loads or travels, and the history of both."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, sqrt
from pathlib import Path

import numpy as np

from dragrig.config import (
    CALIBRATION_FILE,
    CONTACT_FILE,
    Calibration,
    ContactPoint,
    OutputError,
    SettingsError,
    parse,
    read_settings_file,
    read_text,
    to_toml,
)
from dragrig.rig.runfile import replace_text

_MIN_LOADS = 3
_MAX_RELATIVE_GAIN_ERROR = 0.05
"""Largest standard error of the gain, relative to it; beyond, the readings do not follow what was applied."""


@dataclass(frozen=True, slots=True)
class CalibrationLine:
    """A calibration: quantity = gain · raw + zero, with standard errors and the residuals' standard deviation."""

    gain: float
    gain_error: float
    zero: float
    zero_error: float
    residual: float
    points: int

    def at(self, raw: float) -> float:
        """Return the quantity of a raw value."""
        return self.gain * raw + self.zero


def fit_force(loads_mN: Sequence[float], volts: Sequence[float]) -> CalibrationLine:
    """Fit force to volts, both of shape `(n,)`.

    Raises `SettingsError` for fewer than three distinct loads, and for volts that do not follow the loads.
    """
    require_loads(loads_mN)
    force, reading = np.asarray(loads_mN, float), np.asarray(volts, float)
    if not np.isfinite(reading).all() or np.ptp(reading) == 0:
        raise SettingsError("the readings do not change with the load: is the sensor connected, and the load on it?")
    (gain, zero), covariance = np.polyfit(reading, force, 1, cov=True)
    gain_error, zero_error = np.sqrt(np.diag(covariance))
    if not gain_error <= _MAX_RELATIVE_GAIN_ERROR * abs(gain):
        raise SettingsError(
            f"the readings do not follow the loads (gain {gain:.4g} ± {gain_error:.2g} mN/V): is each load on the "
            "sensor, and does it hang still?"
        )
    residuals = force - (gain * reading + zero)
    residual = sqrt(float(residuals @ residuals) / (len(force) - 2))
    return CalibrationLine(float(gain), float(gain_error), float(zero), float(zero_error), residual, len(force))


def require_loads(loads: Sequence[float]) -> None:
    """Raise `SettingsError` for loads that make no line: not finite, or fewer than three distinct ones."""
    if not all(isfinite(load) for load in loads) or len(set(loads)) < _MIN_LOADS:
        raise SettingsError(
            f"weights {', '.join(f'{load:g}' for load in loads)}: a line needs at least {_MIN_LOADS} distinct loads."
        )


def fit_encoder(travels_mm: Sequence[float], counts: Sequence[float]) -> CalibrationLine:
    """Fit travel to counts through the origin, both of shape `(n,)`; a single point has no errors and no residual.

    Raises `SettingsError` for counts that do not follow the travel.
    """
    travel, counted = np.asarray(travels_mm, float), np.asarray(counts, float)
    sum_of_squares = float(counted @ counted)
    if not travel.size or not np.isfinite(travel).all() or sum_of_squares == 0:
        raise SettingsError("the encoder counted nothing: check its cable, and hardware.card.encoder.")
    gain = float(travel @ counted) / sum_of_squares
    residuals = travel - gain * counted
    residual = sqrt(float(residuals @ residuals) / (len(travel) - 1)) if len(travel) > 1 else 0.0
    gain_error = residual / sqrt(sum_of_squares)
    if not (gain > 0 and gain_error <= _MAX_RELATIVE_GAIN_ERROR * gain):
        raise SettingsError(
            f"the counts do not follow the travel ({gain:.4g} ± {gain_error:.2g} mm per count): does the stage "
            "move all of it, and does the encoder count up where the stage moves up (hardware.card.encoder.reversed)?"
        )
    return CalibrationLine(gain, gain_error, 0.0, 0.0, residual, len(travel))


def read_calibrations(folder: Path) -> tuple[Calibration, ...]:
    """Return every entry of a lab folder's history, oldest first; empty where there is no history.

    Raises `SettingsError` for a line that is no calibration, by its number.
    """
    path = folder / CALIBRATION_FILE
    try:
        lines = read_text(path).splitlines()
    except FileNotFoundError:
        return ()
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: cannot be read ({error}); check the file.") from error
    entries: list[Calibration] = []
    for number, line in enumerate(lines, 1):
        source = f"{path}, line {number}"
        if not line.strip():
            continue
        try:
            data = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise SettingsError(f"{source}: is not JSON ({error}); restore the line from a copy.") from error
        if not isinstance(data, dict):
            raise SettingsError(f"{source}: is not a JSON object with the keys of a calibration.")
        entries.append(parse(Calibration, data, source))
    return tuple(entries)


def latest_calibration(
    folder: Path, quantity: str = "force", made_on: str = "", sensor_serial: str = ""
) -> Calibration | None:
    """Return the latest entry for a quantity (force, encoder); None before the first one.

    Parameters
    ----------
    made_on
        Backend that it must be valid for; empty for any.
    sensor_serial
        Sensor that it must be valid for; empty for any. An entry without a serial number is valid for every sensor.
    """
    entries = [
        entry
        for entry in read_calibrations(folder)
        if entry.quantity == quantity
        and (not made_on or entry.made_on in {"", made_on})
        and (not sensor_serial or entry.sensor_serial in {"", sensor_serial})
    ]
    return entries[-1] if entries else None


def append_calibration(folder: Path, entry: Calibration) -> None:
    """Add an entry to a lab folder's history.

    Raises
    ------
    SettingsError
        When the history already has an entry of this id, or holds a line that is no calibration.
    OutputError
        When the history cannot be written.
    """
    path = folder / CALIBRATION_FILE
    if any(earlier.id == entry.id for earlier in read_calibrations(folder)):
        raise SettingsError(f"{path}: id = {entry.id!r} is in the history already; choose another.")
    try:
        with path.open("a+b") as history:
            # An editor may have left the last line without its end; the new entry must not join it.
            text = path.read_bytes()
            line_end = b"\n" if text and not text.endswith(b"\n") else b""
            history.write(line_end + entry.model_dump_json().encode() + b"\n")
            history.flush()
            os.fsync(history.fileno())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); check the folder.") from error


def read_contact(folder: Path) -> ContactPoint | None:
    """Return the contact stored in a lab folder, or None; raises `SettingsError`."""
    path = folder / CONTACT_FILE
    return read_settings_file(ContactPoint, path) if path.is_file() else None


def write_contact(folder: Path, contact: ContactPoint) -> Path:
    """Store a contact in place of the one before; raises `OutputError`."""
    path = folder / CONTACT_FILE
    replace_text(path, to_toml(contact))
    return path
