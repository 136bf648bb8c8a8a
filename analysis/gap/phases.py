"""The phase of a run at any time, as its file says."""

import numpy as np

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.rig.arrays import FloatArray


def commanded_phase(experiment: Experiment, time_s: FloatArray) -> FloatArray:
    """Return the number of the commanded phase at times, shape `(n,)`."""
    index = np.searchsorted(experiment.time_s, time_s + 1e-9, side="right") - 1
    return np.asarray(experiment.run.trace.phase[np.clip(index, 0, None)], dtype=np.float64)
