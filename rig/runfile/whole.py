"""Whole run files made at once, for measurements that come from elsewhere."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import h5py
import numpy as np

from dragrig.config.errors import OutputError, RunFileError
from dragrig.rig.runfile import files, naming, schema, writing
from dragrig.rig.runfile.attributes import LayoutError
from dragrig.rig.runfile.digest import TraceDigest
from dragrig.rig.runfile.model import PHASE_NAMES, Attribute, Ending, Event, RunHeader, Status


def write_run(
    path: Path,
    header: RunHeader,
    columns: Mapping[str, writing.Column],
    *,
    events: Sequence[Event] = (),
    status: Status = Status.COMPLETE,
    reason: str = "",
    end_time: datetime | None = None,
    checks: Mapping[str, Attribute] | None = None,
) -> Path:
    """Write a finished run file at once, for measurements that come from elsewhere.

    Parameters
    ----------
    path
        Where the file is to stand; what stands there already is never written over.
    columns
        time [s], command [mm], phase and every channel of the header, each of shape `(N,)`; float32 stays
        float32, other numbers become float64.

    Raises
    ------
    OutputError
        When something stands at `path` already or the folder refuses.
    RunFileError
        When header or columns break the format.
    """
    try:
        writing.check_header(header)
        _check_columns(header, columns)
    except LayoutError as fault:
        raise RunFileError(f"{path}: cannot be written as a run file because {fault}; correct the input") from fault
    with files.writing(path):
        if path.exists():
            raise OutputError(f"{path}: there is a file already; choose another name or remove it")
        with new_file(path) as file:
            writing.write_header(file, header, status)
            digest = _write_columns(file[schema.TRACE], header, columns)
            writing.write_ending(file, events, Ending(status, reason, end_time, checks or {}), digest)
    return path


@contextmanager
def new_file(path: Path) -> Iterator[h5py.File]:
    """Make an HDF5 file beside `path` and put it in place, synced, once it is whole; drop it otherwise.

    Raises
    ------
    OutputError
        When the disk refuses.
    """
    part = naming.part_path(path)
    try:
        file = h5py.File(part, "w", locking=False)
        try:
            yield file
            file.flush()
        except BaseException:
            files.discard(file)
            raise
        file.close()
        files.put_in_place(part, path)
    except (OSError, RuntimeError) as fault:
        raise OutputError(
            f"{path}: could not be written ({files.said(fault)}); make room or choose another folder"
        ) from fault
    finally:
        files.drop(part)


def _write_columns(group: h5py.Group, header: RunHeader, columns: Mapping[str, writing.Column]) -> str:
    units, digest = writing.units_of(header.channels), TraceDigest()
    for name in sorted(columns):
        values = np.ascontiguousarray(columns[name], dtype=_stored_type(name, np.asarray(columns[name]).dtype))
        dataset = writing.create_column(group, name, len(values), values.dtype)
        writing.describe(dataset, name, units)
        dataset[:] = values
        digest.begin(name, values.dtype, len(values))
        digest.update(values)
    return digest.hexdigest()


def _stored_type(name: str, given: np.dtype[np.generic]) -> np.dtype[np.generic]:
    """Return float32 for what is float32, float64 for any other number, the layout's type for time and phase."""
    fixed = {schema.TIME: "<f8", schema.PHASE: "u1"}.get(name)
    return np.dtype(fixed or ("<f4" if given.itemsize == 4 and given.kind == "f" else "<f8"))


def _check_columns(header: RunHeader, columns: Mapping[str, writing.Column]) -> None:
    wanted = set(writing.column_types(header.channels))
    if set(columns) != wanted:
        raise LayoutError(f"the columns are {', '.join(sorted(columns))} instead of {', '.join(sorted(wanted))}")
    lengths = {name: np.shape(column) for name, column in columns.items()}
    if len(set(lengths.values())) != 1 or len(next(iter(lengths.values()))) != 1:
        raise LayoutError(f"the columns differ in shape: {lengths}")
    time, phase = np.asarray(columns[schema.TIME], dtype=np.float64), np.asarray(columns[schema.PHASE])
    if not np.isfinite(time).all() or not (np.diff(time) > 0).all():
        raise LayoutError("time does not rise from sample to sample")
    if not np.isin(phase, np.arange(len(PHASE_NAMES))).all():
        raise LayoutError(f"phase is not within 0 to {len(PHASE_NAMES) - 1}")
