"""Smooth functions of speed, position, time, session, strain and kind, about 1 in size.

No effect has the form that a catalogue writes down. A candidate whose signature is multiplied by a sum of these, each
with a small prior, can be as foreign as a real effect is, and still not be another one.
"""

from collections.abc import Sequence

import numpy as np

from dragrig.analysis.gap.sights import Sight
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase

MIDDLE_LOG_SPEED, HALF_LOG_SPEED = 1.6, 2.4
"""Speeds from 0.5 to 60 mm/s lie between −1 and 1."""
SLOWEST_MM_S = 0.3
HALF_TRAVEL_MM = 20.0
MIDDLE_STRAIN, HALF_STRAIN = 1.25, 0.75


def modulations(sights: Sequence[Sight]) -> tuple[FloatArray, ...]:
    """Return the functions at the blocks of each run, shape `(K, B)` each."""
    last_s = max(float(one.coordinates.session_s.max()) for one in sights)
    return tuple(_of(one, max(last_s, 1.0)) for one in sights)


def _of(sight: Sight, last_s: float) -> FloatArray:
    at = sight.coordinates
    ones = np.ones_like(at.time_s)
    sticks = sight.experiment.contact is Contact.STICKING
    slides = 0.0 * ones if sticks else ones
    top = slides * _log_speed(at.top_speed_mm_s)
    place = slides * np.clip(at.position_mm / HALF_TRAVEL_MM - 1.0, -1.2, 1.2)
    since = np.clip((np.log(at.since_event_s + 2e-3) + 2.0) / 4.0, -1.2, 1.2)
    strain = (sight.condition[1] - MIDDLE_STRAIN) / HALF_STRAIN * (ones - slides)
    rows = (
        top,
        _curved(top) * slides,
        place,
        _curved(place) * slides,
        since,
        2.0 * at.session_s / last_s - 1.0,
        strain,
        slides * _log_speed(at.speed_mm_s),
        ones * (sight.experiment.kind == "coulomb"),
        ones - slides,
        ones * (sight.experiment.contact is Contact.NONE),
        (at.phase == Phase.HOLD) * ones,
        ((at.phase == Phase.ACCELERATE) | (at.phase == Phase.DECELERATE)) * ones,
    )
    return np.stack(rows)


def _log_speed(speed_mm_s: FloatArray) -> FloatArray:
    scaled = (np.log(speed_mm_s + SLOWEST_MM_S) - MIDDLE_LOG_SPEED) / HALF_LOG_SPEED
    return np.asarray(np.clip(scaled, -1.5, 1.5))


def _curved(value: FloatArray) -> FloatArray:
    return np.asarray(1.5 * value**2 - 0.5)
