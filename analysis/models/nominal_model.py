"""The interface of a nominal model: parameters with priors, and predicted channels of a run.

A user's own model is one file with a `MODEL` that fulfils `NominalModel`; deriving it from `ChannelModel` leaves only
one channel to be predicted from how the stage moves. `docs/own-model.md` has a worked example. Values of parameters
travel as arrays in the order of `NominalModel.parameters`.
"""

from abc import abstractmethod
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import inf
from types import MappingProxyType
from typing import Protocol

import numpy as np

from dragrig.analysis.models.experiment import Experiment, Kinematics, fit_kinematics
from dragrig.config import AnalysisError, suggestion
from dragrig.rig import FloatArray


@dataclass(frozen=True, slots=True)
class Parameter:
    """A quantity of a nominal model that runs determine, with its prior."""

    name: str
    """As in settings."""
    unit: str
    """`1` for none."""
    nominal: float
    """Value before any run."""
    prior_sd: float
    """Standard deviation of the prior: of the value itself, or relative to it when `positive`."""
    positive: bool = True
    """Whether the value must be above 0; its prior is then lognormal, with median `nominal`."""
    meaning: str = ""
    """A few words for tables."""
    of_rig: bool = False
    """Whether it belongs to the rig, so that it is the same for every specimen measured on it."""


@dataclass(frozen=True, slots=True)
class Variation:
    """A part of the prediction that differs from run to run."""

    name: str
    """The differing part."""
    sd: float
    """Its size: one standard deviation."""
    unit: str = "1"
    """`1` where the part differs by a factor, `sd` being relative; another where so much of it is added."""

    @property
    def usual(self) -> float:
        """The value of a run that does not differ: a factor of 1, or nothing added."""
        return 1.0 if self.unit == "1" else 0.0


@dataclass(frozen=True, slots=True)
class ParameterCombination:
    """A product of powers of positive parameters, which runs may determine where they cannot tell its factors apart."""

    name: str
    unit: str
    powers: Mapping[str, float]
    meaning: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """A channel at `n` times."""

    total: FloatArray
    """The channel without the sensor's zero, shape `(n,)`."""
    varying: FloatArray
    """What each of the model's variations multiplies, shape `(V, n)`, in their order."""


class ForcePart(StrEnum):
    """A part of a predicted force by its place; effects of the place act on it.

    `DRY_FRICTION` and `VISCOUS_FRICTION` have the sign of the motion, `RELAXATION` is the force of a specimen that is
    deformed and relaxes, in proportion to its stiffness, and `INERTIA` accelerates a mass.
    """

    DRY_FRICTION = "dry_friction"
    VISCOUS_FRICTION = "viscous_friction"
    RELAXATION = "relaxation"
    INERTIA = "inertia"


