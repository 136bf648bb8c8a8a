"""Writing the layout: header, columns and ending of a run file, whole files at once, edited copies, and the checksum.

A finished file is never changed in place, only replaced whole by a synced copy.
"""

import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import h5py
import numpy as np

from dragrig.config import OutputError, RunFileError
from dragrig.rig import AnyFloatArray, PhaseArray
from dragrig.rig.runfile import schema
from dragrig.rig.runfile.filesystem import brief_error, lock_run, move_into_place, remove_quietly
from dragrig.rig.runfile.hdf5 import abandon_hdf5_file
from dragrig.rig.runfile.model import (
    PHASE_NAMES,
    Attribute,
    FilteredTrace,
    RecordedChannel,
    RunEnding,
    RunEvent,
    RunHeader,
    RunStatus,
)
from dragrig.rig.runfile.reader import (
    LayoutError,
    as_run_file_error,
    check_attributes,
    events_of,
    layout_of,
    one_allowed,
    open_run,
    positive_rate,
    read_info,
    read_run,
    run_id_of,
    timestamp,
)

Column: TypeAlias = AnyFloatArray | PhaseArray

FILE_CHUNK = 1 << 16
"""Samples of a chunk in a finished file."""
GZIP_LEVEL = 4
AS_PLANNED = RunEnding(RunStatus.COMPLETE)
DIGEST_SAMPLES = 1 << 19
"""Samples read at a time, so that memory does not grow with the run."""


