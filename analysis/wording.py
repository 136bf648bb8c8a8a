"""Numbers, counts and names as sentences write them, for analysis and `present` alike."""

from collections.abc import Sequence
from decimal import Decimal
from math import isfinite

UNKNOWN = "–"
"""Shown for a value that is missing or not finite."""


def significant_text(value: float, digits: int = 3) -> str:
    """Write a number with so many significant digits and no exponent: 0.0816, 113, −7.2."""
    if not isfinite(value):
        return UNKNOWN
    return "0" if value == 0 else with_minus_sign(format(Decimal(f"{value:.{digits - 1}e}"), "f"))


def with_minus_sign(text: str) -> str:
    """Return a number's text with the sign for minus in place of the hyphen."""
    return text.replace("-", "−")


def percent_text(share: float) -> str:
    """Write a share as percentage: 71 %, 99.3 %; never as the whole, or as nothing, what only rounds to that."""
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
