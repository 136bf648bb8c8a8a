"""Import of a foreign measurement into a run file."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from uuid import uuid4

import numpy as np

from dragrig.analysis.importing.conversion import IMPORT_EVENT, ConvertedMeasurement, convert_table
from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.analysis.importing.mapping import ImportSettings
from dragrig.analysis.importing.readers import read_foreign
from dragrig.config.errors import ImportDataError, OutputError
from dragrig.rig.arrays import AnyFloatArray, PhaseArray
from dragrig.rig.runfile.model import Attribute, Channel, RunEvent, RunHeader, RunStatus

NOT_CHANNELS = frozenset({"time", "command", "phase"})


@dataclass(frozen=True, slots=True, eq=False)
class RestoredRun:
    """What `write_run` needs to write the run again."""

    header: RunHeader
    columns: Mapping[str, AnyFloatArray | PhaseArray]
    events: tuple[RunEvent, ...]
    status: RunStatus
    reason: str
    end_time: datetime | None
    checks: Mapping[str, Attribute]


def restore_export(table: ForeignTable) -> RestoredRun:
    """Put an exported run together again; what the filter made is left to the filter.

    Raises
    ------
    ImportDataError
        When its metadata were changed so that they no longer fit.
    """
    said = table.export
    try:
        columns, channels = _restored_columns(table, said["columns"])
        header = RunHeader(
            run_id=str(said["run_id"]),
            start_time=datetime.fromisoformat(str(said["start_time"])),
            order=int(str(said["order"])),
            backend="external",
            kind=str(said["kind"]),
            sample_rate_hz=float(str(said["sample_rate_hz"])),
            channels=channels,
            entry={**_restored_attributes(said["entry"]), "exported_from": str(said["backend"])},
            protocol=_restored_attributes(said["protocol"]),
            capsule=_restored_attributes(said["capsule"]),
            specimen=_restored_attributes(said["specimen"]),
            settings_toml=str(said.get("settings_toml", "")),
        )
        return RestoredRun(
            header,
            columns,
            tuple(_restored_events(said["events"])),
            RunStatus(str(said["status"])),
            str(said["reason"]),
            datetime.fromisoformat(str(said["end_time"])) if said["end_time"] else None,
            _restored_attributes(said["checks"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ImportDataError(
            f"{table.path}: the metadata of an export are there but were changed ({error}); restore them, or remove "
            "them all and map the columns."
        ) from error


def _restored_columns(
    table: ForeignTable, said: object
) -> tuple[dict[str, AnyFloatArray | PhaseArray], tuple[Channel, ...]]:
    if not isinstance(said, dict):
        raise TypeError("columns is no table")
    columns: dict[str, AnyFloatArray | PhaseArray] = {}
    channels: list[Channel] = []
    for name, (dataset, units, dtype) in said.items():
        if str(dataset).startswith("filtered/"):
            continue
        column = table.column(name)
        values = table.numbers(column, whole=dataset in NOT_CHANNELS)
        if dataset == "phase":
            columns["phase"] = values.astype(np.uint8)
        elif dtype == "float32":
            columns[dataset] = values.astype(np.float32)
        else:
            columns[dataset] = values
        if dataset not in NOT_CHANNELS:
            channels.append(Channel(dataset, units, "float32" if dtype == "float32" else "float64"))
    return columns, tuple(channels)


def _restored_attributes(said: object) -> dict[str, Attribute]:
    """Attributes of a group; None stands for a number that was not finite."""
    if not isinstance(said, dict):
        raise TypeError("attributes are no table")
    return {str(key): float("nan") if value is None else value for key, value in said.items()}


def _restored_events(said: object) -> list[RunEvent]:
    if not isinstance(said, list):
        raise TypeError("events are no list")
    return [RunEvent(float(time), str(kind), str(message)) for time, kind, message in said]


UNKNOWN_SIZE = float("nan")
MAX_PREAMBLE_CHARS = 4000


@dataclass(frozen=True, slots=True)
class ImportedRun:
    """The run file that was written, and what is to be said of it."""

    path: Path
    samples: int
    sample_rate_hz: float
    events: tuple[RunEvent, ...]


def import_file(path: Path, target: Path, settings: ImportSettings | None = None) -> ImportedRun:
    """Turn a foreign measurement into a run file.

    A file that this software exported comes back as the run it was; for every other file a column map
    is needed. `force` and `motor_force` are stored in mN. A quantity of another kind becomes one by a
    stated factor only (a friction coefficient by the normal load it belongs to, `Friction:1*1000` for
    1 N; a current by the motor's constant, `Iq:A*40000`); the column itself is then kept beside it, in its
    own unit, and an event says so.

    Parameters
    ----------
    target
        A run file to be, or a folder in which it gets its usual name.

    Raises
    ------
    ImportDataError
        When the file does not hold what the settings say.
    OutputError
        When something stands at the target already, or it cannot be written.
    """
    from dragrig.rig.runfile import run_file_name, write_run

    settings = settings or ImportSettings()
    table = read_foreign(path, settings)
    if table.export and not settings.columns.mapped():
        back = restore_export(table)
        where = _run_file_path(target, run_file_name(back.header.start_time, back.header.kind, back.header.order))
        written = write_run(
            where, back.header, back.columns, events=back.events, status=back.status, reason=back.reason,
            end_time=back.end_time, checks=back.checks,
        )  # fmt: skip
        return ImportedRun(written, table.rows, back.header.sample_rate_hz, back.events)
    measured = convert_table(table, settings)
    header, events = _run_header(path, table, settings, measured)
    where = _run_file_path(target, run_file_name(header.start_time, header.kind, header.order))
    written = write_run(where, header, measured.columns, events=events)
    return ImportedRun(written, len(measured.columns["time"]), measured.sample_rate_hz, events)


def _run_file_path(target: Path, name: str) -> Path:
    found = target / name if target.is_dir() else target
    if found.suffix != ".h5":
        raise OutputError(f"{found}: is not a name for a run file; let it end in .h5, or give a folder that exists.")
    return found


def _run_header(
    path: Path, table: ForeignTable, settings: ImportSettings, measured: ConvertedMeasurement
) -> tuple[RunHeader, tuple[RunEvent, ...]]:
    events = list(measured.events)
    start_time = settings.start_time
    if start_time is None:
        start_time = datetime.fromtimestamp(path.stat().st_mtime, UTC)
        events.insert(0, RunEvent(0.0, IMPORT_EVENT, "start time not known: when the file was last changed"))
    entry: dict[str, Attribute] = {
        "software": f"dragrig {version('dragrig')}",
        "operator": settings.operator,
        "note": settings.note,
        "origin_mm": measured.origin_mm,
        "import_source": path.name,
        "import_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "import_columns": json.dumps(dict(measured.sources), ensure_ascii=False),
        "import_settings": settings.model_dump_json(exclude_defaults=True),
        "import_time_origin_s": measured.time_origin_s,
        "import_preamble": "\n".join(table.preamble)[:MAX_PREAMBLE_CHARS],
    }
    header = RunHeader(
        run_id=str(uuid4()),
        start_time=start_time,
        order=settings.order,
        backend="external",
        kind=settings.kind,
        sample_rate_hz=measured.sample_rate_hz,
        channels=measured.channels,
        entry={key: value for key, value in entry.items() if value != ""},
        protocol=dict(settings.protocol),
        capsule={
            "diameter_mm": UNKNOWN_SIZE,
            "length_mm": UNKNOWN_SIZE,
            "mass_g": UNKNOWN_SIZE,
            "contact_angle_deg": UNKNOWN_SIZE,
        },
        specimen={"name": settings.specimen or path.stem, "wall_thickness_mm": UNKNOWN_SIZE, "fixture": "none"},
    )
    return header, tuple(events)
