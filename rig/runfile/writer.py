"""Writing the layout: header, columns and ending of a run file, whole files at once, edited copies, and the checksum.

A finished file is never changed in place, only replaced whole by a synced copy.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import h5py
import numpy as np

from dragrig.config.errors import OutputError, RunFileError
from dragrig.rig.arrays import AnyFloatArray, PhaseArray
from dragrig.rig.runfile import filesystem as files
from dragrig.rig.runfile import reader, schema
from dragrig.rig.runfile import reader as at
from dragrig.rig.runfile import reader as layout
from dragrig.rig.runfile import schema as naming
from dragrig.rig.runfile.model import (
    PHASE_NAMES,
    Attribute,
    Channel,
    FilteredTrace,
    RunEnding,
    RunEvent,
    RunHeader,
    RunStatus,
)
from dragrig.rig.runfile.reader import LayoutError
from dragrig.rig.runfile.schema import is_recording

DIGEST_SAMPLES = 1 << 19
"""Samples read at a time, so that memory does not grow with the run."""


class TraceDigest:
    """SHA-256 over the datasets of `/entry/trace`, in the order of their names.

    Each dataset adds one line of UTF-8, `NAME TYPE COUNT` and a line feed, where TYPE is NumPy's code of
    the little-endian type (`<f8`, `<f4`, `|u1`), and then its samples as little-endian bytes. How the file
    is chunked, compressed or annotated does not matter.
    """

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def begin(self, name: str, dtype: np.dtype[np.generic], samples: int) -> None:
        """Begin the next dataset; names must come in rising order."""
        self._hash.update(f"{name} {little_endian(dtype).str} {samples}\n".encode())

    def update(self, values: AnyFloatArray | PhaseArray) -> None:
        """Add the next samples of the dataset begun."""
        self._hash.update(np.ascontiguousarray(values, dtype=little_endian(values.dtype)).view(np.uint8).data)

    def hexdigest(self) -> str:
        """Return the checksum of all that was added."""
        return self._hash.hexdigest()


def little_endian(dtype: np.dtype[np.generic]) -> np.dtype[np.generic]:
    """Return a type in little-endian order."""
    return dtype.newbyteorder("<")


def trace_sha256(trace: h5py.Group) -> str:
    """Compute the checksum of a trace in a file, piece by piece."""
    digest = TraceDigest()
    for name in sorted(trace):
        dataset = trace[name]
        samples = int(dataset.shape[0])
        digest.begin(name, dataset.dtype, samples)
        for start in range(0, samples, DIGEST_SAMPLES):
            digest.update(dataset[start : start + DIGEST_SAMPLES])
    return digest.hexdigest()


Column = AnyFloatArray | PhaseArray

FILE_CHUNK = 1 << 16
"""Samples of a chunk in a finished file."""
GZIP_LEVEL = 4


def column_types(channels: Sequence[Channel]) -> dict[str, np.dtype[np.generic]]:
    """Return the type of every dataset of a recorded trace, by name."""
    frame: dict[str, np.dtype[np.generic]] = {
        schema.TIME: np.dtype("<f8"),
        schema.COMMAND: np.dtype("<f4"),
        schema.PHASE: np.dtype("u1"),
    }
    return frame | {channel.name: np.dtype(channel.dtype).newbyteorder("<") for channel in channels}


def signal_name(channels: Sequence[Channel]) -> str:
    """Return the channel that a run is about: force, or motor_force for a stage alone."""
    names = {channel.name for channel in channels}
    return next(name for name in schema.SIGNALS if name in names)


def check_header(header: RunHeader) -> None:
    """Make sure that a file with this header could be read back.

    Raises
    ------
    LayoutError
        When the layout asks for something that the header lacks or says otherwise.
    """
    names = [channel.name for channel in header.channels]
    if len(set(names)) < len(names) or set(names) & set(schema.FRAME_DATASETS) or "position" not in names:
        raise LayoutError(f"the channels {', '.join(names)} are not position and further ones, each once")
    if not set(names) & set(schema.SIGNALS):
        raise LayoutError("neither force nor motor_force is among the channels")
    for channel in header.channels:
        if channel.units != schema.UNITS.get(channel.name, channel.units):
            raise LayoutError(f"{channel.name} is in {channel.units!r} instead of {schema.UNITS[channel.name]!r}")
    for path, found in _groups(header, RunStatus.RECORDING).items():
        at.check_attributes(path, found)
    at.run_id_of(header.run_id)
    at.timestamp("start_time", header.start_time.isoformat())
    at.positive_rate(header.sample_rate_hz)
    at.one_allowed(schema.SPECIMEN, "fixture", header.specimen["fixture"], schema.FIXTURES)


def write_header(file: h5py.File, header: RunHeader, status: RunStatus) -> None:
    """Write every group and attribute that is known before the first sample."""
    file.attrs["format"] = schema.FORMAT
    file.attrs["format_version"] = schema.FORMAT_VERSION
    known = _groups(header, status)
    for path in dict.fromkeys((*schema.FIXED_ATTRIBUTES, *known)):
        group = file.require_group(path)
        write_attributes(group, {**schema.FIXED_ATTRIBUTES.get(path, {}), **known.get(path, {})})
    if header.settings_toml:
        file[schema.SETTINGS] = header.settings_toml


def _groups(header: RunHeader, status: RunStatus) -> dict[str, Mapping[str, Attribute]]:
    entry: dict[str, Attribute] = {
        "run_id": header.run_id,
        "start_time": header.start_time.isoformat(),
        "order": header.order,
        "status": str(status),
        "backend": header.backend,
    }
    trace: dict[str, Attribute] = {
        "signal": signal_name(header.channels),
        "sample_rate_hz": float(header.sample_rate_hz),
    }
    return {
        schema.ENTRY: entry | dict(header.entry),
        schema.TRACE: trace,
        schema.PROTOCOL: {"kind": header.kind, **header.protocol},
        schema.CAPSULE: header.capsule,
        schema.SPECIMEN: header.specimen,
    }


def write_attributes(group: h5py.Group, found: Mapping[str, Attribute]) -> None:
    """Write attributes; a number that the layout wants as a real number is written as one."""
    real = {name for name, kind in schema.REQUIRED_ATTRIBUTES.get(group.name, {}).items() if kind is float}
    if group.name == schema.PROTOCOL:
        real.update(*schema.PARAMETERS_OF_KIND.values())
    for name, value in found.items():
        group.attrs[name] = float(value) if name in real else value


def write_dataset_attributes(dataset: h5py.Dataset, name: str, units: Mapping[str, str]) -> None:
    """Write the attributes of one dataset of a trace."""
    if name == schema.PHASE:
        dataset.attrs["names"] = list(PHASE_NAMES)
    else:
        dataset.attrs["units"] = units[name]


def column_units(channels: Sequence[Channel]) -> dict[str, str]:
    """Return the unit of every dataset of a trace that has one."""
    return {schema.TIME: "s", schema.COMMAND: "mm"} | {channel.name: channel.units for channel in channels}


def create_column(group: h5py.Group, name: str, samples: int, dtype: np.dtype[np.generic]) -> h5py.Dataset:
    """Create a compressed dataset of a finished file."""
    if samples == 0:
        return group.create_dataset(name, shape=(0,), dtype=dtype)
    return group.create_dataset(
        name,
        shape=(samples,),
        dtype=dtype,
        chunks=(min(samples, FILE_CHUNK),),
        compression="gzip",
        compression_opts=GZIP_LEVEL,
        shuffle=True,
    )


def event_rows(events: Sequence[RunEvent]) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    """Turn events into rows of `/entry/events`; text too long for a row ends in an ellipsis."""
    rows = [
        (
            event.time_s,
            clip_utf8(event.kind, schema.EVENT_KIND_BYTES),
            clip_utf8(event.message, schema.EVENT_MESSAGE_BYTES),
        )
        for event in events
    ]
    return np.array(rows, dtype=schema.event_dtype())


def clip_utf8(text: str, size: int) -> bytes:
    """Return text as UTF-8 of at most `size` bytes, cut between characters."""
    raw = text.replace("\0", " ").encode("utf-8", "replace")
    if len(raw) <= size:
        return raw
    ellipsis = "…".encode()
    return raw[: size - len(ellipsis)].decode("utf-8", "ignore").encode() + ellipsis


def write_ending(file: h5py.File, events: Sequence[RunEvent], ending: RunEnding, raw_sha256: str) -> None:
    """Write what is known once the last sample has been taken."""
    entry = file[schema.ENTRY]
    entry.create_dataset("events", data=event_rows(events))
    entry.attrs["status"] = str(ending.status)
    entry.attrs["raw_sha256"] = raw_sha256
    if ending.reason:
        entry.attrs["reason"] = ending.reason
    if ending.end_time is not None:
        entry.attrs["end_time"] = ending.end_time.isoformat()
    if ending.checks:
        group = file.create_group(schema.CHECKS)
        group.attrs["NX_class"] = "NXcollection"
        write_attributes(group, ending.checks)


def write_run(
    path: Path,
    header: RunHeader,
    columns: Mapping[str, Column],
    *,
    events: Sequence[RunEvent] = (),
    status: RunStatus = RunStatus.COMPLETE,
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
        check_header(header)
        _check_columns(header, columns)
    except LayoutError as fault:
        raise RunFileError(f"{path}: cannot be written as a run file because {fault}; correct the input") from fault
    with files.lock_run(path):
        if path.exists():
            raise OutputError(f"{path}: there is a file already; choose another name or remove it")
        with new_file(path) as file:
            write_header(file, header, status)
            digest = _write_columns(file[schema.TRACE], header, columns)
            write_ending(file, events, RunEnding(status, reason, end_time, checks or {}), digest)
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
            files.abandon_hdf5_file(file)
            raise
        file.close()
        files.move_into_place(part, path)
    except (OSError, RuntimeError) as fault:
        raise OutputError(
            f"{path}: could not be written ({files.error_text(fault)}); make room or choose another folder"
        ) from fault
    finally:
        files.remove_quietly(part)


def _write_columns(group: h5py.Group, header: RunHeader, columns: Mapping[str, Column]) -> str:
    units, digest = column_units(header.channels), TraceDigest()
    for name in sorted(columns):
        values = np.ascontiguousarray(columns[name], dtype=_stored_type(name, np.asarray(columns[name]).dtype))
        dataset = create_column(group, name, len(values), values.dtype)
        write_dataset_attributes(dataset, name, units)
        dataset[:] = values
        digest.begin(name, values.dtype, len(values))
        digest.update(values)
    return digest.hexdigest()


def _stored_type(name: str, given: np.dtype[np.generic]) -> np.dtype[np.generic]:
    """Return float32 for what is float32, float64 for any other number, the layout's type for time and phase."""
    fixed = {schema.TIME: "<f8", schema.PHASE: "u1"}.get(name)
    return np.dtype(fixed or ("<f4" if given.itemsize == 4 and given.kind == "f" else "<f8"))


