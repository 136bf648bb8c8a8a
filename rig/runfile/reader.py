"""Reading run files of every version, finished or still being recorded."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import h5py

from dragrig.config.errors import DragrigError, RunFileError
from dragrig.rig.runfile import layout, schema
from dragrig.rig.runfile.attributes import LayoutError, attributes_of
from dragrig.rig.runfile.files import said
from dragrig.rig.runfile.heaps import damaged_text
from dragrig.rig.runfile.model import Event, FilteredTrace, Run, RunInfo, Trace
from dragrig.rig.runfile.unfinished import UnfinishedFile, left_open

ReadT = TypeVar("ReadT")
LIVE_ATTEMPTS = 5


@dataclass(frozen=True, slots=True)
class Layout:
    """How one version of the format is read."""

    info: Callable[[h5py.File, Path], RunInfo]
    trace: Callable[[h5py.File, RunInfo, int | None], Trace]
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

    def read() -> RunInfo:
        with opened(path) as file, refused(path):
            return layout_of(file).info(file, path)

    return _steadily(read, path)


def read_run(path: Path, known: RunInfo | None = None) -> Run:
    """Read a run file whole; a recording is cut where its samples end to be sure.

    Parameters
    ----------
    known
        What `read_info` just said of the file, which need not be read again.

    Raises
    ------
    RunFileError
        As `read_info` does, and when the samples break the format.
    """

    def read() -> Run:
        with opened(path) as file, refused(path):
            version = layout_of(file)
            info = version.info(file, path) if known is None else known
            return Run(info, version.trace(file, info, None), version.events(file), version.filtered(file))

    return _steadily(read, path)


def read_tail(path: Path, seconds: float) -> Run:
    """Read the last samples of a run file, finished or still being recorded; its `info` counts all of them.

    Raises
    ------
    RunFileError
        As `read_run` does.
    """

    def read() -> Run:
        with opened(path) as file, refused(path):
            version = layout_of(file)
            info = version.info(file, path)
            last = max(1, round(seconds * info.header.sample_rate_hz))
            return Run(info, version.trace(file, info, last), version.events(file))

    return _steadily(read, path)


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open a run file for reading, also one that is being written; raises `RunFileError` when it cannot be opened."""
    with ExitStack() as stack:
        with refused(path):
            if not path.is_file():
                raise RunFileError(f"{path}: there is no such file; give the path of a run file (.h5)")
            if (place := damaged_text(path)) is not None:
                raise LayoutError(f"its text is damaged at byte {place}")
            if left_open(path):
                view = UnfinishedFile(stack.enter_context(path.open("rb", buffering=0)))
                file = h5py.File(view, "r")
            else:
                file = h5py.File(path, "r", locking="best-effort")
            stack.enter_context(file)
        yield file


@contextmanager
def refused(path: Path) -> Iterator[None]:
    """Say whatever goes wrong while a file is read as a `RunFileError`."""
    try:
        yield
    except DragrigError:
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
    except MemoryError as fault:
        raise RunFileError(f"{path}: does not fit into memory; close other programs or use a larger machine") from fault
    except Exception as fault:
        # h5py reports damage as almost any class of exception; each means that the file cannot be read.
        raise RunFileError(
            f"{path}: is damaged, cut short or no HDF5 file ({said(fault)}); restore it from a copy or bring"
            " the data in with `dragrig import`"
        ) from fault


def layout_of(file: h5py.File) -> Layout:
    """Return how a file is read, by its version."""
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


def _steadily(read: Callable[[], ReadT], path: Path) -> ReadT:
    """Read; again when a file that is being written changed under the reader's eyes."""
    for _ in range(LIVE_ATTEMPTS - 1):
        try:
            return read()
        except RunFileError:
            if not (path.is_file() and left_open(path)):
                raise
    return read()
