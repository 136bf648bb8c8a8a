"""Which wall has been in contact since when: the strokes of a motion and the contact each one finds.

A wall point z is in contact while it lies between the rear contact, p − ℓ, and the front contact, p. Its
age counts from when the front passed it moving forward or the rear passed it moving backward, or from the
insertion when it was there at the first sample.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.motion import Motion


@dataclass(frozen=True, slots=True)
class Segment:
    """Wall from `rear_mm` to `front_mm` that one stroke, or the insertion, brought into contact.

    `direction` is that of the stroke, 0 for the insertion; `first` and `last` are the stretches of the
    motion during which it happened.
    """

    rear_mm: float
    front_mm: float
    direction: int
    first: int = 0
    last: int = 0


@dataclass(frozen=True, slots=True)
class Stroke:
    """Stretches `first` to `last` of a motion, which go one way or stand still.

    `found` is the contact at its start, from rear to front; `fresh` the wall it adds itself.
    """

    direction: int
    first: int
    last: int
    found: tuple[Segment, ...]
    fresh: Segment


@dataclass(frozen=True, slots=True, eq=False)
class ContactHistory:
    """A motion with the contact that each of its strokes finds.

    Attributes
    ----------
    motion
        The motion.
    reach_mm
        Distance ℓ from rear to front contact.
    dwell_s
        Age of the contact at the first sample.
    strokes
        The strokes, in order.
    """

    motion: Motion
    reach_mm: float
    dwell_s: float
    strokes: tuple[Stroke, ...]

    @classmethod
    def of(cls, motion: Motion, reach_mm: float, dwell_s: float) -> "ContactHistory":
        """Follow the motion through its strokes."""
        return cls(motion, reach_mm, dwell_s, tuple(_follow(motion, reach_mm)))

    def travelled(self, stroke: Stroke, z_mm: FloatArray | float, position_mm: FloatArray | float) -> FloatArray:
        """Contact coordinate x of wall points z when the capsule is at a position of a stroke."""
        if stroke.direction > 0:
            return np.asarray(position_mm - np.asarray(z_mm))
        return np.asarray(np.asarray(z_mm) - position_mm + self.reach_mm)

    def wall_at(self, stroke: Stroke, x_mm: FloatArray | float, position_mm: FloatArray) -> FloatArray:
        """Wall point z at a contact coordinate x, the inverse of `travelled`."""
        if stroke.direction > 0:
            return np.asarray(position_mm - x_mm)
        return np.asarray(position_mm - self.reach_mm + x_mm)

    def begin(self, segment: Segment, z_mm: FloatArray) -> FloatArray:
        """Time at which the wall points z of a segment came into contact."""
        if segment.direction == 0:
            return np.full_like(z_mm, -self.dwell_s)
        passing = z_mm if segment.direction > 0 else z_mm + self.reach_mm
        return self.motion.arrival(passing, segment.first, segment.last)


def _follow(motion: Motion, reach_mm: float) -> Iterator[Stroke]:
    position = motion.position(motion.breaks_s)
    found: tuple[Segment, ...] = (Segment(float(position[0]) - reach_mm, float(position[0]), 0),)
    for direction, first, last in _strokes(motion):
        begin, end = float(position[first]), float(position[last + 1])
        if direction > 0:
            fresh = Segment(begin, end, direction, first, last)
            yield Stroke(direction, first, last, found, fresh)
            contact = (*found, fresh)
        else:
            fresh = Segment(end - reach_mm, begin - reach_mm, direction, first, last)
            yield Stroke(direction, first, last, found, fresh)
            contact = (fresh, *found)
        found = tuple(_within(contact, end - reach_mm, end))


def _strokes(motion: Motion) -> Iterator[tuple[int, int, int]]:
    """Direction, first and last stretch; a rest belongs to the stroke before it, the first one to the next."""
    moving = np.flatnonzero(motion.signs)
    turns = [int(b) for a, b in pairwise(moving) if motion.signs[a] != motion.signs[b]]
    edges = [0, *turns, len(motion.signs)]
    for first, end in pairwise(edges):
        signs = motion.signs[first:end]
        yield (-1 if (signs < 0).any() else 1), first, end - 1


def _within(segments: tuple[Segment, ...], rear_mm: float, front_mm: float) -> Iterator[Segment]:
    for segment in segments:
        rear, front = max(segment.rear_mm, rear_mm), min(segment.front_mm, front_mm)
        if front > rear:
            yield replace(segment, rear_mm=rear, front_mm=front)
