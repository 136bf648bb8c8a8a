"""Nominal models by name, by entry point of the group `dragrig.models`, or from a user's file, checked before use."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from importlib.machinery import SourceFileLoader
from importlib.metadata import entry_points
from importlib.util import module_from_spec, spec_from_file_location
from inspect import getattr_static
from itertools import chain
from math import isfinite
from pathlib import Path
from traceback import extract_tb
from types import CodeType
from typing import TypeGuard

import numpy as np

from dragrig.analysis.models.capsule_model import CapsuleModel
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.models.nominal_model import (
    ForcePart,
    NominalModel,
    Parameter,
    ParameterCombination,
    Prediction,
    Predictor,
    Variation,
)
from dragrig.config import (
    AmendedModelSettings,
    AnalysisError,
    DragrigError,
    FrictionModelSettings,
    ModelSettings,
    SettingsError,
    parse,
    read_toml,
    suggestion,
)
from dragrig.rig import FloatArray

ENTRY_POINT_GROUP = "dragrig.models"
SHIPPED_PREFIX = "dragrig."
MODEL_ATTRIBUTE = "MODEL"
REQUIRED_MEMBERS = tuple(name for name in vars(NominalModel) if not name.startswith("_"))
TRIAL_TIMES = 16
"""Times of a run at which a predictor is evaluated once when it is prepared."""


def model_names() -> tuple[str, ...]:
    """Return the names of all installed models."""
    return tuple(sorted(entry_points(group=ENTRY_POINT_GROUP).names))


def find_model(name_or_file: str) -> NominalModel:
    """Find a nominal model.

    Parameters
    ----------
    name_or_file
        Name of an installed model, path of a Python file with a `MODEL`, or of a model as TOML: a friction model,
        which becomes the capsule model's nominal settings, or a diagnosis's form of another model.

    Returns
    -------
    The model. Any failure in the code of a model that does not ship is an `AnalysisError` that names the line.

    Raises
    ------
    SettingsError
        For an unknown name, and for a file or entry point that cannot be loaded or holds no nominal model.
    """
    path = Path(name_or_file)
    if path.suffix in {".py", ".toml"} or len(path.parts) > 1:
        if not path.is_file():
            raise SettingsError(f"{name_or_file}: there is no such file; check the path of the model.")
        if path.suffix == ".toml":
            return nominal_model(parse_model_settings(read_toml(path), str(path)))
        return CheckedModel.of(_load_file(path.resolve()), str(path), path.resolve())
    entry = next(iter(entry_points(group=ENTRY_POINT_GROUP, name=name_or_file)), None)
    if entry is None:
        raise SettingsError(
            f"{name_or_file}: no such model is installed, and it is no file either (.py, .toml); "
            f"{suggestion(name_or_file, model_names())}"
        )
    source = f"model {entry.name} ({entry.value})"
    try:
        model: object = entry.load()
    except DragrigError:
        raise
    except Exception as error:  # an add-on's own code can fail in any way
        raise SettingsError(
            f"{source} cannot be loaded ({type(error).__name__}: {error}); is it installed completely?"
        ) from error
    if entry.value.startswith(SHIPPED_PREFIX) and _is_model(model):
        return model
    return CheckedModel.of(model, source)


def parse_model_settings(table: Mapping[str, object], source: str) -> ModelSettings:
    """Return a friction model, or a diagnosis's form of another model; raises `SettingsError`.

    Where the file of one's own model is no longer where it was, one of its name beside the source is taken.

    Parameters
    ----------
    source
        Path that the table comes from, or another name of its origin.
    """
    if "nominal" not in table:
        return parse(FrictionModelSettings, table, source)
    settings = parse(AmendedModelSettings, table, source)
    file = Path(settings.nominal)
    beside = Path(source).parent / file.name
    if file.suffix == ".py" and not file.is_file() and beside.is_file():
        return settings.model_copy(update={"nominal": str(beside)})
    return settings


def nominal_model(settings: ModelSettings) -> NominalModel:
    """Return the model of these settings; raises `SettingsError` as `find_model`, and for other parameters."""
    if isinstance(settings, FrictionModelSettings):
        return CapsuleModel(settings)
    own = find_model(settings.nominal)
    now = [parameter.name for parameter in own.parameters]
    if set(settings.parameters) != set(now):
        raise SettingsError(
            f"{settings.nominal}: its parameters are {', '.join(now)}, and were {', '.join(settings.parameters)} when "
            "it was diagnosed; diagnose again."
        )
    return AmendedModel(own, settings)


def model_reference(model: NominalModel) -> str:
    """Return the name or file by which `find_model` finds a model; empty where it has neither."""
    if isinstance(model, AmendedModel):
        return model.settings.nominal
    if isinstance(model, CheckedModel) and model.file is not None:
        return str(model.file)
    return model.name if model.name in model_names() else ""


@dataclass(frozen=True)
class _ModelOfAnother(NominalModel):
    """A model that speaks as another one does, unless it knows better."""

    own: NominalModel
    """The other model."""

    @property
    def name(self) -> str:
        """Name in settings and reports."""
        return self.own.name

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters that runs determine."""
        return tuple(self.own.parameters)

    @property
    def variations(self) -> tuple[Variation, ...]:
        """Parts of the prediction that differ from run to run."""
        return tuple(self.own.variations)

    @property
    def combinations(self) -> tuple[ParameterCombination, ...]:
        """Products of parameters worth reporting."""
        return tuple(self.own.combinations)

    @property
    def zero_sd(self) -> Mapping[str, float]:
        """Standard deviation of the unknown zero of every run, by channel."""
        return self.own.zero_sd

    def prepare(self, experiment: Experiment) -> Mapping[str, Predictor]:
        """Prepare the channels of a run."""
        return self.own.prepare(experiment)

    def document(self, values: Mapping[str, float]) -> Mapping[str, object]:
        """Return the contents of a settings file with identified values."""
        return self.own.document(values)


