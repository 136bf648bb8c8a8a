"""Reading run files of every version, finished or still being recorded, checked against the layout.

A breach of the layout is a `LayoutError` that names the place; the public functions turn it into a `RunFileError` that
names the file as well.
"""

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import datetime
from pathlib import Path
from typing import TypeVar
from uuid import UUID

import h5py
import numpy as np

from dragrig.config import NO_TEXT, DragrigError, RunFileError, is_text
from dragrig.rig import AnyFloatArray, FloatArray, PhaseArray, read_only
from dragrig.rig.runfile import schema
from dragrig.rig.runfile.filesystem import brief_error
from dragrig.rig.runfile.hdf5 import (
    ForeignStorageError,
    UnfinishedFile,
    find_damaged_text,
    find_excess,
    find_oversized_text,
    is_open_for_writing,
    refuse_foreign_storage,
)
from dragrig.rig.runfile.model import (
    PHASE_NAMES,
    Attribute,
    FilteredTrace,
    RecordedChannel,
    Run,
    RunEvent,
    RunHeader,
    RunInfo,
    RunStatus,
    Trace,
)

MAX_ATTRIBUTE_VALUES = 256
"""An attribute with more values than this is damaged; reading them could take all memory."""
MAX_VALUE_BYTES = 1 << 16
SCALE_ATTRIBUTES = frozenset({"CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST"})
"""Of HDF5's dimension scales."""
SCALAR_CLASSES = frozenset({h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING, h5py.h5t.ENUM})
MAX_DEFLATE_RATIO = 1100
"""Deflate packs at most 1032 bytes into one; a dataset that claims more than this is damaged."""
UNCHECKED_BYTES = 1 << 24
MAX_TRACE_RATIO = 200
"""A trace is packed less than that, for its force has noise: one that claims more would fill the memory with zeros."""
UNCHECKED_TRACE_BYTES = 1 << 29
_UNREADABLE = ("may not be read;", "is open in another program that lets nobody else read it: close it there, or")
"""Elsewhere, and on Windows."""
MAX_LIVE_ATTEMPTS = 5

ReadT = TypeVar("ReadT")


class LayoutError(ValueError):
    """A file that breaks the layout; the message names the place, its reader names the file."""


def required_group(file: h5py.File, path: str) -> h5py.Group:
    """Return a group that must exist."""
    group = file.get(path)
    if not isinstance(group, h5py.Group):
        raise LayoutError(f"the group {path} is missing")
    return group


def required_dataset(file: h5py.File, path: str) -> h5py.Dataset:
    """Return a dataset that must exist."""
    dataset = file.get(path)
    if not isinstance(dataset, h5py.Dataset):
        raise LayoutError(f"the dataset {path} is missing")
    return dataset


def attributes_of(holder: h5py.Group | h5py.Dataset) -> dict[str, Attribute]:
    """Return all attributes as plain Python values; a list becomes comma-separated text.

    Those that tie a dataset to its dimension scale are not among them.
    """
    names: list[bytes] = []
    h5py.h5a.iterate(holder.id, names.append)
    wanted = sorted(name.decode("utf-8", "replace") for name in names)
    return {name: attribute_of(holder, name) for name in wanted if name not in SCALE_ATTRIBUTES}


def attribute_of(holder: h5py.Group | h5py.Dataset, name: str) -> Attribute:
    """Return one attribute as a plain Python value."""
    # Some seventy of a run file are read whenever runs are listed: h5py's mapping opens each twice.
    attribute = h5py.h5a.open(holder.id, name.encode())
    shape, kind = attribute.shape, attribute.get_type()
    if shape is not None and math.prod(shape) > MAX_ATTRIBUTE_VALUES:
        raise LayoutError(f"the attribute {name} of {holder.name} claims {math.prod(shape)} values")
    if kind.get_class() not in SCALAR_CLASSES or kind.get_size() > MAX_VALUE_BYTES:
        raise LayoutError(f"the attribute {name} of {holder.name} is neither text nor number")
    if shape is None or 0 in shape:
        return ""
    value = np.zeros(shape, kind.dtype)
    attribute.read(value)
    return to_python(value)


def to_python(value: object) -> Attribute:
    """Turn h5py's value of an attribute into text, a number or a truth value."""
    if isinstance(value, h5py.Empty):
        return ""
    if isinstance(value, np.ndarray):
        items = value.ravel().tolist()
        return to_python(items[0]) if len(items) == 1 else ", ".join(str(to_python(item)) for item in items)
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value if isinstance(value, str | float | int | bool) else str(value)


