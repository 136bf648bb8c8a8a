"""Runs that this software exported come back, by the export's own words on its columns, under any names.

Names, units, delimiter and decimal mark are those that `dragrig.analysis.export` wrote, so that nothing is guessed.
"""

import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from uuid import UUID, uuid5

import numpy as np
import numpy.typing as npt

from dragrig.analysis import DELIMITERS, EXPORT_FORMAT_KEY, EXPORT_FORMAT_VERSION, EXPORT_PART_KEY
from dragrig.analysis.importing import file_kinds
from dragrig.analysis.importing.conversion import SIGNAL_CHANNELS, phases_of
from dragrig.analysis.importing.units import TARGET_UNITS
from dragrig.config import ImportDataError
from dragrig.rig import (
    AnyFloatArray,
    Attribute,
    PhaseArray,
    RecordedChannel,
    RunEnding,
    RunEvent,
    RunHeader,
    RunStatus,
)

Array = npt.NDArray[np.generic]

MAT_BEGIN_BYTES = 136
"""Of a version 5 MAT file's text, and of type and length of its first element."""
FRAME = ("time", "command", "phase")
MAX_RATE_RATIO = 1.5
"""Rows of blocks that many gaps break are that much closer than those of whole blocks before their own rate counts."""

_CSV_BEGIN = re.compile(rb"(\xef\xbb\xbf)?# dragrig-export(-part)?: ")
_LINE = re.compile(r"# ([\w-]+): (.*)")


@dataclass(frozen=True, slots=True, eq=False)
class ExportedRun:
    """An export: its metadata, and its columns of shape `(N,)` by the names that the metadata give them."""

    path: Path
    metadata: Mapping[str, object]
    columns: Mapping[str, Array]


@dataclass(frozen=True, slots=True, eq=False)
class PreparedRun:
    """Contents of the run file that an import becomes."""

    header: RunHeader
    columns: Mapping[str, AnyFloatArray | PhaseArray]
    events: tuple[RunEvent, ...]
    remarks: tuple[str, ...] = ()
    ending: RunEnding = field(default_factory=lambda: RunEnding(RunStatus.COMPLETE))


def read_export(path: Path) -> ExportedRun | None:
    """Read an export of this software, which its content tells and not its ending; None for any other file.

    Raises `ImportDataError` where a table is no longer that of its metadata, or a newer version wrote them.
    """
    exported = None
    try:
        with path.open("rb") as file:
            begin = file.read(64)
    except OSError:
        return None
    if _CSV_BEGIN.match(begin):
        exported = _read_csv(path)
    # Libraries report damage as almost any class of error; the readers of foreign files have a sentence for it.
    with suppress(Exception):
        if begin.startswith(b"PAR1"):
            exported = _read_parquet(path)
        elif begin.startswith(b"PK"):
            exported = _read_npz(path)
        elif begin.startswith(b"MATLAB 5.0"):
            exported = _read_mat(path)
        elif begin.startswith(b"TDSm"):
            exported = _read_tdms(path)
    if exported is None:
        return None
    stated = exported.metadata.get(EXPORT_FORMAT_KEY, exported.metadata.get(EXPORT_PART_KEY))
    if not isinstance(stated, int) or stated > EXPORT_FORMAT_VERSION:
        raise ImportDataError(
            f"{path}: is an export in version {stated!r:.20} of the format, and the last one known is "
            f"{EXPORT_FORMAT_VERSION}; install a newer dragrig, or map the columns."
        )
    return exported


def _metadata_of(text: str | bytes) -> dict[str, object]:
    """Return the metadata of an export; empty for those of anything else."""
    metadata: object = json.loads(text) if text else {}
    is_export = isinstance(metadata, dict) and (EXPORT_FORMAT_KEY in metadata or EXPORT_PART_KEY in metadata)
    return metadata if is_export and isinstance(metadata, dict) else {}


def _read_parquet(path: Path) -> ExportedRun | None:
    from pyarrow import parquet

    held = parquet.read_metadata(path)
    metadata = _metadata_of((held.schema.to_arrow_schema().metadata or {}).get(b"dragrig", b""))
    if not metadata or 8 * held.num_rows * held.num_columns > file_kinds.MAX_UNPACKED_BYTES:
        return None
    table = parquet.read_table(path)
    columns = {name: table.column(name).to_numpy() for name in _mapping(metadata["columns"])}
    return ExportedRun(path, metadata, columns)


def _read_npz(path: Path) -> ExportedRun | None:
    with zipfile.ZipFile(path) as archive:
        sizes = [entry.file_size for entry in archive.infolist()]
        if "metadata.npy" not in archive.namelist() or sum(sizes) > file_kinds.MAX_UNPACKED_BYTES:
            return None
    with np.load(path, allow_pickle=False) as held:
        metadata = _metadata_of(str(held["metadata"]))
        columns = {name: np.atleast_1d(held[name]) for name in _mapping(metadata["columns"])}
    return ExportedRun(path, metadata, columns)


