"""Numbers, counts, names and foreign texts as they are written for a reader, for analysis and `present` alike."""

import unicodedata
from collections.abc import Sequence
from decimal import Decimal
from math import floor, isfinite, log10
from typing import TypeGuard

UNKNOWN = "–"
"""Shown for a value that is missing or not finite."""
DIGITS_WITHOUT_ERROR = 4
EXACT, EXACT_DIGITS = 1e-6, 8
"""An error below this share of the value is rounding: it is not written, and the value with so many digits at most."""
MAX_DECIMALS = 9
"""What needs more decimal places is written with an exponent."""

_HIDDEN_CATEGORIES = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Of Unicode: control and format characters, halves of pairs, separators of lines and paragraphs."""
_HARMLESS = frozenset("\n\t\u00ad\u200c\u200d")
"""Of these what ordinary text holds: line break, tab, soft hyphen, and the joiners of scripts and emoji."""


def printable(text: str) -> str:
    """Return a text whose hidden characters are written out as JSON does it, by number.

    Whoever filled in a note or named a file could otherwise drive a terminal with it (colours, the title, the
    clipboard), overwrite the text before it, or turn the order of letters round.
    """
    if text.isprintable():
        return text
    hidden = (letter for letter in set(text) - _HARMLESS if unicodedata.category(letter) in _HIDDEN_CATEGORIES)
    return text.translate({ord(letter): _written_out(letter) for letter in hidden})


def _written_out(letter: str) -> str:
    units = letter.encode("utf-16-be", "surrogatepass").hex()
    return "".join(f"\\u{units[at : at + 4]}" for at in range(0, len(units), 4))


def significant_text(value: float, digits: int = 3) -> str:
    """Write a number with so many significant digits and no exponent: 0.0816, 113, −7.2."""
    if not isfinite(value):
        return UNKNOWN
    return "0" if value == 0 else with_minus_sign(format(Decimal(f"{value:.{digits - 1}e}"), "f"))


def with_minus_sign(text: str) -> str:
    """Return a number's text with the sign for minus in place of the hyphen."""
    return text.replace("-", "−")


def rounded_to_error(value: float | None, error: float | None) -> str:
    """Write a number to the second digit of its standard error; with four digits where the error is not known."""
    if value is None or not isfinite(value):
        return UNKNOWN
    if not _is_known(error):
        return with_minus_sign(f"{value:.{DIGITS_WITHOUT_ERROR}g}")
    if error < EXACT * abs(value):
        return with_minus_sign(f"{value:.{EXACT_DIGITS}g}")
    return _to_places(value, error)


def value_with_error(value: float | None, error: float | None) -> str:
    """Write a value with its standard error, both to the error's second digit: 113.24 ± 0.21."""
    text = rounded_to_error(value, error)
    if value is None or not isfinite(value) or not _is_known(error) or error < EXACT * abs(value):
        return text
    return f"{text} ± {_to_places(error, error)}"


def range_text(interval: tuple[float, float] | None, error: float | None) -> str:
    """Write an interval to the second digit of the error: 3.242 to 3.290; nothing without width."""
    if interval is None or not all(map(isfinite, interval)):
        return ""
    low, high = (rounded_to_error(end, error) for end in interval)
    return "" if low == high else f"{low} to {high}"


def _is_known(error: float | None) -> TypeGuard[float]:
    return error is not None and isfinite(error) and error > 0


def _to_places(value: float, error: float) -> str:
    """Write a number with the decimal places that two digits of an error take."""
    places = max(0, 1 - floor(log10(error)))
    return with_minus_sign(f"{value:.1e}" if places > MAX_DECIMALS else f"{value:z.{places}f}")


def percent_text(share: float) -> str:
    """Write a share as percentage: 71 %, 99.3 %; never as the whole, or as nothing, where it only rounds to that."""
    if not isfinite(share):
        return "an unknown share"
    if 0.9995 <= share < 1:
        return "above 99.9 %"
    if 0 < share < 0.0005:
        return "below 0.1 %"
    precise = 0.9 < share < 1 or 0 < share < 0.01
    return with_minus_sign(f"{100 * share:z.{1 if precise else 0}f} %")


def join_names(names: Sequence[str]) -> str:
    """Join names for a sentence."""
    if not names:
        return ""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def count_text(number: int, noun: str) -> str:
    """Return a number with its noun."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def capitalise(text: str) -> str:
    """Return a text with a capital first letter."""
    return text[:1].upper() + text[1:]


def as_sentence(text: str) -> str:
    """Return a text as a sentence with capital and full stop; empty for an empty text."""
    sentence = capitalise(text.strip())
    return sentence if not sentence or sentence.endswith((".", "!", "?")) else f"{sentence}."