def checked_attributes(file: h5py.File, path: str, written_at: str = "") -> dict[str, Attribute]:
    """Return the attributes of a group, once those that the layout requires are there and valid.

    `written_at` is where today's layout has this group, if elsewhere.
    """
    attributes = attributes_of(file["/"] if path == "/" else required_group(file, path))
    for name, fixed in schema.FIXED_ATTRIBUTES.get(path, {}).items():
        if name not in attributes:
            raise LayoutError(f"{path} lacks the attribute {name}")
        if attributes[name] != fixed:
            raise LayoutError(f"the attribute {name} of {path} is {attributes[name]!r:.60} instead of {fixed!r}")
    check_attributes(path, attributes, written_at or path)
    return attributes


def check_attributes(path: str, attributes: Mapping[str, Attribute], written_at: str = "") -> None:
    """Raise `LayoutError` unless a group has the attributes that the layout requires, each of the right type."""
    always = schema.REQUIRED_ATTRIBUTES.get(written_at or path, {})
    required = dict(always)
    if path == schema.PROTOCOL and "kind" in attributes:
        required |= dict.fromkeys(schema.PARAMETERS_OF_KIND.get(str(attributes["kind"]), ()), float)
    for name, kind in required.items():
        if name not in attributes:
            reason = "" if name in always else f", which the kind {attributes['kind']} needs"
            raise LayoutError(f"{path} lacks the attribute {name}{reason}")
        _check_type(path, name, attributes[name], kind)
    for name, value in attributes.items():
        _check_magnitude(path, name, value)


def _check_magnitude(path: str, name: str, value: Attribute) -> None:
    """Refuse numbers that no rig has, before anything computes with them, and text that no file can hold."""
    if isinstance(value, str):
        if "\0" in value:
            raise LayoutError(f"the attribute {name} of {path} holds a zero byte")
        if not is_text(value):
            raise LayoutError(f"the attribute {name} of {path} {NO_TEXT}")
        if (path, name) == (schema.PROTOCOL, "kind") and len(value) > schema.MAX_KIND_CHARACTERS:
            raise LayoutError(f"the attribute kind of {path} has {len(value)} characters")
        return
    suffix = next((suffix for suffix in schema.MAX_MAGNITUDES if name.endswith(suffix)), "")
    largest = schema.MAX_ORDER if name == "order" else schema.MAX_MAGNITUDES.get(suffix, math.inf)
    if abs(value) > largest:
        raise LayoutError(f"the attribute {name} of {path} is {value:g}, and {largest:g} is the most")


def _check_type(path: str, name: str, value: Attribute, kind: type) -> None:
    if kind is str:
        valid = isinstance(value, str) and bool(value)
    elif kind is int:
        valid = isinstance(value, int) and not isinstance(value, bool) and value >= 0
    else:
        valid = isinstance(value, int | float) and not isinstance(value, bool) and not math.isinf(value)
    if not valid:
        expected = {str: "text", int: "a whole number from 0", float: "a number"}[kind]
        raise LayoutError(f"the attribute {name} of {path} is {value!r:.60} instead of {expected}")


def positive_rate(value: Attribute) -> float:
    """Return a sample rate [Hz]."""
    rate = float(value)
    if not (math.isfinite(rate) and rate > 0):
        raise LayoutError(f"the attribute sample_rate_hz of {schema.TRACE} is {rate} instead of a positive number")
    return rate


def timestamp(name: str, value: Attribute) -> datetime:
    """Return a time of day that must carry its offset."""
    try:
        parsed = datetime.fromisoformat(str(value))
    except ValueError:
        parsed = None
    if parsed is None or parsed.tzinfo is None:
        raise LayoutError(
            f"the attribute {name} of the run is {value!r:.60} instead of an ISO 8601 time with its offset"
        )
    return parsed


def one_allowed(path: str, name: str, value: Attribute, allowed: tuple[str, ...]) -> str:
    """Return a text that must be among those allowed."""
    if value not in allowed:
        raise LayoutError(f"the attribute {name} of {path} is {value!r:.60} instead of one of {', '.join(allowed)}")
    return str(value)


def run_id_of(value: Attribute) -> str:
    """Return a run's identity, which must be a UUID."""
    try:
        UUID(str(value))
    except ValueError:
        raise LayoutError(f"the attribute run_id of the run is {value!r:.60} instead of a UUID") from None
    return str(value)


