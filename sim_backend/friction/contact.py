"""Contact of capsule and wall along a motion: its history, and the environmental resistance f_e (Eq. 9).

A wall point z is in contact while it lies between the rear contact, p − ℓ, and the front contact, p. Its age counts
from when the front passed it moving forward or the rear passed it moving backward, or from the insertion when it was
there at the first sample. The force jumps or bends where the motion does, and again when the wall passed at that
moment reaches the equator of the leading hemisphere. Reversals of some µm, as a stage makes after an overshoot, do not
change which hemisphere leads.

f_e is integrated over contact ages and interpolated in time. Gauss–Legendre panels are geometric in age and Chebyshev
panels geometric in time, because the fast branch relaxes within milliseconds of first contact.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby, pairwise
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from dragrig.rig import FloatArray, read_only
from dragrig.sim_backend.friction.motion import Motion, ProfileMotion, RecordedMotion, turning_samples
from dragrig.sim_backend.friction.wall import HemisphereContact


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


@dataclass(frozen=True, slots=True, eq=False)
class ContactHistory:
    """A motion with the contact that each of its strokes inherits."""

    motion: Motion
    """Motion of the capsule."""
    reach_mm: float
    """Distance ℓ from rear to front contact."""
    dwell_s: float
    """Age of the contact at the first sample."""
    strokes: tuple[ContactStroke, ...]
    """The strokes, in order."""

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


REVERSAL_SLACK_MM = 0.5 - 1e-9
"""A shorter reversal does not bring the other hemisphere to the front (a tenth of the contact).

Less than the round number by rounding, so that a reversal of 0.5 mm is the same in both directions.
"""


def leading_motion(motion: Motion, slack_mm: float = REVERSAL_SLACK_MM) -> Motion:
    """Return a motion without its reversals shorter than `slack_mm`; the same object where it has none."""
    directions = motion.signs[motion.signs != 0]
    if not (directions[1:] != directions[:-1]).any():
        return motion
    pieces = motion.pieces()
    times = pieces.breaks_s
    position = motion.position(times)
    turns = [0, *turning_samples(position, slack_mm).tolist(), position.size - 1]
    leading = _without_short_reversals(position, turns)
    if np.array_equal(leading, position):
        return motion
    unchanged = (leading[:-1] == position[:-1]) & (leading[1:] == position[1:])
    velocity = np.diff(leading) / np.diff(times)
    acceleration = np.where(unchanged, pieces.acceleration_mm_s2, 0.0)
    return RecordedMotion.from_pieces(ProfileMotion.of_means(times, leading[:-1], velocity, acceleration))


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
        points = history.wall_point(stroke, contact_mm, position)
        beyond = [np.maximum(part.rear_mm - points, points - part.front_mm) for part in stroke.segments]
        sides = [stroke.segments[at] for at in np.argmin(beyond, axis=0).tolist()]
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


@dataclass(frozen=True, slots=True)
class QuadratureRule:
    """Nodes per panel."""

    ages: int
    """Gauss–Legendre nodes of a panel of contact ages."""
    times: int
    """Chebyshev nodes of a panel of times."""


FINE_RULE = QuadratureRule(10, 8)
COUNTED_RULE = QuadratureRule(4, 5)
"""For a motion measured in encoder counts, whose many bends divide the panels anyway: a rippling force differs by
0.03 mN r.m.s. from that of the fine rule, where a sensor's noise is 1 mN or more."""


@cache
def gauss_legendre(nodes: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of the quadrature on (0, 1)."""
    at, weights = np.polynomial.legendre.leggauss(nodes)
    at, weights = 0.5 * (1 + at), 0.5 * weights
    read_only(at)
    read_only(weights)
    return at, weights


@cache
def chebyshev_nodes(nodes: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes on (0, 1), and the matrix from values there to coefficients of ascending powers."""
    at = 0.5 * (1 - np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes))
    to_powers = np.asarray(np.linalg.inv(np.vander(at, increasing=True)))
    read_only(at)
    read_only(to_powers)
    return at, to_powers


FIRST_TIME_PANEL = 0.3
"""Width of the first panel after an event, in relaxation times of the fastest branch."""

