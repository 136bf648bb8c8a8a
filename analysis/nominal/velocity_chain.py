"""A position fitted by a velocity that is a chain of straight lines.

A stage cannot change its velocity at once: its motion is taken for pieces of constant acceleration whose velocities
join, and vanish where it rests. The times of the joints belong to the fit, which finds those of a programmed stroke
from 1 µm counts to a small part of a sample.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import log

import numpy as np

from dragrig.analysis.gaps import IndexArray
from dragrig.analysis.phases import Mask
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction import RecordedMotion
from dragrig.sim_backend.friction.recorded import JITTER_MM, WINDOW_S

MOST_JOINTS = 24
"""A motion of more pieces is no programmed stroke; its joints stay where the smoothing of the record puts them."""
SAMPLES_PER_PIECE = 64
"""Evenly spread samples of each piece that are fitted; all samples of a long steady piece would say no more."""
SLACK = 0.45
"""How far a joint may move in one fit, as a share of the way to its neighbours."""
CLOSEST_S = 0.004
"""Joints that start out closer than this are one."""
ROUNDING = 0.2
"""Root mean square of what counts or noise leave of a position, over how far it wanders."""
MOST_STEPS = 30
FITS = 4
"""Fits in a row, each of which may move the joints again."""


def fit_velocity(
    motion: RecordedMotion, time_s: FloatArray, position_mm: FloatArray, wander_mm: float = JITTER_MM
) -> tuple[FloatArray, FloatArray]:
    """Fit a measured position.

    Parameters
    ----------
    motion
        The same record smoothed, which says where it rests and bends.
    time_s, position_mm
        The record, from its first sample on, shape `(N,)`.
    wander_mm
        How far it wanders at rest.

    Returns
    -------
    Times of the joints [s], from the record's begin to its end, and the velocity [mm/s] at each, shapes `(K,)`.
    """
    chain = _first_guess(motion)
    if len(chain.joints_s) <= MOST_JOINTS:
        chain = _simplest(*_fine_enough(chain, time_s, position_mm, wander_mm), time_s, position_mm, wander_mm)
    return chain.joints_s, chain.velocity_mm_s


@dataclass(frozen=True, slots=True, eq=False)
class _Chain:
    """Joints, the velocities there, and which joints are ends of a rest."""

    joints_s: FloatArray
    velocity_mm_s: FloatArray
    resting: Mask

    def keep(self, joints: Mask) -> "_Chain":
        return _Chain(self.joints_s[joints], self.velocity_mm_s[joints], self.resting[joints])

    def plus(self, time_s: float) -> "_Chain":
        at = int(np.searchsorted(self.joints_s, time_s))
        speed = float(np.interp(time_s, self.joints_s, self.velocity_mm_s))
        return _Chain(
            np.insert(self.joints_s, at, time_s),
            np.insert(self.velocity_mm_s, at, speed),
            np.insert(self.resting, at, False),
        )

    def moved(self, time_s: FloatArray) -> FloatArray:
        """Way [mm] since the first joint."""
        before, after = _carried(self.joints_s, time_s)
        return np.asarray(self.velocity_mm_s @ (before + after))


def _first_guess(motion: RecordedMotion) -> _Chain:
    """Return the record's own breaks, and joints just off each rest, where its ramps may hide."""
    breaks = motion.breaks_s
    rest = (motion.signs == 0) & (np.diff(breaks) >= 0.5 * WINDOW_S)
    ends = np.concatenate((breaks[:-1][rest], breaks[1:][rest]))
    beside = np.concatenate((breaks[:-1][rest] - WINDOW_S, breaks[1:][rest] + WINDOW_S))
    inside = np.array([not np.any((breaks[:-1][rest] <= one) & (one <= breaks[1:][rest])) for one in beside])
    beside = beside[(beside > breaks[0]) & (beside < breaks[-1]) & inside.astype(np.bool_)]
    times = np.union1d(np.union1d(breaks, ends), beside)
    resting = np.isin(times, ends)
    chain = _Chain(times, np.where(resting, 0.0, motion.velocity(times)), resting)
    return chain.keep(_apart(times, resting))


def _apart(times: FloatArray, resting: Mask) -> Mask:
    """Tell which joints to keep, so that none lie closer than `CLOSEST_S`: ends of record and rests go first."""
    kept = np.zeros(len(times), dtype=np.bool_)
    kept[[0, -1]] = True
    for index in np.argsort(~resting, kind="stable"):
        kept[index] |= np.all(np.abs(times[kept] - times[index]) >= CLOSEST_S)
    return kept