def info_of(file: h5py.File, layout: schema.Layout, path: Path) -> RunInfo:
    """Read an open file's facts about its run: attributes and shapes only."""
    checked_attributes(file, "/")
    checked_attributes(file, schema.ENTRY)
    run = checked_attributes(file, layout.run, schema.RUN)
    trace = checked_attributes(file, schema.TRACE)
    protocol = checked_attributes(file, schema.PROTOCOL)
    capsule = checked_attributes(file, schema.CAPSULE)
    specimen = checked_attributes(file, schema.SPECIMEN)
    one_allowed(schema.SPECIMEN, "fixture", specimen["fixture"], schema.FIXTURES)
    signal = one_allowed(schema.TRACE, "signal", trace["signal"], schema.SIGNALS)
    samples, channels = _trace_shape(file, layout, signal)
    header = RunHeader(
        run_id=run_id_of(run["run_id"]),
        start_time=timestamp("start_time", run["start_time"]),
        order=int(run["order"]),
        backend=str(run["backend"]),
        kind=str(protocol.pop("kind")),
        sample_rate_hz=positive_rate(trace["sample_rate_hz"]),
        channels=channels,
        entry={name: value for name, value in run.items() if name not in schema.HEADER_ATTRIBUTES},
        protocol=_without_class(protocol),
        capsule=_without_class(capsule),
        specimen=_without_class(specimen),
        settings_toml=_text(file, layout.settings) if layout.settings in file else "",
    )
    return RunInfo(
        path=path,
        format_version=layout.version,
        status=RunStatus(one_allowed(layout.run, "status", run["status"], tuple(RunStatus))),
        header=header,
        samples=samples,
        reason=str(run.get("reason", "")),
        end_time=timestamp("end_time", run["end_time"]) if run.get("end_time") else None,
        checks=_without_class(attributes_of(required_group(file, schema.CHECKS))) if schema.CHECKS in file else {},
        raw_sha256=str(run.get("raw_sha256", "")),
    )


def _text(file: h5py.File, path: str) -> str:
    """Read a single text; a damaged shape is refused before memory is allocated for it."""
    dataset = required_dataset(file, path)
    if dataset.size != 1:
        raise LayoutError(f"{path} is not a single text")
    _require_plausible_size(dataset)
    return str(to_python(dataset[()]))


def _without_class(attributes: dict[str, Attribute]) -> dict[str, Attribute]:
    return {name: value for name, value in attributes.items() if name != "NX_class"}


def trace_of(file: h5py.File, info: RunInfo, last: int | None = None) -> Trace:
    """Read all samples, or the last so many; arrays are read-only."""
    rows = slice(0 if last is None else max(0, info.samples - last), info.samples)
    time = np.asarray(_column(file, schema.TIME, rows), dtype=np.float64)
    if not np.isfinite(time).all():
        raise LayoutError("/entry/trace/time holds NaN or infinity")
    if not (np.diff(time) > 0).all():
        raise LayoutError("/entry/trace/time does not rise from sample to sample")
    _check_rate(time, info.header.sample_rate_hz)
    phase = _phase(file, rows)
    for array in (time, phase):
        read_only(array)
    return Trace(
        sample_rate_hz=info.header.sample_rate_hz,
        signal=str(attribute_of(file[schema.TRACE], "signal")),
        time=time,
        command=_column(file, schema.COMMAND, rows),
        phase=phase,
        channels={channel.name: _column(file, channel.name, rows) for channel in info.header.channels},
        units={schema.TIME: "s", schema.COMMAND: "mm"} | {c.name: c.units for c in info.header.channels},
    )


def _check_rate(time: FloatArray, rate_hz: float) -> None:
    """Refuse a sample rate that is not that of the samples: whoever lays time out by it would run out of memory."""
    if len(time) < 2:
        return
    mismatch = float(np.median(np.diff(time))) * rate_hz
    if not 1 / schema.MAX_RATE_MISMATCH <= mismatch <= schema.MAX_RATE_MISMATCH:
        raise LayoutError(
            f"the attribute sample_rate_hz of {schema.TRACE} is {rate_hz:g}, and the samples are "
            f"{mismatch / rate_hz:g} s apart"
        )


