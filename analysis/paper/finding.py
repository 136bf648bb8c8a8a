"""Something in the paper that does not fit together, with the numbers that show it."""

from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal
from math import isfinite


@dataclass(frozen=True, slots=True)
class Number:
    """A computed number; `quantity` names it, `digits` are the significant ones that are shown.

    `signed` shows a plus sign too.
    """

    quantity: str
    value: float
    unit: str = ""
    digits: int = 3
    signed: bool = False

    def __str__(self) -> str:
        sign = "+" if self.signed and self.value > 0 else ""
        return f"{sign}{spelled(self.value, self.digits)} {self.unit}".strip()


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding.

    Attributes
    ----------
    key
        Short name for tables.
    where
        The paper's equations, tables or sections concerned.
    paper
        What the paper says, in other words.
    shown
        What the numbers show.
    practice
        What dragrig does.
    """

    key: str
    title: str
    where: str
    paper: str
    numbers: tuple[Number, ...]
    shown: str
    practice: str

    def value(self, quantity: str) -> float:
        """Return one of the numbers; raises `KeyError` for one that is not there."""
        return {one.quantity: one.value for one in self.numbers}[quantity]


def spelled(value: float, digits: int = 3) -> str:
    """Spell a number to so many significant digits, without an exponent: 0.0816, 113, −7.2."""
    if not isfinite(value):
        return "–"
    if value == 0:
        return "0"
    return format(Decimal(f"{value:.{digits - 1}e}"), "f").replace("-", "−")


def percent(difference: float, digits: int = 2) -> str:
    """Spell a relative difference with its sign: +20 %, −0.35 %."""
    sign = "+" if difference > 0 else ""
    return f"{sign}{spelled(100 * difference, digits)} %"


def listed(numbers: Iterable[float], digits: int = 3) -> str:
    """Spell several numbers in a row: 1, 2 and 3."""
    words = [spelled(one, digits) for one in numbers]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
