"""Numbers as people type them, on any desktop: point and comma are decimal marks, and no mark of thousands is read.

The number that a text shows is the one that it gives, or it is refused in a sentence that says how to write it.
"""

import re
from dataclasses import dataclass, replace
from decimal import Decimal
from math import inf, isfinite

from dragrig.config.errors import SettingsError

_NUMBER = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)(e[-+]?\d+)?", re.ASCII | re.IGNORECASE)
_MARKED = re.compile(r"([-+]?[1-9]\d{0,2})((?P<mark>[.,'’_ ])\d{3}(?:(?P=mark)\d{3})*)([.,]\d+)?", re.ASCII)
_WITH_UNIT = re.compile(rf"{_NUMBER.pattern} ?[^\W\d_][^\d.,;]*|{_NUMBER.pattern} ?[%°].*", re.ASCII | re.IGNORECASE)
_TIGHT_COMMA = re.compile(r",(?=\S)")
_ALIKE = str.maketrans({"−": "-", "μ": "µ"})
"""The minus of tables and the Greek letter, as keyboards have them."""
_MOST_SHOWN = 40
_PLAIN = (1e-9, 1e16)
"""Sizes of numbers that are written without an exponent."""


@dataclass(frozen=True, slots=True)
class NumberRange:
    """Numbers that a field takes, in the unit that they are typed in."""

    unit: str = ""
    lowest: float = -inf
    highest: float = inf
    above_lowest: bool = False
    """Whether `lowest` itself is not allowed."""
    whole: bool = False
    limits: tuple[str, str] = ("the least allowed", "the most allowed")
    """Names of the lowest and the highest, as "the rig's limit"."""

    def __str__(self) -> str:
        """Return the range as text, as "from 0 to 60 s"; empty without one."""
        low = "" if self.lowest == -inf else f"{'above' if self.above_lowest else 'from'} {number_text(self.lowest)}"
        high = "" if self.highest == inf else f"to {number_text(self.highest)}"
        text = " ".join(filter(None, (low, high)))
        return f"{text} {self.unit}".strip() if text else ""

    def within(self, lowest: float, highest: float, limit: str) -> "NumberRange":
        """Return the range within further limits of this name; as it is where they are wider."""
        tightened = self
        if lowest > self.lowest:
            tightened = replace(tightened, lowest=lowest, above_lowest=False, limits=(limit, self.limits[1]))
        if highest < self.highest:
            tightened = replace(tightened, highest=highest, limits=(tightened.limits[0], limit))
        return tightened

    def why_not(self, value: float) -> str:
        """Say why a number is not allowed, as "is above 100 mm/s, the most allowed"; empty where it is."""
        if value > self.highest:
            return f"is above {self._named(self.highest)}, {self.limits[1]}"
        if self.above_lowest:
            return "" if value > self.lowest else f"is not above {self._named(self.lowest)}"
        return "" if value >= self.lowest else f"is below {self._named(self.lowest)}, {self.limits[0]}"

    def _named(self, value: float) -> str:
        return f"{number_text(value)} {self.unit}".strip()


ANY_NUMBER = NumberRange()


def read_number(text: str, allowed: NumberRange = ANY_NUMBER) -> float:
    """Return the number in a text; a whole one where those alone are allowed.

    Read are digits 0 to 9 with a point or a comma as decimal mark, a sign, also U+2212, an exponent, and behind it the
    unit of the range.

    Raises
    ------
    SettingsError
        For a text that is no such number, has a mark of thousands or another unit, and for a number that is not
        allowed: a sentence that begins with the text.
    """
    typed = _typed(text)
    digits = _without_unit(typed, allowed.unit)
    if not _NUMBER.fullmatch(digits):
        raise SettingsError(f"{_shown(text)} {_why_no_number(typed, digits, allowed)}.")
    exact = Decimal(digits.replace(",", "."))
    value = float(exact) + 0.0  # no zero with a sign
    if not isfinite(value) or (value == 0 and exact != 0):
        raise SettingsError(f"{_shown(text)} is too {'small' if value == 0 else 'large'} for a number.")
    if problem := allowed.why_not(value):
        raise SettingsError(f"{_shown(text)} {problem}.")
    if not allowed.whole:
        return value
    if not value.is_integer():
        raise SettingsError(f"{_shown(text)} is not a whole number; write it as {round(value)}.")
    if not -(2**63) <= exact < 2**63:
        raise SettingsError(f"{_shown(text)} is too large for a whole number.")
    return int(exact)


