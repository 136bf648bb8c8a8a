"""When a run began to move, from its recorded positions, and by how much two runs are to be shifted."""

import numpy as np

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Run

BEFORE_S = 0.05
SETTING_OFF_MM = 2.0
"""The start of the way, over which two positions are laid on each other."""
LONGEST_S = 0.5
FURTHEST_SAMPLES = 3.0
"""The recorded rest ends within so many samples of the start of motion."""
STEPS = 8


def start_of_motion(run: Run) -> float | None:
    """Return the time in the file [s] at which the recorded position leaves its first rest; None where it never does.

    Where the positions cannot be used, or show no rest, it is where the phases say that the rest ends.
    """
    trace = run.trace
    if not trace.time.size:
        return None
    try:
        motion = Experiment(run).motion
    except AnalysisError:
        pass  # a spoilt position; the phases still tell
    else:
        moving = np.flatnonzero(motion.signs)
        if moving.size and moving[0] > 0:
            seen = np.flatnonzero(np.isfinite(trace.position))
            return float(trace.time[seen[0]] + motion.breaks_s[moving[0]])
        if not moving.size:
            return None
    off = np.flatnonzero((trace.phase > Phase.REST) & (trace.phase < Phase.HOLD))
    return float(trace.time[off[0]]) if off.size else None


def shift_between(a: Run, b: Run) -> float | None:
    """Return what is to be added to the times of B so that both begin to move at the same time.

    The starts are found to about a sample each; sliding the first millimetres of the two positions over each other
    by least squares makes that a small part of one.
    """
    starts = start_of_motion(a), start_of_motion(b)
    if starts[0] is None or starts[1] is None:
        return None
    shift = starts[0] - starts[1]
    limit = FURTHEST_SAMPLES / min(a.trace.sample_rate_hz, b.trace.sample_rate_hz)
    return shift + _refined(a, b, starts[0], shift, limit)


def _refined(a: Run, b: Run, start_s: float, shift_s: float, limit_s: float) -> float:
    time, position = _finite(a)
    other_time, other = _finite(b)
    if position.size < 2 or other.size < 2:
        return 0.0
    way = np.abs(position - position[np.searchsorted(time, start_s).clip(0, time.size - 1)])
    arrived = time[(time > start_s) & (way > SETTING_OFF_MM)]
    until = min(start_s + LONGEST_S, float(arrived[0]) if arrived.size else np.inf)
    window = (time >= start_s - BEFORE_S) & (time <= until)
    if np.count_nonzero(window) < 4:
        return 0.0
    at, mine = time[window], position[window] - position[window][0]
    fine = 0.0
    for _ in range(STEPS):
        theirs = np.interp(at - shift_s - fine, other_time, other)
        slope = np.gradient(theirs, at)
        strength = float(slope @ slope)
        if strength == 0:
            return 0.0
        # A constant between the two positions is no shift.
        miss = (theirs - theirs[0]) - mine
        fine += float(slope @ miss) / strength
    return fine if abs(fine) <= limit_s else 0.0


def _finite(run: Run) -> tuple[FloatArray, FloatArray]:
    position = np.asarray(run.trace.position, dtype=np.float64)
    seen = np.isfinite(position)
    return run.trace.time[seen], position[seen]
