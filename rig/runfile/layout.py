"""Layout 1 of the run file, read and checked. Errors are `LayoutError`s that name the place."""

from pathlib import Path

import h5py
import numpy as np

from dragrig.rig.arrays import AnyFloatArray, FloatArray, PhaseArray, read_only
from dragrig.rig.runfile import attributes as at
from dragrig.rig.runfile import schema
from dragrig.rig.runfile.attributes import LayoutError
from dragrig.rig.runfile.model import (
    PHASE_NAMES,
    Attribute,
    Channel,
    Event,
    FilteredTrace,
    RunHeader,
    RunInfo,
    Status,
    Trace,
)

DEFLATE_LIMIT = 1100
"""Deflate packs at most 1032 bytes into one; a dataset that claims more than this is damaged."""
SMALL_BYTES = 1 << 24


def read_info(file: h5py.File, path: Path) -> RunInfo:
    """Read what a file says of itself: attributes and shapes only."""
    at.checked_attributes(file, "/")
    entry = at.checked_attributes(file, schema.ENTRY)
    trace = at.checked_attributes(file, schema.TRACE)
    protocol = at.checked_attributes(file, schema.PROTOCOL)
    capsule = at.checked_attributes(file, schema.CAPSULE)
    specimen = at.checked_attributes(file, schema.SPECIMEN)
    at.one_of(schema.SPECIMEN, "fixture", specimen["fixture"], schema.FIXTURES)
    signal = at.one_of(schema.TRACE, "signal", trace["signal"], schema.SIGNALS)
    samples, channels = _shape_of_trace(file, signal)
    header = RunHeader(
        run_id=at.run_id_of(entry["run_id"]),
        start_time=at.moment("start_time", entry["start_time"]),
        order=int(entry["order"]),
        backend=str(entry["backend"]),
        kind=str(protocol.pop("kind")),
        sample_rate_hz=at.positive_rate(trace["sample_rate_hz"]),
        channels=channels,
        entry={name: value for name, value in entry.items() if name not in schema.WRITERS_ATTRIBUTES},
        protocol=protocol,
        capsule=_without_class(capsule),
        specimen=_without_class(specimen),
        settings_toml=_text(file, schema.SETTINGS),
    )
    return RunInfo(
        path=path,
        format_version=schema.FORMAT_VERSION,
        status=at.status_of(entry["status"]),
        header=header,
        samples=samples,
        reason=str(entry.get("reason", "")),
        end_time=at.moment("end_time", entry["end_time"]) if entry.get("end_time") else None,
        checks=_without_class(at.attributes_of(at.group_at(file, schema.CHECKS))) if schema.CHECKS in file else {},
        raw_sha256=str(entry.get("raw_sha256", "")),
    )


def read_trace(file: h5py.File, info: RunInfo, last: int | None = None) -> Trace:
    """Read all samples, or the last so many; arrays are read-only."""
    rows = slice(0 if last is None else max(0, info.samples - last), info.samples)
    time = np.asarray(_column(file, schema.TIME, rows), dtype=np.float64)
    if not np.isfinite(time).all():
        raise LayoutError("/entry/trace/time holds NaN or infinity")
    if not (np.diff(time) > 0).all():
        raise LayoutError("/entry/trace/time does not rise from sample to sample")
    phase = _phase(file, rows)
    command = _column(file, schema.COMMAND, rows)
    channels = {channel.name: _column(file, channel.name, rows) for channel in info.header.channels}
    for array in (time, phase):
        read_only(array)
    return Trace(
        sample_rate_hz=info.header.sample_rate_hz,
        signal=str(at.attributes_of(file[schema.TRACE])["signal"]),
        time=time,
        command=command,
        phase=phase,
        channels=channels,
        units={schema.TIME: "s", schema.COMMAND: "mm"} | {c.name: c.units for c in info.header.channels},
    )


def read_events(file: h5py.File) -> tuple[Event, ...]:
    """Read the table of events; a file without one has none. Of a recording, the rows that are whole."""
    if schema.EVENTS not in file:
        return ()
    table = at.dataset_at(file, schema.EVENTS)
    if table.ndim != 1 or table.dtype.names != schema.EVENT_FIELDS:
        raise LayoutError(f"/entry/events is not a table of {', '.join(schema.EVENT_FIELDS)}")
    _believable(table)
    rows = table[: valid_count(file, schema.VALID_EVENTS, len(table)) if still_recording(file) else None]
    return tuple(
        Event(float(time), str(at.plain(kind)), str(at.plain(message))) for time, kind, message in rows.tolist()
    )


