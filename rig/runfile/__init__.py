"""The run file: one run, one HDF5 file. h5py is loaded when a function is first asked for."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dragrig.rig.runfile.reader import read_info, read_run

__all__ = ["read_info", "read_run"]

_HOME = {
    "read_info": "reader",
    "read_run": "reader",
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
