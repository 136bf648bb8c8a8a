"""Sentinels: one run made again and again; its steady force says how far the specimen has drifted since the first."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot

from dragrig.rig.runfile import Attribute

SENTINEL_ROLE = "sentinel"
"""Attribute `role` of a sentinel's run file."""


@dataclass(frozen=True, slots=True)
class SteadyForce:
    """Steady force of a run with its force at rest taken off [mN], or the reason why there is none."""

    order: int
    """Number of the run in its campaign."""
    value_mN: float | None
    standard_error_mN: float | None = None
    reason: str = ""

    def __str__(self) -> str:
        if self.value_mN is None:
            return f"no steady force ({self.reason})"
        error = "" if self.standard_error_mN is None else f" ± {self.standard_error_mN:.2f}"
        return f"{self.value_mN:.2f}{error} mN"


@dataclass(frozen=True, slots=True)
class Drift:
    """A sentinel compared with the first of its campaign."""

    measured: SteadyForce
    reference: SteadyForce | None
    """The first sentinel; None where this is the first."""
    bounds: tuple[float, float] = (0.0, 0.0)
    """Allowed drift in per cent and in standard errors; 0 where a bound is not given."""

    @property
    def percent(self) -> float | None:
        """Change of the steady force since the first sentinel [%]."""
        if self.reference is None or self.measured.value_mN is None or not self.reference.value_mN:
            return None
        return 100 * (self.measured.value_mN / self.reference.value_mN - 1)

    @property
    def error_percent(self) -> float | None:
        """Standard error of the change [%], from those of both forces."""
        if self.percent is None or self.reference is None or not self.reference.value_mN:
            return None
        errors = (self.measured.standard_error_mN, self.reference.standard_error_mN)
        if errors[0] is None or errors[1] is None:
            return None
        ratio = 1 + self.percent / 100
        return 100 * hypot(errors[0], ratio * errors[1]) / abs(self.reference.value_mN)

    @property
    def needs_decision(self) -> bool:
        """Whether a person is asked: the drift is beyond every bound that is given, or nothing can be compared."""
        if self.measured.value_mN is None:
            return True
        if self.reference is None:
            return False
        if self.percent is None:
            return True
        by_percent, by_errors = self.bounds
        if by_errors and self.error_percent is None:
            return True
        return abs(self.percent) > by_percent and abs(self.percent) > by_errors * (self.error_percent or 0.0)

    @property
    def bound(self) -> str:
        """The allowed drift, in words."""
        by_percent, by_errors = self.bounds
        words = (f"{by_percent:g} %" if by_percent else "", f"{by_errors:g} standard errors" if by_errors else "")
        return " and ".join(filter(None, words))

    def __str__(self) -> str:
        sentence = f"Sentinel, run {self.measured.order}: steady − rest {self.measured}"
        if self.reference is None:
            return f"{sentence}, the first" if self.measured.value_mN is not None else sentence
        if self.percent is None:
            return f"{sentence}, not to be compared with run {self.reference.order} ({self.reference})"
        error = "" if self.error_percent is None else f" ± {self.error_percent:.1f}"
        verdict = f"beyond {self.bound}" if self.needs_decision else f"within {self.bound}"
        change = f"{self.percent:+.1f}{error} % from run {self.reference.order}"
        return f"{sentence}, {change}, {verdict} (± is one standard error)"

    def attributes(self, decision: str) -> Mapping[str, Attribute]:
        """Return the entry about the specimen in the files of the runs after it.

        Parameters
        ----------
        decision
            The decision, where somebody was asked.
        """
        attributes: dict[str, Attribute] = {"sentinel_run": self.measured.order, "sentinel_decision": decision}
        if self.percent is not None:
            attributes["sentinel_drift_percent"] = self.percent
        if self.error_percent is not None:
            attributes["sentinel_drift_error_percent"] = self.error_percent
        return attributes