class TraceDigest:
    """SHA-256 over the datasets of `/entry/trace`, in the order of their names.

    Each dataset adds one line of UTF-8, `NAME TYPE COUNT` and a line feed, where TYPE is NumPy's code of the little-
    endian type (`<f8`, `<f4`, `|u1`), and then its samples as little-endian bytes. How the file is chunked, compressed
    or annotated does not matter.
    """

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def begin(self, name: str, dtype: np.dtype[np.generic], samples: int) -> None:
        """Begin the next dataset; names must come in alphabetical order."""
        self._hash.update(f"{name} {dtype.newbyteorder('<').str} {samples}\n".encode())

    def update(self, values: AnyFloatArray | PhaseArray) -> None:
        """Add the next samples of the dataset begun."""
        self._hash.update(np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<")).view(np.uint8).data)

    def hexdigest(self) -> str:
        """Return the checksum of all that was added."""
        return self._hash.hexdigest()


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


def column_types(channels: Sequence[RecordedChannel]) -> dict[str, np.dtype[np.generic]]:
    """Return the type of every dataset of a recorded trace, by name."""
    frame: dict[str, np.dtype[np.generic]] = {
        schema.TIME: np.dtype("<f8"),
        schema.COMMAND: np.dtype("<f4"),
        schema.PHASE: np.dtype("u1"),
    }
    return frame | {channel.name: np.dtype(channel.dtype).newbyteorder("<") for channel in channels}


def check_header(header: RunHeader) -> None:
    """Raise `LayoutError` unless a file with this header could be read back."""
    names = [channel.name for channel in header.channels]
    if len(set(names)) < len(names) or set(names) & set(schema.FRAME_DATASETS) or "position" not in names:
        raise LayoutError(f"the channels {', '.join(names)} are not position and others, each once")
    if not set(names) & set(schema.SIGNALS):
        raise LayoutError("neither force nor motor_force is among the channels")
    for channel in header.channels:
        if channel.units != schema.UNITS.get(channel.name, channel.units):
            raise LayoutError(f"{channel.name} is in {channel.units!r} instead of {schema.UNITS[channel.name]!r}")
    for path, attributes in _groups(header, RunStatus.RECORDING).items():
        check_attributes(path, attributes)
    run_id_of(header.run_id)
    timestamp("start_time", header.start_time.isoformat())
    positive_rate(header.sample_rate_hz)
    one_allowed(schema.SPECIMEN, "fixture", header.specimen["fixture"], schema.FIXTURES)


def write_header(file: h5py.File, header: RunHeader, status: RunStatus) -> None:
    """Write every group and attribute that is known before the first sample."""
    groups = _groups(header, status)
    for path in dict.fromkeys((*schema.FIXED_ATTRIBUTES, *groups)):
        fixed = schema.FIXED_ATTRIBUTES.get(path) or {"NX_class": schema.NEXUS_CLASSES[path]}
        write_attributes(file.require_group(path), {**fixed, **groups.get(path, {})})
    mark_format(file[schema.RUN])
    if header.settings_toml:
        file[schema.LAYOUT.settings] = header.settings_toml


def mark_format(run: h5py.Group) -> None:
    """Write which format a file has, and which version of it."""
    run.attrs.update(
        NX_class=schema.NEXUS_CLASSES[schema.RUN], format=schema.FORMAT, format_version=schema.FORMAT_VERSION
    )


def _groups(header: RunHeader, status: RunStatus) -> dict[str, Mapping[str, Attribute]]:
    run: dict[str, Attribute] = {
        "run_id": header.run_id,
        "start_time": header.start_time.isoformat(),
        "order": header.order,
        "status": str(status),
        "backend": header.backend,
    }
    # What the run is about: force, or motor_force for a stage alone.
    signal = next(name for name in schema.SIGNALS if name in {channel.name for channel in header.channels})
    return {
        schema.RUN: run | dict(header.entry),
        schema.TRACE: {"signal": signal, "sample_rate_hz": float(header.sample_rate_hz)},
        schema.PROTOCOL: {"kind": header.kind, **header.protocol},
        schema.CAPSULE: header.capsule,
        schema.SPECIMEN: header.specimen,
    }


def write_attributes(group: h5py.Group, attributes: Mapping[str, Attribute]) -> None:
    """Write attributes; a number that the layout requires to be real is written as one."""
    real = {name for name, kind in schema.REQUIRED_ATTRIBUTES.get(group.name, {}).items() if kind is float}
    if group.name == schema.PROTOCOL:
        real.update(*schema.PARAMETERS_OF_KIND.values())
    for name, value in attributes.items():
        group.attrs[name] = float(value) if name in real else value


def write_dataset_attributes(dataset: h5py.Dataset, name: str, units: Mapping[str, str]) -> None:
    """Write the attributes of one dataset of a trace."""
    if name == schema.PHASE:
        dataset.attrs["names"] = list(PHASE_NAMES)
    else:
        dataset.attrs["units"] = units[name]
    label = schema.LONG_NAMES.get(name, name.replace("_", " "))
    dataset.attrs["long_name"] = f"{label} ({units[name]})" if name in units else label


def column_units(channels: Sequence[RecordedChannel]) -> dict[str, str]:
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
    """Turn events into rows of the table of events; text too long for a row ends in an ellipsis."""
    kind_bytes, message_bytes = schema.EVENT_KIND_BYTES, schema.EVENT_MESSAGE_BYTES
    rows = [(e.time_s, clip_utf8(e.kind, kind_bytes), clip_utf8(e.message, message_bytes)) for e in events]
    return np.array(rows, dtype=schema.event_dtype())


def clip_utf8(text: str, size: int) -> bytes:
    """Return text as UTF-8 of at most `size` bytes, cut between characters."""
    raw = text.replace("\0", " ").encode("utf-8", "replace")
    if len(raw) <= size:
        return raw
    ellipsis = "…".encode()
    return raw[: size - len(ellipsis)].decode("utf-8", "ignore").encode() + ellipsis


def write_ending(file: h5py.File, events: Sequence[RunEvent], ending: RunEnding, raw_sha256: str) -> None:
    """Write the facts known once the last sample has been taken."""
    file.create_dataset(schema.LAYOUT.events, data=event_rows(events))
    run = file[schema.RUN].attrs
    run["status"] = str(ending.status)
    run["raw_sha256"] = raw_sha256
    if ending.reason:
        run["reason"] = ending.reason
    if ending.end_time is not None:
        run["end_time"] = ending.end_time.isoformat()
    if ending.checks:
        group = file.create_group(schema.CHECKS)
        group.attrs["NX_class"] = schema.NEXUS_CLASSES[schema.CHECKS]
        write_attributes(group, ending.checks)
    _write_nexus_fields(file)
    trace = file[schema.TRACE]
    others = [name for name in trace if name not in {*schema.FRAME_DATASETS, trace.attrs["signal"]}]
    trace.attrs["auxiliary_signals"] = others
    scale_time(trace)


def _write_nexus_fields(file: h5py.File) -> None:
    """Write, from the attributes, the fields and groups of the NeXus standard, for programs that look there."""
    entry, specimen = file[schema.ENTRY], file[schema.SPECIMEN].attrs
    attributes = {name: str(value) for name, value in file[schema.RUN].attrs.items()}
    fields = {
        "title": f"{file[schema.PROTOCOL].attrs['kind']} of {specimen['name']}",
        "start_time": attributes["start_time"],
        "end_time": attributes.get("end_time", ""),
        "entry_identifier_uuid": attributes["run_id"],
        "experiment_description": attributes.get("note", ""),
        "program_name": attributes.get("software", ""),
    }
    _write_fields(entry, fields)
    sample = _nexus_group(entry, "sample", "NXsample", {"name": str(specimen["name"])})
    temperature = specimen.get("temperature_degC")
    if isinstance(temperature, float | int):
        sample["temperature"] = float(temperature)
        sample["temperature"].attrs["units"] = "degC"
    if operator := attributes.get("operator"):
        _nexus_group(entry, "user", "NXuser", {"name": operator})
    instrument = _nexus_group(entry, "instrument", "NXinstrument", {"name": "linear-motor drag tester"})
    _nexus_group(instrument, "force_sensor", "NXsensor", {"name": attributes.get("sensor_serial", "force sensor")})
    write_attributes(_nexus_group(entry, "provenance", "NXcollection", {}), schema.provenance())


def _nexus_group(parent: h5py.Group, name: str, nexus_class: str, fields: Mapping[str, str]) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nexus_class
    _write_fields(group, fields)
    return group


def _write_fields(group: h5py.Group, fields: Mapping[str, str]) -> None:
    for name, text in fields.items():
        if text:
            group[name] = text


def scale_time(group: h5py.Group) -> None:
    """Make the time of a trace the dimension scale of its other datasets, in place of those that a copy lost."""
    time = group[schema.TIME]
    columns = [group[name] for name in group if name != schema.TIME]
    for dataset, name in ((time, "REFERENCE_LIST"), *((column, "DIMENSION_LIST") for column in columns)):
        if name in dataset.attrs:
            del dataset.attrs[name]
    time.make_scale(schema.TIME)
    for column in columns:
        column.dims[0].attach_scale(time)


def write_run(
    path: Path,
    header: RunHeader,
    columns: Mapping[str, Column],
    *,
    events: Sequence[RunEvent] = (),
    ending: RunEnding = AS_PLANNED,
) -> Path:
    """Write a finished run file at once, for measurements that come from elsewhere.

    Parameters
    ----------
    path
        The new file; an existing one is never overwritten.
    columns
        time [s], command [mm], phase and every channel of the header, each of shape `(N,)`; float32 stays float32,
        other numbers become float64.

    Raises
    ------
    OutputError
        When the file exists already or the folder refuses.
    RunFileError
        When header or columns break the format.
    """
    try:
        check_header(header)
        _check_columns(header, columns)
    except LayoutError as error:
        raise RunFileError(f"{path}: cannot be written as a run file because {error}; correct the input") from error
    with lock_run(path):
        if path.exists():
            raise OutputError(f"{path}: there is a file already; choose another name or remove it")
        with new_file(path) as file:
            write_header(file, header, ending.status)
            digest = _write_columns(file[schema.TRACE], header, columns)
            write_ending(file, events, ending, digest)
    return path


@contextmanager
def new_file(path: Path) -> Iterator[h5py.File]:
    """Make an HDF5 file beside `path` and move it into place, synced, once it is whole; remove it otherwise.

    Raises `OutputError` when the disk refuses.
    """
    part = schema.part_path(path)
    try:
        file = h5py.File(part, "w", locking=False)
        try:
            yield file
            file.flush()
        except BaseException:
            abandon_hdf5_file(file)
            raise
        file.close()
        move_into_place(part, path)
    except (OSError, RuntimeError) as error:
        raise OutputError(
            f"{path}: could not be written ({brief_error(error)}); make room or choose another folder"
        ) from error
    finally:
        remove_quietly(part)


def _write_columns(group: h5py.Group, header: RunHeader, columns: Mapping[str, Column]) -> str:
    units, digest = column_units(header.channels), TraceDigest()
    for name in sorted(columns):
        column = np.asarray(columns[name])
        is_float32 = column.dtype.itemsize == 4 and column.dtype.kind == "f"
        stored_type = {schema.TIME: "<f8", schema.PHASE: "u1"}.get(name, "<f4" if is_float32 else "<f8")
        values = np.ascontiguousarray(column, dtype=np.dtype(stored_type))
        dataset = create_column(group, name, len(values), values.dtype)
        write_dataset_attributes(dataset, name, units)
        dataset[:] = values
        digest.begin(name, values.dtype, len(values))
        digest.update(values)
    return digest.hexdigest()


def _check_columns(header: RunHeader, columns: Mapping[str, Column]) -> None:
    required = set(column_types(header.channels))
    if set(columns) != required:
        raise LayoutError(f"the columns are {', '.join(sorted(columns))} instead of {', '.join(sorted(required))}")
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
    """The checksum stored with a trace, empty where none ever was, and the one computed from it now."""

    path: Path
    stored: str
    computed: str

    @property
    def holds(self) -> bool:
        """Whether the trace still is the recorded one."""
        return self.stored == self.computed


def verify(path: Path) -> Verification:
    """Read a run file whole and compare its trace with `raw_sha256`; raises `RunFileError` as `read_run` does."""
    run = read_run(path)
    with open_run(path) as file, as_run_file_error(path):
        return Verification(path, run.info.raw_sha256, trace_sha256(file[schema.TRACE]))


def rewrite(path: Path, edit: Callable[[h5py.File], None], *, without: Sequence[str] = ()) -> None:
    """Replace a finished file by an edited copy; readers see either the old file or the new one, whole.

    Parameters
    ----------
    edit
        Changes the copy. The trace must stay as it is.
    without
        Children of `/entry` that are not copied, so that they take no room.

    Raises
    ------
    BusyError
        When another process is writing this run.
    OutputError
        When the disk refuses.
    RunFileError
        When the file is still being recorded or cannot be read.
    """
    if schema.is_recording(path):
        raise RunFileError(f"{path}: is still a recording; finish it with `dragrig recover` first")
    with lock_run(path):
        read_info(path)
        with new_file(path) as file:
            # Closed before the copy takes its place: Windows replaces no file that is open.
            with open_run(path) as source:
                _copy_group(source, file, {"entry"})
                _copy_group(source[schema.ENTRY], file.create_group(schema.ENTRY), without)
            edit(file)
            for group in (schema.TRACE, schema.FILTERED):
                if group in file:
                    scale_time(file[group])


def store_filtered(path: Path, filtered: FilteredTrace, events: Sequence[RunEvent] = ()) -> None:
    """Store a filtered trace as `/entry/filtered` beside the raw one, in place of an earlier one; raises as `rewrite`.

    `events` are the filter's remarks, such as pieces too short for it; its earlier remarks are replaced.
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
            label = schema.LONG_NAMES.get(name, name.replace("_", " "))
            dataset.attrs["long_name"] = f"filtered {label}" if name != schema.TIME else label
            dataset[:] = column
        layout = layout_of(file)
        run_events = [event for event in events_of(file, layout) if event.kind != schema.FILTER_EVENT]
        filter_events = [RunEvent(event.time_s, schema.FILTER_EVENT, event.message) for event in events]
        if layout.events in file:
            del file[layout.events]
        file.create_dataset(layout.events, data=event_rows([*run_events, *filter_events]))

    rewrite(path, edit, without=("filtered",))


def _copy_group(source: h5py.Group, target: h5py.Group, without: Collection[str]) -> None:
    """Copy attributes and members of a group; a link as the link that it is, for it may lead nowhere."""
    target.attrs.update(source.attrs)
    for name in (name for name in source if name not in without):
        link = source.get(name, getlink=True)
        if isinstance(link, h5py.HardLink):
            source.copy(name, target)
        else:
            target[name] = link
