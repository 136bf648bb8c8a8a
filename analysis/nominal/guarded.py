"""A person's own nominal model, of which nothing is taken on trust."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from traceback import extract_tb

import numpy as np

from dragrig.analysis.nominal.declared import wrong_declarations, wrong_numbers
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.nominal.protocol import Combination, NominalModel, Parameter, Prediction, Predictor, Variation
from dragrig.config.errors import AnalysisError, DragrigError, SettingsError
from dragrig.rig.arrays import FloatArray

TRIED = 16
"""Times of a run at which a prediction is tried when it is prepared."""


def told(error: Exception, file: Path | None) -> str:
    """Say an error of a person's own code: where and what. The line is the last one in their file, if there is one."""
    if isinstance(error, SyntaxError) and error.filename:
        where, line, what = error.filename, error.lineno, error.msg
    else:
        lines = extract_tb(error.__traceback__)
        at = ([one for one in lines if file is not None and Path(one.filename) == file] or lines)[-1]
        where, line, what = at.filename, at.lineno, f"{type(error).__name__}: {str(error) or 'no message'}"
    known = file is not None and Path(where) == file
    return f"line {line}: {what}" if known else f"{where}, line {line}: {what}"


@dataclass(frozen=True)
class GuardedModel(NominalModel):
    """A nominal model whose mistakes are one sentence each.

    Attributes
    ----------
    own
        The model itself.
    source
        Where it comes from, for messages.
    file
        Its file, where it is one.
    """

    own: NominalModel
    source: str
    file: Path | None = None

    @classmethod
    def of(cls, own: NominalModel, source: str, file: Path | None = None) -> "GuardedModel":
        """Guard a model; raises `SettingsError` where it contradicts itself."""
        guarded = cls(own, source, file)
        with guarded.mended():
            wrong = next(chain(wrong_declarations(own), wrong_numbers(own)), None)
        if wrong is not None:
            raise SettingsError(f"{source}: the model cannot be used: {wrong}.")
        return guarded

    @property
    def name(self) -> str:
        """What the model is called."""
        return self.own.name

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What runs are to determine."""
        return tuple(self.own.parameters)

    @property
    def variations(self) -> tuple[Variation, ...]:
        """Parts of the prediction that differ from run to run."""
        return tuple(self.own.variations)

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """Products of parameters worth reporting."""
        return tuple(self.own.combinations)

    @property
    def zero_sd(self) -> Mapping[str, float]:
        """Standard deviation of the unknown zero that every run has, by channel."""
        return self.own.zero_sd

    def prepare(self, experiment: Experiment) -> Mapping[str, Predictor]:
        """Prepare a run and try what comes out; raises `AnalysisError`."""
        with self.mended(experiment):
            prepared = self.own.prepare(experiment)
        if not isinstance(prepared, Mapping):
            raise self.fault(
                experiment, f"prepare returned {prepared!r:.40}; return a predictor by channel, {{}} if none"
            )
        channels = experiment.run.trace.channels
        for channel in prepared:
            if channel not in channels:
                known = ", ".join(sorted(channels))
                raise self.fault(experiment, f"it predicts {channel!r}, which the run did not record (only {known})")
        found = {channel: GuardedPredictor(self, one, experiment) for channel, one in prepared.items()}
        for predictor in found.values():
            predictor.try_out()
        return found

    def document(self, values: Mapping[str, float]) -> Mapping[str, object]:
        """Return what a settings file holds of identified values."""
        with self.mended():
            return self.own.document(values)

    def fault(self, experiment: Experiment | None, what: str) -> AnalysisError:
        """Return an error that says what is wrong with the model, and at which run."""
        where = f" at {experiment.file}" if experiment is not None else ""
        return AnalysisError(f"{self.source}: the model {self.name!s} fails{where}: {what}.")

    @contextmanager
    def mended(self, experiment: Experiment | None = None) -> Iterator[None]:
        """Turn whatever the model's own code raises into an `AnalysisError` of one sentence."""
        try:
            yield
        except DragrigError:
            raise
        except Exception as error:  # a person's own code can fail in any way
            raise self.fault(experiment, told(error, self.file)) from error


@dataclass(frozen=True, eq=False)
class GuardedPredictor(Predictor):
    """A predictor that answers in the right shapes, or says that it does not."""

    model: GuardedModel
    own: Predictor
    experiment: Experiment

    @property
    def events_s(self) -> FloatArray:
        """Times at which the prediction may jump or bend."""
        with self.model.mended(self.experiment):
            return np.asarray(self.own.events_s, dtype=np.float64)

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Predict the channel."""
        with self.model.mended(self.experiment):
            found = self.own.predict(values, time_s)
            total, varying = np.asarray(found.total, np.float64), np.asarray(found.varying, np.float64)
        self._shaped("predict's total", total, (len(time_s),))
        self._shaped("predict's varying", varying, (len(self.model.variations), len(time_s)))
        return Prediction(total, varying)

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return the derivative of the predicted total by every parameter."""
        with self.model.mended(self.experiment):
            found = np.asarray(self.own.sensitivities(values, time_s), dtype=np.float64)
        return self._shaped("sensitivities", found, (len(self.model.parameters), len(time_s)))

    def uncertainty(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return how well the channel can be predicted from the measured motion."""
        with self.model.mended(self.experiment):
            found = np.asarray(self.own.uncertainty(values, time_s), dtype=np.float64)
        return self._shaped("uncertainty", found, (len(time_s),))

    def try_out(self) -> None:
        """Ask for everything once, with the nominal values; raises `AnalysisError`."""
        values = np.array([one.nominal for one in self.model.parameters], dtype=np.float64)
        time = np.linspace(0.0, float(self.experiment.time_s[-1]), TRIED)
        prediction = self.predict(values, time)
        answers = {
            "predict's total": prediction.total,
            "predict's varying": prediction.varying,
            "sensitivities": self.sensitivities(values, time),
            "uncertainty": self.uncertainty(values, time),
            "events_s": self._shaped("events_s", self.events_s, self.events_s.shape[:1]),
        }
        for name, answer in answers.items():
            if not np.isfinite(answer).all():
                raise self.model.fault(self.experiment, f"{name} holds NaN or infinity at the nominal values")

    def _shaped(self, name: str, found: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        if found.shape != shape:
            raise self.model.fault(self.experiment, f"{name} has the shape {found.shape}, and must have {shape}")
        return found
