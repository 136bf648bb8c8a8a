"""Motions known by their samples: measured in encoder counts, commanded, or computed.

Sliding friction needs a velocity: a measured position is smoothed between rests, because raw differences of counts
would be false velocities far above the speed over which Coulomb friction changes sign. The wall of a sticking capsule
needs the position only and takes it unsmoothed, since smoothing would round the corners of a ramp by 20 µm, which is
30 mN.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.sim_backend.friction.motion import Pieces, ProfileMotion, SignArray

IndexArray = npt.NDArray[np.intp]

SMOOTHING_ORDER = 2
"""Order of the smoothing polynomial: a ramp of constant acceleration passes unchanged."""

TURN_JITTERS = 5.0
"""A way back shorter than this many times the jitter is not a turn."""


def smooth_between_rests(
    position_mm: FloatArray, window: int, jitter_mm: float, rest_window: int | None = None
) -> tuple[FloatArray, IndexArray]:
    """Make rests exactly still and each way between turns monotone, smoothed without looking beyond a rest.

    Parameters
    ----------
    window
        Samples that are smoothed together.
    jitter_mm
        How far the position wanders within a window at rest.
    rest_window
        Samples of the shortest rest, as many as the window unless given.

    Returns
    -------
    The smoothed position, and the edges of rests and of ways from turn to turn.
    """
    from scipy.signal import savgol_filter

    still = _at_rest(position_mm, rest_window or window, jitter_mm)
    changes = np.flatnonzero(np.diff(still))
    edges = np.unique(np.concatenate(([0], np.where(still[changes], changes, changes + 1), [still.size - 1])))
    smooth = position_mm.copy()
    turns: list[int] = []
    for begin, end in pairwise(edges.tolist()):
        if still[(begin + end) // 2]:
            smooth[begin : end + 1] = position_mm[begin : end + 1].mean()
    for begin, end in pairwise(edges.tolist()):
        inner = slice(begin + int(still[begin]), end + 1 - int(still[end]))
        length = min(window, (inner.stop - inner.start - 1) // 2 * 2 + 1)
        if not still[(begin + end) // 2] and length > SMOOTHING_ORDER:
            smooth[inner] = savgol_filter(position_mm[inner], length, SMOOTHING_ORDER)
            turns += (begin + _turning_samples(smooth[begin : end + 1], TURN_JITTERS * jitter_mm)).tolist()
    edges = np.union1d(edges, np.array(turns, dtype=np.intp))
    return _monotone_between(smooth, edges), edges


def _at_rest(position_mm: FloatArray, window: int, span_mm: float) -> BoolArray:
    """Whether each sample lies in some window that spans no more than `span_mm`."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    quiet = maximum_filter1d(position_mm, window) - minimum_filter1d(position_mm, window) <= span_mm
    return np.asarray(maximum_filter1d(quiet.astype(np.uint8), window) > 0)


def _turning_samples(position_mm: FloatArray, least_mm: float) -> IndexArray:
    """Peaks and valleys of a way, each at least `least_mm` above or below what is around it."""
    from scipy.signal import find_peaks

    return np.concatenate([find_peaks(side * position_mm, prominence=least_mm)[0] for side in (1.0, -1.0)])


def _monotone_between(position_mm: FloatArray, edges: IndexArray) -> FloatArray:
    """Make a position rise or fall throughout between edges, where it keeps its value."""
    monotone = position_mm.copy()
    for begin, end in pairwise(edges.tolist()):
        first, last = position_mm[begin], position_mm[end]
        sign = 1.0 if last >= first else -1.0
        rising = np.maximum.accumulate(sign * position_mm[begin : end + 1])
        monotone[begin : end + 1] = sign * np.clip(rising, sign * first, sign * last)
    return monotone


FINEST_STEP_S = 0.5e-3
"""Faster records are averaged down to this."""

SMOOTHING_WINDOW_S = 0.03
"""Length of the smoothing window, and of the shortest rest."""

MIN_SAMPLES = 5
"""Least samples in a record and in a smoothing window."""

ENCODER_JITTER_MM = 0.0015
"""How far an encoder of 1 µm counts may wander at rest: from one count to the next."""

REST_SPEED_MM_S = 0.05
"""A stage that wanders further than the counts rests only where a window so much longer sees no such speed."""
MAX_REST_WINDOW_S = 0.3

CREEP_MM_S = 1e-4
"""A computed position that goes slower than this stands still: 0.2 % of the speed that turns Coulomb friction."""

COMPUTED_TOLERANCE_MM = 1e-6
"""How near its pieces come to a computed position."""

