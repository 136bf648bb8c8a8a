"""Nominal models by name, by entry point of the group `dragrig.models`, or from a user's file, checked before use."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from importlib.machinery import SourceFileLoader
from importlib.metadata import EntryPoint, entry_points
from importlib.util import module_from_spec, spec_from_file_location
from inspect import getattr_static
from itertools import chain
from math import isfinite
from pathlib import Path
from traceback import extract_tb
from types import CodeType, ModuleType
from typing import TypeGuard

import numpy as np

from dragrig.analysis.models.capsule_model import CapsuleModel
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.models.nominal_model import Combination, NominalModel, Parameter, Prediction, Predictor, Variation
from dragrig.config.errors import AnalysisError, DragrigError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.settings import load_settings, suggestion
from dragrig.rig.arrays import FloatArray


def declaration_errors(model: NominalModel) -> Iterator[str]:
    """Yield what is wrong with name, parameters, variations, combinations and zeros, a clause each."""
    name: object = model.name
    if not isinstance(name, str) or not name:
        yield f"its name is {name!r}, and must be some text"
    members = (("parameters", Parameter), ("variations", Variation), ("combinations", Combination))
    for attribute, kind in members:
        yield from _type_errors(attribute, getattr(model, attribute), kind)


def value_errors(model: NominalModel) -> Iterator[str]:
    """Yield what is wrong with numbers and names of a model whose declarations are of the right types."""
    if not model.parameters:
        yield "it has no parameters, so that there is nothing to identify"
    for what, named in (("parameter", model.parameters), ("variation", model.variations)):
        yield from _duplicate_errors(what, [one.name for one in named])
    for parameter in model.parameters:
        yield from _parameter_errors(parameter)
    for variation in model.variations:
        if not _is_positive(variation.sd):
            yield f"variation {variation.name} has sd = {variation.sd!r}, which must be above 0"
    for combination in model.combinations:
        yield from _combination_errors(combination, [one.name for one in model.parameters if one.positive])
    for channel, sd in model.zero_sd.items():
        if not _is_positive(sd):
            yield f"zero_sd of {channel} is {sd!r}, and must be above 0"


def _type_errors(attribute: str, members: object, kind: type) -> Iterator[str]:
    if not isinstance(members, Sequence):
        yield f"its {attribute} are a {type(members).__name__}, and must be a tuple of {kind.__name__}"
        return
    for one in members:
        if not isinstance(one, kind):
            yield f"{one!r:.60} among its {attribute} is no {kind.__name__}"


def _duplicate_errors(what: str, names: Sequence[str]) -> Iterator[str]:
    for name in dict.fromkeys(one for one in names if names.count(one) > 1):
        yield f"{what} {name} is there {names.count(name)} times; each name may be used once"


def _parameter_errors(parameter: Parameter) -> Iterator[str]:
    name = parameter.name
    if not _is_positive(parameter.prior_sd):
        yield f"parameter {name} has prior_sd = {parameter.prior_sd!r}, which must be above 0"
    if not _is_finite_number(parameter.nominal):
        yield f"parameter {name} has nominal = {parameter.nominal!r}, which is no finite number"
    elif parameter.positive and parameter.nominal <= 0:
        yield f"parameter {name} has nominal = {parameter.nominal!r}; give one above 0, or positive=False"


def _combination_errors(combination: Combination, positive: Sequence[str]) -> Iterator[str]:
    for factor in combination.powers:
        if factor not in positive:
            hint = suggestion(factor, positive).rstrip(".")
            yield f"combination {combination.name} is made of {factor}, which is no positive parameter; {hint}"


def _is_finite_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float) and _is_finite_number(value) and value > 0


TRIAL_TIMES = 16
"""Times of a run at which a prediction is tried when it is prepared."""


def describe_error(error: Exception, file: Path | None) -> str:
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
class CheckedModel(NominalModel):
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
    def of(cls, own: NominalModel, source: str, file: Path | None = None) -> "CheckedModel":
        """Guard a model; raises `SettingsError` where it contradicts itself."""
        guarded = cls(own, source, file)
        with guarded.mended():
            wrong = next(chain(declaration_errors(own), value_errors(own)), None)
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
        found = {channel: CheckedPredictor(self, one, experiment) for channel, one in prepared.items()}
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
            raise self.fault(experiment, describe_error(error, self.file)) from error


@dataclass(frozen=True, eq=False)
class CheckedPredictor(Predictor):
    """A predictor that answers in the right shapes, or says that it does not."""

    model: CheckedModel
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
        time = np.linspace(0.0, float(self.experiment.time_s[-1]), TRIAL_TIMES)
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


ENTRY_POINT_GROUP = "dragrig.models"
SHIPPED_PREFIX = "dragrig."
MODEL_ATTRIBUTE = "MODEL"
REQUIRED_MEMBERS = tuple(name for name in vars(NominalModel) if not name.startswith("_"))


def model_names() -> tuple[str, ...]:
    """Return the names of all models that are installed."""
    return tuple(sorted(entry_points(group=ENTRY_POINT_GROUP).names))


def find_model(name_or_file: str, beside: Path | None = None) -> NominalModel:
    """Find a nominal model.

    Parameters
    ----------
    name_or_file
        Name of an installed model, path of a Python file that holds a `MODEL`, or of a friction model as TOML, from
        which the capsule model then counts.
    beside
        Folder from which a relative path counts besides the working folder.

    Returns
    -------
    The model. One that does not ship is guarded: whatever goes wrong in its code is an `AnalysisError` that names
    the line.

    Raises
    ------
    SettingsError
        For an unknown name, and for a file or entry point that cannot be loaded or holds no nominal model.
    """
    path = Path(name_or_file)
    if path.suffix in {".py", ".toml"} or len(path.parts) > 1:
        found = next((one for one in (path, *([beside / path] if beside else [])) if one.is_file()), None)
        if found is None:
            raise SettingsError(f"{name_or_file}: there is no such file; check the path of the model.")
        if found.suffix == ".toml":
            return CapsuleModel(load_settings(FrictionModelSettings, found))
        file = found.resolve()
        return _checked_model(_load_file(file), str(found), file)
    entry = next(iter(entry_points(group=ENTRY_POINT_GROUP, name=name_or_file)), None)
    if entry is None:
        raise SettingsError(
            f"{name_or_file}: no such model is installed, and it is no file either (.py, .toml); "
            f"{suggestion(name_or_file, model_names())}"
        )
    model, source = _load_entry_point(entry), f"model {entry.name} ({entry.value})"
    if entry.value.startswith(SHIPPED_PREFIX) and _is_model(model):
        return model
    return _checked_model(model, source)


def _checked_model(candidate: object, source: str, file: Path | None = None) -> NominalModel:
    if isinstance(candidate, type):
        raise SettingsError(
            f"{source}: {MODEL_ATTRIBUTE} is the class {candidate.__name__}; write {candidate.__name__}()."
        )
    if not _is_model(candidate):
        lacking = [one for one in REQUIRED_MEMBERS if getattr_static(candidate, one, None) is None]
        raise SettingsError(
            f"{source}: {MODEL_ATTRIBUTE} is a {type(candidate).__name__} without {' and '.join(lacking)}, which is no "
            "nominal model; derive its class from ChannelModel or NominalModel."
        )
    return CheckedModel.of(candidate, source, file)


def _is_model(candidate: object) -> TypeGuard[NominalModel]:
    return all(getattr_static(candidate, one, None) is not None for one in REQUIRED_MEMBERS)


def _load_entry_point(entry: EntryPoint) -> object:
    try:
        return entry.load()
    except DragrigError:
        raise
    except Exception as error:  # an add-on's own code can fail in any way
        raise SettingsError(
            f"model {entry.name} ({entry.value}) cannot be loaded ({type(error).__name__}: {error}); "
            "is it installed whole?"
        ) from error


def _load_file(path: Path) -> object:
    module = _load_module(path)
    if not hasattr(module, MODEL_ATTRIBUTE):
        close = suggestion(MODEL_ATTRIBUTE, [name for name in vars(module) if not name.startswith("_")])
        hint = f"; {close.rstrip('?')} meant to be it?" if close.startswith("did you mean") else ""
        raise SettingsError(f"{path}: holds no {MODEL_ATTRIBUTE}; end it with {MODEL_ATTRIBUTE} = YourModel(){hint}.")
    return vars(module)[MODEL_ATTRIBUTE]


class _UncachedLoader(SourceFileLoader):
    """Loads a file as it is now: compiled code is looked up by the second, and models are changed faster than that."""

    def get_code(self, fullname: str) -> CodeType:  # noqa: ARG002  # as the loader calls it
        return self.source_to_code(self.get_data(self.path), self.path)


def _load_module(path: Path) -> ModuleType:
    # Two files of one name must not be one module, and none may pass for an installed one.
    name = f"_dragrig_model_{sha256(str(path).encode()).hexdigest()[:16]}"
    spec = spec_from_file_location(name, path, loader=_UncachedLoader(name, str(path)))
    if spec is None or spec.loader is None:
        raise SettingsError(f"{path}: is not a Python file; name a file that ends in .py.")
    module = module_from_spec(spec)
    sys.modules[name] = module
    try:
        with _importable_folder(path.parent):
            spec.loader.exec_module(module)
    except Exception as error:  # a person's own code can fail in any way
        del sys.modules[name]
        raise SettingsError(f"{path}: {describe_error(error, path)}; mend the model and try again.") from error
    return module


@contextmanager
def _importable_folder(folder: Path) -> Iterator[None]:
    """Let a model import what lies beside it, while it is loaded and no longer."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
