"""Nominal models by name, from entry points of the group `dragrig.models`, or from a person's own file."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from importlib.machinery import SourceFileLoader
from importlib.metadata import EntryPoint, entry_points
from importlib.util import module_from_spec, spec_from_file_location
from inspect import getattr_static
from pathlib import Path
from types import CodeType, ModuleType
from typing import TypeGuard

from dragrig.analysis.nominal.capsule import CapsuleModel
from dragrig.analysis.nominal.guarded import GuardedModel, told
from dragrig.analysis.nominal.protocol import NominalModel
from dragrig.config.errors import DragrigError, SettingsError
from dragrig.config.loading import load, nearest
from dragrig.config.model import FrictionModelSettings

GROUP = "dragrig.models"
SHIPPED = "dragrig."
ATTRIBUTE = "MODEL"
NEEDED = tuple(name for name in vars(NominalModel) if not name.startswith("_"))


def names() -> tuple[str, ...]:
    """Return the names of all models that are installed."""
    return tuple(sorted(entry_points(group=GROUP).names))


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
            return CapsuleModel(load(FrictionModelSettings, found))
        file = found.resolve()
        return _guarded(_from_file(file), str(found), file)
    entry = next(iter(entry_points(group=GROUP, name=name_or_file)), None)
    if entry is None:
        raise SettingsError(
            f"{name_or_file}: no such model is installed, and it is no file either (.py, .toml); "
            f"{nearest(name_or_file, names())}"
        )
    model, source = _loaded(entry), f"model {entry.name} ({entry.value})"
    if entry.value.startswith(SHIPPED) and _is_model(model):
        return model
    return _guarded(model, source)


def _guarded(candidate: object, source: str, file: Path | None = None) -> NominalModel:
    if isinstance(candidate, type):
        raise SettingsError(f"{source}: {ATTRIBUTE} is the class {candidate.__name__}; write {candidate.__name__}().")
    if not _is_model(candidate):
        lacking = [one for one in NEEDED if getattr_static(candidate, one, None) is None]
        raise SettingsError(
            f"{source}: {ATTRIBUTE} is a {type(candidate).__name__} without {' and '.join(lacking)}, which is no "
            "nominal model; derive its class from ChannelModel or NominalModel."
        )
    return GuardedModel.of(candidate, source, file)


def _is_model(candidate: object) -> TypeGuard[NominalModel]:
    return all(getattr_static(candidate, one, None) is not None for one in NEEDED)


def _loaded(entry: EntryPoint) -> object:
    try:
        return entry.load()
    except DragrigError:
        raise
    except Exception as error:  # an add-on's own code can fail in any way
        raise SettingsError(
            f"model {entry.name} ({entry.value}) cannot be loaded ({type(error).__name__}: {error}); "
            "is it installed whole?"
        ) from error


def _from_file(path: Path) -> object:
    module = _module(path)
    if not hasattr(module, ATTRIBUTE):
        close = nearest(ATTRIBUTE, [name for name in vars(module) if not name.startswith("_")])
        hint = f"; {close.rstrip('?')} meant to be it?" if close.startswith("did you mean") else ""
        raise SettingsError(f"{path}: holds no {ATTRIBUTE}; end it with {ATTRIBUTE} = YourModel(){hint}.")
    return vars(module)[ATTRIBUTE]


class _Fresh(SourceFileLoader):
    """Loads a file as it is now: compiled code is looked up by the second, and models are changed faster than that."""

    def get_code(self, fullname: str) -> CodeType:  # noqa: ARG002  # as the loader calls it
        return self.source_to_code(self.get_data(self.path), self.path)


def _module(path: Path) -> ModuleType:
    # Two files of one name must not be one module, and none may pass for an installed one.
    name = f"_dragrig_model_{sha256(str(path).encode()).hexdigest()[:16]}"
    spec = spec_from_file_location(name, path, loader=_Fresh(name, str(path)))
    if spec is None or spec.loader is None:
        raise SettingsError(f"{path}: is not a Python file; name a file that ends in .py.")
    module = module_from_spec(spec)
    sys.modules[name] = module
    try:
        with _beside(path.parent):
            spec.loader.exec_module(module)
    except Exception as error:  # a person's own code can fail in any way
        del sys.modules[name]
        raise SettingsError(f"{path}: {told(error, path)}; mend the model and try again.") from error
    return module


@contextmanager
def _beside(folder: Path) -> Iterator[None]:
    """Let a model import what lies beside it, while it is loaded and no longer."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