TIME_PANEL_RATIO = 2.0
"""Ratio of the ends of successive panels, counted from the event."""


def time_panel_edges(begin_s: float, end_s: float, fastest_rate: float) -> FloatArray:
    """Return the ends of panels from `begin_s` to `end_s`, shortest at the beginning."""
    first = FIRST_TIME_PANEL / fastest_rate
    count = max(0, int(np.ceil(np.log((end_s - begin_s) / first) / np.log(TIME_PANEL_RATIO))))
    inner = begin_s + first * TIME_PANEL_RATIO ** np.arange(count)
    return np.concatenate(([begin_s], inner[inner < end_s], [end_s]))


@dataclass(frozen=True, slots=True, eq=False)
class PanelPolynomials:
    """SciPy's `PPoly` to the bit, without its import, which takes longer than to simulate most runs."""

    coefficients: FloatArray
    edges_s: FloatArray

    def __call__(self, time_s: FloatArray) -> FloatArray:
        """Return the values at times `(n,)`, shape `(n, …)`; beyond the ends those of the nearest panel's."""
        panel = np.clip(np.searchsorted(self.edges_s, time_s, side="right") - 1, 0, self.edges_s.size - 2)
        since = (time_s - self.edges_s[panel]).reshape(-1, *[1] * (self.coefficients.ndim - 2))
        value, power = np.asarray(self.coefficients[-1].take(panel, axis=0)), since.copy()
        for coefficient in self.coefficients[-2::-1]:
            value += coefficient.take(panel, axis=0) * power
            power *= since
        return value


def interpolate_panels(
    evaluate: Callable[[FloatArray], FloatArray], edges_s: FloatArray, nodes_per_panel: int
) -> PanelPolynomials:
    """Interpolate `evaluate`, from times of shape `(n,)` to values of shape `(…, n)`, between strictly rising edges.

    The nodes lie inside the panels, so that `evaluate` is never called at a jump.
    """
    nodes, to_powers = chebyshev_nodes(nodes_per_panel)
    width = np.diff(edges_s)
    times = edges_s[:-1, None] + width[:, None] * nodes
    at_nodes = evaluate(times.ravel())
    values = at_nodes.reshape(*at_nodes.shape[:-1], *times.shape)
    coefficients = (values @ to_powers.T) / width[:, None] ** np.arange(nodes.size)
    return PanelPolynomials(np.moveaxis(coefficients, (-1, -2), (0, 1))[::-1], edges_s)


LoadDensity: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]
"""Load per length of the contact from contact coordinates and ages of one shape; may add axes in front."""

FIRST_AGE_PANEL = 0.5
"""Width of the freshest panel, in relaxation times of the fastest branch."""

AGE_PANEL_RATIO = 5.0
"""Ratio of the ages at end and start of a panel."""