def _fine_enough(chain: _Chain, time_s: FloatArray, position_mm: FloatArray, wander_mm: float) -> tuple[_Chain, float]:
    """Fit a chain, with more joints where it misses the record by more than this wanders."""
    chain, squares = _fitted(chain, time_s, position_mm)
    while squares > wander_mm**2 and len(chain.joints_s) < MOST_JOINTS:
        off = position_mm - chain.moved(time_s)
        off = np.abs(off - off.mean())
        off[np.abs(time_s[:, None] - chain.joints_s).min(axis=1) < CLOSEST_S] = 0.0
        at = float(time_s[int(off.argmax())])
        finer, fewer = _fitted(chain.plus(at), time_s, position_mm)
        if fewer > 0.9 * squares:
            break
        chain, squares = finer, fewer
    return chain, squares


def _simplest(chain: _Chain, squares: float, time_s: FloatArray, position_mm: FloatArray, wander_mm: float) -> _Chain:
    """Take joints away as long as the record does not need them (Bayesian information criterion)."""
    while (joint := _least_bent(chain)) is not None:
        fewer, more = _fitted(chain.keep(np.arange(len(chain.joints_s)) != joint), time_s, position_mm)
        samples = SAMPLES_PER_PIECE * len(fewer.joints_s)
        if more > max(squares, (ROUNDING * wander_mm) ** 2) * (1 + 2 * log(samples) / samples):
            break
        chain, squares = fewer, more
    return chain


def _least_bent(chain: _Chain) -> int | None:
    """Return the joint without which the positions would change least; None where only ends of rests are left."""
    time, velocity = chain.joints_s, chain.velocity_mm_s
    share = (time[1:-1] - time[:-2]) / (time[2:] - time[:-2])
    off = np.abs(velocity[1:-1] - velocity[:-2] - share * (velocity[2:] - velocity[:-2])) * (time[2:] - time[:-2])
    off[chain.resting[1:-1]] = np.inf
    if not np.isfinite(off).any():
        return None
    return int(off.argmin()) + 1


def _fitted(chain: _Chain, time_s: FloatArray, position_mm: FloatArray) -> tuple[_Chain, float]:
    """Fit velocities and times of the joints; also return the mean square of what is left [mm²]."""
    from scipy.optimize import least_squares

    squares = np.inf
    for _ in range(FITS):
        at = _spread(chain.joints_s, time_s)
        moving = np.flatnonzero(~chain.resting)
        inner = np.arange(1, len(chain.joints_s) - 1)
        gaps = SLACK * np.diff(chain.joints_s)
        free = np.concatenate(([position_mm[0]], chain.velocity_mm_s[moving]))
        start = np.concatenate((free, chain.joints_s[inner]))
        lowest = np.concatenate((np.full(len(free), -np.inf), chain.joints_s[inner] - gaps[:-1]))
        highest = np.concatenate((np.full(len(free), np.inf), chain.joints_s[inner] + gaps[1:]))
        problem = _Problem(chain, moving, inner, time_s[at], position_mm[at])
        done = least_squares(
            problem.residual, start, problem.jacobian, (lowest, highest), x_scale="jac", ftol=1e-6, max_nfev=MOST_STEPS
        )
        chain = problem.chain_of(done.x)
        before, squares = squares, 2 * float(done.cost) / len(at)
        if squares > 0.99 * before:
            break
    return chain, squares


def _spread(joints_s: FloatArray, time_s: FloatArray) -> IndexArray:
    edges = np.searchsorted(time_s, joints_s)
    edges[-1] = len(time_s) - 1
    picked = [np.linspace(a, b, SAMPLES_PER_PIECE).astype(np.intp) for a, b in pairwise(edges.tolist())]
    return np.unique(np.concatenate(picked))


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    chain: _Chain
    moving: IndexArray
    inner: IndexArray
    time_s: FloatArray
    position_mm: FloatArray

    def chain_of(self, values: FloatArray) -> _Chain:
        joints, velocity = self.chain.joints_s.copy(), np.zeros(len(self.chain.joints_s))
        velocity[self.moving] = values[1 : 1 + len(self.moving)]
        joints[self.inner] = values[1 + len(self.moving) :]
        return _Chain(joints, velocity, self.chain.resting)

    def residual(self, values: FloatArray) -> FloatArray:
        return np.asarray(values[0] + self.chain_of(values).moved(self.time_s) - self.position_mm)

    def jacobian(self, values: FloatArray) -> FloatArray:
        chain = self.chain_of(values)
        before, after = _carried(chain.joints_s, self.time_s)
        slope = np.diff(chain.velocity_mm_s) / np.diff(chain.joints_s)
        shifted = -slope[self.inner - 1, None] * before[self.inner] - slope[self.inner, None] * after[self.inner]
        return np.vstack((np.ones((1, len(self.time_s))), (before + after)[self.moving], shifted)).T


def _carried(joints_s: FloatArray, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far a rise of one joint's velocity by 1 carries before the joint and after it, shapes `(K, n)`."""
    length = np.diff(joints_s)[:, None]
    elapsed = np.clip(time_s - joints_s[:-1, None], 0.0, length)
    rising = elapsed**2 / (2 * length)
    nothing = np.zeros((1, len(time_s)))
    return np.vstack((nothing, rising)), np.vstack((elapsed - rising, nothing))
