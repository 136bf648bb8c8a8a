"""Motions as the friction model uses them: of a profile, or known by samples that were measured, commanded or computed.

Units: mm and s; position 0 is where the run starts, time 0 its first sample. Sliding friction needs a velocity: a
measured position is smoothed between rests, because raw differences of counts would be false velocities far above the
speed over which Coulomb friction changes sign. The wall of a sticking capsule needs the position only and takes it
unsmoothed, since smoothing would round the corners of a ramp by 20 µm, which is 30 mN.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt

from dragrig.config import AnalysisError
from dragrig.rig import TIME_TOLERANCE_S, BoolArray, FloatArray, IndexArray, MotionProfile

ROUNDING_MM_S = 1e-9
"""Lower speeds are rounding errors."""

SignArray = npt.NDArray[np.int8]


class _BitwiseValue:
    """Values that are equal where all fields are, bit for bit: prepared forces are cached by motions."""

    __slots__: tuple[str, ...] = ()

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, _BitwiseValue) and self._bits == other._bits)

    def __hash__(self) -> int:
        return hash(self._bits)

    @property
    def _bits(self) -> tuple[object, ...]:
        values = (getattr(self, name) for name in self.__slots__)
        return type(self), *(value.tobytes() if isinstance(value, np.ndarray) else value for value in values)


@dataclass(frozen=True, slots=True, eq=False)
class ProfileMotion(_BitwiseValue):
    """A motion profile, its `K` pieces divided at reversals; equal to another of the same pieces."""

    breaks_s: FloatArray
    """Ends of the pieces, shape `(K + 1,)`, from 0 to the motion's duration."""
    signs: SignArray
    """Direction of motion in each piece, shape `(K,)`: 1, −1, or 0 at rest."""
    uniform: BoolArray
    """Whether the velocity is constant in each piece, shape `(K,)`."""
    start_mm: FloatArray
    velocity_mm_s: FloatArray
    acceleration_mm_s2: FloatArray
    counted: ClassVar[bool] = False
    """Whether it was measured in encoder counts; a profile is exact."""

    @property
    def start_s(self) -> FloatArray:
        """Begin of each piece, shape `(K,)`."""
        return self.breaks_s[:-1]

    @classmethod
    def of(cls, profile: MotionProfile) -> "ProfileMotion":
        """Prepare a profile; an empty one is at rest for an instant."""
        if not profile.start_s.size:
            zero, instant = np.zeros(1), np.array([0.0, TIME_TOLERANCE_S])
            return cls(instant, zero.astype(np.int8), zero == 0, zero, zero, zero)
        turns = _turning_times(profile)
        begin = np.array(sorted({*profile.start_s.tolist(), *turns.tolist()}))  # NumPy's union1d imports numpy.ma
        piece = np.searchsorted(profile.start_s, begin, side="right") - 1
        velocity = np.where(np.isin(begin, turns), 0.0, profile.velocity(begin))
        acceleration = profile.acceleration_mm_s2[piece]
        breaks = np.append(begin, profile.duration_s)
        mean = velocity + 0.5 * acceleration * np.diff(breaks)
        signs = np.where(np.abs(mean) < ROUNDING_MM_S, 0.0, np.sign(mean)).astype(np.int8)
        return cls(breaks, signs, acceleration == 0, profile.position(begin), velocity, acceleration)

    @classmethod
    def of_means(
        cls,
        breaks_s: FloatArray,
        start_mm: FloatArray,
        mean_mm_s: FloatArray,
        acceleration_mm_s2: FloatArray | float = 0.0,
    ) -> "ProfileMotion":
        """Build from where each piece starts, its mean velocity and its acceleration, which does not reverse it."""
        acceleration = np.zeros_like(mean_mm_s) + acceleration_mm_s2
        start_mm_s = mean_mm_s - 0.5 * acceleration * np.diff(breaks_s)
        signs = np.sign(mean_mm_s).astype(np.int8)
        return cls(breaks_s, signs, acceleration == 0, start_mm, start_mm_s, acceleration)

    def position(self, time_s: FloatArray) -> FloatArray:
        """Return the position [mm] at any times within the motion."""
        return self._position(*self.locate(time_s))

    def velocity(self, time_s: FloatArray) -> FloatArray:
        """Return the velocity [mm/s] at any times within the motion."""
        index, elapsed = self.locate(time_s)
        return np.asarray(self.velocity_mm_s[index] + self.acceleration_mm_s2[index] * elapsed)

    def state_within_interval(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return position and velocity at times of shape `(n, m)`, each row of which lies within one interval."""
        middle = 0.5 * (time_s[:, :1] + time_s[:, -1:])
        index, _ = self.locate(middle)
        elapsed = time_s - self.breaks_s[index]
        velocity = self.velocity_mm_s[index] + self.acceleration_mm_s2[index] * elapsed
        return self._position(index, elapsed), np.asarray(velocity)

    def arrival_time(self, position_mm: FloatArray, first: int, last: int) -> FloatArray:
        """Return the last time of a position within the intervals `first` to `last`, which have no reversal."""
        sign = float(self.signs[first : last + 1].sum() >= 0) * 2 - 1
        ahead = sign * (position_mm - self.start_mm[first])
        starts = sign * (self.start_mm[first : last + 1] - self.start_mm[first])
        index = first + np.clip(np.searchsorted(starts, ahead, side="right") - 1, 0, None)
        distance = np.maximum(ahead - starts[index - first], 0.0)
        speed = sign * self.velocity_mm_s[index]
        square = speed**2 + 2 * sign * self.acceleration_mm_s2[index] * distance
        mean_speed = 0.5 * (speed + np.sqrt(np.maximum(square, 0.0)))
        elapsed = np.divide(distance, mean_speed, out=np.zeros_like(distance), where=mean_speed > 0)
        return np.asarray(np.minimum(self.breaks_s[index] + elapsed, self.breaks_s[index + 1]))

    def pieces(self) -> "ProfileMotion":
        """Return the motion as pieces of constant acceleration: itself."""
        return self

    def locate(self, time_s: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
        """Return the piece that each time lies in, and the time since that piece began."""
        index = np.maximum(np.searchsorted(self.start_s, time_s, side="right") - 1, 0)
        return index, time_s - self.breaks_s[index]

    def _position(self, index: npt.NDArray[np.intp], elapsed: FloatArray) -> FloatArray:
        speed = self.velocity_mm_s[index] + 0.5 * self.acceleration_mm_s2[index] * elapsed
        return np.asarray(self.start_mm[index] + speed * elapsed)


def _turning_times(profile: MotionProfile) -> FloatArray:
    """Return when pieces reverse; at the very end of a piece it is rounding, not a reversal."""
    end = np.append(profile.start_s[1:], profile.duration_s)
    moving = profile.acceleration_mm_s2 != 0
    after = -profile.velocity_mm_s[moving] / profile.acceleration_mm_s2[moving]
    inside = (after > TIME_TOLERANCE_S) & (after < (end - profile.start_s)[moving] - TIME_TOLERANCE_S)
    return np.asarray((profile.start_s[moving] + after)[inside])


SMOOTHING_ORDER = 2
"""Order of the smoothing polynomial: a ramp of constant acceleration passes unchanged."""

TURN_JITTERS = 5.0
"""A reversal shorter than this many times the jitter is ignored."""


def smooth_between_rests(
    position_mm: FloatArray, window: int, jitter_mm: float, rest_window: int | None = None
) -> tuple[FloatArray, IndexArray]:
    """Make rests exactly still and the motion between reversals monotone, smoothed separately between rests.

    Parameters
    ----------
    window
        Length of the smoothing window [samples].
    jitter_mm
        Peak-to-peak variation of the position within a window at rest.
    rest_window
        Length of the shortest rest [samples]; default: the smoothing window.

    Returns
    -------
    The smoothed position, and the edges of rests and of the motion between reversals.
    """
    from scipy.signal import savgol_filter

    still = _at_rest(position_mm, rest_window or window, jitter_mm)
    changes = np.flatnonzero(np.diff(still))
    edges = np.unique(np.concatenate(([0], np.where(still[changes], changes, changes + 1), [still.size - 1])))
    smooth = position_mm.copy()
    reversals: list[int] = []
    for begin, end in pairwise(edges.tolist()):
        if still[(begin + end) // 2]:
            smooth[begin : end + 1] = position_mm[begin : end + 1].mean()
    for begin, end in pairwise(edges.tolist()):
        inner = slice(begin + int(still[begin]), end + 1 - int(still[end]))
        length = min(window, (inner.stop - inner.start - 1) // 2 * 2 + 1)
        if not still[(begin + end) // 2] and length > SMOOTHING_ORDER:
            smooth[inner] = savgol_filter(position_mm[inner], length, SMOOTHING_ORDER)
            reversals += (begin + turning_samples(smooth[begin : end + 1], TURN_JITTERS * jitter_mm)).tolist()
    edges = np.union1d(edges, np.array(reversals, dtype=np.intp))
    return _monotone_between(smooth, edges), edges


def _at_rest(position_mm: FloatArray, window: int, span_mm: float) -> BoolArray:
    """Return whether each sample lies in some window whose positions span no more than `span_mm`."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    quiet = maximum_filter1d(position_mm, window) - minimum_filter1d(position_mm, window) <= span_mm
    return np.asarray(maximum_filter1d(quiet.astype(np.uint8), window) > 0)


def turning_samples(position_mm: FloatArray, min_mm: float) -> IndexArray:
    """Return, in order, peaks and valleys from which a position moves at least `min_mm` to both sides.

    They are those of `scipy.signal.find_peaks` with this prominence, the first of equal ones; it takes longer to load
    than a short run to simulate.
    """
    steps = np.diff(position_mm)
    moving = np.flatnonzero(steps)
    bends = np.flatnonzero(np.diff(np.sign(steps[moving])))
    middles = (moving[bends] + 1 + moving[bends + 1]) // 2
    turns: list[int] = []
    rising: bool | None = None
    low = high = 0
    for at in [*middles.tolist(), position_mm.size - 1]:
        high = at if position_mm[at] > position_mm[high] else high
        low = at if position_mm[at] < position_mm[low] else low
        if rising is not False and position_mm[high] - position_mm[at] >= min_mm:
            turns += [high] if rising else []
            rising, low = False, at
        elif rising is not True and position_mm[at] - position_mm[low] >= min_mm:
            turns += [low] if rising is False else []
            rising, high = True, at
    return np.array(turns, dtype=np.intp)


def _monotone_between(position_mm: FloatArray, edges: IndexArray) -> FloatArray:
    """Make a position monotone between edges, at which it keeps its values."""
    monotone = position_mm.copy()
    for begin, end in pairwise(edges.tolist()):
        first, last = position_mm[begin], position_mm[end]
        sign = 1.0 if last >= first else -1.0
        rising = np.maximum.accumulate(sign * position_mm[begin : end + 1])
        monotone[begin : end + 1] = sign * np.clip(rising, sign * first, sign * last)
    return monotone


FINEST_STEP_S = 0.5e-3
"""Records of shorter steps are averaged down to this."""

SMOOTHING_WINDOW_S = 0.03
"""Length of the smoothing window, and of the shortest rest."""

MIN_SAMPLES = 5
"""Least samples in a record and in a smoothing window."""

ENCODER_JITTER_MM = 0.0015
"""Variation of an encoder of 1 µm counts at rest: it may toggle between two counts."""

REST_SPEED_MM_S = 0.05
"""Where a stage varies by more than the counts, the window of a rest is so long that this speed would exceed that."""
MAX_REST_WINDOW_S = 0.3

CREEP_MM_S = 1e-4
"""Below this speed a computed position is at rest: 0.2 % of the speed over which Coulomb friction changes sign."""

COMPUTED_TOLERANCE_MM = 1e-6
"""Greatest deviation of the pieces from a computed position."""

BEND_MM_S = 0.05
BEND_SHARE = 0.03
"""A bend is a change of velocity above both limits, the second relative to the top speed."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedMotion(_BitwiseValue):
    """A measured motion, whose times and positions count from the first sample, in smooth intervals without reversals.

    Rests are found first and made exactly still; the motion between them is smoothed on its own and then described by
    as few pieces of constant acceleration as stay within its jitter.
    """

    breaks_s: FloatArray
    signs: SignArray
    uniform: BoolArray
    """`breaks_s`, `signs`, `uniform`: as of a profile; breaks are edges of rests, reversals, and bends of the velocity.
    """
    profile: ProfileMotion
    """All pieces of constant acceleration."""
    counted: bool = False
    """Whether it was measured in counts."""

    @classmethod
    def of(
        cls, time_s: npt.ArrayLike, position_mm: npt.ArrayLike, jitter_mm: float = ENCODER_JITTER_MM
    ) -> "RecordedMotion":
        """Prepare a measured position.

        Parameters
        ----------
        time_s, position_mm
            The record, shape `(n,)`; times rise, gaps are bridged by straight lines.
        jitter_mm
            Peak-to-peak variation of the position while the stage rests.

        Raises
        ------
        AnalysisError
            When the record is too short, its times do not rise, or a value is not finite.
        """
        grid, raw = resample_uniformly(*check_record(time_s, position_mm))
        step = float(grid[1])
        window = max(MIN_SAMPLES, 2 * round(0.5 * SMOOTHING_WINDOW_S / step) + 1)
        resting_s = min(max(SMOOTHING_WINDOW_S, jitter_mm / REST_SPEED_MM_S), MAX_REST_WINDOW_S)
        at_rest = max(window, 2 * round(0.5 * resting_s / step) + 1)
        smooth, edges = smooth_between_rests(raw, window, jitter_mm, at_rest)
        fitted = _fit_parabolas(grid, smooth - smooth[0], edges, jitter_mm)
        breaks = add_bends(fitted, grid[edges])
        first = np.searchsorted(fitted.breaks_s, breaks[:-1])
        signs = np.sign(np.add.reduceat(fitted.signs, first)).astype(np.int8)
        return cls(breaks, signs, signs == 0, fitted, counted=True)

    @classmethod
    def computed(cls, time_s: FloatArray, position_mm: FloatArray) -> "RecordedMotion":
        """Prepare a computed position, which needs no smoothing.

        Parameters
        ----------
        time_s, position_mm
            Rising times from 0 on, and the position then, shape `(n,)` with at least two times; between times the
            position is nearly linear.
        """
        step = np.diff(position_mm)
        step[np.abs(step) < CREEP_MM_S * np.diff(time_s)] = 0.0
        position = np.append(0.0, np.cumsum(step))
        edges = np.concatenate(([0], np.flatnonzero(np.diff(np.sign(step))) + 1, [step.size]))
        return cls.from_pieces(_fit_parabolas(time_s, position, edges, COMPUTED_TOLERANCE_MM))

    @classmethod
    def from_pieces(cls, profile: ProfileMotion) -> "RecordedMotion":
        """Join pieces between rests and reversals where the velocity hardly bends."""
        changes = profile.signs[1:] != profile.signs[:-1]
        breaks = add_bends(profile, profile.breaks_s[np.concatenate(([True], changes, [True]))])
        first = np.searchsorted(profile.breaks_s, breaks[:-1])
        alone = np.diff(np.append(first, profile.signs.size)) == 1
        uniform = np.logical_and.reduceat(profile.uniform, first) & alone
        return cls(breaks, profile.signs[first], uniform, profile)

    def position(self, time_s: FloatArray) -> FloatArray:
        """Return the position [mm] at any times within the motion."""
        return self.profile.position(time_s)

    def velocity(self, time_s: FloatArray) -> FloatArray:
        """Return the velocity [mm/s] at any times within the motion."""
        return self.profile.velocity(time_s)

    def state_within_interval(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return position and velocity at times of shape `(n, m)`."""
        return self.profile.position(time_s), self.profile.velocity(time_s)

    def arrival_time(self, position_mm: FloatArray, first: int, last: int) -> FloatArray:
        """Return the last time of a position within the intervals `first` to `last`, which have no reversal."""
        begin, end = np.searchsorted(self.profile.breaks_s, self.breaks_s[[first, last + 1]]).tolist()
        return self.profile.arrival_time(position_mm, begin, end - 1)

    def pieces(self) -> ProfileMotion:
        """Return the motion as pieces of constant acceleration."""
        return self.profile


Motion: TypeAlias = ProfileMotion | RecordedMotion
"""A motion made of smooth intervals without reversals inside."""


def check_record(time_s: npt.ArrayLike, position_mm: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return a record as arrays, its times from 0; raises `AnalysisError` for an unusable one."""
    time, position = np.asarray(time_s, dtype=float), np.asarray(position_mm, dtype=float)
    if time.ndim != 1 or time.shape != position.shape or time.size < MIN_SAMPLES:
        raise AnalysisError(f"A recorded motion needs at least {MIN_SAMPLES} times and as many positions")
    if not (np.isfinite(time).all() and np.isfinite(position).all()):
        raise AnalysisError("A recorded motion must not hold NaN or infinite values; leave those samples out")
    if not (np.diff(time) > 0).all():
        raise AnalysisError("The times of a recorded motion must rise; sort them and leave out repeated samples")
    return time - time[0], position


def resample_uniformly(time_s: FloatArray, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average a fast record down, then interpolate it on a uniform grid from 0 to its last time."""
    step = float(np.median(np.diff(time_s)))
    block = max(1, min(int(FINEST_STEP_S / step + 1e-6), time_s.size // MIN_SAMPLES))
    whole = time_s.size // block * block
    time, position = (values[:whole].reshape(-1, block).mean(axis=1) for values in (time_s, position_mm))
    grid = np.linspace(0.0, float(time_s[-1]), max(MIN_SAMPLES, round(float(time_s[-1]) / (step * block)) + 1))
    return grid, np.interp(grid, time, position)


def _split_spans(edges: IndexArray, worst: Callable[[int, int], int | None]) -> IndexArray:
    """Divide the spans between edges where `worst` returns an index, until it returns None."""
    divided = [int(edges[0])]
    pending = [(int(begin), int(end)) for begin, end in pairwise(edges)][::-1]
    while pending:
        begin, end = pending.pop()
        at = worst(begin, end)
        if at is None:
            divided.append(end)
        else:
            pending += [(at, end), (begin, at)]
    return np.array(divided, dtype=np.intp)


def _curvature(time_s: FloatArray, position_mm: FloatArray) -> float:
    """Return c of the best-fitting monotone parabola through both ends, chord + c (t − t0)(t1 − t)."""
    bow = (time_s - time_s[0]) * (time_s[-1] - time_s)
    slope = (position_mm[-1] - position_mm[0]) / (time_s[-1] - time_s[0])
    deviation = position_mm - position_mm[0] - slope * (time_s - time_s[0])
    best = float(bow @ deviation) / max(float(bow @ bow), 1e-300)
    steepest = abs(slope) / float(time_s[-1] - time_s[0])
    return float(np.clip(best, -steepest, steepest))


def _fit_parabolas(
    grid_s: FloatArray, position_mm: FloatArray, edges: IndexArray, tolerance_mm: float
) -> ProfileMotion:
    """Describe a position, monotone between edges, by parabolas within a tolerance."""

    def worst(begin: int, end: int) -> int | None:
        time, position = grid_s[begin : end + 1], position_mm[begin : end + 1]
        elapsed, left = time - time[0], time[-1] - time
        slope = (position[-1] - position[0]) / elapsed[-1]
        parabola = position[0] + (slope + _curvature(time, position) * left) * elapsed
        deviation = np.abs(position - parabola)
        at = int(deviation.argmax())
        return begin + at if deviation[at] > tolerance_mm and end - begin >= MIN_SAMPLES else None

    knots = _split_spans(edges, worst)
    time, position = grid_s[knots], position_mm[knots]
    slope = np.diff(position) / np.diff(time)
    curvature = np.array([_curvature(grid_s[a : b + 1], position_mm[a : b + 1]) for a, b in pairwise(knots.tolist())])
    return ProfileMotion.of_means(time, position[:-1], slope, -2 * curvature)


def add_bends(profile: ProfileMotion, edges_s: FloatArray) -> FloatArray:
    """Add to the edges the ends of pieces at which the velocity bends."""
    time = profile.breaks_s
    ending = profile.velocity_mm_s + profile.acceleration_mm_s2 * np.diff(time)
    after, before = np.append(profile.velocity_mm_s, 0.0), np.concatenate(([0.0], ending))
    tolerance = max(BEND_MM_S, BEND_SHARE * float(np.abs(after).max()))

    def worst(begin: int, end: int) -> int | None:
        if end - begin < 2:
            return None
        inner = slice(begin + 1, end)
        line = np.interp(time[inner], time[[begin, end]], [after[begin], before[end]])
        deviation = np.maximum(np.abs(after[inner] - line), np.abs(before[inner] - line))
        at = int(deviation.argmax())
        return begin + 1 + at if deviation[at] > tolerance else None

    return np.asarray(time[_split_spans(np.searchsorted(time, edges_s), worst)])


FLOAT32_ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Relative rounding of a position in single precision."""
MIN_CHORD_MM_S = 1e-6
"""Lower velocities of a command are rounding errors."""


def commanded_motion(time_s: npt.ArrayLike, position_mm: npt.ArrayLike) -> RecordedMotion:
    """Return a commanded motion: one piece a sample during acceleration, one for each interval of constant velocity.

    Nothing is smoothed, so that the millisecond in which friction builds up is not shifted.

    Parameters
    ----------
    time_s, position_mm
        The command, shape `(n,)`; times rise, gaps are bridged by straight lines.

    Raises
    ------
    AnalysisError
        When the record is too short, its times do not rise, or a value is not finite.
    """
    grid, position = resample_uniformly(*check_record(time_s, position_mm))
    step = float(grid[1])
    chord = np.diff(position) / step
    tolerance = max(MIN_CHORD_MM_S, FLOAT32_ROUNDING * float(np.abs(position).max()) / step)
    chord[np.abs(chord) < tolerance] = 0.0
    knots = np.concatenate(([0], np.flatnonzero(np.abs(np.diff(chord)) > tolerance) + 1, [chord.size]))
    knots = np.concatenate([[0], *(_gradual_knots(chord, *span, tolerance) for span in pairwise(knots.tolist()))])
    time, knot_mm = grid[knots], position[knots] - position[0]
    duration = np.diff(time)
    mean = np.diff(knot_mm) / duration
    mean[np.abs(mean) < tolerance] = 0.0
    change = np.diff(chord) / step
    acceleration = _minmod(np.concatenate(([0.0], change))[knots[:-1]], np.append(change, 0.0)[knots[1:] - 1])
    acceleration[np.diff(knots) > 1] = 0.0
    # A piece must not reverse.
    limit = 2 * np.abs(mean) / duration
    acceleration = np.clip(acceleration, -limit, limit)
    return RecordedMotion.from_pieces(ProfileMotion.of_means(time, knot_mm[:-1], mean, acceleration))


def _gradual_knots(chord_mm_s: FloatArray, begin: int, end: int, tolerance_mm_s: float) -> list[int]:
    """Return where a velocity that changes by less than the tolerance a sample has changed by more, and the end."""
    knots: list[int] = []
    if np.ptp(chord_mm_s[begin:end]) > 2 * tolerance_mm_s:
        level = chord_mm_s[begin]
        for index, velocity in enumerate(chord_mm_s[begin:end].tolist(), begin):
            if abs(velocity - level) >= tolerance_mm_s:
                knots.append(index)
                level = velocity
    return [*knots, end]


MAX_KNOTS = 4000
"""A longer record is averaged down to about this many knots."""
SAME_TIME_S = 1e-7
"""Times closer than this are equal, but computed in two ways."""


CREEP_BLOCK_S, MIN_CREEP_MM = 0.1, 0.0015
"""A stage whose position at rest, averaged over so long, changes by more than counts do, creeps as its load relaxes."""


def measured_motion(motion: RecordedMotion, time_s: FloatArray, position_mm: FloatArray) -> ProfileMotion:
    """Return a measured motion of constant velocity between points, exactly at rest where the stage rests.

    Parameters
    ----------
    motion
        The same record smoothed, whose rests are used.
    time_s, position_mm
        The record, shape `(n,)`: rising times from 0, finite positions.
    """
    time_s, position_mm = _with_midpoints(time_s, position_mm)
    edges = np.searchsorted(time_s, motion.breaks_s)
    times, positions = [np.zeros(0)], [np.zeros(0)]
    for number, sign in enumerate(motion.signs.tolist()):
        within = slice(int(edges[number]), int(edges[number + 1]) + 1)
        if sign == 0:
            time, position = _nearly_at_rest(time_s[within], position_mm[within], *motion.breaks_s[number : number + 2])
        else:
            time, position = _averaged_down(time_s[within], position_mm[within])
        later = time > (times[-1][-1] + SAME_TIME_S if times[-1].size else -1.0)
        times.append(time[later])
        positions.append(position[later])
    time, position = np.concatenate(times), np.concatenate(positions)
    velocity = np.diff(position) / np.diff(time)
    return ProfileMotion.of_means(time, position[:-1] - position[0], velocity)


def _nearly_at_rest(
    time_s: FloatArray, position_mm: FloatArray, begin_s: float, end_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return times and positions of a rest: two alike, or averages over a while where the stage creeps."""
    blocks = np.array_split(np.arange(time_s.size), max(round((end_s - begin_s) / CREEP_BLOCK_S), 1))
    means = np.array([position_mm[block].mean() for block in blocks if block.size])
    if means.size < MIN_SAMPLES or np.ptp(means) <= MIN_CREEP_MM:
        return np.array([begin_s, end_s]), np.full(2, position_mm.mean())
    middle = np.array([time_s[block].mean() for block in blocks if block.size])
    return np.concatenate(([begin_s], middle, [end_s])), np.concatenate((means[:1], means, means[-1:]))


def _with_midpoints(time_s: FloatArray, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Insert a point between any two samples, on the parabola of their acceleration: a chord would cut ramps short."""
    bend = np.pad(np.diff(position_mm, 2), 1)
    agreed = _minmod(bend[:-1], bend[1:])
    time, position = np.repeat(time_s, 2)[:-1], np.repeat(position_mm, 2)[:-1]
    time[1::2] = 0.5 * (time_s[1:] + time_s[:-1])
    position[1::2] = 0.5 * (position_mm[1:] + position_mm[:-1]) - agreed / 8
    return time, position


def _minmod(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the smaller of two accelerations, 0 where they differ in sign, so that no corner is overshot."""
    return np.where(before * after > 0, np.sign(before) * np.minimum(np.abs(before), np.abs(after)), 0.0)


def _averaged_down(time_s: FloatArray, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    group = -(-time_s.size // MAX_KNOTS)
    starts = np.arange(0, time_s.size, max(1, group))
    count = np.diff(np.append(starts, time_s.size))
    return np.add.reduceat(time_s, starts) / count, np.add.reduceat(position_mm, starts) / count
