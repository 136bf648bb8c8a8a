"""A number with its uncertainty, or the reason why there is none."""

from dataclasses import dataclass

NORMAL_95 = 1.959964
"""Standard errors on either side that hold 95 % of a normal distribution."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A measured value.

    Attributes
    ----------
    value, standard_error
        In the unit that the estimate's name says; None where the data do not support one.
    effective_samples
        How many independent samples would give the same standard error.
    reason
        Why value or standard error is None; empty when both are there.
    """

    value: float | None = None
    standard_error: float | None = None
    effective_samples: float | None = None
    reason: str = ""

    @property
    def interval(self) -> tuple[float, float] | None:
        """Interval that holds the true value with 95 % confidence."""
        if self.value is None or self.standard_error is None:
            return None
        half = NORMAL_95 * self.standard_error
        return self.value - half, self.value + half

    def __str__(self) -> str:
        if self.value is None:
            return f"- ({self.reason})"
        if self.standard_error is None:
            return f"{self.value:.4g}"
        return f"{self.value:.4g} ± {self.standard_error:.2g}"


def missing(reason: str) -> Estimate:
    """Return an estimate that is not there, and why."""
    return Estimate(reason=reason)
