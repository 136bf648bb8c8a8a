"""Position against command, and two positions against each other."""

import numpy as np

from dragrig.analysis.comparison.overlay import Overlay
from dragrig.analysis.comparison.results import Following, MotionDifference
from dragrig.analysis.phases import Mask, in_phase
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Run


def motion_difference(a: Run, b: Run, overlay: Overlay | None, *, b_is_model: bool) -> MotionDifference:
    """Compare the motions of two runs; a model is driven by the motion that was recorded, so that there is no other."""
    if b_is_model:
        return MotionDifference(following(a), None, None, None)
    if overlay is None:
        return MotionDifference(following(a), following(b), None, None)
    miss = overlay.position_b - overlay.position_a
    miss = miss[np.isfinite(miss)]
    if not miss.size:
        return MotionDifference(following(a), following(b), None, None)
    miss = miss - miss[0]
    largest = float(miss[np.abs(miss).argmax()])
    return MotionDifference(following(a), following(b), float(np.sqrt(np.mean(miss**2))), largest)


def following(run: Run) -> Following | None:
    """Return position minus command while in motion; None where no command but the position itself was recorded."""
    trace = run.trace
    position, command = (np.asarray(one, dtype=np.float64) for one in (trace.position, trace.command))
    moving = (trace.phase > Phase.REST) & (trace.phase < Phase.HOLD) & np.isfinite(position) & np.isfinite(command)
    if np.array_equal(command, position) or not moving.any():
        return None
    error = position - command
    largest = float(error[moving][np.abs(error[moving]).argmax()])
    return Following(float(np.sqrt(np.mean(error[moving] ** 2))), largest, _lag(run, error, moving))


def _lag(run: Run, error: FloatArray, moving: Mask) -> float | None:
    steady = moving & in_phase(run.trace, Phase.STEADY)
    if np.count_nonzero(steady) < 2:
        return None
    time, command = run.trace.time[steady], run.trace.command[steady]
    took = float(time[-1] - time[0])
    speed = float(command[-1] - command[0]) / took if took > 0 else 0.0
    return -float(np.mean(error[steady])) / speed if speed else None