def events_of(file: h5py.File, layout: schema.Layout) -> tuple[RunEvent, ...]:
    """Read the table of events, of a recording its valid rows; a file without a table has none."""
    if layout.events not in file:
        return ()
    table = required_dataset(file, layout.events)
    if table.ndim != 1 or table.dtype.names != schema.EVENT_FIELDS:
        raise LayoutError(f"{layout.events} is not a table of {', '.join(schema.EVENT_FIELDS)}")
    _require_plausible_size(table)
    _, valid_events, _ = layout.valid_counts
    rows = table[: valid_count(file, valid_events, len(table)) if _is_unfinished(file, layout) else None]
    return tuple(
        RunEvent(float(time), str(to_python(kind)), str(to_python(message))) for time, kind, message in rows.tolist()
    )


def filtered_of(file: h5py.File) -> FilteredTrace | None:
    """Read the filtered trace, if one was stored."""
    if schema.FILTERED not in file:
        return None
    group = required_group(file, schema.FILTERED)
    _require_text_names(group)
    _require_plausible_total(schema.FILTERED, group.values())
    columns: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    for name, dataset in group.items():
        if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1 or dataset.dtype.kind != "f":
            raise LayoutError(f"{schema.FILTERED}/{name} is not a row of numbers")
        _require_plausible_size(dataset)
        columns[name] = np.asarray(dataset[:], dtype=np.float64)
        read_only(columns[name])
        units[name] = str(attributes_of(dataset).get("units", ""))
    if schema.TIME not in columns:
        raise LayoutError(f"the dataset {schema.FILTERED}/time is missing")
    time = columns.pop(schema.TIME)
    del units[schema.TIME]
    if any(column.shape != time.shape for column in columns.values()):
        raise LayoutError(f"the datasets of {schema.FILTERED} differ in length")
    layout_names = {"NX_class", "signal", "axes"}
    parameters = {name: value for name, value in attributes_of(group).items() if name not in layout_names}
    return FilteredTrace(time=time, channels=columns, parameters=parameters, units=units)


def valid_count(file: h5py.File, path: str, default: int) -> int:
    """Return how many rows of a dataset a recording declares valid, `default` where it declares none."""
    dataset = file.get(path)
    if not isinstance(dataset, h5py.Dataset):
        return default
    if dataset.size != 1 or dataset.dtype.kind not in "iu":
        raise LayoutError(f"{path} is not a count")
    return min(max(int(np.ravel(dataset[()])[0]), 0), default)


def _is_unfinished(file: h5py.File, layout: schema.Layout) -> bool:
    """Tell whether a file is a recording, whose datasets may be longer than their valid part."""
    run = required_group(file, layout.run)
    return "status" in run.attrs and attribute_of(run, "status") == RunStatus.RECORDING


def _require_text_names(group: h5py.Group) -> None:
    """Refuse names that are no UTF-8, which h5py gives as bytes."""
    for name in group:
        if not isinstance(name, str):
            raise LayoutError(f"the name {name!r:.60} in {group.name} is no UTF-8")


def _rows_of_trace(file: h5py.File, signal: str) -> dict[str, h5py.Dataset]:
    """Return every dataset of the trace: to open one takes longer than to read an attribute, so each is opened once."""
    group = required_group(file, schema.TRACE)
    _require_text_names(group)
    members = dict(group.items())
    for name in (schema.TIME, signal, "position", schema.COMMAND, schema.PHASE):
        if not isinstance(members.get(name), h5py.Dataset):
            raise LayoutError(f"the dataset {schema.TRACE}/{name} is missing")
    for name, dataset in members.items():
        if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1:
            raise LayoutError(f"{schema.TRACE}/{name} is not a row of samples")
    _require_plausible_total(schema.TRACE, members.values())
    return members


