"""Units of foreign columns: their spellings, and their conversion to the units of a run file."""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from math import pi

import numpy as np
import numpy.typing as npt

from dragrig.config import ImportDataError
from dragrig.rig import FloatArray

STANDARD_GRAVITY = 9.80665
"""[m/s²]; turns gram-force into millinewtons."""

TARGET_UNITS: Mapping[str, str] = {
    "time": "s",
    "force": "mN",
    "position": "mm",
    "command": "mm",
    "motor_force": "mN",
    "temperature": "degC",
}
"""Quantities of a run file that a column can be mapped to, with the unit it is stored in."""

CONVERTIBLE_UNITS: Mapping[str, Mapping[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86_400.0},
    "mN": {"mN": 1.0, "N": 1e3, "kN": 1e6, "µN": 1e-3, "gf": STANDARD_GRAVITY, "kgf": 1e3 * STANDARD_GRAVITY,
           "lbf": 4448.2216152605},
    "mm": {"mm": 1.0, "µm": 1e-3, "nm": 1e-6, "cm": 10.0, "m": 1e3, "in": 25.4},
    "degC": {"degC": 1.0, "K": 1.0, "degF": 5 / 9},
}  # fmt: skip
"""For each stored unit, the factor of every unit that converts to it."""
_OFFSETS = {"K": -273.15, "degF": -32 * 5 / 9}

ROTARY_UNITS: Mapping[str, Mapping[str, float]] = {
    "mm": {"rad": 1.0, "deg": pi / 180, "rev": 2 * pi},
    "mN": {"Nm": 1e6, "Ncm": 1e4, "mNm": 1e3},
}
"""Units of a turning rig: an angle is multiplied by the radius [mm], a torque divided by it."""

OTHER_UNITS = ("mV", "V", "mA", "A", "rad", "deg", "rev", "counts", "1", "%", "MPa", "kPa", "Pa", "bar", "rad/s",
               "mm/s", "m/s", "µm/s", "mm/min", "µm/m", "rpm", "Hz", "Nm", "Ncm", "mNm", "W", "g", "kg")  # fmt: skip
"""Units of other quantities, which only a factor stated by the user converts."""

_SPELLINGS = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "us": "µs", "usec": "µs", "minutes": "min",
    "hours": "h", "day": "d", "days": "d", "um": "µm", "micron": "µm", "microns": "µm", "micrometer": "µm",
    "inch": "in", "newton": "N", "newtons": "N", "un": "µN", "kg-f": "kgf", "kp": "kgf", "g-f": "gf", "pond": "gf",
    "°c": "degC", "c": "degC", "celsius": "degC", "deg c": "degC", "°f": "degF", "kelvin": "K", "volt": "V",
    "volts": "V", "ampere": "A", "amps": "A", "radian": "rad", "radians": "rad", "°": "deg", "degree": "deg",
    "degrees": "deg", "turns": "rev", "count": "counts", "cts": "counts", "-": "1", "percent": "%", "u/min": "rpm",
}  # fmt: skip
_EXACT = {unit for units in CONVERTIBLE_UNITS.values() for unit in units} | set(OTHER_UNITS)
_SAME_IN_CAPITALS = Counter(unit.lower() for unit in _EXACT)
_MILLI_OR_MEGA = frozenset({"mN", "MPa", "mPa", "mV", "mA", "mNm"})
_FOLDED = {
    unit.lower(): unit for unit in _EXACT if _SAME_IN_CAPITALS[unit.lower()] == 1 and unit not in _MILLI_OR_MEGA
} | _SPELLINGS

_NAME_WITH_UNIT = (
    r"(?P<label>.*?)\s*[\[(<](?P<unit>[^\[\]()]*)[\])>]\s*",
    r"(?P<label>.+?)\s*(?:[/,]|\s-\s)\s*(?P<unit>\S+)",
    r"(?P<label>.+)_(?P<unit>[^_]+)",
)


