"""A number with its interval, and what is not used."""

from collections.abc import Iterable
from dataclasses import dataclass

MOST_REASONS = 3
"""So many reasons are told where no run is left."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """An identified number; `interval` holds the true one with 95 % confidence."""

    name: str
    unit: str
    value: float
    standard_error: float
    interval: tuple[float, float]

    @property
    def half_width(self) -> float:
        """Half of the interval, relative to the value."""
        low, high = self.interval
        return 0.5 * (high - low) / abs(self.value) if self.value else float("inf")


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A run, or a part of the result, that is not used, and why."""

    what: str
    reason: str


def counted(left_out: Iterable[LeftOut]) -> str:
    """Return each reason once, with the runs that it holds for, most of them counted only."""
    reasons: dict[str, list[str]] = {}
    for one in left_out:
        reasons.setdefault(one.reason, []).append(one.what)
    told = [
        f"{files[0]}{f' and {len(files) - 1} more' if len(files) > 1 else ''}: {reason}"
        for reason, files in reasons.items()
    ]
    return "; ".join(told if len(told) <= MOST_REASONS else [*told[:MOST_REASONS], "and other reasons"])