def _read_mat(path: Path) -> ExportedRun | None:
    from scipy.io import loadmat

    with path.open("rb") as file:
        file.seek(MAT_BEGIN_BYTES)
        begin = zlib.decompressobj().decompress(file.read(4096), 256)
    # The struct `run` is the only element, and its length is that to which it unpacks.
    if b"run" not in begin or struct.unpack("=I", begin[4:8])[0] > file_kinds.MAX_UNPACKED_BYTES:
        return None
    run = loadmat(path, variable_names=["run"])["run"][0, 0]
    metadata = _metadata_of(str(run["metadata_json"].item()))
    return ExportedRun(path, metadata, {name: run[name].ravel() for name in _mapping(metadata["columns"])})


def _read_tdms(path: Path) -> ExportedRun | None:
    from nptdms import TdmsFile

    with TdmsFile.open(path) as held:
        metadata = _metadata_of(str(held.properties.get("dragrig", "")))
        names = _mapping(metadata["columns"])
        if 8 * sum(len(held["run"][name]) for name in names) > file_kinds.MAX_UNPACKED_BYTES:
            return None
        return ExportedRun(path, metadata, {name: held["run"][name][:] for name in names})


def _read_csv(path: Path) -> ExportedRun | None:
    entries: dict[str, object] = {}
    try:
        with path.open("rb") as file:
            line = file.readline().decode("utf-8-sig")
            while match := _LINE.fullmatch(line.rstrip("\r\n")):
                entries[match[1]] = json.loads(match[2])
                line = file.readline().decode()
            body = file.read()
        types = {name: str(_sequence(column)[2]) for name, column in _mapping(entries["columns"]).items()}
    except (LookupError, TypeError, ValueError):
        return None  # changed so far that it is a table as any other
    delimiter = next((mark for mark in DELIMITERS if mark.join(types) == line.rstrip("\r\n")), None)
    if delimiter is None:
        raise _changed(path, "the columns are no longer those that they name")
    return ExportedRun(path, entries, _csv_columns(path, body, delimiter, types))


def _csv_columns(path: Path, body: bytes, delimiter: str, types: Mapping[str, str]) -> dict[str, Array]:
    import pyarrow as pa
    from pyarrow import csv

    if not body.strip():
        return {name: np.empty(0, dtype=dtype) for name, dtype in types.items()}
    decimal = "," if delimiter != "," and b"," in body else "."
    try:
        table = csv.read_csv(
            io.BytesIO(body),
            csv.ReadOptions(column_names=list(types), block_size=min(len(body) + 1, 2**31 - 1)),
            csv.ParseOptions(delimiter=delimiter),
            csv.ConvertOptions(
                decimal_point=decimal,
                null_values=[""],
                column_types={name: pa.from_numpy_dtype(np.dtype(dtype)) for name, dtype in types.items()},
            ),
        )
    except (pa.ArrowException, TypeError) as error:
        raise _changed(path, str(error).splitlines()[0][:100]) from error
    return {name: table.column(name).to_numpy() for name in types}


def restore_run(exported: ExportedRun) -> PreparedRun:
    """Return an exported run without its filtered traces, which can be computed again.

    Of a part of a run, columns that were not exported are missing (position), taken from the position (command, phase),
    or as filtered (force); an event says so. Rows that are means of samples are those of a run at a lower rate.

    Raises
    ------
    ImportDataError
        When the metadata were changed, or no force was exported.
    """
    metadata = exported.metadata
    try:
        columns, channels, rate_hz, remarks = _part_of_run(exported)
        run_id, entry = str(metadata["run_id"]), _attributes(metadata["entry"])
        if EXPORT_PART_KEY in metadata:
            run_id = str(uuid5(UUID(run_id), json.dumps([list(columns), metadata["samples_averaged"]])))
            entry["samples_averaged"] = int(str(metadata["samples_averaged"]))
        header = RunHeader(
            run_id=run_id,
            start_time=datetime.fromisoformat(str(metadata["start_time"])),
            order=int(str(metadata["order"])),
            backend="external",
            kind=str(metadata["kind"]),
            sample_rate_hz=rate_hz,
            channels=channels,
            entry={**entry, "exported_from": str(metadata["backend"])},
            protocol=_attributes(metadata["protocol"]),
            capsule=_attributes(metadata["capsule"]),
            specimen=_attributes(metadata["specimen"]),
            settings_toml=str(metadata.get("settings_toml", "")),
        )
        entries = (_sequence(event) for event in _sequence(metadata["events"]))
        events = tuple(RunEvent(float(str(time_s)), str(kind), str(message)) for time_s, kind, message in entries)
        end_time = datetime.fromisoformat(str(metadata["end_time"])) if metadata["end_time"] else None
        status, reason, checks = str(metadata["status"]), str(metadata["reason"]), _attributes(metadata["checks"])
        return PreparedRun(header, columns, events, remarks, RunEnding(RunStatus(status), reason, end_time, checks))
    except (ArithmeticError, KeyError, TypeError, ValueError) as error:
        raise _changed(exported.path, str(error)) from error