def read_numbers(text: str, allowed: NumberRange = ANY_NUMBER, *, tight: bool = False) -> tuple[float, ...]:
    """Return the numbers in a text, separated by a comma and a blank, or by semicolons.

    A comma between two digits may be a decimal mark: it is asked about, but for numbers between semicolons.

    Parameters
    ----------
    tight
        Numbers may be separated by commas without a blank, as a command line has them, where they can be nothing else:
        0,20,50 and 0.5,1, but neither 5,5 nor 1,000,000.

    Raises
    ------
    SettingsError
        As `read_number`, and for a text that could be other numbers.
    """
    typed = _typed(text)
    mark = ";" if ";" in typed else ","
    if mark == "," and _TIGHT_COMMA.search(typed) and not (tight and _lists(typed)):
        raise SettingsError(f"{_shown(text)} {_question(typed)}")
    parts = typed.split(mark)
    if len(parts) > 1 and not parts[-1].strip():
        parts.pop()
    for part in parts:
        apart = re.split(r"[,;]? ", part.strip())
        if len(apart) > 1 and all(map(_NUMBER.fullmatch, apart)):
            example = ", ".join(apart)
            raise SettingsError(
                f"{_shown(text)} is not clear: write {example} for {len(apart)} numbers, and no blank in a number."
            )
    return tuple(read_number(part, allowed) for part in parts)


def number_text(value: float) -> str:
    """Return the shortest text that `read_number` gives this very number for."""
    exact = Decimal(repr(value))
    if exact == exact.to_integral_value() and abs(exact) < _PLAIN[1]:
        return str(int(exact))
    return f"{exact:f}" if _PLAIN[0] <= abs(value) < _PLAIN[1] else repr(value)


def _typed(text: str) -> str:
    """Return a text with single plain blanks, none at its ends."""
    return " ".join(text.split()).translate(_ALIKE)


def _shown(text: str) -> str:
    plain = " ".join(text.split())
    return repr(plain if len(plain) <= _MOST_SHOWN else f"{plain[:_MOST_SHOWN]}…")


def _without_unit(typed: str, unit: str) -> str:
    names = (unit, unit.replace("µ", "u"), unit.replace("²", "^2"), unit.replace("²", "2"))
    ends = [name for name in names if name and typed.endswith(name)]
    return typed.removesuffix(max(ends, key=len)).rstrip() if ends else typed


def _why_no_number(typed: str, digits: str, allowed: NumberRange) -> str:
    if not typed:
        return "is empty; write a number, as 12.5"
    if marked := _MARKED.fullmatch(digits):
        groups = marked[2].replace(marked["mark"], "")
        return f"has a mark of thousands; write {marked[1]}{groups}{(marked[4] or '').replace(',', '.')}"
    if _WITH_UNIT.fullmatch(typed):
        if allowed.unit:
            return f"is not in {allowed.unit}; write the number in {allowed.unit}"
        return "has a unit; write the number alone, as 12.5"
    parts = re.split(r", |; ?", typed)
    if len(parts) > 1 and all(map(_NUMBER.fullmatch, parts)):
        return "is several numbers; one is allowed"
    return "is not a number; write it as 12.5"


def _lists(typed: str) -> bool:
    """Whether commas without a blank can only separate numbers."""
    return not (" " in typed or _NUMBER.fullmatch(typed) or _MARKED.fullmatch(typed))


def _question(typed: str) -> str:
    decimal, apart = _TIGHT_COMMA.sub(".", typed), _TIGHT_COMMA.sub(", ", typed)
    readable = {text: all(map(_NUMBER.fullmatch, text.split(", "))) for text in (decimal, apart)}
    if all(readable.values()):
        return f"is {decimal} or {apart}? Write a point in a decimal, or a blank between numbers."
    example = apart if readable[apart] else "5.5, 10"
    return f"is not clear: write a point in a decimal, and a comma and a blank between numbers, as {example}."
