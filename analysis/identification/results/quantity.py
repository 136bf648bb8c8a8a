"""A number with its interval, and what is not used."""

from dataclasses import dataclass


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