@dataclass(frozen=True)
class AmendedModel(_ModelOfAnother):
    """A model other than the friction model, expected to have the values, and the effects, of a diagnosis."""

    settings: AmendedModelSettings
    """Values of its parameters, and effects."""

    @property
    def name(self) -> str:
        """Name in reports."""
        return f"{self.own.name}, {self.settings.name}"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the model, around their values in the settings."""
        return tuple(
            replace(parameter, nominal=self.settings.parameters[parameter.name]) for parameter in self.own.parameters
        )


def _is_model(candidate: object) -> TypeGuard[NominalModel]:
    return all(getattr_static(candidate, name, None) is not None for name in REQUIRED_MEMBERS)


class _UncachedLoader(SourceFileLoader):
    """Loads a file as it is: cached code is valid by the second, and a model may be edited faster than that."""

    def get_code(self, fullname: str) -> CodeType:  # noqa: ARG002  # as the loader calls it
        return self.source_to_code(self.get_data(self.path), self.path)


def _load_file(path: Path) -> object:
    # Two files of one name must not be one module, nor shadow an installed one.
    name = f"_dragrig_model_{sha256(str(path).encode()).hexdigest()[:16]}"
    spec = spec_from_file_location(name, path, loader=_UncachedLoader(name, str(path)))
    if spec is None or spec.loader is None:
        raise SettingsError(f"{path}: is not a Python file; name a file that ends in .py.")
    module = module_from_spec(spec)
    sys.modules[name] = module
    # A model may import what lies beside it, while it is loaded.
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # a user's own code can fail in any way
        del sys.modules[name]
        raise SettingsError(f"{path}: {_describe_error(error, path)}; correct the model and try again.") from error
    finally:
        sys.path.remove(str(path.parent))
    if not hasattr(module, MODEL_ATTRIBUTE):
        close = suggestion(MODEL_ATTRIBUTE, [name for name in vars(module) if not name.startswith("_")])
        hint = f"; {close.rstrip('?')} meant to be it?" if close.startswith("did you mean") else ""
        raise SettingsError(f"{path}: holds no {MODEL_ATTRIBUTE}; end it with {MODEL_ATTRIBUTE} = YourModel(){hint}.")
    return vars(module)[MODEL_ATTRIBUTE]


def _describe_error(error: Exception, file: Path | None) -> str:
    """Line and message of an error in a user's code; the line is the last one in their file, if there is one."""
    if isinstance(error, SyntaxError) and error.filename:
        where, line, fault = error.filename, error.lineno, error.msg
    else:
        frames = extract_tb(error.__traceback__)
        frame = ([frame for frame in frames if file is not None and Path(frame.filename) == file] or frames)[-1]
        where, line, fault = frame.filename, frame.lineno, f"{type(error).__name__}: {str(error) or 'no message'}"
    in_file = file is not None and Path(where) == file
    return f"line {line}: {fault}" if in_file else f"{where}, line {line}: {fault}"


