"""Since when each point of the wall has been in contact, and the time intervals within which the force is smooth.

A wall point z is in contact while it lies between the rear contact, p − ℓ, and the front contact, p. Its age counts
from when the front passed it moving forward or the rear passed it moving backward, or from the insertion when it was
there at the first sample. The force jumps or bends where the motion does, and again when the wall passed at that
moment reaches the equator of the leading hemisphere. Reversals of some µm, as a stage makes after an overshoot, do not
change which hemisphere leads.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.motion import Motion, ProfileMotion, RecordedMotion


@dataclass(frozen=True, slots=True)
class WallSegment:
    """Wall from `rear_mm` to `front_mm` that one stroke, or the insertion, brought into contact.

    `direction` is that of the stroke, 0 for the insertion; `first` and `last` are the intervals of the motion in which
    it happened.
    """

    rear_mm: float
    front_mm: float
    direction: int
    first: int = 0
    last: int = 0


@dataclass(frozen=True, slots=True)
class ContactStroke:
    """Intervals `first` to `last` of a motion, all in one direction or at rest.

    `inherited` is the contact at its start, from rear to front; `fresh` the wall that it adds.
    """

    direction: int
    first: int
    last: int
    inherited: tuple[WallSegment, ...]
    fresh: WallSegment

    @property
    def segments(self) -> tuple[WallSegment, ...]:
        """All wall that is in contact during the stroke."""
        return *self.inherited, self.fresh

    def segment_at(self, z_mm: float) -> WallSegment:
        """Return the segment of a wall point."""
        return min(self.segments, key=lambda segment: max(segment.rear_mm - z_mm, z_mm - segment.front_mm))


@dataclass(frozen=True, slots=True, eq=False)
class ContactHistory:
    """A motion with the contact that each of its strokes inherits.

    Attributes
    ----------
    motion
        Motion of the capsule.
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
    strokes: tuple[ContactStroke, ...]

    @classmethod
    def of(cls, motion: Motion, reach_mm: float, dwell_s: float) -> "ContactHistory":
        """Divide the motion into strokes."""
        return cls(motion, reach_mm, dwell_s, tuple(_contact_strokes(motion, reach_mm)))

    def contact_coordinate(
        self, stroke: ContactStroke, z_mm: FloatArray | float, position_mm: FloatArray | float
    ) -> FloatArray:
        """Return the contact coordinate x of wall points z at a position of the capsule in a stroke."""
        if stroke.direction > 0:
            return np.asarray(position_mm - np.asarray(z_mm))
        return np.asarray(np.asarray(z_mm) - position_mm + self.reach_mm)

    def wall_point(self, stroke: ContactStroke, x_mm: FloatArray | float, position_mm: FloatArray) -> FloatArray:
        """Return the wall point z at a contact coordinate x, the inverse of `contact_coordinate`."""
        if stroke.direction > 0:
            return np.asarray(position_mm - x_mm)
        return np.asarray(position_mm - self.reach_mm + x_mm)

    def contact_time(self, segment: WallSegment, z_mm: FloatArray) -> FloatArray:
        """Return when the wall points z of a segment came into contact."""
        if segment.direction == 0:
            return np.full_like(z_mm, -self.dwell_s)
        passing = z_mm if segment.direction > 0 else z_mm + self.reach_mm
        return self.motion.arrival_time(passing, segment.first, segment.last)


def _contact_strokes(motion: Motion, reach_mm: float) -> Iterator[ContactStroke]:
    position = motion.position(motion.breaks_s)
    inherited: tuple[WallSegment, ...] = (WallSegment(float(position[0]) - reach_mm, float(position[0]), 0),)
    for direction, first, last in _one_way_spans(motion):
        begin, end = float(position[first]), float(position[last + 1])
        if direction > 0:
            fresh = WallSegment(begin, end, direction, first, last)
            contact = (*inherited, fresh)
        else:
            fresh = WallSegment(end - reach_mm, begin - reach_mm, direction, first, last)
            contact = (fresh, *inherited)
        yield ContactStroke(direction, first, last, inherited, fresh)
        clipped = (
            replace(part, rear_mm=max(part.rear_mm, end - reach_mm), front_mm=min(part.front_mm, end))
            for part in contact
        )
        inherited = tuple(part for part in clipped if part.front_mm > part.rear_mm)


def _one_way_spans(motion: Motion) -> Iterator[tuple[int, int, int]]:
    """Yield direction, first and last interval; a rest belongs to the stroke before it, the first rest to the next."""
    moving = np.flatnonzero(motion.signs)
    turns = [int(b) for a, b in pairwise(moving) if motion.signs[a] != motion.signs[b]]
    edges = [0, *turns, len(motion.signs)]
    for first, end in pairwise(edges):
        signs = motion.signs[first:end]
        yield (-1 if (signs < 0).any() else 1), first, end - 1


REVERSAL_SLACK_MM = 0.5
"""A reversal shorter than this does not bring the other hemisphere to the front (a tenth of the contact)."""


def leading_motion(motion: Motion, slack_mm: float = REVERSAL_SLACK_MM) -> Motion:
    """Return a motion without its reversals shorter than `slack_mm`; the same object where it has none."""
    directions = motion.signs[motion.signs != 0]
    if not (directions[1:] != directions[:-1]).any():
        return motion
    pieces = motion.pieces()
    times = np.append(pieces.start_s, motion.breaks_s[-1])
    position = motion.position(times)
    if _shortest_reversal(position) > slack_mm:
        return motion
    leading = _without_short_reversals(position, _turning_points(position, slack_mm))
    if np.array_equal(leading, position):
        return motion
    unchanged = (leading[:-1] == position[:-1]) & (leading[1:] == position[1:])
    velocity = np.diff(leading) / np.diff(times)
    acceleration = np.where(unchanged, pieces.acceleration_mm_s2, 0.0)
    return RecordedMotion.from_pieces(
        ProfileMotion(
            breaks_s=times,
            signs=np.sign(velocity).astype(np.int8),
            uniform=acceleration == 0,
            start_mm=leading[:-1],
            velocity_mm_s=np.where(unchanged, pieces.velocity_mm_s, velocity),
            acceleration_mm_s2=acceleration,
        )
    )


