"""The motion that decides which hemisphere leads: a way back too short to change that is no way back.

After an overshoot of some µm a stage creeps back. Coulomb friction turns with it, but the wall stays on the hemisphere
that it lies on.
"""

from itertools import pairwise

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.motion import Motion, ProfileMotion
from dragrig.sim_backend.friction.recorded import RecordedMotion

SLACK_MM = 0.5
"""A way back shorter than this does not bring the other hemisphere to the front (a tenth of the contact)."""


def leading_motion(motion: Motion, slack_mm: float = SLACK_MM) -> Motion:
    """Return a motion without its ways back shorter than `slack_mm`; the same object where it has none."""
    turning = motion.signs[motion.signs != 0]
    if not (turning[1:] != turning[:-1]).any():
        return motion
    pieces = motion.pieces()
    times = np.append(pieces.start_s, motion.breaks_s[-1])
    position = motion.position(times)
    if _shortest_way(position) > slack_mm:
        return motion
    turns = _turns(position, slack_mm)
    led = _monotone(position, turns)
    if np.array_equal(led, position):
        return motion
    return _following(motion, times, position, led)


def _shortest_way(position_mm: FloatArray) -> float:
    """Return the least distance between two turns of a position, its ends included [mm]."""
    steps = np.diff(position_mm)
    steps = steps[steps != 0]
    turns = np.flatnonzero(np.sign(steps[1:]) != np.sign(steps[:-1])) + 1
    return float(np.add.reduceat(np.abs(steps), np.append(0, turns)).min(initial=np.inf)) if steps.size else 0.0


def _turns(position_mm: FloatArray, slack_mm: float) -> list[int]:
    """Return where a position turns by more than the slack, as indices, both ends included."""
    from scipy.signal import find_peaks

    peaks = [find_peaks(side * position_mm, prominence=slack_mm, plateau_size=1)[0] for side in (1.0, -1.0)]
    return [0, *np.sort(np.concatenate(peaks)).tolist(), position_mm.size - 1]


def _monotone(position_mm: FloatArray, turns: list[int]) -> FloatArray:
    led = position_mm.copy()
    for begin, end in pairwise(turns):
        part = position_mm[begin : end + 1].copy()
        part[0] = led[begin]
        rises = part[-1] >= part[0] if end - begin > 1 else True
        led[begin : end + 1] = np.maximum.accumulate(part) if rises else np.minimum.accumulate(part)
    return led


def _following(motion: Motion, times_s: FloatArray, position_mm: FloatArray, led_mm: FloatArray) -> RecordedMotion:
    pieces = motion.pieces()
    kept = (led_mm[:-1] == position_mm[:-1]) & (led_mm[1:] == position_mm[1:])
    velocity = np.diff(led_mm) / np.diff(times_s)
    acceleration = np.where(kept, pieces.acceleration_mm_s2, 0.0)
    fine = ProfileMotion(
        breaks_s=times_s,
        signs=np.sign(velocity).astype(np.int8),
        uniform=acceleration == 0,
        start_mm=led_mm[:-1],
        velocity_mm_s=np.where(kept, pieces.velocity_mm_s, velocity),
        acceleration_mm_s2=acceleration,
    )
    return RecordedMotion.of_pieces(fine)
