"""A measured motion as the wall of a sticking capsule takes it: straight from point to point, two to a sample.

An elastic wall asks for the position, not for its derivative, so that the encoder's counts do no harm, while
the smoothing that a velocity needs rounds the corners of a ramp off by 20 µm, which is 30 mN.
"""

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.motion import ProfileMotion
from dragrig.sim_backend.friction.recorded import RecordedMotion

MOST_KNOTS = 4000
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
    time_s, position_mm = _rounded(time_s, position_mm)
    edges = np.searchsorted(time_s, motion.breaks_s)
    times, positions = [np.zeros(0)], [np.zeros(0)]
    for number, sign in enumerate(motion.signs.tolist()):
        within = slice(int(edges[number]), int(edges[number + 1]) + 1)
        if sign == 0:
            time, position = motion.breaks_s[number : number + 2], np.full(2, position_mm[within].mean())
        else:
            time, position = _thinned(time_s[within], position_mm[within])
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


def _rounded(time_s: FloatArray, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
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


def _thinned(time_s: FloatArray, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    group = -(-time_s.size // MOST_KNOTS)
    starts = np.arange(0, time_s.size, max(1, group))
    count = np.diff(np.append(starts, time_s.size))
    return np.add.reduceat(time_s, starts) / count, np.add.reduceat(position_mm, starts) / count