def _shortest_reversal(position_mm: FloatArray) -> float:
    """Return the least distance between two reversals of a position, its ends included [mm]."""
    steps = np.diff(position_mm)
    steps = steps[steps != 0]
    turns = np.flatnonzero(np.sign(steps[1:]) != np.sign(steps[:-1])) + 1
    return float(np.add.reduceat(np.abs(steps), np.append(0, turns)).min(initial=np.inf)) if steps.size else 0.0


def _turning_points(position_mm: FloatArray, slack_mm: float) -> list[int]:
    """Return the indices at which a position reverses by more than the slack, both ends included."""
    from scipy.signal import find_peaks

    peaks = [find_peaks(side * position_mm, prominence=slack_mm, plateau_size=1)[0] for side in (1.0, -1.0)]
    return [0, *np.sort(np.concatenate(peaks)).tolist(), position_mm.size - 1]


def _without_short_reversals(position_mm: FloatArray, turns: list[int]) -> FloatArray:
    leading = position_mm.copy()
    for begin, end in pairwise(turns):
        part = position_mm[begin : end + 1].copy()
        part[0] = leading[begin]
        rises = part[-1] >= part[0] if end - begin > 1 else True
        leading[begin : end + 1] = np.maximum.accumulate(part) if rises else np.minimum.accumulate(part)
    return leading


MIN_INTERVAL_S = 1e-9
"""Shorter intervals are joined to their neighbour."""


@dataclass(frozen=True, slots=True)
class SmoothInterval:
    """Times from `begin_s` to `end_s` of one stroke.

    `side` is the segment of the wall at the equator. `steady` says that the forces are constant, `uniform` that the
    velocity is; `sign` is its direction, 0 at rest.
    """

    begin_s: float
    end_s: float
    stroke: ContactStroke
    side: WallSegment
    sign: int
    uniform: bool
    steady: bool


def smooth_intervals(history: ContactHistory, contact_mm: float) -> Iterator[SmoothInterval]:
    """Divide a motion where its force jumps or bends; `contact_mm` is the length L of the contact."""
    motion = history.motion
    for stroke in history.strokes:
        edges = _interval_edges(history, stroke, contact_mm)
        middle = 0.5 * (edges[:-1] + edges[1:])
        position = motion.position(middle)
        index = np.searchsorted(motion.breaks_s[:-1], middle, side="right") - 1
        uniform, signs = motion.uniform[index], motion.signs[index]
        # Once a contact length has been travelled at one velocity, every age is x / v.
        settled = np.abs(position - motion.position(motion.breaks_s[index])) >= contact_mm
        steady = uniform & (signs != 0) & settled
        sides = [stroke.segment_at(float(z)) for z in history.wall_point(stroke, contact_mm, position)]
        times = pairwise(edges.tolist())
        for (begin, end), side, *flags in zip(times, sides, signs, uniform, steady, strict=True):
            sign, constant_velocity, constant_force = (int(flag) for flag in flags)
            yield SmoothInterval(begin, end, stroke, side, sign, bool(constant_velocity), bool(constant_force))


def join_intervals(parts: Sequence[SmoothInterval]) -> Iterator[SmoothInterval]:
    """Join neighbours that differ in nothing but their times; those of constant force stay apart."""
    for _, group in groupby(parts, key=lambda part: (part.stroke.first, part.side, part.sign, part.steady)):
        first, *others = group
        if not others:
            yield first
        elif first.steady:
            yield from (first, *others)
        else:
            yield replace(first, end_s=others[-1].end_s, uniform=False)


def _interval_edges(history: ContactHistory, stroke: ContactStroke, contact_mm: float) -> FloatArray:
    """Return the begin of a stroke, every event in it, and its end."""
    breaks = history.motion.breaks_s[stroke.first : stroke.last + 2]
    edges, end = [float(breaks[0])], float(breaks[-1])
    for time in np.sort(np.concatenate((breaks[1:-1], _equator_times(history, stroke, contact_mm)))).tolist():
        if min(time - edges[-1], end - time) > MIN_INTERVAL_S:
            edges.append(time)
    return np.array([*edges, end])


def _equator_times(history: ContactHistory, stroke: ContactStroke, contact_mm: float) -> FloatArray:
    """Return when the ends of segments, and the wall passed at a bend of the motion, reach the equator."""
    motion = history.motion
    points: list[float] = []
    for segment in stroke.segments:
        points += (segment.rear_mm, segment.front_mm)
        if segment.direction:
            passed = motion.position(motion.breaks_s[segment.first + 1 : segment.last + 1])
            points += (passed - (0.0 if segment.direction > 0 else history.reach_mm)).tolist()
    begin, end = motion.position(motion.breaks_s[[stroke.first, stroke.last + 1]])
    # The wall point z is at the equator of a capsule at p = z + (p - wall_point(L, p)).
    passing = np.asarray(points) - history.wall_point(stroke, contact_mm, np.zeros(1))
    ahead = stroke.direction * (passing - begin)
    inside = passing[(ahead > 0) & (ahead < stroke.direction * (end - begin))]
    return motion.arrival_time(inside, stroke.first, stroke.last)