def _trace_shape(file: h5py.File, layout: schema.Layout, signal: str) -> tuple[int, tuple[RecordedChannel, ...]]:
    lengths: dict[str, int] = {}
    channels: list[RecordedChannel] = []
    for name, dataset in _rows_of_trace(file, signal).items():
        path = f"{schema.TRACE}/{name}"
        lengths[name] = int(dataset.shape[0])
        if name == schema.PHASE:
            continue
        if (kind := dataset.dtype).kind != "f" or kind.itemsize not in {4, 8}:
            raise LayoutError(f"{path} holds {kind} instead of float32 or float64")
        if not h5py.h5a.exists(dataset.id, b"units"):
            raise LayoutError(f"{path} lacks the attribute units")
        units = str(attribute_of(dataset, "units"))
        if units != (required := schema.UNITS.get(name, units)):
            raise LayoutError(f"the attribute units of {path} is {units!r} instead of {required!r}")
        if name not in schema.FRAME_DATASETS:
            channels.append(RecordedChannel(name, units, "float32" if kind.itemsize == 4 else "float64"))
    channels.sort(key=lambda channel: (channel.name != signal, channel.name != "position", channel.name))
    samples = lengths[schema.TIME]
    if _is_unfinished(file, layout):
        return valid_count(file, layout.valid_counts[0], min(lengths.values())), tuple(channels)
    for name, length in lengths.items():
        if length != samples:
            raise LayoutError(f"/entry/trace/{name} has {length} samples, /entry/trace/time {samples}")
    return samples, tuple(channels)


def _column(file: h5py.File, name: str, rows: slice) -> AnyFloatArray:
    dataset = file[schema.TRACE][name]
    _require_plausible_size(dataset)
    array: AnyFloatArray = dataset[rows].astype(np.float32 if dataset.dtype.itemsize == 4 else np.float64, copy=False)
    largest = schema.MAX_TRACE_MAGNITUDES.get(str(attribute_of(dataset, "units")), float(np.finfo(array.dtype).max))
    # NaN, a sample that is not known, is no magnitude.
    if array.size and max(np.fmax.reduce(array), -np.fmin.reduce(array)) > largest:
        raise LayoutError(f"{schema.TRACE}/{name} holds values beyond {largest:g}")
    read_only(array)
    return array


def _phase(file: h5py.File, rows: slice) -> PhaseArray:
    dataset = file[schema.TRACE][schema.PHASE]
    if dataset.dtype != np.uint8:
        raise LayoutError(f"/entry/trace/phase holds {dataset.dtype} instead of uint8")
    if "names" not in dataset.attrs:
        raise LayoutError("/entry/trace/phase lacks the attribute names")
    names = ", ".join(PHASE_NAMES)
    if attribute_of(dataset, "names") != names:
        raise LayoutError(f"the attribute names of /entry/trace/phase is not {names}")
    _require_plausible_size(dataset)
    phase: PhaseArray = dataset[rows]
    if phase.size and phase.max() >= len(PHASE_NAMES):
        raise LayoutError(f"/entry/trace/phase holds {phase.max()}, above {len(PHASE_NAMES) - 1}")
    return phase


def _require_plausible_size(dataset: h5py.Dataset) -> None:
    """Refuse a damaged shape before memory is allocated for it."""
    claimed = dataset.size * dataset.dtype.itemsize
    if claimed > UNCHECKED_BYTES and claimed > MAX_DEFLATE_RATIO * dataset.id.get_storage_size():
        raise LayoutError(f"{dataset.name} claims {claimed} bytes, which the file does not hold")


def _require_plausible_total(path: str, members: Iterable[object]) -> None:
    """Refuse a group that unpacks to far more than a recording does, before memory is allocated for it."""
    datasets = [dataset for dataset in members if isinstance(dataset, h5py.Dataset) and dataset.size]
    claimed = sum(dataset.size * dataset.dtype.itemsize for dataset in datasets)
    held = sum(dataset.id.get_storage_size() for dataset in datasets)
    if claimed > UNCHECKED_TRACE_BYTES and claimed > MAX_TRACE_RATIO * held:
        raise LayoutError(f"{path} claims {claimed} bytes, which the file does not hold")


def read_info(path: Path) -> RunInfo:
    """Read a run file's facts about its run, without its samples.

    Raises `RunFileError` when the file is missing, foreign, damaged, of a newer format, or lacks a required part.
    """
    return _read(path, lambda layout, file: info_of(file, layout, path))


def read_run(path: Path, info: RunInfo | None = None) -> Run:
    """Read a run file whole, a recording up to its last valid sample.

    Parameters
    ----------
    info
        The result of `read_info`, so that it need not be read again.

    Raises
    ------
    RunFileError
        As `read_info` does, and when the samples break the format.
    """

    def read(layout: schema.Layout, file: h5py.File) -> Run:
        described = info_of(file, layout, path) if info is None else info
        return Run(described, trace_of(file, described), events_of(file, layout), filtered_of(file))

    return _read(path, read)


