"""A campaign as a table with one row per run, and means of repeated runs."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from math import nan, sqrt
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dragrig.analysis.computation import Progress, no_progress
from dragrig.analysis.measures import measure
from dragrig.analysis.segments import attribute_number
from dragrig.config.errors import RunFileError
from dragrig.rig.runfile.model import Run, RunInfo, RunStatus

if TYPE_CHECKING:
    import pandas as pd

UNREADABLE = "unreadable"
"""Status in the table of a file that cannot be read as a run."""
COMPLETE_STATUSES = frozenset({RunStatus.COMPLETE.value})
"""Runs that ended otherwise are shown but never averaged."""


@dataclass(frozen=True, slots=True)
class TableRow:
    """Measures of one run; None where the run has none, with the reason in `remark`."""

    file: str
    specimen: str = ""
    order: int | None = None
    kind: str = ""
    start_time: datetime | None = None
    speed_mm_s: float | None = None
    shear_strain: float | None = None
    travel_mm: float | None = None
    capsule: str = ""
    steady_force_mN: float | None = None
    steady_force_error_mN: float | None = None
    rest_offset_mN: float | None = None
    rest_offset_error_mN: float | None = None
    peak_force_mN: float | None = None
    hold_force_mN: float | None = None
    measured_speed_mm_s: float | None = None
    status: str = ""
    checks: str = ""
    bad: bool = False
    mark: str = ""
    remark: str = ""

    @property
    def counts(self) -> bool:
        """Whether the run may be averaged with others: complete, and not marked as bad."""
        return not self.bad and self.status in COMPLETE_STATUSES


@dataclass(frozen=True, slots=True)
class SpeedMean:
    """Mean over the runs of one kind, at one speed, on one specimen.

    `standard_error_mN` is the larger of the errors by the scatter between the runs and by their own
    errors; a single run has only its own.
    """

    specimen: str
    kind: str
    capsule: str
    speed_mm_s: float
    direction: int
    runs: int
    steady_force_mN: float
    standard_error_mN: float | None


def table_rows(folder: Path, progress: Progress = no_progress) -> tuple[TableRow, ...]:
    """Measure every run of a campaign, in order; a file that cannot be read has a row with the reason.

    Raises
    ------
    RunFileError
        When there is no such folder.
    """
    from dragrig.rig.runfile import read_campaign, read_run

    campaign = read_campaign(folder)
    rows: list[TableRow] = []
    for done, info in enumerate(campaign.runs):
        progress(done, len(campaign.runs))
        mark = campaign.marks.get(info.path)
        try:
            rows.append(table_row(read_run(info.path), mark.reason if mark else None))
        except RunFileError as error:
            rows.append(_unreadable_row(info.path, error))
    progress(len(campaign.runs), len(campaign.runs))
    rows.extend(_unreadable_row(path, error) for path, error in campaign.unreadable)
    rows.extend(TableRow(path.name, status=RunStatus.RECORDING.value) for path in campaign.recordings)
    return tuple(rows)


def table_row(run: Run, bad: str | None = None) -> TableRow:
    """Measure one run; `bad` is the reason of its mark, if it has one."""
    info, measured = run.info, measure(run)
    header, protocol = info.header, info.header.protocol
    named = {"steady force": measured.steady_force, "rest offset": measured.rest_offset, "peak": measured.peak_force,
             "hold force": measured.hold_force, "speed": measured.speed}  # fmt: skip
    return TableRow(
        file=info.path.name,
        specimen=str(header.specimen.get("name", "")),
        order=header.order,
        kind=header.kind,
        start_time=header.start_time,
        speed_mm_s=attribute_number(protocol, "speed_mm_s", "ramp_speed_mm_s"),
        shear_strain=attribute_number(protocol, "shear_strain"),
        travel_mm=attribute_number(protocol, "travel_mm"),
        capsule=_capsule_label(info),
        steady_force_mN=measured.steady_force.value,
        steady_force_error_mN=measured.steady_force.standard_error,
        rest_offset_mN=measured.rest_offset.value,
        rest_offset_error_mN=measured.rest_offset.standard_error,
        peak_force_mN=measured.peak_force.value,
        hold_force_mN=measured.hold_force.value,
        measured_speed_mm_s=measured.speed.value,
        status=info.status.value,
        checks=_check_summary(info),
        bad=bad is not None,
        mark=bad or "",
        remark="; ".join(f"no {name}: {estimate.reason}" for name, estimate in named.items() if estimate.reason),
    )


def _capsule_label(info: RunInfo) -> str:
    """Return the capsule's name, or its sizes where it has none."""
    capsule = info.header.capsule
    if name := capsule.get("name"):
        return str(name)
    diameter, length, mass = (attribute_number(capsule, key) for key in ("diameter_mm", "length_mm", "mass_g"))
    if diameter is None or length is None:
        return ""
    return f"{diameter:g} × {length:g} mm" + ("" if mass is None else f", {mass:g} g")


def _check_summary(info: RunInfo) -> str:
    """Results of the run's own checks; empty where nothing was checked."""
    checks = info.checks
    if not checks:
        return ""
    counted = {"lost_samples": "lost", "clipped_samples": "clipped"}
    findings = [f"{checks[key]} {word}" for key, word in counted.items() if checks.get(key)]
    slip_s = attribute_number(checks, "slip_time_s")
    if slip_s is not None and slip_s >= 0:
        findings.append(f"slip at {slip_s:.1f} s")
    return ", ".join(findings) or "ok"


def _unreadable_row(path: Path, error: RunFileError) -> TableRow:
    return TableRow(path.name, status=UNREADABLE, remark=str(error).removeprefix(f"{path}: "))


def mean_per_speed(rows: Sequence[TableRow]) -> tuple[SpeedMean, ...]:
    """Average the steady force over repeated runs that are complete, not marked as bad, and have one."""
    groups: dict[tuple[str, str, str, float, int], list[tuple[float, float | None]]] = {}
    for row in rows:
        if row.counts and row.steady_force_mN is not None and row.speed_mm_s is not None:
            direction = -1 if (row.measured_speed_mm_s or row.travel_mm or 1.0) < 0 else 1
            key = (row.specimen, row.kind, row.capsule, row.speed_mm_s, direction)
            groups.setdefault(key, []).append((row.steady_force_mN, row.steady_force_error_mN))
    means = []
    for key, measured in sorted(groups.items()):
        forces, errors = zip(*measured, strict=True)
        means.append(SpeedMean(*key, len(forces), float(np.mean(forces)), _error_of_mean(forces, errors)))
    return tuple(means)


def _error_of_mean(forces: Sequence[float], errors: Sequence[float | None]) -> float | None:
    known = [error for error in errors if error is not None]
    from_errors = sqrt(sum(error**2 for error in known)) / len(forces) if len(known) == len(forces) else None
    if len(forces) < 2:
        return from_errors
    return max(float(np.std(forces, ddof=1)) / sqrt(len(forces)), from_errors or 0.0)


def as_frame(rows: Sequence[TableRow] | Sequence[SpeedMean]) -> "pd.DataFrame":
    """Return rows as a data frame whose columns are the rows' fields; a missing number is NaN."""
    import pandas as pd

    columns: dict[str, list[object]] = {}
    for column in fields(type(rows[0]) if rows else TableRow):
        values = [getattr(row, column.name) for row in rows]
        if "float" in str(column.type):
            values = [nan if value is None else value for value in values]
        columns[column.name] = values
    return pd.DataFrame(columns)
