"""Velocity and acceleration of a stage from its measured position.

Twice differentiated, a position in counts is noise; smoothed first, ramps lose their edges, and the identified mass
a part of itself. A stage cannot change its velocity at once, so the motion is modelled as pieces of constant
acceleration whose velocities join, and vanish where it rests: a chain of straight lines of velocity. The times of the
joints belong to the fit, which finds those of a programmed stroke from 1 µm counts to a small part of a sample.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import log

import numpy as np

from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.segments import Mask
from dragrig.rig.arrays import FloatArray, IndexArray
from dragrig.sim_backend.friction.motion import ENCODER_JITTER_MM, SMOOTHING_WINDOW_S, RecordedMotion

MAX_JOINTS = 24
"""A motion of more pieces is no programmed stroke; its joints stay where the smoothed record bends."""
SAMPLES_PER_PIECE = 64
"""Evenly spread samples of each piece that are fitted; all samples of a long steady piece add no information."""
JOINT_FREEDOM = 0.45
"""Largest move of a joint in one fit, as a share of the distance to its neighbours."""
MIN_JOINT_DISTANCE_S = 0.004
"""Start values of joints that are closer are merged."""
ROUNDING_RMS_SHARE = 0.2
"""RMS error of a position by counts or noise, over its wander."""
MAX_EVALUATIONS = 30
MAX_FITS = 4
"""Successive fits, each of which may move the joints again."""


def fit_velocity(
    motion: RecordedMotion, time_s: FloatArray, position_mm: FloatArray, wander_mm: float = ENCODER_JITTER_MM
) -> tuple[FloatArray, FloatArray]:
    """Fit a measured position.

    Parameters
    ----------
    motion
        The same record smoothed, with its rests and bends.
    time_s, position_mm
        The record, from its first sample on, shape `(N,)`.
    wander_mm
        Range of the recorded position at rest.

    Returns
    -------
    Times of the joints [s], from the start of the record to its end, and the velocity [mm/s] at each, shapes `(K,)`.
    """
    chain = _first_guess(motion)
    if len(chain.joints_s) <= MAX_JOINTS:
        chain = _simplify(*_refine(chain, time_s, position_mm, wander_mm), time_s, position_mm, wander_mm)
    return chain.joints_s, chain.velocity_mm_s


@dataclass(frozen=True, slots=True, eq=False)
class _VelocityChain:
    """Joints, the velocities there, and which joints are ends of a rest."""

    joints_s: FloatArray
    velocity_mm_s: FloatArray
    resting: Mask

    def keep(self, joints: Mask) -> "_VelocityChain":
        return _VelocityChain(self.joints_s[joints], self.velocity_mm_s[joints], self.resting[joints])

    def plus(self, time_s: float) -> "_VelocityChain":
        at = int(np.searchsorted(self.joints_s, time_s))
        speed = float(np.interp(time_s, self.joints_s, self.velocity_mm_s))
        return _VelocityChain(
            np.insert(self.joints_s, at, time_s),
            np.insert(self.velocity_mm_s, at, speed),
            np.insert(self.resting, at, False),
        )

    def moved(self, time_s: FloatArray) -> FloatArray:
        """Displacement [mm] since the first joint."""
        before, after = _displacement_basis(self.joints_s, time_s)
        return np.asarray(self.velocity_mm_s @ (before + after))


def _first_guess(motion: RecordedMotion) -> _VelocityChain:
    """Take the breaks of the smoothed record, and joints just beside each rest, where its ramps may be."""
    breaks = motion.breaks_s
    rest = (motion.signs == 0) & (np.diff(breaks) >= 0.5 * SMOOTHING_WINDOW_S)
    ends = np.concatenate((breaks[:-1][rest], breaks[1:][rest]))
    beside = np.concatenate((breaks[:-1][rest] - SMOOTHING_WINDOW_S, breaks[1:][rest] + SMOOTHING_WINDOW_S))
    inside = np.array([not np.any((breaks[:-1][rest] <= time) & (time <= breaks[1:][rest])) for time in beside])
    beside = beside[(beside > breaks[0]) & (beside < breaks[-1]) & inside.astype(np.bool_)]
    times = np.union1d(np.union1d(breaks, ends), beside)
    resting = np.isin(times, ends)
    chain = _VelocityChain(times, np.where(resting, 0.0, motion.velocity(times)), resting)
    return chain.keep(_far_apart(times, resting))


def _far_apart(times: FloatArray, resting: Mask) -> Mask:
    """Mask of the joints to keep, none closer than `MIN_JOINT_DISTANCE_S`: ends of record and rests go first."""
    mask = np.zeros(len(times), dtype=np.bool_)
    mask[[0, -1]] = True
    for index in np.argsort(~resting, kind="stable"):
        mask[index] |= np.all(np.abs(times[mask] - times[index]) >= MIN_JOINT_DISTANCE_S)
    return mask


def _refine(
    chain: _VelocityChain, time_s: FloatArray, position_mm: FloatArray, wander_mm: float
) -> tuple[_VelocityChain, float]:
    """Fit a chain, adding joints while it deviates from the record by more than the wander."""
    chain, squares = _fit_chain(chain, time_s, position_mm)
    while squares > wander_mm**2 and len(chain.joints_s) < MAX_JOINTS:
        off = position_mm - chain.moved(time_s)
        off = np.abs(off - off.mean())
        off[np.abs(time_s[:, None] - chain.joints_s).min(axis=1) < MIN_JOINT_DISTANCE_S] = 0.0
        at = float(time_s[int(off.argmax())])
        finer, fewer = _fit_chain(chain.plus(at), time_s, position_mm)
        if fewer > 0.9 * squares:
            break
        chain, squares = finer, fewer
    return chain, squares


def _simplify(
    chain: _VelocityChain, squares: float, time_s: FloatArray, position_mm: FloatArray, wander_mm: float
) -> _VelocityChain:
    """Remove joints while the record does not need them (Bayesian information criterion)."""
    while (joint := _least_needed_joint(chain)) is not None:
        fewer, more = _fit_chain(chain.keep(np.arange(len(chain.joints_s)) != joint), time_s, position_mm)
        samples = SAMPLES_PER_PIECE * len(fewer.joints_s)
        if more > max(squares, (ROUNDING_RMS_SHARE * wander_mm) ** 2) * (1 + 2 * log(samples) / samples):
            break
        chain, squares = fewer, more
    return chain


def _least_needed_joint(chain: _VelocityChain) -> int | None:
    """Find the joint whose removal changes the positions least; None where only ends of rests are left."""
    time, velocity = chain.joints_s, chain.velocity_mm_s
    share = (time[1:-1] - time[:-2]) / (time[2:] - time[:-2])
    off = np.abs(velocity[1:-1] - velocity[:-2] - share * (velocity[2:] - velocity[:-2])) * (time[2:] - time[:-2])
    off[chain.resting[1:-1]] = np.inf
    if not np.isfinite(off).any():
        return None
    return int(off.argmin()) + 1


def _fit_chain(chain: _VelocityChain, time_s: FloatArray, position_mm: FloatArray) -> tuple[_VelocityChain, float]:
    """Fit velocities and times of the joints; also return the mean squared residual [mm²]."""
    from scipy.optimize import least_squares

    squares = np.inf
    for _ in range(MAX_FITS):
        edges = np.searchsorted(time_s, chain.joints_s)
        edges[-1] = len(time_s) - 1
        spread = [np.linspace(*ends, SAMPLES_PER_PIECE).astype(np.intp) for ends in pairwise(edges.tolist())]
        at = np.unique(np.concatenate(spread))
        moving = np.flatnonzero(~chain.resting)
        inner = np.arange(1, len(chain.joints_s) - 1)
        gaps = JOINT_FREEDOM * np.diff(chain.joints_s)
        free = np.concatenate(([position_mm[0]], chain.velocity_mm_s[moving]))
        start = np.concatenate((free, chain.joints_s[inner]))
        lowest = np.concatenate((np.full(len(free), -np.inf), chain.joints_s[inner] - gaps[:-1]))
        highest = np.concatenate((np.full(len(free), np.inf), chain.joints_s[inner] + gaps[1:]))
        problem = _ChainLeastSquares(chain, moving, inner, time_s[at], position_mm[at])
        done = least_squares(
            problem.residual,
            start,
            problem.jacobian,
            (lowest, highest),
            x_scale="jac",
            ftol=1e-6,
            max_nfev=MAX_EVALUATIONS,
        )
        chain = problem.chain_of(done.x)
        before, squares = squares, 2 * float(done.cost) / len(at)
        if squares > 0.99 * before:
            break
    return chain, squares


@dataclass(frozen=True, slots=True, eq=False)
class _ChainLeastSquares:
    chain: _VelocityChain
    moving: IndexArray
    inner: IndexArray
    time_s: FloatArray
    position_mm: FloatArray

    def chain_of(self, values: FloatArray) -> _VelocityChain:
        joints, velocity = self.chain.joints_s.copy(), np.zeros(len(self.chain.joints_s))
        velocity[self.moving] = values[1 : 1 + len(self.moving)]
        joints[self.inner] = values[1 + len(self.moving) :]
        return _VelocityChain(joints, velocity, self.chain.resting)

    def residual(self, values: FloatArray) -> FloatArray:
        return np.asarray(values[0] + self.chain_of(values).moved(self.time_s) - self.position_mm)

    def jacobian(self, values: FloatArray) -> FloatArray:
        chain = self.chain_of(values)
        before, after = _displacement_basis(chain.joints_s, self.time_s)
        slope = np.diff(chain.velocity_mm_s) / np.diff(chain.joints_s)
        shifted = -slope[self.inner - 1, None] * before[self.inner] - slope[self.inner, None] * after[self.inner]
        return np.vstack((np.ones((1, len(self.time_s))), (before + after)[self.moving], shifted)).T


def _displacement_basis(joints_s: FloatArray, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Displacement by 1 mm/s at one joint, before the joint and after it, shapes `(K, n)`."""
    length = np.diff(joints_s)[:, None]
    elapsed = np.clip(time_s - joints_s[:-1, None], 0.0, length)
    rising = elapsed**2 / (2 * length)
    nothing = np.zeros((1, len(time_s)))
    return np.vstack((nothing, rising)), np.vstack((elapsed - rising, nothing))


