"""The backends there are: entry points of the group `dragrig.backends`."""

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points

from dragrig.config.errors import DeviceError, DragrigError, SettingsError
from dragrig.config.loading import nearest
from dragrig.rig.backend import Backend, BackendRequest

GROUP = "dragrig.backends"


def names() -> tuple[str, ...]:
    """Return the names of all backends that are installed."""
    return tuple(sorted(entry_points(group=GROUP).names))


def find(name: str) -> EntryPoint:
    """Return the entry point of a backend without loading it; raises `SettingsError` for an unknown one."""
    found = entry_points(group=GROUP, name=name)
    if not found:
        raise SettingsError(f"backend = {name!r}: no such backend is installed; {nearest(name, names())}")
    return next(iter(found))


def open_backend(name: str, request: BackendRequest) -> Backend:
    """Load a backend and open its devices.

    Raises
    ------
    SettingsError
        For an unknown backend.
    DeviceError
        When it cannot be loaded or what it returns is no backend.
    """
    entry = find(name)
    try:
        factory: Callable[[BackendRequest], object] = entry.load()
        backend = factory(request)
    except DragrigError:
        raise
    except Exception as error:  # an add-on's own code can fail in any way
        raise DeviceError(
            f"backend {name} ({entry.value}) cannot be opened ({type(error).__name__}: {error}); is it installed whole?"
        ) from error
    if not isinstance(backend, Backend):
        raise DeviceError(f"backend {name} ({entry.value}) returns a {type(backend).__name__}, which is no backend.")
    return backend
