"""Rates as rows of a table."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dragrig.gap_scoring.rates import Rate

RATE_HEADER: Sequence[str] = ("", "held", "share", "95 % interval")
RATE_NUMBERS = (1, 2, 3)


def rate_row(one: "Rate") -> tuple[str, ...]:
    """Return a rate's name, how often it held, its share and its interval."""
    if not one.count:
        return one.name, "no case", "", ""
    return one.name, f"{one.held} of {one.count}", f"{one.share:.2f}", f"{one.low:.2f} to {one.high:.2f}"