BEND_MM_S = 0.05
BEND_SHARE = 0.03
"""A bend is a change of velocity larger than either, the second as a share of the top speed."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedMotion:
    """A measured motion: a `Motion` whose times and positions count from the first sample.

    A position comes in counts: its raw differences would be false velocities far above the speed over
    which Coulomb friction turns its sign. So rests are found first and made exactly still; what lies
    between them is smoothed on its own and then described by as few pieces of constant acceleration
    as stay within the jitter of it.

    Attributes
    ----------
    breaks_s, signs, uniform
        As `Motion` says; breaks are the edges of rests, the turns, and where the velocity bends.
    fine
        All pieces.
    counted
        Whether it was measured in counts, and not computed.
    """

    breaks_s: FloatArray
    signs: SignArray
    uniform: BoolArray
    fine: ProfileMotion
    counted: bool = False

    def __eq__(self, other: object) -> bool:
        """Whether both are the same, bit for bit, as those of repeats that obeyed one command are."""
        return self is other or (isinstance(other, RecordedMotion) and self._bits == other._bits)

    def __hash__(self) -> int:
        """Follow `==`."""
        return hash(self._bits)

    @property
    def _bits(self) -> tuple[object, ...]:
        return self.breaks_s.tobytes(), self.signs.tobytes(), self.uniform.tobytes(), self.fine, self.counted

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
            How far the position wanders while the stage rests, from least to largest.

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
        fine = _fit_parabolas(grid, smooth - smooth[0], edges, jitter_mm)
        breaks = add_bends(fine, grid[edges])
        first = np.searchsorted(fine.breaks_s, breaks[:-1])
        signs = np.sign(np.add.reduceat(fine.signs, first)).astype(np.int8)
        return cls(breaks, signs, signs == 0, fine, counted=True)

    @classmethod
    def exact(cls, time_s: FloatArray, position_mm: FloatArray) -> "RecordedMotion":
        """Prepare a position that was computed, so that nothing has to be smoothed.

        Parameters
        ----------
        time_s, position_mm
            Rising times from 0 on, and where the stage is then, shape `(n,)` with at least two times. Between times it
            goes straight or nearly so.
        """
        step = np.diff(position_mm)
        step[np.abs(step) < CREEP_MM_S * np.diff(time_s)] = 0.0
        position = np.append(0.0, np.cumsum(step))
        edges = np.concatenate(([0], np.flatnonzero(np.diff(np.sign(step))) + 1, [step.size]))
        return cls.of_pieces(_fit_parabolas(time_s, position, edges, COMPUTED_TOLERANCE_MM))

    @classmethod
    def of_pieces(cls, fine: ProfileMotion) -> "RecordedMotion":
        """Join pieces between rests and turns where the velocity hardly bends."""
        changes = fine.signs[1:] != fine.signs[:-1]
        breaks = add_bends(fine, fine.breaks_s[np.concatenate(([True], changes, [True]))])
        first = np.searchsorted(fine.breaks_s, breaks[:-1])
        alone = np.diff(np.append(first, fine.signs.size)) == 1
        uniform = np.logical_and.reduceat(fine.uniform, first) & alone
        return cls(breaks, fine.signs[first], uniform, fine)

    def position(self, time_s: FloatArray) -> FloatArray:
        """Position [mm] at any times within the motion."""
        return self.fine.position(time_s)

    def velocity(self, time_s: FloatArray) -> FloatArray:
        """Velocity [mm/s] at any times within the motion."""
        return self.fine.velocity(time_s)

    def along(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Position and velocity at times of shape `(n, m)`."""
        return self.fine.position(time_s), self.fine.velocity(time_s)

    def arrival(self, position_mm: FloatArray, first: int, last: int) -> FloatArray:
        """Last time at which the stretches `first` to `last`, which do not turn round, are at a position."""
        begin, end = np.searchsorted(self.fine.breaks_s, self.breaks_s[[first, last + 1]]).tolist()
        return self.fine.arrival(position_mm, begin, end - 1)

    def pieces(self) -> Pieces:
        """Return the motion as pieces of constant acceleration."""
        return self.fine.pieces()