@dataclass(frozen=True)
class CheckedModel(_ModelOfAnother):
    """A user's model, whose declarations and answers are checked and whose errors become one sentence each."""

    source: str
    """Its origin, for messages."""
    file: Path | None = None
    """Its file, if it has one."""

    @classmethod
    def of(cls, candidate: object, source: str, file: Path | None = None) -> "CheckedModel":
        """Check a candidate; raises `SettingsError` where it is no model or its declarations are wrong."""
        if isinstance(candidate, type):
            name = candidate.__name__
            raise SettingsError(f"{source}: {MODEL_ATTRIBUTE} is the class {name}; write {name}().")
        if not _is_model(candidate):
            missing = [name for name in REQUIRED_MEMBERS if getattr_static(candidate, name, None) is None]
            raise SettingsError(
                f"{source}: {MODEL_ATTRIBUTE} is a {type(candidate).__name__} without {' and '.join(missing)}, which "
                "is no nominal model; derive its class from ChannelModel or NominalModel."
            )
        model = cls(candidate, source, file)
        with model.reported():
            error = next(chain(_type_errors(candidate), _value_errors(candidate)), None)
        if error is not None:
            raise SettingsError(f"{source}: the model cannot be used: {error}.")
        return model

    def prepare(self, experiment: Experiment) -> Mapping[str, Predictor]:
        """Prepare a run and evaluate the predictors once; raises `AnalysisError`."""
        with self.reported(experiment):
            prepared = self.own.prepare(experiment)
        if not isinstance(prepared, Mapping):
            raise self.error(
                experiment, f"prepare returned {prepared!r:.40}; return a predictor by channel, {{}} if none"
            )
        channels = experiment.run.trace.channels
        for channel in prepared:
            if channel not in channels:
                known = ", ".join(sorted(channels))
                raise self.error(experiment, f"it predicts {channel!r}, which the run did not record (only {known})")
        checked = {channel: CheckedPredictor(self, predictor, experiment) for channel, predictor in prepared.items()}
        for predictor in checked.values():
            predictor.evaluate_once()
        return checked

    def document(self, values: Mapping[str, float]) -> Mapping[str, object]:
        """Return the contents of a settings file with identified values."""
        with self.reported():
            return self.own.document(values)

    def error(self, experiment: Experiment | None, fault: str) -> AnalysisError:
        """Return an error that names the model and the run."""
        where = f" at {experiment.file}" if experiment is not None else ""
        return AnalysisError(f"{self.source}: the model {self.name!s} fails{where}: {fault}.")

    @contextmanager
    def reported(self, experiment: Experiment | None = None) -> Iterator[None]:
        """Turn whatever the model's own code raises into an `AnalysisError` of one sentence."""
        try:
            yield
        except DragrigError:
            raise
        except Exception as error:  # a user's own code can fail in any way
            raise self.error(experiment, _describe_error(error, self.file)) from error