def _check_columns(header: RunHeader, columns: Mapping[str, Column]) -> None:
    wanted = set(column_types(header.channels))
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


@dataclass(frozen=True, slots=True)
class Verification:
    """Whether a trace still is what was recorded; `stored` is empty where no checksum was ever stored."""

    path: Path
    stored: str
    computed: str

    @property
    def holds(self) -> bool:
        """Whether there is a checksum and it is the trace's."""
        return self.stored == self.computed


def verify(path: Path) -> Verification:
    """Read a run file whole and compare its trace with `raw_sha256`.

    Raises
    ------
    RunFileError
        As `read_run` does.
    """
    run = reader.read_run(path)
    with reader.open_run(path) as file, reader.as_run_file_error(path):
        return Verification(path, run.info.raw_sha256, trace_sha256(file[schema.TRACE]))


def rewrite(path: Path, edit: Callable[[h5py.File], None], *, without: Sequence[str] = ()) -> None:
    """Replace a finished file by a copy that was edited; readers see the old one or the new one whole.

    Parameters
    ----------
    edit
        Changes the copy. The trace must stay as it is.
    without
        Children of `/entry` that are not copied, so that their room is not kept.

    Raises
    ------
    BusyError
        When another process is writing this run.
    OutputError
        When the disk refuses.
    RunFileError
        When the file is still being recorded or cannot be read.
    """
    if is_recording(path):
        raise RunFileError(f"{path}: is still a recording; finish it with `dragrig recover` first")
    with files.lock_run(path):
        reader.read_info(path)
        with new_file(path) as file:
            # Closed before the copy takes its place: Windows replaces no file that is open.
            with reader.open_run(path) as source:
                _copy_run(source, file, frozenset(without))
            edit(file)