def check_record(time_s: npt.ArrayLike, position_mm: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return a record that a motion can be made of, its times from 0; raises `AnalysisError` for another."""
    time, position = np.asarray(time_s, dtype=float), np.asarray(position_mm, dtype=float)
    if time.ndim != 1 or time.shape != position.shape or time.size < MIN_SAMPLES:
        raise AnalysisError(f"A recorded motion needs at least {MIN_SAMPLES} times and as many positions")
    if not (np.isfinite(time).all() and np.isfinite(position).all()):
        raise AnalysisError("A recorded motion must not hold NaN or infinite values; leave those samples out")
    if not (np.diff(time) > 0).all():
        raise AnalysisError("The times of a recorded motion must rise; sort them and leave out repeated samples")
    return time - time[0], position


def resample_uniformly(time_s: FloatArray, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average a fast record down, then put it on a uniform grid from 0 to its last time."""
    step = float(np.median(np.diff(time_s)))
    block = max(1, min(int(FINEST_STEP_S / step + 1e-6), time_s.size // MIN_SAMPLES))
    whole = time_s.size // block * block
    time, position = (values[:whole].reshape(-1, block).mean(axis=1) for values in (time_s, position_mm))
    grid = np.linspace(0.0, float(time_s[-1]), max(MIN_SAMPLES, round(float(time_s[-1]) / (step * block)) + 1))
    return grid, np.interp(grid, time, position)


def _split_spans(edges: IndexArray, worst: Callable[[int, int], int | None]) -> IndexArray:
    """Divide the spans between edges at what `worst` names, until it names nothing."""
    done = [int(edges[0])]
    waiting = [(int(begin), int(end)) for begin, end in pairwise(edges)][::-1]
    while waiting:
        begin, end = waiting.pop()
        at = worst(begin, end)
        if at is None:
            done.append(end)
        else:
            waiting += [(at, end), (begin, at)]
    return np.array(done, dtype=np.intp)


def _curvature(time_s: FloatArray, position_mm: FloatArray) -> float:
    """Return c of the parabola through both ends that fits best, chord + c (t − t0)(t1 − t), kept monotone."""
    bow = (time_s - time_s[0]) * (time_s[-1] - time_s)
    slope = (position_mm[-1] - position_mm[0]) / (time_s[-1] - time_s[0])
    rest = position_mm - position_mm[0] - slope * (time_s - time_s[0])
    best = float(bow @ rest) / max(float(bow @ bow), 1e-300)
    steepest = abs(slope) / float(time_s[-1] - time_s[0])
    return float(np.clip(best, -steepest, steepest))


def _fit_parabolas(
    grid_s: FloatArray, position_mm: FloatArray, edges: IndexArray, tolerance_mm: float
) -> ProfileMotion:
    """Describe a position that is monotone between edges by parabolas that stay within a tolerance."""

    def worst(begin: int, end: int) -> int | None:
        time, position = grid_s[begin : end + 1], position_mm[begin : end + 1]
        elapsed, left = time - time[0], time[-1] - time
        slope = (position[-1] - position[0]) / elapsed[-1]
        parabola = position[0] + (slope + _curvature(time, position) * left) * elapsed
        stray = np.abs(position - parabola)
        at = int(stray.argmax())
        return begin + at if stray[at] > tolerance_mm and end - begin >= MIN_SAMPLES else None

    knots = _split_spans(edges, worst)
    time, position = grid_s[knots], position_mm[knots]
    duration = np.diff(time)
    slope = np.diff(position) / duration
    curvature = np.array([_curvature(grid_s[a : b + 1], position_mm[a : b + 1]) for a, b in pairwise(knots.tolist())])
    return ProfileMotion(
        breaks_s=time,
        signs=np.sign(slope).astype(np.int8),
        uniform=curvature == 0,
        start_mm=position[:-1],
        velocity_mm_s=slope + curvature * duration,
        acceleration_mm_s2=-2 * curvature,
    )


def add_bends(fine: ProfileMotion, edges_s: FloatArray) -> FloatArray:
    """Add to the edges those ends of pieces between which the velocity runs nearly straight."""
    time = fine.breaks_s
    ending = fine.velocity_mm_s + fine.acceleration_mm_s2 * np.diff(time)
    after, before = np.append(fine.velocity_mm_s, 0.0), np.concatenate(([0.0], ending))
    tolerance = max(BEND_MM_S, BEND_SHARE * float(np.abs(after).max()))

    def worst(begin: int, end: int) -> int | None:
        if end - begin < 2:
            return None
        inner = slice(begin + 1, end)
        line = np.interp(time[inner], time[[begin, end]], [after[begin], before[end]])
        stray = np.maximum(np.abs(after[inner] - line), np.abs(before[inner] - line))
        at = int(stray.argmax())
        return begin + 1 + at if stray[at] > tolerance else None

    return np.asarray(time[_split_spans(np.searchsorted(time, edges_s), worst)])


FLOAT32_ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Relative rounding of a position that is kept in single precision."""
MIN_CHORD_MM_S = 1e-6


def commanded_motion(time_s: npt.ArrayLike, position_mm: npt.ArrayLike) -> RecordedMotion:
    """Return a commanded motion: one piece for each sample while it accelerates, one for each stretch that is uniform.

    Nothing is smoothed, so that the millisecond in which friction builds up stays where it is.

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
    knots = _bends(chord, tolerance)
    return RecordedMotion.of_pieces(_commanded_pieces(grid, position - position[0], chord, knots, tolerance))


def _bends(chord: FloatArray, tolerance: float) -> npt.NDArray[np.intp]:
    bends = np.abs(np.diff(chord)) > tolerance
    return np.concatenate(([0], np.flatnonzero(bends) + 1, [chord.size]))


def _commanded_pieces(
    grid_s: FloatArray, position_mm: FloatArray, chord: FloatArray, knots: npt.NDArray[np.intp], tolerance: float
) -> ProfileMotion:
    time, place = grid_s[knots], position_mm[knots]
    duration = np.diff(time)
    mean = np.diff(place) / duration
    mean[np.abs(mean) < tolerance] = 0.0
    step = float(grid_s[1])
    change = np.diff(chord) / step
    before = np.concatenate(([0.0], change))[knots[:-1]]
    after = np.append(change, 0.0)[knots[1:] - 1]
    bend = np.where(before * after > 0, np.sign(before) * np.minimum(np.abs(before), np.abs(after)), 0.0)
    bend[np.diff(knots) > 1] = 0.0
    most = 2 * np.abs(mean) / duration
    bend = np.clip(bend, -most, most)
    return ProfileMotion(
        breaks_s=time,
        signs=np.sign(mean).astype(np.int8),
        uniform=bend == 0,
        start_mm=place[:-1],
        velocity_mm_s=mean - 0.5 * bend * duration,
        acceleration_mm_s2=bend,
    )


MAX_KNOTS = 4000
"""A longer way is averaged down to about as many knots."""
SAME_TIME_S = 1e-7
"""Times closer than this are one, computed in two ways."""


def measured_motion(motion: RecordedMotion, time_s: FloatArray, position_mm: FloatArray) -> ProfileMotion:
    """Return a measured motion of constant velocity from point to point, still where it rests.

    Parameters
    ----------
    motion
        The same record, smoothed: it knows the rests.
    time_s, position_mm
        The record, shape `(n,)`: rising times from 0, finite positions.
    """
    time_s, position_mm = _with_midpoints(time_s, position_mm)
    edges = np.searchsorted(time_s, motion.breaks_s)
    times, positions = [np.zeros(0)], [np.zeros(0)]
    for number, sign in enumerate(motion.signs.tolist()):
        within = slice(int(edges[number]), int(edges[number + 1]) + 1)
        if sign == 0:
            time, position = motion.breaks_s[number : number + 2], np.full(2, position_mm[within].mean())
        else:
            time, position = _averaged_down(time_s[within], position_mm[within])
        later = time > (times[-1][-1] + SAME_TIME_S if times[-1].size else -1.0)
        times.append(time[later])
        positions.append(position[later])
    time, position = np.concatenate(times), np.concatenate(positions)
    velocity = np.diff(position) / np.diff(time)
    return ProfileMotion(
        breaks_s=time,
        signs=np.sign(velocity).astype(np.int8),
        uniform=np.ones(velocity.size, dtype=np.bool_),
        start_mm=position[:-1] - position[0],
        velocity_mm_s=velocity,
        acceleration_mm_s2=np.zeros_like(velocity),
    )


def _with_midpoints(time_s: FloatArray, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Put a point between any two samples, off the chord by what constant acceleration makes of it.

    A chord cuts the bends of a ramp short. The acceleration is the smaller one of those at both samples, and none where
    they differ in sign, so that a corner is not overshot.
    """
    bend = np.pad(np.diff(position_mm, 2), 1)
    before, after = bend[:-1], bend[1:]
    agreed = np.where(before * after > 0, np.sign(before) * np.minimum(np.abs(before), np.abs(after)), 0.0)
    time, position = np.repeat(time_s, 2)[:-1], np.repeat(position_mm, 2)[:-1]
    time[1::2] = 0.5 * (time_s[1:] + time_s[:-1])
    position[1::2] = 0.5 * (position_mm[1:] + position_mm[:-1]) - agreed / 8
    return time, position


def _averaged_down(time_s: FloatArray, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    group = -(-time_s.size // MAX_KNOTS)
    starts = np.arange(0, time_s.size, max(1, group))
    count = np.diff(np.append(starts, time_s.size))
    return np.add.reduceat(time_s, starts) / count, np.add.reduceat(position_mm, starts) / count