def read_tail(path: Path, duration_s: float) -> Run:
    """Read the last samples of a run file, finished or still being recorded; its `info` counts all of them.

    Raises `RunFileError` as `read_run` does.
    """

    def read(layout: schema.Layout, file: h5py.File) -> Run:
        info = info_of(file, layout, path)
        last = max(1, round(duration_s * info.header.sample_rate_hz))
        return Run(info, trace_of(file, info, last), events_of(file, layout))

    return _read(path, read)


def _read(path: Path, read: Callable[[schema.Layout, h5py.File], ReadT]) -> ReadT:
    """Read from an opened file; again when a file that is being written changed meanwhile."""
    for attempts_left in reversed(range(MAX_LIVE_ATTEMPTS)):
        try:
            with open_run(path) as file, as_run_file_error(path):
                return read(layout_of(file), file)
        except RunFileError:
            with as_run_file_error(path):
                if attempts_left and path.is_file() and is_open_for_writing(path):
                    continue
            raise
    raise AssertionError("the last attempt returns or raises")


@contextmanager
def open_run(path: Path) -> Iterator[h5py.File]:
    """Open a run file for reading, also one that is being written; raises `RunFileError` when it cannot be opened."""
    with ExitStack() as stack:
        with as_run_file_error(path):
            if not path.is_file():
                raise RunFileError(f"{path}: there is no such file; give the path of a run file (.h5)")
            if (offset := find_damaged_text(path)) is not None:
                raise LayoutError(f"its text is damaged at byte {offset}")
            if is_open_for_writing(path):
                view = UnfinishedFile(stack.enter_context(path.open("rb", buffering=0)))
                file = h5py.File(view, "r")
            else:
                file = h5py.File(path, "r", locking="best-effort")
            stack.enter_context(file)
            if (excess := find_excess(file)) is not None:
                raise LayoutError(excess)
            refuse_foreign_storage(file)
            if (offset := find_oversized_text(file, path)) is not None:
                raise LayoutError(f"its text is damaged at byte {offset}")
        yield file


@contextmanager
def as_run_file_error(path: Path) -> Iterator[None]:
    """Turn whatever goes wrong while a file is read into a `RunFileError`."""
    restore = "restore it from a copy or bring the data in with `dragrig import`"
    try:
        yield
    except DragrigError:
        raise
    except LayoutError as error:
        raise RunFileError(f"{path}: {error}; this is not a whole run file, {restore}") from error
    except ForeignStorageError as error:
        raise RunFileError(
            f"{path}: {error}, which is never read; ask for a file that holds all of its data"
        ) from error
    except BlockingIOError as error:
        raise RunFileError(f"{path}: is being written by another program; close it there") from error
    except PermissionError as error:
        raise RunFileError(f"{path}: {_UNREADABLE[os.name == 'nt']} ask for permission to read it") from error
    except MemoryError as error:
        raise RunFileError(f"{path}: does not fit into memory; close other programs or use a larger machine") from error
    except Exception as error:
        # h5py reports damage as almost any class of exception; each means that the file cannot be read.
        raise RunFileError(
            f"{path}: is damaged, cut short or no HDF5 file ({brief_error(error)}); {restore}"
        ) from error


def layout_of(file: h5py.File) -> schema.Layout:
    """Return the places of a file's parts, by its version."""
    holder = schema.RUN if isinstance(file.get(schema.RUN), h5py.Group) else "/"
    marked = file[holder]
    marks = {name: attribute_of(marked, name) for name in ("format", "format_version") if name in marked.attrs}
    if holder == "/" and "format" not in marks:
        # Of the first version it would have the format here, of any later one these groups.
        required_group(file, schema.ENTRY)
        required_group(file, schema.RUN)
    if marks.get("format") != schema.FORMAT:
        raise LayoutError(f"the attribute format of {holder} is not {schema.FORMAT!r}")
    if "format_version" not in marks:
        raise LayoutError(f"{holder} lacks the attribute format_version")
    version = marks["format_version"]
    if isinstance(version, int) and not isinstance(version, bool):
        if version > max(schema.LAYOUTS):
            raise RunFileError(
                f"{file.filename}: has format_version {version}; this dragrig reads versions up to "
                f"{max(schema.LAYOUTS)}, install a newer one"
            )
        if version in schema.LAYOUTS and schema.LAYOUTS[version].marked == holder:
            return schema.LAYOUTS[version]
    known = next(number for number, layout in schema.LAYOUTS.items() if layout.marked == holder)
    raise LayoutError(f"the attribute format_version of {holder} is {version!r} instead of {known}")
