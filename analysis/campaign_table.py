"""A campaign as a table with one row per run, and means of repeated runs."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from math import isnan, nan, sqrt
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dragrig.analysis.computation import Progress, no_progress
from dragrig.analysis.measures import RunMeasures, measure
from dragrig.config.errors import RunFileError
from dragrig.rig.runfile.model import Attribute, Run, RunInfo, RunStatus

if TYPE_CHECKING:
    import pandas as pd

UNREADABLE = "unreadable"
"""Status in the table of a file that cannot be read as a run."""
COMPLETE_STATUSES = frozenset({RunStatus.COMPLETE.value})
"""Runs that ended otherwise are shown but never averaged."""


@dataclass(frozen=True, slots=True)
class TableRow:
    """One run in numbers; None where the run has no such number, with the reason in `remark`."""

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
        """Whether the run may be averaged with others: whole, and not marked as bad."""
        return not self.bad and self.status in COMPLETE_STATUSES


@dataclass(frozen=True, slots=True)
class SpeedMean:
    """What the runs of one kind, at one speed, on one specimen say together.

    `standard_error_mN` is the larger of what the scatter between the runs gives and what their own
    errors give; a single run has only its own.
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
    """Measure every run of a campaign, in order; files that cannot be read get a row that says so.

    Raises
    ------
    RunFileError
        When there is no such folder.
    """
    from dragrig.rig.runfile import read_campaign, read_run

    found = read_campaign(folder)
    rows: list[TableRow] = []
    for done, info in enumerate(found.runs):
        progress(done, len(found.runs))
        mark = found.marks.get(info.path)
        try:
            rows.append(table_row(read_run(info.path), mark.reason if mark else None))
        except RunFileError as error:
            rows.append(_unreadable_row(info.path, error))
    progress(len(found.runs), len(found.runs))
    rows.extend(_unreadable_row(path, error) for path, error in found.unreadable)
    rows.extend(TableRow(path.name, status=RunStatus.RECORDING.value) for path in found.recordings)
    return tuple(rows)


def table_row(run: Run, bad: str | None = None) -> TableRow:
    """Measure one run; `bad` is the reason of its mark, if it has one."""
    info, measured = run.info, measure(run)
    header, protocol = info.header, info.header.protocol
    return TableRow(
        file=info.path.name,
        specimen=str(header.specimen.get("name", "")),
        order=header.order,
        kind=header.kind,
        start_time=header.start_time,
        speed_mm_s=_finite_number(protocol.get("speed_mm_s", protocol.get("ramp_speed_mm_s"))),
        shear_strain=_finite_number(protocol.get("shear_strain")),
        travel_mm=_finite_number(protocol.get("travel_mm")),
        capsule=capsule_label(info),
        steady_force_mN=measured.steady_force.value,
        steady_force_error_mN=measured.steady_force.standard_error,
        rest_offset_mN=measured.rest_offset.value,
        rest_offset_error_mN=measured.rest_offset.standard_error,
        peak_force_mN=measured.peak_force.value,
        hold_force_mN=measured.hold_force.value,
        measured_speed_mm_s=measured.speed.value,
        status=info.status.value,
        checks=check_summary(info),
        bad=bad is not None,
        mark=bad or "",
        remark=_remark(measured),
    )


def mean_per_speed(rows: Sequence[TableRow]) -> tuple[SpeedMean, ...]:
    """Average the steady force over repeated runs, leaving out bad, unfinished and force-less ones."""
    groups: dict[tuple[str, str, str, float, int], list[TableRow]] = {}
    for row in rows:
        if row.counts and row.steady_force_mN is not None and row.speed_mm_s is not None:
            direction = -1 if (row.measured_speed_mm_s or row.travel_mm or 1.0) < 0 else 1
            groups.setdefault((row.specimen, row.kind, row.capsule, row.speed_mm_s, direction), []).append(row)
    return tuple(
        SpeedMean(*key, len(found), float(np.mean(_forces(found))), _error_of_mean(found))
        for key, found in sorted(groups.items())
    )


def as_frame(rows: Sequence[TableRow] | Sequence[SpeedMean]) -> "pd.DataFrame":
    """Return rows as a data frame whose columns are the rows' fields; a missing number is NaN."""
    import pandas as pd

    kind = type(rows[0]) if rows else TableRow
    columns: dict[str, list[object]] = {}
    for one in fields(kind):
        values = [getattr(row, one.name) for row in rows]
        columns[one.name] = (
            [nan if value is None else value for value in values] if "float" in str(one.type) else values
        )
    return pd.DataFrame(columns)


def capsule_label(info: RunInfo) -> str:
    """Return the capsule's name, or its measures where it has none."""
    capsule = info.header.capsule
    name = capsule.get("name")
    if name:
        return str(name)
    diameter, length, mass = (_finite_number(capsule.get(key)) for key in ("diameter_mm", "length_mm", "mass_g"))
    if diameter is None or length is None:
        return ""
    return f"{diameter:g} × {length:g} mm" + ("" if mass is None else f", {mass:g} g")


def check_summary(info: RunInfo) -> str:
    """Return what the run's own checks found, in a few words; empty where nothing was checked."""
    checks = info.checks
    if not checks:
        return ""
    said = [f"{checks[key]} {word}" for key, word in _COUNTED_CHECKS.items() if checks.get(key)]
    slip = _finite_number(checks.get("slip_time_s"))
    if slip is not None and slip >= 0:
        said.append(f"slip at {slip:.1f} s")
    return ", ".join(said) or "ok"


_COUNTED_CHECKS = {"lost_samples": "lost", "clipped_samples": "clipped"}


def _finite_number(value: Attribute | None) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or isnan(value):
        return None
    return float(value)


def _remark(measured: RunMeasures) -> str:
    named = {"steady force": measured.steady_force, "rest offset": measured.rest_offset, "peak": measured.peak_force,
             "hold force": measured.hold_force, "speed": measured.speed}  # fmt: skip
    return "; ".join(f"no {name}: {one.reason}" for name, one in named.items() if one.reason)


def _unreadable_row(path: Path, error: RunFileError) -> TableRow:
    return TableRow(path.name, status=UNREADABLE, remark=str(error).removeprefix(f"{path}: "))


def _forces(rows: Sequence[TableRow]) -> list[float]:
    return [row.steady_force_mN for row in rows if row.steady_force_mN is not None]


def _error_of_mean(rows: Sequence[TableRow]) -> float | None:
    own = [row.steady_force_error_mN for row in rows if row.steady_force_error_mN is not None]
    from_errors = sqrt(sum(error**2 for error in own)) / len(rows) if len(own) == len(rows) else None
    if len(rows) < 2:
        return from_errors
    scatter = float(np.std(_forces(rows), ddof=1)) / sqrt(len(rows))
    return max(scatter, from_errors or 0.0)
