"""Which coordinate a gap without a name may be a function of, whatever the function, beside the effect most like it."""

from collections.abc import Mapping
from types import MappingProxyType

from dragrig.analysis.gap.evidence import Evidence
from dragrig.sim_backend.effects.catalogue import catalogue

LEAST_SHARE = 0.5
"""Part of the excess that a law must explain."""
MORE = 1.1
"""A law is told that explains so much more than the effect most like it."""

_OF: Mapping[str, str] = MappingProxyType(
    {
        "speed": "that depends on the speed alone, in all runs",
        "speed of sliding": "that depends on the speed alone, wherever something slides",
        "speed in the gut": "that depends on the speed alone, in the gut",
        "place": "that depends on the position alone, in all runs that slide or touch nothing",
        "place in the gut": "that depends on the position alone, in the gut",
        "time at rest": "that depends on the time at rest alone, in all runs",
        "time at rest in the gut": "that depends on the time at rest alone, in the gut",
        "time since start and stop": "that depends on the time since start and stop alone, in all runs",
        "time since start and stop in the gut": "that depends on the time since start and stop alone, in the gut",
        "load": "that depends on the load alone",
        "session": "that depends on the session's time alone",
        "gain of a run": "whose gain differs from run to run",
        "swing in all runs": "that swings on the session's clock, in all runs",
    }
)
"""Laws in words."""


def any_law(found: Evidence) -> str:
    """Return a sentence on the law without a name that explains more than any effect; empty where none does."""
    if not found.nameless:
        return ""
    law = found.nameless[0]
    best = min((one for one in found.tried if len(one.effects) == 1), key=lambda one: one.flexible, default=None)
    gain, other = found.squares - law.squares, 0.0 if best is None else max(found.squares - best.flexible, 0.0)
    if gain < LEAST_SHARE * max(found.excess, 1.0) or gain < MORE * other:
        return ""
    beside = "" if best is None else f"; {_called(best.effects[0])}, in any form, {_told(other, found)}"
    return f"A force {_OF[law.law]}, in whatever way, explains {_told(gain, found)} of it{beside}."


def _called(effect: str) -> str:
    known = catalogue()
    return known[effect].name if effect in known else effect.replace("_", " ")


def _told(gain: float, found: Evidence) -> str:
    return f"{min(gain / max(found.excess, 1.0), 1.0):.0%}"
