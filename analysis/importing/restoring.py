"""Runs that this software exported, read back as they were."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.config.errors import ImportDataError
from dragrig.rig.arrays import AnyFloatArray, PhaseArray
from dragrig.rig.runfile.model import Attribute, Channel, Event, RunHeader, Status

NOT_CHANNELS = frozenset({"time", "command", "phase"})


@dataclass(frozen=True, slots=True, eq=False)
class Restored:
    """What `write_run` needs to write the run again."""

    header: RunHeader
    columns: Mapping[str, AnyFloatArray | PhaseArray]
    events: tuple[Event, ...]
    status: Status
    reason: str
    end_time: datetime | None
    checks: Mapping[str, Attribute]


def restore(table: ForeignTable) -> Restored:
    """Put an exported run together again; what the filter made is left to the filter.

    Raises
    ------
    ImportDataError
        When its metadata were changed so that they no longer fit.
    """
    said = table.export
    try:
        columns, channels = _columns(table, said["columns"])
        header = RunHeader(
            run_id=str(said["run_id"]),
            start_time=datetime.fromisoformat(str(said["start_time"])),
            order=int(str(said["order"])),
            backend="external",
            kind=str(said["kind"]),
            sample_rate_hz=float(str(said["sample_rate_hz"])),
            channels=channels,
            entry={**_attributes(said["entry"]), "exported_from": str(said["backend"])},
            protocol=_attributes(said["protocol"]),
            capsule=_attributes(said["capsule"]),
            specimen=_attributes(said["specimen"]),
            settings_toml=str(said.get("settings_toml", "")),
        )
        return Restored(
            header,
            columns,
            tuple(_events(said["events"])),
            Status(str(said["status"])),
            str(said["reason"]),
            datetime.fromisoformat(str(said["end_time"])) if said["end_time"] else None,
            _attributes(said["checks"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ImportDataError(
            f"{table.path}: the metadata of an export are there but were changed ({error}); restore them, or remove "
            "them all and map the columns."
        ) from error


def _columns(table: ForeignTable, said: object) -> tuple[dict[str, AnyFloatArray | PhaseArray], tuple[Channel, ...]]:
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


def _attributes(said: object) -> dict[str, Attribute]:
    """Attributes of a group; None stands for a number that was not finite."""
    if not isinstance(said, dict):
        raise TypeError("attributes are no table")
    return {str(key): float("nan") if value is None else value for key, value in said.items()}


def _events(said: object) -> list[Event]:
    if not isinstance(said, list):
        raise TypeError("events are no list")
    return [Event(float(time), str(kind), str(message)) for time, kind, message in said]
