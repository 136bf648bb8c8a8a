"""Stretches of time within which the force is smooth, and the panels that it is interpolated on.

The force jumps or bends where the motion does, and again when the wall that was passed at that moment
comes to the equator of the leading hemisphere.
"""

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise

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
        edges = _edges(history, stroke, contact_mm)
        middle = 0.5 * (edges[:-1] + edges[1:])
        position = motion.position(middle)
        index = np.searchsorted(motion.breaks_s[:-1], middle, side="right") - 1
        uniform, signs = motion.uniform[index], motion.signs[index]
        # Once a contact length has been travelled at one velocity, every age is x / v.
        settled = np.abs(position - motion.position(motion.breaks_s[index])) >= contact_mm
        steady = uniform & (signs != 0) & settled
        sides = [_segment_at(stroke, float(z)) for z in history.wall_at(stroke, contact_mm, position)]
        times = pairwise(edges.tolist())
        for (begin, end), side, *flags in zip(times, sides, signs, uniform, steady, strict=True):
            sign, constant_velocity, constant_force = (int(flag) for flag in flags)
            yield Stretch(begin, end, stroke, side, sign, bool(constant_velocity), bool(constant_force))


def joined(parts: Sequence[Stretch]) -> Iterator[Stretch]:
    """Join neighbours that differ by nothing but where they are; those where the forces are constant stay apart."""
    for _, group in groupby(parts, key=_joinable):
        first, *others = group
        if not others:
            yield first
        elif first.steady:
            yield from (first, *others)
        else:
            yield replace(first, end_s=others[-1].end_s, uniform=False)


def _joinable(one: Stretch) -> Hashable:
    return one.stroke.first, one.side, one.sign, one.steady


def _edges(history: ContactHistory, stroke: Stroke, contact_mm: float) -> FloatArray:
    """Begin of a stroke, every event in it, and its end."""
    breaks = history.motion.breaks_s[stroke.first : stroke.last + 2]
    edges, end = [float(breaks[0])], float(breaks[-1])
    for time in np.sort(np.concatenate((breaks[1:-1], _at_equator(history, stroke, contact_mm)))).tolist():
        if min(time - edges[-1], end - time) > SHORTEST_S:
            edges.append(time)
    return np.array([*edges, end])


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


def _segment_at(stroke: Stroke, z_mm: float) -> Segment:
    """Return the segment that a wall point belongs to."""
    segments = (*stroke.found, stroke.fresh)
    return min(segments, key=lambda segment: max(segment.rear_mm - z_mm, z_mm - segment.front_mm))
