"""What an export holds: columns with their units in their names, and everything the run file says of itself."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite

import numpy as np
import numpy.typing as npt

from dragrig.rig.runfile.model import PHASE_NAMES, Attribute, Run

FORMAT = "dragrig-export"
VERSION = 1

Json = str | float | int | bool | None | list["Json"] | dict[str, "Json"]


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One column of an export: `dataset` and `units` are those of the run file."""

    name: str
    dataset: str
    units: str
    values: npt.NDArray[np.generic]


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """Columns, all of the same length, and metadata that any format can carry."""

    columns: tuple[Column, ...]
    metadata: Mapping[str, Json]


def content_of(run: Run) -> Content:
    """Gather what is exported of a run: time, signal, further channels, filtered values, position, command, phase."""
    trace = run.trace
    others = [name for name in trace.channels if name not in {trace.signal, "position"}]
    found = [_column("time", "s", trace.time)]
    found += [_column(name, trace.units.get(name, ""), trace.channels[name]) for name in (trace.signal, *others)]
    if run.filtered is not None and len(run.filtered.time) == len(trace.time):
        for name, values in run.filtered.channels.items():
            units = run.filtered.units.get(name) or ("mm/s" if name == "speed" else trace.units.get(name, ""))
            label = name if name not in trace.channels else f"{name}_filtered"
            found.append(_column(label, units, values, f"filtered/{name}"))
    found.append(_column("position", "mm", trace.position))
    found.append(_column("command", "mm", trace.command))
    found.append(Column("phase", "phase", "", trace.phase))
    return Content(tuple(found), _metadata(run, found))


def column_name(label: str, units: str) -> str:
    """Put a unit into a column's name: force and mN become force_mN, speed and mm/s speed_mm_s."""
    unit = re.sub(r"\W+", "_", units.replace("²", "2").replace("µ", "u").replace("°", "deg")).strip("_")
    name = re.sub(r"\W+", "_", label).strip("_") or "column"
    return f"{name}_{unit}" if unit else name


def _column(label: str, units: str, values: npt.NDArray[np.generic], dataset: str = "") -> Column:
    return Column(column_name(label, units), dataset or label, units, values)


def _metadata(run: Run, columns: list[Column]) -> dict[str, Json]:
    info, header = run.info, run.info.header
    return {
        FORMAT: VERSION,
        "run_id": header.run_id,
        "start_time": header.start_time.isoformat(),
        "end_time": info.end_time.isoformat() if info.end_time else "",
        "order": header.order,
        "kind": header.kind,
        "backend": header.backend,
        "status": info.status.value,
        "reason": info.reason,
        "sample_rate_hz": header.sample_rate_hz,
        "signal": run.trace.signal,
        "phases": list(PHASE_NAMES),
        "columns": {column.name: [column.dataset, column.units, column.values.dtype.name] for column in columns},
        "entry": _plain(header.entry),
        "protocol": _plain(header.protocol),
        "capsule": _plain(header.capsule),
        "specimen": _plain(header.specimen),
        "checks": _plain(info.checks),
        "filter": _plain(run.filtered.parameters) if run.filtered is not None else {},
        "events": [[event.time_s, event.kind, event.message] for event in run.events],
        "settings_toml": header.settings_toml,
    }


def _plain(attributes: Mapping[str, Attribute]) -> dict[str, Json]:
    """Numbers that are not finite become None: JSON knows no others."""
    return {
        key: None if isinstance(value, float) and not isfinite(value) else value for key, value in attributes.items()
    }
