"""The backends there are: entry points of the group `dragrig.backends`, and their doubles, of `dragrig.doubles`."""

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from inspect import getattr_static
from typing import TypeGuard

from dragrig.config.errors import DeviceError, DragrigError, SettingsError
from dragrig.config.loading import nearest
from dragrig.rig.backend import Backend, BackendRequest

GROUP = "dragrig.backends"
DOUBLES = "dragrig.doubles"


def names() -> tuple[str, ...]:
    """Return the names of all backends that are installed."""
    return _names(GROUP)


def find(name: str, *, double: bool = False) -> EntryPoint:
    """Return the entry point of a backend, or of its double, without loading it.

    Raises
    ------
    SettingsError
        For an unknown one.
    """
    found = entry_points(group=DOUBLES if double else GROUP, name=name)
    if found:
        return next(iter(found))
    if double and name in names():
        raise SettingsError(
            f"backend = {name!r}: has no double; leave out --double, or name one with --backend: "
            f"{', '.join(_names(DOUBLES))}."
        )
    raise SettingsError(f"backend = {name!r}: no such backend is installed; {nearest(name, names())}")


def open_backend(name: str, request: BackendRequest, *, double: bool = False) -> Backend:
    """Load a backend, or its double, and open its devices.

    Raises
    ------
    SettingsError
        For an unknown backend.
    DeviceError
        When it cannot be loaded or what it returns is no backend.
    """
    entry = find(name, double=double)
    try:
        factory: Callable[[BackendRequest], object] = entry.load()
        backend = factory(request)
    except DragrigError:
        raise
    except Exception as error:  # an add-on's own code can fail in any way
        raise DeviceError(
            f"backend {name} ({entry.value}) cannot be opened ({type(error).__name__}: {error}); is it installed whole?"
        ) from error
    if not _is_backend(backend):
        raise DeviceError(f"backend {name} ({entry.value}) returns a {type(backend).__name__}, which is no backend.")
    return backend


def _is_backend(candidate: object) -> TypeGuard[Backend]:
    # Not isinstance, which in Python 3.11 asks a rig that is not connected yet for its devices.
    wanted = [name for name in vars(Backend) if not name.startswith("_")]
    return all(getattr_static(candidate, name, None) is not None for name in wanted)


def _names(group: str) -> tuple[str, ...]:
    return tuple(sorted(entry_points(group=group).names))
