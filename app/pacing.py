"""How fast a rig that is no rig lives."""

from dataclasses import dataclass
from typing import Literal

from dragrig.config.errors import SettingsError

Pace = Literal["fast", "real"] | float
"""As fast as it can, as fast as a real rig, or so many times faster; the last for doubles only."""
_FASTEST = 1000.0


@dataclass(frozen=True, slots=True)
class Pacing:
    """What a backend is told: whether a simulated clock keeps the wall's pace, and how much faster a double lives."""

    real_time: bool
    times_faster: float = 1.0


def pacing(pace: Pace | None, *, double: bool) -> Pacing:
    """Return what a pace means; unless given, a simulated rig is fast and a double real.

    Raises
    ------
    SettingsError
        For a pace that is not there for this kind of rig.
    """
    if not double:
        if pace not in {None, "fast", "real"}:
            raise SettingsError(f"--pace {pace}: is fast or real; so many times faster is for --double.")
        return Pacing(real_time=pace == "real")
    times_faster = 1.0 if pace is None or pace == "real" else pace
    if isinstance(times_faster, str) or not 0 < times_faster <= _FASTEST:
        raise SettingsError(f"--pace {pace}: a double's is real, or so many times faster, as 20, up to {_FASTEST:g}.")
    return Pacing(real_time=True, times_faster=float(times_faster))