MIN_PANEL_S = 1e-12
"""Panels shorter than this are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class EnvironmentalResistance:
    """f_e at any time of a contact history, exact except for the quadrature."""

    contact: HemisphereContact
    history: ContactHistory
    ages_s: FloatArray
    nodes: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, contact: HemisphereContact, history: ContactHistory, rule: QuadratureRule) -> "EnvironmentalResistance":
        """Set the panels, geometric in contact age."""
        longest = float(history.motion.breaks_s[-1])
        ages = age_panel_edges(contact.fastest_rate, longest)
        return cls(contact, history, ages, *gauss_legendre(rule.ages))

    def force(self, stroke: ContactStroke, time_s: FloatArray) -> FloatArray:
        """Return f_e [mN] at times of shape `(n,)` within a stroke, with the stroke's sign."""
        return self._integrate(self.contact.axial_load, stroke, time_s)

    def log_derivatives(self, stroke: ContactStroke, time_s: FloatArray) -> FloatArray:
        """Return derivatives of f_e [mN] by the logarithms of E1, E2, E3, η1 and η2, shape `(5, n)`."""
        return self._integrate(self.contact.axial_load_log_derivatives, stroke, time_s)

    def _integrate(self, load: LoadDensity, stroke: ContactStroke, time_s: FloatArray) -> FloatArray:
        position = self.history.motion.position(time_s)
        parts = [
            (self._inserted if segment.direction == 0 else self._passed)(load, stroke, segment, time_s, position)
            for segment in stroke.segments
        ]
        return np.asarray(stroke.direction * sum(parts[1:], start=parts[0]))

    def _inserted(
        self,
        load: LoadDensity,
        stroke: ContactStroke,
        segment: WallSegment,
        time_s: FloatArray,
        position_mm: FloatArray,
    ) -> FloatArray:
        """Return the contribution of wall in contact since the insertion, which all has the same age."""
        ends = [self.history.contact_coordinate(stroke, z, position_mm) for z in (segment.rear_mm, segment.front_mm)]
        low, high = np.sort(np.clip(ends, 0.0, self.contact.length_mm), axis=0)
        rows = np.flatnonzero(high > low)
        width = 0.5 * (high - low)[rows, None]
        nodes = np.concatenate((self.nodes, 1 + self.nodes))
        weights = np.concatenate((self.weights, self.weights))
        x = low[rows, None] + width * nodes
        per_row = (load(x, self.history.dwell_s + time_s[rows, None]) @ weights) * width[:, 0]
        total = np.zeros((*per_row.shape[:-1], time_s.size))
        total[..., rows] = per_row
        return total

    def _passed(
        self,
        load: LoadDensity,
        stroke: ContactStroke,
        segment: WallSegment,
        time_s: FloatArray,
        position_mm: FloatArray,
    ) -> FloatArray:
        """Return the contribution of wall that a stroke passed, integrated over the time of passing."""
        youngest, oldest = self._age_limits(stroke, segment, time_s, position_mm)
        breaks = self.history.motion.breaks_s[segment.first + 1 : segment.last + 1]
        edges = np.concatenate(
            (np.broadcast_to(self.ages_s, (time_s.size, self.ages_s.size)), time_s[:, None] - breaks), axis=1
        )
        edges = np.sort(np.clip(edges, youngest[:, None], oldest[:, None]), axis=1)
        rows, columns = np.nonzero(np.diff(edges, axis=1) > MIN_PANEL_S)
        begin = edges[rows, columns]
        width = edges[rows, columns + 1] - begin
        age = begin[:, None] + width[:, None] * self.nodes
        passed, velocity = self.history.motion.state_within_interval(time_s[rows, None] - age)
        z = passed if segment.direction > 0 else passed - self.history.reach_mm
        x = np.clip(self.history.contact_coordinate(stroke, z, position_mm[rows, None]), 0.0, self.contact.length_mm)
        return _sum_by_row(((load(x, age) * np.abs(velocity)) @ self.weights) * width, rows, time_s.size)

    def _age_limits(
        self, stroke: ContactStroke, segment: WallSegment, time_s: FloatArray, position_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the least and greatest age of a segment's part under the hemisphere, equal where there is none."""
        covered = [self.history.wall_point(stroke, x, position_mm) for x in (0.0, self.contact.length_mm)]
        ends = np.clip(covered, segment.rear_mm, segment.front_mm)
        ages = time_s - self.history.contact_time(segment, ends)
        empty = ends[0] == ends[1]
        youngest, oldest = np.sort(np.maximum(ages, 0.0), axis=0)
        return youngest, np.where(empty, youngest, oldest)


def _sum_by_row(values: FloatArray, rows: npt.NDArray[np.intp], size: int) -> FloatArray:
    """Sum values, shape `(…, r)`, by row number, shape `(…, size)`."""
    if values.ndim == 1:
        return np.bincount(rows, values, minlength=size).astype(float)
    return np.stack([_sum_by_row(component, rows, size) for component in values])


def age_panel_edges(fastest_rate: float, longest_s: float) -> FloatArray:
    """Return the ends of quadrature panels in age, from 0 to at least `longest_s`."""
    first = FIRST_AGE_PANEL / fastest_rate
    count = max(1, int(np.ceil(np.log(max(longest_s, first) / first) / np.log(AGE_PANEL_RATIO))) + 1)
    return np.concatenate(([0.0], first * AGE_PANEL_RATIO ** np.arange(count)))
