"""What a model of one's own is derived from: one channel, predicted from how the stage moves.

`docs/own-model.md` has a worked example.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf

import numpy as np

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.nominal.kinematics import Kinematics, kinematics
from dragrig.analysis.nominal.protocol import NominalModel, Parameter, Prediction, Predictor, Variation
from dragrig.rig.arrays import FloatArray

__all__ = ["ChannelModel", "Moment", "Parameter"]

TURNING_SPEED_MM_S = 0.05
"""Speed over which a direction turns its sign, the friction model's own."""
VALUE_STEP, PRIOR_STEP = 1e-4, 1e-6
"""Steps of derivatives by differences, relative to the value and to the prior's width."""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """How the stage moves at times of a run, arrays of shape `(n,)`.

    Attributes
    ----------
    time_s
        Since the first sample; rising, not evenly.
    position_mm, velocity_mm_s, acceleration_mm_s2
        Measured motion, position since the first sample; exactly at rest where the stage rests.
    experiment
        The run: what was done, to what, and everything recorded.
    """

    time_s: FloatArray
    position_mm: FloatArray
    velocity_mm_s: FloatArray
    acceleration_mm_s2: FloatArray
    experiment: Experiment

    @property
    def speed_mm_s(self) -> FloatArray:
        """Velocity without its sign."""
        return np.abs(self.velocity_mm_s)

    @property
    def direction(self) -> FloatArray:
        """1 forwards, -1 backwards, 0 at rest; in between below some 0.05 mm/s."""
        return np.tanh(self.velocity_mm_s / TURNING_SPEED_MM_S)


class ChannelModel(NominalModel):
    """A model of one channel. A subclass gives `name` and `parameters` and says what is measured at a moment.

    Attributes
    ----------
    channel
        The recorded quantity that is predicted.
    zero_sd_mN
        Standard deviation of the sensor's unknown zero in every run; 0 where the zero is known.
    run_to_run
        Relative standard deviation by which the whole prediction differs between runs; 0 where it does not.
    follows_s
        Time over which the prediction runs straight even in steady motion; shorter than half a second only where
        something changes quickly there, as cogging does.
    """

    channel: str = "force"
    zero_sd_mN: float = 5.0
    run_to_run: float = 0.0
    follows_s: float = inf

    @abstractmethod
    def predict(self, values: Mapping[str, float], at: Moment) -> FloatArray:
        """Return the channel without its zero, shape `(n,)`, for parameter values by name."""

    def suits(self, experiment: Experiment) -> bool:
        """Tell whether the model has something to say of a run; of every run unless a subclass says otherwise."""
        del experiment
        return True

    @property
    def variations(self) -> tuple[Variation, ...]:
        """One factor of each run where runs differ."""
        return (Variation("run_to_run", self.run_to_run),) if self.run_to_run else ()

    @property
    def zero_sd(self) -> Mapping[str, float]:
        """The sensor's zero."""
        return {self.channel: self.zero_sd_mN} if self.zero_sd_mN else {}

    def prepare(self, experiment: Experiment) -> Mapping[str, Predictor]:
        """Prepare a run that suits and recorded the channel; raises `AnalysisError` as `kinematics`."""
        if self.channel not in experiment.run.trace.channels or not self.suits(experiment):
            return {}
        return {self.channel: _MomentPredictor(self, experiment, kinematics(experiment))}


@dataclass(frozen=True, eq=False)
class _MomentPredictor(Predictor):
    model: ChannelModel
    experiment: Experiment
    motion: Kinematics

    @property
    def events_s(self) -> FloatArray:
        begin, end = self.motion.joints_s[[0, -1]].tolist()
        if not self.model.follows_s < end - begin:
            return self.motion.joints_s
        return np.union1d(self.motion.joints_s, np.arange(begin, end, self.model.follows_s))

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        total = self._total(values, time_s)
        return Prediction(total, np.repeat(total[None], len(self.model.variations), axis=0))

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        rows = []
        for index, parameter in enumerate(self.model.parameters):
            value = float(values[index])
            width = 0.0 if parameter.positive else PRIOR_STEP * parameter.prior_sd
            step = max(VALUE_STEP * abs(value), width)
            ahead, behind = values.copy(), values.copy()
            ahead[index], behind[index] = value + step, value - step
            rows.append((self._total(ahead, time_s) - self._total(behind, time_s)) / (2 * step))
        return np.array(rows)

    def uncertainty(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        doubt = self.motion.doubt(lambda times: self._total(values, times), time_s)
        accelerated = self._total(values, time_s, self.motion.acceleration_error(time_s))
        return np.hypot(doubt, accelerated - self._total(values, time_s))

    def _total(self, values: FloatArray, time_s: FloatArray, error: FloatArray | float = 0.0) -> FloatArray:
        motion, experiment = self.motion, self.experiment
        acceleration = motion.acceleration(time_s) + error
        at = Moment(time_s, experiment.position(time_s), motion.velocity(time_s), acceleration, experiment)
        named = {one.name: float(value) for one, value in zip(self.model.parameters, values, strict=True)}
        return np.asarray(self.model.predict(named, at), dtype=np.float64)
