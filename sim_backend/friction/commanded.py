"""A motion that is known exactly at its samples: a command that the stage was seen to follow to the count."""

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.motion import ProfileMotion
from dragrig.sim_backend.friction.recorded import RecordedMotion, checked, on_a_grid

ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Relative rounding of a position that is kept in single precision."""
LEAST_MM_S = 1e-6


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
    grid, position = on_a_grid(*checked(time_s, position_mm))
    step = float(grid[1])
    chord = np.diff(position) / step
    tolerance = max(LEAST_MM_S, ROUNDING * float(np.abs(position).max()) / step)
    chord[np.abs(chord) < tolerance] = 0.0
    knots = _knots(chord, tolerance)
    return RecordedMotion.of_pieces(_fine(grid, position - position[0], chord, knots, tolerance))


def _knots(chord: FloatArray, tolerance: float) -> npt.NDArray[np.intp]:
    bends = np.abs(np.diff(chord)) > tolerance
    return np.concatenate(([0], np.flatnonzero(bends) + 1, [chord.size]))


def _fine(
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
