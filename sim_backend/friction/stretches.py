"""Stretches of time within which the force is smooth, and the panels that it is interpolated on.

The force jumps or bends where the motion does, and again when the wall that was passed at that moment
comes to the equator of the leading hemisphere.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.history import ContactHistory, Segment, Stroke

SHORTEST_S = 1e-9
"""Stretches shorter than this are joined to their neighbour."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Times from `begin_s` to `end_s` of one stroke.

    `side` is the segment that the wall at the equator belongs to. `steady` says that the forces are
    constant, `uniform` that the velocity is; `sign` is its direction, 0 at rest.
    """

    begin_s: float
    end_s: float
    stroke: Stroke
    side: Segment
    sign: int
    uniform: bool
    steady: bool


def stretches(history: ContactHistory, contact_mm: float) -> Iterator[Stretch]:
    """Divide a motion where its force jumps or bends; `contact_mm` is the length L of the contact."""
    motion = history.motion
    for stroke in history.strokes:
        begin, end = float(motion.breaks_s[stroke.first]), float(motion.breaks_s[stroke.last + 1])
        events = np.concatenate(
            (motion.breaks_s[stroke.first : stroke.last + 1], _at_equator(history, stroke, contact_mm))
        )
        edges = [begin]
        for time in np.sort(events[(events > begin) & (events < end)]):
            if min(time - edges[-1], end - time) > SHORTEST_S:
                edges.append(float(time))
        for start, stop in pairwise((*edges, end)):
            yield _stretch(history, stroke, contact_mm, start, stop)


def _at_equator(history: ContactHistory, stroke: Stroke, contact_mm: float) -> FloatArray:
    """Return when the ends of what the stroke found, and the bends in how it was passed, reach the equator."""
    motion = history.motion
    points: list[float] = []
    for segment in (*stroke.found, stroke.fresh):
        points += (segment.rear_mm, segment.front_mm)
        if segment.direction:
            passed = motion.position(motion.breaks_s[segment.first + 1 : segment.last + 1])
            points += (passed - (0.0 if segment.direction > 0 else history.reach_mm)).tolist()
    begin, end = motion.position(motion.breaks_s[[stroke.first, stroke.last + 1]])
    # The capsule has the wall point z at its equator when it is at p = z + (p - wall_at(L, p)).
    passing = np.asarray(points) - history.wall_at(stroke, contact_mm, np.zeros(1))
    ahead = stroke.direction * (passing - begin)
    inside = passing[(ahead > 0) & (ahead < stroke.direction * (end - begin))]
    return motion.arrival(inside, stroke.first, stroke.last)


def _stretch(history: ContactHistory, stroke: Stroke, contact_mm: float, begin_s: float, end_s: float) -> Stretch:
    motion = history.motion
    middle = np.array([0.5 * (begin_s + end_s)])
    index = int(np.searchsorted(motion.breaks_s[:-1], middle[0], side="right")) - 1
    side = _segment_at(history, stroke, contact_mm, middle)
    uniform = bool(motion.uniform[index])
    sign = int(motion.signs[index])
    oldest = history.begin(side, history.wall_at(stroke, contact_mm, motion.position(middle)))
    steady = uniform and sign != 0 and side is stroke.fresh and bool(oldest[0] >= motion.breaks_s[index])
    return Stretch(begin_s, end_s, stroke, side, sign, uniform, steady)


def _segment_at(history: ContactHistory, stroke: Stroke, contact_mm: float, time_s: FloatArray) -> Segment:
    """Return the segment that the wall at the equator belongs to."""
    z = float(history.wall_at(stroke, contact_mm, history.motion.position(time_s))[0])
    segments = (*stroke.found, stroke.fresh)
    return min(segments, key=lambda segment: max(segment.rear_mm - z, z - segment.front_mm))
