"""What a nominal model is to those who identify, compare and diagnose: parameters, and predicted channels.

A model of one's own is one file with a `MODEL` that fulfils `NominalModel`; deriving from it brings the
defaults. Values of parameters travel as arrays in the order of `NominalModel.parameters`.
"""

from abc import abstractmethod
from collections.abc import Collection, Hashable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

import numpy as np

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.rig.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Parameter:
    """A quantity of a nominal model that runs are to determine, with what is known of it before any run.

    Attributes
    ----------
    name, unit
        As in settings; a unit of `1` for none.
    nominal
        Value before any run.
    prior_sd
        Standard deviation of what is known beforehand: of the value itself, or relative to it when `positive`.
    positive
        Whether the value cannot be 0 or below; its prior is lognormal then, with median `nominal`.
    meaning
        A few words for tables.
    """

    name: str
    unit: str
    nominal: float
    prior_sd: float
    positive: bool = True
    meaning: str = ""


@dataclass(frozen=True, slots=True)
class Variation:
    """A part of the prediction that differs from run to run.

    Attributes
    ----------
    name, sd
        What differs, and by how much: one standard deviation.
    unit
        `1` where the part differs by a factor, `sd` being relative; another where so much of it is added.
    """

    name: str
    sd: float
    unit: str = "1"

    @property
    def usual(self) -> float:
        """What a run has that does not differ: a factor of 1, or nothing added."""
        return 1.0 if self.unit == "1" else 0.0


@dataclass(frozen=True, slots=True)
class Combination:
    """A product of powers of positive parameters, which runs may determine where they cannot tell its factors apart."""

    name: str
    unit: str
    powers: Mapping[str, float]
    meaning: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """A channel at `n` times.

    Attributes
    ----------
    total
        The channel without the sensor's zero, shape `(n,)`.
    varying
        What each of the model's variations multiplies, shape `(V, n)`, in their order.
    """

    total: FloatArray
    varying: FloatArray


class Predictor(Protocol):
    """One channel of one run, prepared: all that does not depend on the parameters is computed already."""

    @property
    def events_s(self) -> FloatArray:
        """Times within the run at which the prediction may jump or bend, shape `(K,)`."""
        ...

    @property
    def likeness(self) -> Hashable:
        """What is equal where the same is predicted whatever the values and times; unless said, each is its own.

        Of predictors that are alike one is asked for all, as of repeats whose motion is the same bit for bit.
        """
        return id(self)

    @abstractmethod
    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Predict the channel at rising times, shape `(n,)`, for parameter values of shape `(P,)`."""

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return the derivative of the predicted total by every parameter, shape `(P, n)`; here by differences."""
        return by_differences(self, values, time_s)

    def sensitivities_without(self, names: Collection[str], values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return `sensitivities`; those by parameters of these names nobody asks for, and they mean nothing."""
        del names
        return self.sensitivities(values, time_s)

    def uncertainty(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return how well the channel can be predicted from the measured motion, one standard deviation, shape `(n,)`.

        A motion that is known to a few µm leaves a start or stop uncertain by milliseconds; here 0.
        """
        del values
        return np.zeros_like(time_s)


class NominalModel(Protocol):
    """A model of rig and specimen without any of the effects that a diagnosis looks for."""

    @property
    def name(self) -> str:
        """What the model is called."""
        ...

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What runs are to determine."""
        ...

    @property
    def variations(self) -> tuple[Variation, ...]:
        """Parts of the prediction that differ from run to run; none unless said."""
        return ()

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """Products of parameters worth reporting; none unless said."""
        return ()

    @property
    def zero_sd(self) -> Mapping[str, float]:
        """Standard deviation of the unknown zero that every run has, by channel; one that is not named has none."""
        return MappingProxyType({})

    @abstractmethod
    def prepare(self, experiment: Experiment) -> Mapping[str, Predictor]:
        """Prepare the channels of a run that the model predicts; empty where it says nothing of such a run.

        Raises
        ------
        AnalysisError
            One sentence, where the run lacks what the model needs.
        """

    def document(self, values: Mapping[str, float]) -> Mapping[str, object]:
        """Return what a settings file holds of identified values: their names and values unless a model says more."""
        return {"nominal": self.name, "parameters": dict(values)}


RELATIVE_STEP = 1e-4


def by_differences(predictor: Predictor, values: FloatArray, time_s: FloatArray) -> FloatArray:
    """Return central differences of a prediction by every parameter, shape `(P, n)`."""
    rows = []
    for index, value in enumerate(values):
        step = RELATIVE_STEP * (abs(float(value)) or 1.0)
        ahead, behind = values.copy(), values.copy()
        ahead[index], behind[index] = value + step, value - step
        rows.append((predictor.predict(ahead, time_s).total - predictor.predict(behind, time_s).total) / (2 * step))
    return np.array(rows).reshape(len(values), len(time_s))