def _part_of_run(
    exported: ExportedRun,
) -> tuple[Mapping[str, AnyFloatArray | PhaseArray], tuple[RecordedChannel, ...], float, tuple[str, ...]]:
    """Return a run file's columns by dataset, the recorded ones, their rate, and the events on columns made up."""
    columns: dict[str, AnyFloatArray | PhaseArray] = {}
    channels: list[RecordedChannel] = []
    remarks: list[str] = []
    for name, dataset, units in _wanted(exported.metadata):
        channel = dataset
        if dataset.startswith("filtered/"):
            channel = dataset.removeprefix("filtered/")
            channel = channel if TARGET_UNITS.get(channel, units) == units else f"{channel}_filtered"
            remarks.append(f"{channel} is what the filter made of it: the recorded one is not in the export")
        values = exported.columns[name]
        if channel in FRAME and not np.isfinite(values).all():
            raise ValueError(f"{name} has no number in row {np.isfinite(values).argmin() + 1}")
        is_float32 = values.dtype == np.float32
        columns[channel] = values.astype(np.uint8 if channel == "phase" else "f4" if is_float32 else "f8")
        if channel not in FRAME:
            channels.append(RecordedChannel(channel, units, "float32" if is_float32 else "float64"))
    if not set(columns) & set(SIGNAL_CHANNELS):
        raise ImportDataError(
            f"{exported.path}: is an export without a force, of which no run can be made; export the force, too, "
            "as in --columns force,position."
        )
    rate_hz = _rate_hz(exported, np.asarray(columns["time"], dtype=np.float64))
    if EXPORT_PART_KEY in exported.metadata:
        remarks += _complete(columns, channels, rate_hz)
    return columns, tuple(channels), rate_hz, tuple(remarks)


def _wanted(metadata: Mapping[str, object]) -> list[tuple[str, str, str]]:
    """Name, dataset and unit of each column that a run is made of.

    Of the filtered ones only those without the recorded quantity that the filter would make them of again.
    """
    described = [
        (name, str(dataset), str(units))
        for name, (dataset, units, _) in ((n, _sequence(d)) for n, d in _mapping(metadata["columns"]).items())
    ]
    recorded = {dataset for _, dataset, _ in described}
    computable = {f"filtered/{dataset}" for dataset in recorded} | (
        {"filtered/speed"} if "position" in recorded else set()
    )
    return [column for column in described if column[1] not in computable]


def _rate_hz(exported: ExportedRun, time: npt.NDArray[np.float64]) -> float:
    rate_hz = float(str(exported.metadata["sample_rate_hz"])) / int(str(exported.metadata.get("samples_averaged", 1)))
    if len(time) < 2 or EXPORT_FORMAT_KEY in exported.metadata:
        return rate_hz
    own_hz = 1 / float(np.median(np.diff(time)))
    return rate_hz if 1 / MAX_RATE_RATIO < own_hz / rate_hz < MAX_RATE_RATIO else own_hz


def _complete(
    columns: dict[str, AnyFloatArray | PhaseArray], channels: list[RecordedChannel], rate_hz: float
) -> list[str]:
    """Add position, command and phase where the export is without; return the remarks on them."""
    time = np.asarray(columns["time"], dtype=np.float64)
    remarks: list[str] = []
    if "position" not in columns:
        columns["position"] = np.full(len(time), np.nan)
        channels.append(RecordedChannel("position", "mm", "float64"))
        remarks.append("no position in the export: position is missing (NaN)")
    if "command" not in columns:
        columns["command"] = columns["position"]
        remarks.append("no command in the export: the position is used in its place")
    if "phase" not in columns:
        columns["phase"], found = phases_of(np.asarray(columns["position"], dtype=np.float64), time, rate_hz)
        remarks.append(found)
    return remarks


def _changed(path: Path, reason: str) -> ImportDataError:
    return ImportDataError(
        f"{path}: holds the metadata of an export, which were changed ({reason}); restore them, or remove them all and "
        "map the columns."
    )


def _attributes(group: object) -> dict[str, Attribute]:
    """Attributes of a group; None stands for a number that was not finite."""
    return {str(key): float("nan") if value is None else value for key, value in _mapping(group).items()}


def _mapping(value: object) -> Mapping[str, "Attribute | None"]:
    if not isinstance(value, dict):
        raise TypeError(f"{value!r:.40} is no table")
    return value


def _sequence(value: object) -> list[object]:
    if not isinstance(value, list):
        raise TypeError(f"{value!r:.40} is no list")
    return value
