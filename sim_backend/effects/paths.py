"""Along the path of a motion: distance gone, and a friction that builds up over distance and turns with it."""

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.maxwell import linear_recursion
from dragrig.sim_backend.friction.motion import Motion


def path_mm(motion: Motion, time_s: FloatArray) -> FloatArray:
    """Return the distance gone since the motion's first instant, there and back added up, of the times' shape."""
    index, moved = _since_break(motion, time_s)
    steps = np.abs(np.diff(motion.position(motion.breaks_s)))
    return np.asarray(np.append(0.0, np.cumsum(steps))[index] + moved)


def deflection(motion: Motion, time_s: FloatArray, length_mm: float) -> FloatArray:
    """Return a bristle's deflection over its steady one, −1 to 1, of the times' shape.

    It starts from 0, follows the motion over a sliding distance, `length_mm · dz/ds = sign − z`, and keeps its value
    while nothing moves (Dahl).
    """
    index, moved = _since_break(motion, time_s)
    signs = motion.signs.astype(np.float64)
    kept = np.exp(-np.abs(np.diff(motion.position(motion.breaks_s))) / length_mm)
    begin = linear_recursion(np.append(0.0, kept), np.append(0.0, signs * (1 - kept)))
    share = np.exp(-moved / length_mm)
    return np.asarray(begin[index] * share + signs[index] * (1 - share))


def _since_break(motion: Motion, time_s: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return in which stretch each time lies, and the distance gone since that began."""
    breaks = motion.breaks_s
    time = np.clip(time_s, 0.0, breaks[-1])
    index = np.clip(np.searchsorted(breaks, time, side="right") - 1, 0, breaks.size - 2)
    return index, np.asarray(np.abs(motion.position(time) - motion.position(breaks[index])))
