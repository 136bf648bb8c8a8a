"""Numbers with as many digits as their error supports."""

from math import floor, isfinite, log10

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.results import Quantity

SIGNIFICANT = 4
"""Digits of a number whose error is not known."""
MOST_DECIMALS = 9


def to_error(value: float | None, error: float | None) -> str:
    """Spell a number to the second digit of its error; `-` where there is no number."""
    if value is None or not isfinite(value):
        return "-"
    return f"{value:.{_decimals(error)}f}" if _known(error) else f"{value:.{SIGNIFICANT}g}"


def error_of(error: float | None) -> str:
    """Spell an error with two digits; nothing where it is not known."""
    if error is None or not isfinite(error):
        return ""
    return f"{error:.{_decimals(error)}f}" if _known(error) else f"{error:.2g}"


def interval_of(quantity: Quantity) -> str:
    """Spell the 95 % interval to the second digit of the error: 3.242 to 3.290."""
    return between(quantity.interval, quantity.standard_error)


def between(interval: tuple[float, float] | None, error: float | None) -> str:
    """Spell an interval; nothing where it is not known."""
    if interval is None or not all(isfinite(one) for one in interval):
        return ""
    return " to ".join(to_error(one, error) for one in interval)


def with_error(estimate: Estimate) -> tuple[str, str]:
    """Spell an estimate and its standard error for two columns; a missing one by the reason."""
    if estimate.value is None:
        return f"- ({estimate.reason})" if estimate.reason else "-", ""
    return to_error(estimate.value, estimate.standard_error), error_of(estimate.standard_error)


def unit_of(unit: str) -> str:
    """Spell a unit for a table: nothing for a pure number."""
    return "" if unit == "1" else unit


def chance(p_value: float) -> str:
    """Spell a probability: p = 0.39, p < 0.0001."""
    return "p < 0.0001" if p_value < 1e-4 else f"p = {p_value:.2g}"


def _known(error: float | None) -> bool:
    return error is not None and isfinite(error) and error > 0


def _decimals(error: float | None) -> int:
    if error is None or not _known(error):
        return 0
    return min(max(0, 1 - floor(log10(error))), MOST_DECIMALS)
