"""What a fit leaves of its run, whitened: numbers that white noise of unit variance should look like."""

from dataclasses import dataclass

import numpy as np

from dragrig.analysis.identification.maxwell.fit import Whitened
from dragrig.analysis.identification.maxwell.record import ShearRecord
from dragrig.analysis.identification.noise import Noise
from dragrig.analysis.identification.results import RelaxationFit
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RunResiduals:
    """A run beside its fit.

    Attributes
    ----------
    ramp_s
        When the ramp begins and ends.
    middle_s, whitened
        Middle of each block of the fit, and its residual, measured less predicted, shape `(n,)`.
    time_s, predicted_mN
        Times from the ramp's begin on, evenly spread over their logarithm, and the predicted force, zero included.
    """

    ramp_s: tuple[float, float]
    middle_s: FloatArray
    whitened: FloatArray
    time_s: FloatArray
    predicted_mN: FloatArray


def residuals(fit: RelaxationFit, experiment: Experiment, noise: Noise, points: int = 400) -> RunResiduals:
    """Evaluate a fit beside its run; `AnalysisError` where it has no numbers."""
    record = ShearRecord.of(experiment)
    moduli, times, spring, zero = _values(fit)
    blocks = record.blocks
    predicted = zero + spring * record.spring() + moduli @ record.branches(times)
    whitened = Whitened.of(record, noise).rows((blocks.mean - predicted)[None])[0, :-1]
    begin = record.ramp_s[0]
    time = begin + np.geomspace(record.step_s, blocks.end_s[-1] - begin, points)
    force = zero + record.forces_at(times, moduli, spring, time)
    return RunResiduals(record.ramp_s, blocks.middle_s, whitened, time, force)


def predicted_force(fit: RelaxationFit, experiment: Experiment, time_s: FloatArray) -> FloatArray:
    """Force [mN] that a fit predicts at times of its run, zero included; `AnalysisError` where it has no numbers."""
    moduli, times, spring, zero = _values(fit)
    return zero + ShearRecord.of(experiment).forces_at(times, moduli, spring, time_s)


def _values(fit: RelaxationFit) -> tuple[FloatArray, FloatArray, float, float]:
    if not fit.elements or fit.zero.value is None:
        raise AnalysisError(f"{fit.file}: has no identified elements to predict from ({fit.remark})")
    E1, E2, E3, eta1, eta2 = (one.value for one in fit.elements)
    return np.array([E1, E2]), np.array([eta1 / E1, eta2 / E2]), E3, fit.zero.value
