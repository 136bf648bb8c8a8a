"""Writing the layout: what recorder, finisher, importer and rewriters have in common."""

from collections.abc import Mapping, Sequence

import h5py
import numpy as np

from dragrig.rig.arrays import AnyFloatArray, PhaseArray
from dragrig.rig.runfile import attributes as at
from dragrig.rig.runfile import schema
from dragrig.rig.runfile.attributes import LayoutError
from dragrig.rig.runfile.model import PHASE_NAMES, Attribute, Channel, Ending, Event, RunHeader, Status

Column = AnyFloatArray | PhaseArray

CHUNK = 1 << 16
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


def signal_of(channels: Sequence[Channel]) -> str:
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
    if len(set(names)) < len(names) or set(names) & set(schema.FRAME) or "position" not in names:
        raise LayoutError(f"the channels {', '.join(names)} are not position and further ones, each once")
    if not set(names) & set(schema.SIGNALS):
        raise LayoutError("neither force nor motor_force is among the channels")
    for channel in header.channels:
        if channel.units != schema.UNITS.get(channel.name, channel.units):
            raise LayoutError(f"{channel.name} is in {channel.units!r} instead of {schema.UNITS[channel.name]!r}")
    for path, found in _groups(header, Status.RECORDING).items():
        at.check_attributes(path, found)
    at.run_id_of(header.run_id)
    at.moment("start_time", header.start_time.isoformat())
    at.positive_rate(header.sample_rate_hz)
    at.one_of(schema.SPECIMEN, "fixture", header.specimen["fixture"], schema.FIXTURES)


def write_header(file: h5py.File, header: RunHeader, status: Status) -> None:
    """Write every group and attribute that is known before the first sample."""
    file.attrs["format"] = schema.FORMAT
    file.attrs["format_version"] = schema.FORMAT_VERSION
    known = _groups(header, status)
    for path in dict.fromkeys((*schema.FIXED_ATTRIBUTES, *known)):
        group = file.require_group(path)
        write_attributes(group, {**schema.FIXED_ATTRIBUTES.get(path, {}), **known.get(path, {})})
    if header.settings_toml:
        file[schema.SETTINGS] = header.settings_toml


def _groups(header: RunHeader, status: Status) -> dict[str, Mapping[str, Attribute]]:
    entry: dict[str, Attribute] = {
        "run_id": header.run_id,
        "start_time": header.start_time.isoformat(),
        "order": header.order,
        "status": str(status),
        "backend": header.backend,
    }
    trace: dict[str, Attribute] = {
        "signal": signal_of(header.channels),
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


def describe(dataset: h5py.Dataset, name: str, units: Mapping[str, str]) -> None:
    """Write the attributes of one dataset of a trace."""
    if name == schema.PHASE:
        dataset.attrs["names"] = list(PHASE_NAMES)
    else:
        dataset.attrs["units"] = units[name]


def units_of(channels: Sequence[Channel]) -> dict[str, str]:
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
        chunks=(min(samples, CHUNK),),
        compression="gzip",
        compression_opts=GZIP_LEVEL,
        shuffle=True,
    )


def event_rows(events: Sequence[Event]) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    """Turn events into rows of `/entry/events`; text too long for a row ends in an ellipsis."""
    rows = [
        (event.time_s, clipped(event.kind, schema.EVENT_KIND_BYTES), clipped(event.message, schema.EVENT_MESSAGE_BYTES))
        for event in events
    ]
    return np.array(rows, dtype=schema.event_dtype())


def clipped(text: str, size: int) -> bytes:
    """Return text as UTF-8 of at most `size` bytes, cut between characters."""
    raw = text.replace("\0", " ").encode("utf-8", "replace")
    if len(raw) <= size:
        return raw
    ellipsis = "…".encode()
    return raw[: size - len(ellipsis)].decode("utf-8", "ignore").encode() + ellipsis


def write_ending(file: h5py.File, events: Sequence[Event], ending: Ending, raw_sha256: str) -> None:
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
