"""One measure of two runs side by side, and the judgement of its difference."""

from dataclasses import dataclass
from enum import StrEnum
from math import hypot

from dragrig.analysis.estimates import NORMAL_95, Estimate

STEADY, ABOVE_REST, REST, PEAK, HOLD, SPEED = "steady force", "above rest", "rest", "peak", "hold", "speed"


class Verdict(StrEnum):
    """How a difference stands beside what differs anyway; each limit holds 95 % of equal runs."""

    NOISE = "within noise"
    SCATTER = "within scatter"
    BEYOND = "differs"
    UNKNOWN = "cannot be told"


@dataclass(frozen=True, slots=True)
class Difference:
    """One measure of two runs.

    Attributes
    ----------
    measure, unit
        As in `analysis.measures`, in words.
    a, b
        As recorded.
    zeros
        What the rest before the motion shows of both, taken off before they were subtracted; None where it was not.
    value
        B − A; None where one is missing, with the `reason`.
    noise
        Its standard error by the noise of both runs.
    spread
        Standard deviation by which it differs between repeats on one specimen, unknown zeros included.
    """

    measure: str
    unit: str
    a: Estimate
    b: Estimate
    zeros: tuple[float, float] | None = None
    value: float | None = None
    noise: float | None = None
    spread: float = 0.0
    reason: str = ""

    @property
    def compared(self) -> tuple[float | None, float | None]:
        """Values of both that were subtracted, zeros taken off."""
        zeros = self.zeros or (0.0, 0.0)
        a, b = (
            None if one.value is None else one.value - zero for one, zero in zip((self.a, self.b), zeros, strict=True)
        )
        return a, b

    @property
    def error(self) -> float | None:
        """Standard deviation of the difference of two runs that are equal but for noise and scatter."""
        return None if self.noise is None else hypot(self.noise, self.spread)

    @property
    def verdict(self) -> Verdict:
        """Whether noise, or noise and scatter, explain it."""
        return judged(self.value, self.noise, self.error)


def judged(value: float | None, noise: float | None, error: float | None) -> Verdict:
    """Judge a difference by the standard errors of noise alone and of noise and scatter together."""
    if value is None or noise is None or error is None:
        return Verdict.UNKNOWN
    if abs(value) <= NORMAL_95 * noise:
        return Verdict.NOISE
    return Verdict.SCATTER if abs(value) <= NORMAL_95 * error else Verdict.BEYOND


def main_measures(kind: str) -> tuple[str, ...]:
    """Return the measures that a kind of run is made for."""
    return (PEAK, HOLD) if kind == "relaxation" else (STEADY,)