@dataclass(frozen=True, slots=True)
class UnitScale:
    """Converts a column to the stored unit: `values * factor + offset`."""

    factor: float = 1.0
    offset: float = 0.0

    def apply(self, values: npt.ArrayLike) -> FloatArray:
        """Return the values in the stored unit; the identity leaves every bit as it is."""
        array = np.asarray(values, dtype=np.float64)
        return array if self == UnitScale() else array * self.factor + self.offset


def canonical_unit(text: str) -> str | None:
    """Return the standard spelling of a unit; None for an unknown one.

    Case is folded only where it decides nothing: `MN` may be milli or mega, and `NM` a length or a torque.
    """
    plain = text.strip().replace("μ", "µ").strip("[](){}").strip()  # the Greek letter and the micro sign look alike
    return plain if plain in _EXACT else _FOLDED.get(plain.lower())


def unit_scale(
    quantity: str, unit: str, factor: float | None, offset: float, radius_mm: float | None = None
) -> UnitScale:
    """Return how a column in `unit` becomes a quantity of the run file.

    Parameters
    ----------
    factor
        Multiplies besides the unit's own factor; required for a unit of another quantity, where it is the number of
        stored units per unit of the column.
    radius_mm
        Of a turning rig: converts angles to travels, and torques to forces.

    Raises
    ------
    ImportDataError
        When the unit is unknown, or of another quantity and no factor is given.
    """
    target = TARGET_UNITS[quantity]
    convertible = CONVERTIBLE_UNITS[target]
    standard = canonical_unit(unit)
    if standard is not None and standard in convertible:
        stated = 1.0 if factor is None else factor
        return UnitScale(convertible[standard] * stated, _OFFSETS.get(standard, 0.0) * stated + offset)
    rotary = ROTARY_UNITS.get(target, {}).get(standard or "")
    if factor is None and rotary is not None and radius_mm is not None:
        return UnitScale(rotary * radius_mm if target == "mm" else rotary / radius_mm, offset)
    if factor is not None:
        return UnitScale(factor, offset)
    allowed = ", ".join(convertible)
    if standard is None:
        alike = [known for known in sorted(_EXACT) if known.lower() == unit.strip().lower()]
        if alike:
            raise ImportDataError(
                f"{quantity} in {unit!r} may be {' or '.join(alike)}, or another prefix; state it as it is, as in "
                f"{quantity}=COLUMN:{alike[0]}"
            )
        raise ImportDataError(
            f"{quantity} in {unit!r} is not understood; allowed are {allowed}, or any other unit with a factor, as in "
            f"{quantity}=COLUMN:{unit or 'UNIT'}*12.5 for 12.5 {target} per {unit or 'UNIT'}"
        )
    turning = ", or the radius of a turning rig (--radius-mm)" if rotary is not None else ""
    raise ImportDataError(
        f"{quantity} in {standard} needs a factor, as in {quantity}=COLUMN:{standard}*12.5 for 12.5 {target} per "
        f"{standard}{turning}; without one allowed are {allowed}"
    )


def split_unit(name: str) -> tuple[str, str | None]:
    """Split a column's name such as `Load [N]`, `Time(s)`, `Weg / mm`, `force_mN` or `v_mm_s` into label and unit.

    In square brackets stands a unit even where it is not known.
    """
    quotient = re.fullmatch(r"(?P<label>.+)_(?P<above>[^_]+)_(?P<below>s|s2)", name)
    if quotient and (unit := canonical_unit(f"{quotient['above']}/{quotient['below']}")):
        return quotient["label"], unit
    if stated := re.fullmatch(r"(?P<label>.*\S)\s*\[(?P<unit>[^\[\]]+)\]\s*", name):
        return stated["label"], canonical_unit(stated["unit"]) or stated["unit"].strip()
    for pattern in _NAME_WITH_UNIT:
        match = re.fullmatch(pattern, name)
        if match and (unit := canonical_unit(match["unit"])) is not None:
            return match["label"].strip(), unit
    return name, None
