"""Units that instruments write, and what they are in ours: s, mN, mm, degC."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dragrig.config.errors import ImportDataError
from dragrig.rig.arrays import FloatArray

G0 = 9.80665
"""Standard gravity [m/s²]: turns gram-force into millinewtons."""

TARGETS: Mapping[str, str] = {
    "time": "s",
    "force": "mN",
    "position": "mm",
    "command": "mm",
    "motor_force": "mN",
    "temperature": "degC",
}
"""Quantities of a run file that a column can be mapped to, with the unit it is stored in."""

_LENGTHS = {"mm": 1.0, "µm": 1e-3, "nm": 1e-6, "cm": 10.0, "m": 1e3, "in": 25.4}
_FORCES = {"mN": 1.0, "N": 1e3, "kN": 1e6, "µN": 1e-3, "gf": G0, "kgf": 1e3 * G0, "lbf": 4448.2216152605}
KNOWN: Mapping[str, Mapping[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "min": 60.0, "h": 3600.0},
    "mN": _FORCES,
    "mm": _LENGTHS,
    "degC": {"degC": 1.0, "K": 1.0, "degF": 5 / 9},
}
"""For each unit of ours, the factor of every unit that can be turned into it."""
_OFFSETS = {"K": -273.15, "degF": -32 * 5 / 9}

FOREIGN = ("mV", "V", "mA", "A", "rad", "deg", "rev", "counts", "1", "%", "MPa", "kPa", "Pa", "bar", "rad/s", "mm/s",
           "m/s", "µm/s", "rpm", "Hz", "Nm", "W", "g", "kg")  # fmt: skip
"""Units that only a stated factor turns into ours."""

_SPELLINGS = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "us": "µs", "usec": "µs", "minutes": "min",
    "hours": "h", "um": "µm", "micron": "µm", "microns": "µm", "micrometer": "µm", "inch": "in", "newton": "N",
    "newtons": "N", "un": "µN", "kg-f": "kgf", "kp": "kgf", "g-f": "gf", "pond": "gf", "°c": "degC", "c": "degC",
    "celsius": "degC", "deg c": "degC", "°f": "degF", "kelvin": "K", "volt": "V", "volts": "V", "ampere": "A",
    "amps": "A", "radian": "rad", "radians": "rad", "°": "deg", "degree": "deg", "degrees": "deg", "turns": "rev",
    "count": "counts", "cts": "counts", "-": "1", "percent": "%", "u/min": "rpm",
}  # fmt: skip
_EXACT = {unit: unit for group in KNOWN.values() for unit in group} | {unit: unit for unit in FOREIGN}
_FOLDED = {unit.lower(): unit for unit in _EXACT if unit not in {"mN", "MPa", "mPa"}} | _SPELLINGS


@dataclass(frozen=True, slots=True)
class Scale:
    """Turns numbers of a column into our unit: `values * factor + offset`."""

    factor: float = 1.0
    offset: float = 0.0

    def apply(self, values: npt.ArrayLike) -> FloatArray:
        """Return the values in our unit; a scale that changes nothing leaves every bit as it is."""
        array = np.asarray(values, dtype=np.float64)
        return array if self == Scale() else array * self.factor + self.offset


def canonical(text: str) -> str | None:
    """Return the usual spelling of a unit, or None when the text is none that is known."""
    plain = text.strip().replace("μ", "µ").strip("[](){}").strip()  # the Greek letter and the micro sign look alike
    if plain in _EXACT:
        return plain
    return _FOLDED.get(plain.lower())


def scale_to(quantity: str, unit: str, factor: float | None, offset: float) -> Scale:
    """Return how a column in `unit` becomes a quantity of the run file.

    Parameters
    ----------
    factor
        Multiplies besides the unit's own factor; needed for a unit of another kind, where it says how
        much of our unit one of theirs is.

    Raises
    ------
    ImportDataError
        When the unit is unknown, or of another kind and no factor is given.
    """
    target = TARGETS[quantity]
    known = KNOWN[target]
    usual = canonical(unit)
    if usual is not None and usual in known:
        stated = 1.0 if factor is None else factor
        return Scale(known[usual] * stated, _OFFSETS.get(usual, 0.0) * stated + offset)
    if factor is not None:
        return Scale(factor, offset)
    allowed = ", ".join(known)
    if usual is None:
        raise ImportDataError(
            f"{quantity} in {unit!r} is not understood; allowed are {allowed}, or any other unit with a factor, as in "
            f"{quantity}=COLUMN:{unit or 'UNIT'}*12.5 for 12.5 {target} per {unit or 'UNIT'}"
        )
    raise ImportDataError(
        f"{quantity} in {usual} needs a factor, as in {quantity}=COLUMN:{usual}*12.5 for 12.5 {target} per {usual}; "
        f"without one allowed are {allowed}"
    )


def unit_of_name(name: str) -> tuple[str, str | None]:
    """Split a column's name such as `Load [N]`, `Time(s)`, `Weg / mm` or `force_mN` into label and unit."""
    two_part = re.fullmatch(r"(?P<label>.+)_(?P<above>[^_]+)_(?P<below>s|s2)", name)
    if two_part and (unit := canonical(f"{two_part['above']}/{two_part['below']}")):
        return two_part["label"], unit
    for pattern in (r"(?P<label>.*?)\s*[\[(](?P<unit>[^\[\]()]*)[\])]\s*", r"(?P<label>.+?)\s*[/,]\s*(?P<unit>\S+)",
                    r"(?P<label>.+)_(?P<unit>[^_]+)"):  # fmt: skip
        found = re.fullmatch(pattern, name)
        unit = canonical(found["unit"]) if found else None
        if found and unit is not None:
            return found["label"].strip(), unit
    return name, None