class Predictor(Protocol):
    """One channel of one run, prepared: all that does not depend on the parameters is computed already."""

    @property
    def events_s(self) -> FloatArray:
        """Times within the run at which the prediction may jump or bend, shape `(K,)`."""

    @property
    def jumps(self) -> bool:
        """Whether parameters move jumps of the prediction in time, so that a sample stands for the time around it.

        Otherwise it stands for its instant; default: yes.
        """
        return True

    @property
    def equivalence_key(self) -> Hashable:
        """Equal for predictors that predict the same whatever the values and times; default: its identity.

        One of several equivalent predictors is evaluated for all, as for repeats whose motion is the same bit for bit.
        """
        return id(self)

    @abstractmethod
    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Predict the channel at rising times, shape `(n,)`, for parameter values of shape `(P,)`."""

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return the derivative of the predicted total by every parameter, shape `(P, n)`; here by differences."""
        return central_differences(
            self, values, time_s, [VALUE_STEP * (abs(value) or 1.0) for value in values.tolist()]
        )

    def sensitivities_without(self, names: Collection[str], values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return `sensitivities`; rows of the named parameters are not used, and may hold anything."""
        del names
        return self.sensitivities(values, time_s)

    def parts(self, values: FloatArray, time_s: FloatArray) -> Mapping[ForcePart, FloatArray]:
        """Return the parts of the prediction whose place is known, shape `(n,)` each; default: none."""
        del values, time_s
        return {}

    def uncertainty(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return how well the channel can be predicted from the measured motion, one standard deviation, shape `(n,)`.

        A motion known to a few µm leaves its start or stop uncertain by milliseconds; default: 0.
        """
        del values
        return np.zeros_like(time_s)


class NominalModel(Protocol):
    """A model of rig and specimen without any of the effects that a diagnosis searches."""

    @property
    def name(self) -> str:
        """Name in settings and reports."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters that runs determine."""

    @property
    def variations(self) -> tuple[Variation, ...]:
        """Parts of the prediction that differ from run to run; default: none."""
        return ()

    @property
    def combinations(self) -> tuple[ParameterCombination, ...]:
        """Products of parameters worth reporting; default: none."""
        return ()

    @property
    def zero_sd(self) -> Mapping[str, float]:
        """Standard deviation of the unknown zero of every run, by channel; default: no zeros."""
        return MappingProxyType({})

    @abstractmethod
    def prepare(self, experiment: Experiment) -> Mapping[str, Predictor]:
        """Prepare the channels of a run that the model predicts; empty where it does not apply.

        Raises
        ------
        AnalysisError
            One sentence, where the run lacks a part that the model needs.
        """

    def document(self, values: Mapping[str, float]) -> Mapping[str, object]:
        """Return the contents of a settings file with identified values; default: names and values."""
        return {"nominal": self.name, "parameters": dict(values)}


VALUE_STEP, PRIOR_STEP = 1e-4, 1e-6
"""Steps of derivatives by differences, relative to the value and to the prior's width."""


def central_differences(
    predictor: Predictor, values: FloatArray, time_s: FloatArray, steps: Sequence[float]
) -> FloatArray:
    """Return central differences of a prediction by every parameter, each with its step, shape `(P, n)`."""
    rows = []
    for index, (value, step) in enumerate(zip(values.tolist(), steps, strict=True)):
        ahead, behind = values.copy(), values.copy()
        ahead[index], behind[index] = value + step, value - step
        rows.append((predictor.predict(ahead, time_s).total - predictor.predict(behind, time_s).total) / (2 * step))
    return np.array(rows).reshape(len(values), len(time_s))


UNKNOWN_FORCE_MN = 1e6
"""Uncertainty of a force of which a model knows nothing."""
TURNING_SPEED_MM_S = 0.05
"""Speed over which a direction changes sign, as in the friction model.

A sign function would have no derivative, and no encoder distinguishes a slower creep from rest: at 1 µm per count and
500 Hz one count more or less is 0.25 mm/s.
"""


@dataclass(frozen=True, slots=True, eq=False)
class MotionState:
    """How the stage moves at times of a run, arrays of shape `(n,)`."""

    time_s: FloatArray
    """Since the first sample; rising, not evenly."""
    position_mm: FloatArray
    velocity_mm_s: FloatArray
    acceleration_mm_s2: FloatArray
    """`position_mm`, `velocity_mm_s`, `acceleration_mm_s2`: measured motion, position since the first sample; exactly
    at rest where the stage rests.
    """
    experiment: Experiment
    """The run: protocol, specimen, and everything recorded."""

    @property
    def speed_mm_s(self) -> FloatArray:
        """Velocity without its sign."""
        return np.abs(self.velocity_mm_s)

    @property
    def direction(self) -> FloatArray:
        """1 forwards, -1 backwards, 0 at rest; in between below some 0.05 mm/s."""
        return np.tanh(self.velocity_mm_s / TURNING_SPEED_MM_S)


class ChannelModel(NominalModel):
    """A model of one channel. A subclass gives `name`, `parameters` and the channel as a function of the motion."""

    channel: str = "force"
    """The recorded quantity that is predicted."""
    zero_sd_mN: float = 5.0
    """Standard deviation of the sensor's unknown zero in every run; 0 where the zero is known."""
    run_to_run: float = 0.0
    """Relative standard deviation of the whole prediction between runs; 0 where it does not vary."""
    follows_s: float = inf
    """Time over which the prediction is straight even in steady motion; set it below half a second only where it
    changes quickly there, as cogging does.
    """

    @abstractmethod
    def predict(self, values: Mapping[str, float], at: MotionState) -> FloatArray:
        """Return the channel without its zero, shape `(n,)`, for parameter values by name."""

    def parts(self, values: Mapping[str, float], at: MotionState) -> Mapping[str, FloatArray]:
        """Return parts of the prediction by their place (`ForcePart`), shape `(n,)` each; default: none is known.

        A diagnosis tries the effects of the places that are named, beside those of the sensor.
        """
        del values, at
        return {}

    def suits(self, experiment: Experiment) -> bool:
        """Whether the model applies to a run; default: to every run."""
        del experiment
        return True

    @property
    def variations(self) -> tuple[Variation, ...]:
        """A factor of each run, where runs differ."""
        return (Variation("run_to_run", self.run_to_run),) if self.run_to_run else ()

    @property
    def zero_sd(self) -> Mapping[str, float]:
        """The sensor's zero."""
        return {self.channel: self.zero_sd_mN} if self.zero_sd_mN else {}

    def prepare(self, experiment: Experiment) -> Mapping[str, Predictor]:
        """Prepare a run with the channel that the model applies to; raises `AnalysisError` as `fit_kinematics`."""
        if self.channel not in experiment.run.trace.channels or not self.suits(experiment):
            return {}
        return {self.channel: _ChannelPredictor(self, experiment, fit_kinematics(experiment))}


@dataclass(frozen=True, eq=False)
class _ChannelPredictor(Predictor):
    model: ChannelModel
    experiment: Experiment
    motion: Kinematics

    @property
    def events_s(self) -> FloatArray:
        begin, end = self.motion.joints_s[[0, -1]].tolist()
        if not self.model.follows_s < end - begin:
            return self.motion.events_s
        return np.union1d(self.motion.events_s, np.arange(begin, end, self.model.follows_s))

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        total = self._total(values, time_s)
        return Prediction(total, np.repeat(total[None], len(self.model.variations), axis=0))

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        widths = [0.0 if parameter.positive else PRIOR_STEP * parameter.prior_sd for parameter in self.model.parameters]
        steps = np.maximum(VALUE_STEP * np.abs(values), widths).tolist()
        return central_differences(self, values, time_s, steps)

    def uncertainty(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        by_joints = self.motion.joint_uncertainty(lambda times: self._total(values, times), time_s)
        accelerated = self._total(values, time_s, self.motion.acceleration_error(time_s))
        return np.hypot(by_joints, accelerated - self._total(values, time_s))

    def parts(self, values: FloatArray, time_s: FloatArray) -> Mapping[ForcePart, FloatArray]:
        declared = self.model.parts(self._named(values), self._motion_at(time_s))
        unknown = [name for name in declared if name not in set(ForcePart)]
        if unknown:
            raise AnalysisError(
                f"the model {self.model.name} declares a part {unknown[0]!r} of its force; "
                f"{suggestion(unknown[0], list(ForcePart))}"
            )
        return {ForcePart(name): np.asarray(force, dtype=np.float64) for name, force in declared.items()}

    def _total(self, values: FloatArray, time_s: FloatArray, error: FloatArray | float = 0.0) -> FloatArray:
        return np.asarray(self.model.predict(self._named(values), self._motion_at(time_s, error)), dtype=np.float64)

    def _named(self, values: FloatArray) -> Mapping[str, float]:
        return {parameter.name: float(value) for parameter, value in zip(self.model.parameters, values, strict=True)}

    def _motion_at(self, time_s: FloatArray, error: FloatArray | float = 0.0) -> MotionState:
        motion, experiment = self.motion, self.experiment
        acceleration = motion.acceleration(time_s) + error
        return MotionState(time_s, experiment.position(time_s), motion.velocity(time_s), acceleration, experiment)