RAMP_LENGTH_WANDERS = 4 / 3
"""Error of a ramp's length in units of the wander: a count at either end."""
MAX_JOINT_TIMING_S = 0.01
"""Uncertainty of a joint's time in the slowest motion."""


@dataclass(frozen=True, slots=True, eq=False)
class Kinematics:
    """A motion whose velocity is a chain of straight lines.

    Attributes
    ----------
    joints_s
        Times at which the lines join, from the first sample to the last, shape `(K,)`.
    velocity_mm_s
        Velocity at the joints, shape `(K,)`.
    step_s
        Time between samples.
    wander_mm
        Range of the recorded position at rest.
    """

    joints_s: FloatArray
    velocity_mm_s: FloatArray
    step_s: float
    wander_mm: float = ENCODER_JITTER_MM

    def velocity(self, time_s: FloatArray) -> FloatArray:
        """Velocity [mm/s] at times of shape `(n,)`."""
        return np.interp(time_s, self.joints_s, self.velocity_mm_s)

    def acceleration(self, time_s: FloatArray) -> FloatArray:
        """Acceleration [mm/s²] at times of shape `(n,)`; at a joint, that of the piece that begins there."""
        slope = np.diff(self.velocity_mm_s) / np.diff(self.joints_s)
        return np.asarray(slope[self._piece(time_s)])

    def acceleration_error(self, time_s: FloatArray) -> FloatArray:
        """Error [mm/s²] of the acceleration, one standard deviation, shape `(n,)`.

        A count more or less moves the ends of a ramp, and the errors of all its samples are equal; the error is
        widened so that samples taken as independent weigh no more than the ramp as a whole.
        """
        length, change = np.diff(self.joints_s), np.abs(np.diff(self.velocity_mm_s))
        fastest = np.maximum(np.abs(self.velocity_mm_s[1:]), np.abs(self.velocity_mm_s[:-1]))
        stretched = RAMP_LENGTH_WANDERS * self.wander_mm / np.maximum(fastest, 1e-9) / length
        error = change / length * np.minimum(stretched, 1.0) * np.sqrt(np.maximum(length / self.step_s, 1.0))
        return np.asarray(error[self._piece(time_s)])

    def joint_uncertainty(self, quantity: Callable[[FloatArray], FloatArray], time_s: FloatArray) -> FloatArray:
        """Return the uncertainty near the joints of a quantity computed from this motion, 0 elsewhere, shape `(n,)`.

        The side of a joint on which a sample lies is known only up to the time in which the stage moves by the
        encoder's wander, and up to one sample, for position and force need not be of the same instant.

        Parameters
        ----------
        quantity
            The quantity, at rising times.
        time_s
            Rising times.
        """
        speed = np.abs(self.velocity_mm_s)
        fastest = np.maximum(speed, np.maximum(np.append(speed[1:], 0.0), np.append(0.0, speed[:-1])))
        timing = self.step_s + np.minimum(self.wander_mm / np.maximum(fastest, 1e-9), MAX_JOINT_TIMING_S)
        nearest = np.searchsorted(0.5 * (self.joints_s[1:] + self.joints_s[:-1]), time_s)
        shift = timing[nearest]
        change = np.zeros(len(time_s))
        unshifted = quantity(time_s)
        for shifted_s in (np.maximum.accumulate(time_s - shift), np.maximum.accumulate(time_s + shift)):
            shifted = quantity(np.clip(shifted_s, self.joints_s[0], self.joints_s[-1]))
            change = np.maximum(change, np.abs(shifted - unshifted))
        return np.where(np.abs(time_s - self.joints_s[nearest]) <= shift, change, 0.0)

    def _piece(self, time_s: FloatArray) -> IndexArray:
        piece = np.searchsorted(self.joints_s, time_s, side="right") - 1
        return np.clip(piece, 0, len(self.joints_s) - 2)


def fit_kinematics(experiment: Experiment) -> Kinematics:
    """Fit the measured position of a run; raises `AnalysisError` where its motion cannot be used."""
    position = np.asarray(experiment.run.trace.position, dtype=np.float64)
    finite = np.isfinite(position)
    wander_mm = experiment.wander_mm
    fitted = fit_velocity(experiment.motion, experiment.time_s[finite], position[finite], wander_mm)
    return Kinematics(*insert_reversals(*fitted), 1.0 / experiment.run.trace.sample_rate_hz, wander_mm)


def insert_reversals(joints_s: FloatArray, velocity_mm_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Add a joint wherever a straight line of velocity crosses 0, where friction changes sign."""
    before, after = velocity_mm_s[:-1], velocity_mm_s[1:]
    turning = np.flatnonzero(before * after < 0)
    share = before[turning] / (before[turning] - after[turning])
    turns_s = joints_s[turning] + share * np.diff(joints_s)[turning]
    return np.insert(joints_s, turning + 1, turns_s), np.insert(velocity_mm_s, turning + 1, 0.0)