def read_filtered(file: h5py.File) -> FilteredTrace | None:
    """Read what the filter stored, if it did."""
    if schema.FILTERED not in file:
        return None
    group = at.group_at(file, schema.FILTERED)
    columns: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    for name, dataset in group.items():
        if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1 or dataset.dtype.kind != "f":
            raise LayoutError(f"{schema.FILTERED}/{name} is not a row of numbers")
        _believable(dataset)
        columns[name] = np.asarray(dataset[:], dtype=np.float64)
        read_only(columns[name])
        units[name] = str(at.attributes_of(dataset).get("units", ""))
    if schema.TIME not in columns:
        raise LayoutError(f"the dataset {schema.FILTERED}/time is missing")
    time = columns.pop(schema.TIME)
    del units[schema.TIME]
    if any(column.shape != time.shape for column in columns.values()):
        raise LayoutError(f"the datasets of {schema.FILTERED} differ in length")
    parameters = {k: v for k, v in at.attributes_of(group).items() if k not in {"NX_class", "signal", "axes"}}
    return FilteredTrace(time=time, channels=columns, parameters=parameters, units=units)


def valid_count(file: h5py.File, path: str, otherwise: int) -> int:
    """Return how many rows a recording says are whole; `otherwise` where it does not say."""
    dataset = file.get(path)
    return min(int(np.ravel(dataset[()])[0]), otherwise) if isinstance(dataset, h5py.Dataset) else otherwise


def still_recording(file: h5py.File) -> bool:
    """Tell whether a file is a recording, whose datasets may be longer than what is whole of them."""
    entry = at.group_at(file, schema.ENTRY)
    return "status" in entry.attrs and at.attribute_of(entry, "status") == Status.RECORDING


def _shape_of_trace(file: h5py.File, signal: str) -> tuple[int, tuple[Channel, ...]]:
    trace = file[schema.TRACE]
    for name in (schema.TIME, signal, "position", schema.COMMAND, schema.PHASE):
        at.dataset_at(file, f"{schema.TRACE}/{name}")
    lengths: dict[str, int] = {}
    channels: list[Channel] = []
    for name, dataset in trace.items():
        where = f"{schema.TRACE}/{name}"
        if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1:
            raise LayoutError(f"{where} is not a row of samples")
        lengths[name] = int(dataset.shape[0])
        if name == schema.PHASE:
            continue
        if dataset.dtype.kind != "f" or dataset.dtype.itemsize not in {4, 8}:
            raise LayoutError(f"{where} holds {dataset.dtype} instead of float32 or float64")
        units = _units(dataset, where, schema.UNITS.get(name))
        if name not in schema.FRAME:
            channels.append(Channel(name, units, "float32" if dataset.dtype.itemsize == 4 else "float64"))
    channels.sort(key=lambda channel: (channel.name != signal, channel.name != "position", channel.name))
    return _common_length(file, lengths), tuple(channels)


def _common_length(file: h5py.File, lengths: dict[str, int]) -> int:
    samples = lengths[schema.TIME]
    if still_recording(file):
        return valid_count(file, schema.VALID_SAMPLES, min(lengths.values()))
    for name, length in lengths.items():
        if length != samples:
            raise LayoutError(f"/entry/trace/{name} has {length} samples, /entry/trace/time {samples}")
    return samples


def _units(dataset: h5py.Dataset, where: str, wanted: str | None) -> str:
    found = at.attributes_of(dataset)
    if "units" not in found:
        raise LayoutError(f"{where} lacks the attribute units")
    if wanted is not None and found["units"] != wanted:
        raise LayoutError(f"the attribute units of {where} is {found['units']!r} instead of {wanted!r}")
    return str(found["units"])


def _column(file: h5py.File, name: str, rows: slice) -> AnyFloatArray:
    dataset = file[schema.TRACE][name]
    _believable(dataset)
    native = np.float32 if dataset.dtype.itemsize == 4 else np.float64
    array: AnyFloatArray = dataset[rows].astype(native, copy=False)
    read_only(array)
    return array


def _phase(file: h5py.File, rows: slice) -> PhaseArray:
    dataset = file[schema.TRACE][schema.PHASE]
    if dataset.dtype != np.uint8:
        raise LayoutError(f"/entry/trace/phase holds {dataset.dtype} instead of uint8")
    if "names" not in dataset.attrs:
        raise LayoutError("/entry/trace/phase lacks the attribute names")
    names = ", ".join(PHASE_NAMES)
    if at.attributes_of(dataset)["names"] != names:
        raise LayoutError(f"the attribute names of /entry/trace/phase is not {names}")
    _believable(dataset)
    phase: PhaseArray = dataset[rows]
    if phase.size and phase.max() >= len(PHASE_NAMES):
        raise LayoutError(f"/entry/trace/phase holds {phase.max()}, above {len(PHASE_NAMES) - 1}")
    return phase


def _believable(dataset: h5py.Dataset) -> None:
    """Refuse a damaged shape before memory is asked for it."""
    claimed = dataset.size * dataset.dtype.itemsize
    if claimed > SMALL_BYTES and claimed > DEFLATE_LIMIT * dataset.id.get_storage_size():
        raise LayoutError(f"{dataset.name} claims {claimed} bytes, which the file does not hold")


def _text(file: h5py.File, path: str) -> str:
    return str(at.plain(at.dataset_at(file, path)[()])) if path in file else ""


def _without_class(found: dict[str, Attribute]) -> dict[str, Attribute]:
    return {name: value for name, value in found.items() if name != "NX_class"}
