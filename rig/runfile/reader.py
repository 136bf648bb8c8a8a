"""Reading run files of every version, finished or still being recorded."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py

from dragrig.config.errors import DragrigError, RunFileError
from dragrig.rig.runfile import layout, schema
from dragrig.rig.runfile.attributes import LayoutError, attributes_of
from dragrig.rig.runfile.files import said
from dragrig.rig.runfile.heaps import damaged_text
from dragrig.rig.runfile.model import Event, FilteredTrace, Run, RunInfo, Trace
from dragrig.rig.runfile.naming import is_recording


@dataclass(frozen=True, slots=True)
class Layout:
    """How one version of the format is read."""

    info: Callable[[h5py.File, Path], RunInfo]
    trace: Callable[[h5py.File, RunInfo], Trace]
    events: Callable[[h5py.File], tuple[Event, ...]]
    filtered: Callable[[h5py.File], FilteredTrace | None]


LAYOUTS: Mapping[int, Layout] = {
    1: Layout(layout.read_info, layout.read_trace, layout.read_events, layout.read_filtered),
}
"""Every version that can be read; a new one is added, none is taken away."""


def read_info(path: Path) -> RunInfo:
    """Read what a run file says of itself, without its samples.

    Raises
    ------
    RunFileError
        When the file is missing, foreign, damaged, of a newer format, or lacks something it must have.
    """
    with opened(path) as file:
        return _layout_of(file).info(file, path)


def read_run(path: Path) -> Run:
    """Read a run file whole; a recording is cut where its samples end to be sure.

    Raises
    ------
    RunFileError
        As `read_info` does, and when the samples break the format.
    """
    with opened(path) as file:
        version = _layout_of(file)
        info = version.info(file, path)
        return Run(info, version.trace(file, info), version.events(file), version.filtered(file))


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open a run file for reading; whatever goes wrong inside is said as a `RunFileError`."""
    if not path.is_file():
        raise RunFileError(f"{path}: there is no such file; give the path of a run file (.h5)")
    try:
        _refuse_damaged_text(path)
        recording = is_recording(path)
        with h5py.File(path, "r", swmr=recording, locking=False if recording else "best-effort") as file:
            yield file
    except (DragrigError, MemoryError):
        raise
    except LayoutError as fault:
        raise RunFileError(
            f"{path}: {fault}; this is not a whole run file, restore it from a copy or bring the data in"
            " with `dragrig import`"
        ) from fault
    except BlockingIOError as fault:
        raise RunFileError(f"{path}: is being written by another program; close it there") from fault
    except PermissionError as fault:
        raise RunFileError(f"{path}: may not be read; ask for permission or copy it elsewhere") from fault
    except Exception as fault:
        # h5py reports damage as almost any class of exception; each means that the file cannot be read.
        raise RunFileError(
            f"{path}: is damaged, cut short or no HDF5 file ({said(fault)}); restore it from a copy or bring"
            " the data in with `dragrig import`"
        ) from fault


def _refuse_damaged_text(path: Path) -> None:
    if not is_recording(path) and (place := damaged_text(path)) is not None:
        raise LayoutError(f"its text is damaged at byte {place}")


def _layout_of(file: h5py.File) -> Layout:
    root = attributes_of(file)
    if root.get("format") != schema.FORMAT:
        raise LayoutError(f"the attribute format of / is not {schema.FORMAT!r}")
    if "format_version" not in root:
        raise LayoutError("/ lacks the attribute format_version")
    version = root["format_version"]
    if isinstance(version, int) and version in LAYOUTS and not isinstance(version, bool):
        return LAYOUTS[version]
    if isinstance(version, int) and version > max(LAYOUTS):
        raise RunFileError(
            f"{file.filename}: has format_version {version}, newer than the {max(LAYOUTS)} that this dragrig reads;"
            " install a newer dragrig"
        )
    raise LayoutError(f"the attribute format_version of / is {version!r} instead of a whole number from 1")