def store_filtered(path: Path, filtered: FilteredTrace, events: Sequence[RunEvent] = ()) -> None:
    """Store a filtered trace beside the raw one as `/entry/filtered`, in place of one stored before.

    Parameters
    ----------
    events
        What the filter has to say, such as pieces too short for it; what it said before is replaced.

    Raises
    ------
    BusyError, OutputError, RunFileError
        As `rewrite` does.
    """

    def edit(file: h5py.File) -> None:
        group = file.create_group(schema.FILTERED)
        signal = str(file[schema.TRACE].attrs["signal"])
        names = list(filtered.channels)
        group.attrs.update(NX_class="NXdata", axes=schema.TIME)
        group.attrs["signal"] = signal if signal in names else names[0]
        write_attributes(group, filtered.parameters)
        units = {schema.TIME: "s", **schema.UNITS, **filtered.units}
        for name, column in {schema.TIME: filtered.time, **filtered.channels}.items():
            dataset = create_column(group, name, len(column), np.dtype("<f8"))
            dataset.attrs["units"] = units.get(name, "")
            dataset[:] = column
        kept = [event for event in layout.read_events_v1(file) if event.kind != schema.FILTER_EVENT]
        said = [RunEvent(event.time_s, schema.FILTER_EVENT, event.message) for event in events]
        if schema.EVENTS in file:
            del file[schema.EVENTS]
        file.create_dataset(schema.EVENTS, data=event_rows([*kept, *said]))

    rewrite(path, edit, without=("filtered",))


def _copy_run(source: h5py.File, file: h5py.File, without: frozenset[str]) -> None:
    file.attrs.update(source.attrs)
    for name in source:
        if name != "entry":
            source.copy(name, file)
    entry = file.create_group(schema.ENTRY)
    for name, value in source[schema.ENTRY].attrs.items():
        entry.attrs[name] = value
    for name in source[schema.ENTRY]:
        if name not in without:
            source[schema.ENTRY].copy(name, entry)
