"""Samples at the end of the sensor's range, which say only that the force was beyond it."""

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import AnyFloatArray
from dragrig.rig.runfile.model import Run

LONGEST_CHANCE_RUN = 4
"""So many equal samples in a row at the very top or bottom of a noisy trace do not come about by chance."""


def clipped(run: Run) -> npt.NDArray[np.bool_]:
    """Tell for each sample of the signal whether it is clipped.

    Where the run's checks counted clipped samples, those at the trace's extremes are meant. A run
    without checks is judged by its trace: an extreme held for more than four samples, while the samples
    around it are noisy.
    """
    force = run.trace.force
    counted = run.info.checks.get("clipped_samples")
    found = np.zeros(len(force), dtype=np.bool_)
    if not np.isfinite(force).any() or (counted is not None and not counted):
        return found
    for extreme in (np.nanmax(force), np.nanmin(force)):
        at = np.asarray(force == extreme)
        if counted or _held_in_noise(force, at):
            found |= at
    return found


def _held_in_noise(force: AnyFloatArray, at: npt.NDArray[np.bool_]) -> bool:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], at, [False])).astype(np.int8)))
    starts, stops = edges[::2], edges[1::2]
    longest = int((stops - starts).argmax())
    start, stop = int(starts[longest]), int(stops[longest])
    if stop - start <= LONGEST_CHANCE_RUN:
        return False
    nearby = np.concatenate((force[max(0, start - 50) : start], force[stop : stop + 50]))
    return len(nearby) > 1 and float(np.nanmedian(np.abs(np.diff(nearby)))) > 0
