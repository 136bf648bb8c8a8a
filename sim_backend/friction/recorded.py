"""A measured motion, as the friction model takes it."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.sim_backend.friction.motion import Pieces, ProfileMotion, SignArray
from dragrig.sim_backend.friction.smoothing import IndexArray, smooth_between_rests

FINEST_STEP_S = 0.5e-3
"""Faster records are averaged down to this."""

WINDOW_S = 0.03
"""Length of the smoothing window, and of the shortest rest."""

FEWEST = 5
"""Least samples in a record and in a smoothing window."""

JITTER_MM = 0.0015
"""How far an encoder of 1 µm counts may wander at rest: from one count to the next."""

SLOWEST_MM_S = 0.05
"""A stage that wanders further than the counts rests only where a window so much longer sees no such speed."""
LONGEST_REST_WINDOW_S = 0.3

CREEP_MM_S = 1e-4
"""A computed position that goes slower than this stands still: 0.2 % of the speed that turns Coulomb friction."""

EXACT_MM = 1e-6
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
    def of(cls, time_s: npt.ArrayLike, position_mm: npt.ArrayLike, jitter_mm: float = JITTER_MM) -> "RecordedMotion":
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
        grid, raw = on_a_grid(*checked(time_s, position_mm))
        step = float(grid[1])
        window = max(FEWEST, 2 * round(0.5 * WINDOW_S / step) + 1)
        resting_s = min(max(WINDOW_S, jitter_mm / SLOWEST_MM_S), LONGEST_REST_WINDOW_S)
        at_rest = max(window, 2 * round(0.5 * resting_s / step) + 1)
        smooth, edges = smooth_between_rests(raw, window, jitter_mm, at_rest)
        fine = _pieces(grid, smooth - smooth[0], edges, jitter_mm)
        breaks = with_bends(fine, grid[edges])
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
        return cls.of_pieces(_pieces(time_s, position, edges, EXACT_MM))

    @classmethod
    def of_pieces(cls, fine: ProfileMotion) -> "RecordedMotion":
        """Join pieces between rests and turns where the velocity hardly bends."""
        changes = fine.signs[1:] != fine.signs[:-1]
        breaks = with_bends(fine, fine.breaks_s[np.concatenate(([True], changes, [True]))])
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


def checked(time_s: npt.ArrayLike, position_mm: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return a record that a motion can be made of, its times from 0; raises `AnalysisError` for another."""
    time, position = np.asarray(time_s, dtype=float), np.asarray(position_mm, dtype=float)
    if time.ndim != 1 or time.shape != position.shape or time.size < FEWEST:
        raise AnalysisError(f"A recorded motion needs at least {FEWEST} times and as many positions")
    if not (np.isfinite(time).all() and np.isfinite(position).all()):
        raise AnalysisError("A recorded motion must not hold NaN or infinite values; leave those samples out")
    if not (np.diff(time) > 0).all():
        raise AnalysisError("The times of a recorded motion must rise; sort them and leave out repeated samples")
    return time - time[0], position


def on_a_grid(time_s: FloatArray, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average a fast record down, then put it on a uniform grid from 0 to its last time."""
    step = float(np.median(np.diff(time_s)))
    block = max(1, min(int(FINEST_STEP_S / step + 1e-6), time_s.size // FEWEST))
    whole = time_s.size // block * block
    time, position = (values[:whole].reshape(-1, block).mean(axis=1) for values in (time_s, position_mm))
    grid = np.linspace(0.0, float(time_s[-1]), max(FEWEST, round(float(time_s[-1]) / (step * block)) + 1))
    return grid, np.interp(grid, time, position)


def _divide(edges: IndexArray, worst: Callable[[int, int], int | None]) -> IndexArray:
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


def _pieces(grid_s: FloatArray, position_mm: FloatArray, edges: IndexArray, tolerance_mm: float) -> ProfileMotion:
    """Describe a position that is monotone between edges by parabolas that stay within a tolerance."""

    def worst(begin: int, end: int) -> int | None:
        time, position = grid_s[begin : end + 1], position_mm[begin : end + 1]
        elapsed, left = time - time[0], time[-1] - time
        slope = (position[-1] - position[0]) / elapsed[-1]
        parabola = position[0] + (slope + _curvature(time, position) * left) * elapsed
        stray = np.abs(position - parabola)
        at = int(stray.argmax())
        return begin + at if stray[at] > tolerance_mm and end - begin >= FEWEST else None

    knots = _divide(edges, worst)
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


def with_bends(fine: ProfileMotion, edges_s: FloatArray) -> FloatArray:
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

    return np.asarray(time[_divide(np.searchsorted(time, edges_s), worst)])