@dataclass(frozen=True, eq=False)
class CheckedPredictor(Predictor):
    """A predictor whose answers are checked for their shapes."""

    model: CheckedModel
    own: Predictor
    experiment: Experiment

    @property
    def events_s(self) -> FloatArray:
        """Times at which the prediction may jump or bend."""
        with self.model.reported(self.experiment):
            return np.asarray(self.own.events_s, dtype=np.float64)

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Predict the channel."""
        with self.model.reported(self.experiment):
            prediction = self.own.predict(values, time_s)
            total, varying = np.asarray(prediction.total, np.float64), np.asarray(prediction.varying, np.float64)
        self._require_shape("predict's total", total, (len(time_s),))
        self._require_shape("predict's varying", varying, (len(self.model.variations), len(time_s)))
        return Prediction(total, varying)

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return the derivative of the predicted total by every parameter."""
        with self.model.reported(self.experiment):
            rows = np.asarray(self.own.sensitivities(values, time_s), dtype=np.float64)
        return self._require_shape("sensitivities", rows, (len(self.model.parameters), len(time_s)))

    def parts(self, values: FloatArray, time_s: FloatArray) -> Mapping[ForcePart, FloatArray]:
        """Return the parts of the prediction whose place is known."""
        with self.model.reported(self.experiment):
            declared: Mapping[ForcePart, FloatArray] = self.own.parts(values, time_s)
            parts = {ForcePart(name): np.asarray(force, np.float64) for name, force in declared.items()}
        for name, force in parts.items():
            self._require_shape(f"parts' {name}", force, (len(time_s),))
        return parts

    def uncertainty(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return how well the channel can be predicted from the measured motion."""
        with self.model.reported(self.experiment):
            uncertainty = np.asarray(self.own.uncertainty(values, time_s), dtype=np.float64)
        return self._require_shape("uncertainty", uncertainty, (len(time_s),))

    def evaluate_once(self) -> None:
        """Evaluate everything with the nominal values; raises `AnalysisError`."""
        values = np.array([parameter.nominal for parameter in self.model.parameters], dtype=np.float64)
        time = np.linspace(0.0, float(self.experiment.time_s[-1]), TRIAL_TIMES)
        prediction = self.predict(values, time)
        answers = {
            "predict's total": prediction.total,
            "predict's varying": prediction.varying,
            "sensitivities": self.sensitivities(values, time),
            "uncertainty": self.uncertainty(values, time),
            **{f"parts' {name}": force for name, force in self.parts(values, time).items()},
            "events_s": self._require_shape("events_s", self.events_s, self.events_s.shape[:1]),
        }
        for name, answer in answers.items():
            if not np.isfinite(answer).all():
                raise self.model.error(self.experiment, f"{name} holds NaN or infinity at the nominal values")

    def _require_shape(self, name: str, answer: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        if answer.shape != shape:
            raise self.model.error(self.experiment, f"{name} has the shape {answer.shape}, and must have {shape}")
        return answer


def _type_errors(model: NominalModel) -> Iterator[str]:
    """Yield wrong types among a model's declarations, a clause each."""
    name: object = model.name
    if not isinstance(name, str) or not name:
        yield f"its name is {name!r}, and must be some text"
    kinds = {"parameters": Parameter, "variations": Variation, "combinations": ParameterCombination}
    for attribute, kind in kinds.items():
        members: object = getattr(model, attribute)
        if not isinstance(members, Sequence):
            yield f"its {attribute} are a {type(members).__name__}, and must be a tuple of {kind.__name__}"
            continue
        for member in members:
            if not isinstance(member, kind):
                yield f"{member!r:.60} among its {attribute} is no {kind.__name__}"


def _value_errors(model: NominalModel) -> Iterator[str]:
    """Yield wrong numbers and names of a model whose declarations have the right types, a clause each."""
    if not model.parameters:
        yield "it has no parameters, so that there is nothing to identify"
    yield from _duplicate_errors("parameter", [parameter.name for parameter in model.parameters])
    yield from _duplicate_errors("variation", [variation.name for variation in model.variations])
    for parameter in model.parameters:
        yield from _parameter_errors(parameter)
    positive = [parameter.name for parameter in model.parameters if parameter.positive]
    for variation in model.variations:
        if not _is_positive(variation.sd):
            yield f"variation {variation.name} has sd = {variation.sd!r}, which must be above 0"
    factors = ((combination.name, factor) for combination in model.combinations for factor in combination.powers)
    for name, factor in factors:
        if factor not in positive:
            hint = suggestion(factor, positive).rstrip(".")
            yield f"combination {name} is made of {factor}, which is no positive parameter; {hint}"
    for channel, sd in model.zero_sd.items():
        if not _is_positive(sd):
            yield f"zero_sd of {channel} is {sd!r}, and must be above 0"


def _duplicate_errors(noun: str, names: Sequence[str]) -> Iterator[str]:
    for name in dict.fromkeys(name for name in names if names.count(name) > 1):
        yield f"{noun} {name} is there {names.count(name)} times; each name may be used once"


def _parameter_errors(parameter: Parameter) -> Iterator[str]:
    name, nominal = parameter.name, parameter.nominal
    if not _is_positive(parameter.prior_sd):
        yield f"parameter {name} has prior_sd = {parameter.prior_sd!r}, which must be above 0"
    if not _is_finite_number(nominal):
        yield f"parameter {name} has nominal = {nominal!r}, which is no finite number"
    elif parameter.positive and nominal <= 0:
        yield f"parameter {name} has nominal = {nominal!r}; give one above 0, or positive=False"


def _is_finite_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float) and _is_finite_number(value) and value > 0
