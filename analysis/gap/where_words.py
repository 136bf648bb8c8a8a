"""Where a gap is, in words: a line for each axis, and what the residual is above all a function of."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite

from dragrig.analysis.gap.where.results import Location, Where

LEAST_SHARE = 0.01
"""Smaller shares are not told."""
BY_CHANCE = 0.05
EVENLY = "nothing stands out"


@dataclass(frozen=True, slots=True)
class PlaceInWords:
    """One axis: its name, where on it most of the excess is, and the chance that it stands out so without a gap."""

    axis: str
    where: str
    p: float


_UNITS: Mapping[str, tuple[str, str, float]] = {
    "speed_mm_s": ("speed", "mm/s", 1.0),
    "position": ("position", "mm", 1.0),
    "session": ("session", "min", 1 / 60),
    "strain": ("strain", "%", 100.0),
    "band_hz": ("frequency", "Hz", 1.0),
}
"""Name, unit and factor of axes whose bins are ranges."""
DOMAINS: Mapping[str, str] = {
    "speed": "speed",
    "position": "position along the stroke",
    "time": "time within the run",
    "session": "the session's clock",
    "frequency": "time at a high frequency",
    "strain": "strain",
    "transient": "what happens when the velocity changes",
}


def places(where: Where) -> tuple[PlaceInWords, ...]:
    """Return the axes on which a part of the excess lies; none without a gap."""
    if not where.present:
        return ()
    alone = where.runs == 1
    return tuple(
        PlaceInWords(_axis(one), text, float("nan") if alone else one.least_p)
        for one in where.locations
        if (text := _text(one, alone=alone))
    )


def where_sentence(where: Where) -> str:
    """Say what the residual is above all a function of."""
    if not where.present:
        return "No place stands out of noise and repeatability."
    if not where.domain:
        return "What the residual is a function of, these runs do not say of one another."
    score = where.domain_scores.get(where.domain, float("nan"))
    others = "" if where.runs == 1 else " on runs that took no part"
    share = f", which accounts for {100 * score:.0f} % of its squares{others}"
    if not isfinite(score):
        share = ""
    return f"The residual is above all a function of {DOMAINS.get(where.domain, where.domain)}{share}."


def _axis(location: Location) -> str:
    return _UNITS[location.name][0] if location.name in _UNITS else location.name


def _text(location: Location, *, alone: bool) -> str:
    named = sorted(location.shares.items(), key=lambda one: -one[1])
    if named:
        return ", ".join(f"{name} {100 * share:.0f} %" for name, share in named if share >= LEAST_SHARE)
    if location.low is None or location.high is None or location.share < LEAST_SHARE:
        return ""
    if alone and location.low == location.high:
        return ""
    if location.p > BY_CHANCE and not alone:
        return EVENLY
    _, unit, factor = _UNITS.get(location.name, (location.name, "", 1.0))
    low, high = f"{location.low * factor:.3g}", f"{location.high * factor:.3g}"
    ends = f"at {low}" if low == high else f"{low} to {high}"
    return f"{ends} {unit}".strip() + f": {100 * location.share:.0f} %"
