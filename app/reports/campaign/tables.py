"""The tables of a campaign's report."""

from collections.abc import Collection, Iterator

from dragrig.analysis.table import UNREADABLE, TableRow, mean_per_speed
from dragrig.reports.campaign.results import CampaignResults, anchor
from dragrig.reports.tabular import Cell, Column, Table, briefly, digits, places, plainly
from dragrig.rig.runfile.model import RunInfo, Status

_TENTHS = places(1)
_SPEED = Column("speed_mm_s", "mm/s", briefly)
_STEADY = Column("steady_force_mN", "steady, mN", _TENTHS)


def tables(results: CampaignResults, drawn: Collection[str]) -> dict[str, Table]:
    """Return all tables by name; `drawn` holds the ids of the runs that are drawn by themselves."""
    made = (_means(results), _runs(results, drawn), _sessions(results), left_out(results))
    return {table.name: table for table in made}


def _means(results: CampaignResults) -> Table:
    columns = (
        Column("specimen", "specimen"),
        Column("kind", "kind"),
        Column("capsule", "capsule"),
        _SPEED,
        Column("way", "way"),
        Column("runs", "runs", plainly),
        _STEADY,
        Column("standard_error_mN", "±", digits(2)),
    )
    rows = tuple(
        (
            one.specimen,
            one.kind,
            one.capsule,
            one.speed_mm_s,
            "forward" if one.direction > 0 else "backward",
            one.runs,
            one.steady_force_mN,
            one.standard_error_mN,
        )
        for one in mean_per_speed(results.rows)
    )
    return Table("means", "Mean of equal runs, without bad and unfinished ones; ± is one standard error", columns, rows)


def _runs(results: CampaignResults, drawn: Collection[str]) -> Table:
    columns = (
        Column("order", "run", lambda value: f"{value:03.0f}"),
        Column("kind", "kind"),
        _SPEED,
        Column("shear_strain", "strain", lambda value: f"{100 * value:g} %"),
        _STEADY,
        Column("steady_force_error_mN", "±", digits(2)),
        Column("rest_offset_mN", "at rest, mN", _TENTHS),
        Column("peak_force_mN", "peak, mN", _TENTHS),
        Column("status", "status"),
        Column("checks", "checks"),
        Column("began", "began"),
    )
    rows = tuple(_run(row) for row in results.rows if row.kind)
    ids = (anchor(row.file) for row in results.rows if row.kind)
    links = tuple(one if one in drawn else "" for one in ids)
    return Table("runs", "Every run, in order; ± is one standard error", columns, rows, links)


def _run(row: TableRow) -> tuple[Cell, ...]:
    return (
        row.order,
        row.kind,
        row.measured_speed_mm_s if row.speed_mm_s is None else row.speed_mm_s,
        row.shear_strain,
        row.steady_force_mN,
        row.steady_force_error_mN,
        row.rest_offset_mN,
        row.peak_force_mN,
        f"{row.status}, marked bad" if row.bad else row.status,
        row.checks,
        "" if row.start_time is None else f"{row.start_time:%H:%M:%S}",
    )


def _sessions(results: CampaignResults) -> Table:
    columns = (
        Column("begun", "begun"),
        Column("plan", "plan"),
        Column("rig", "rig"),
        Column("operator", "operator"),
        Column("runs", "runs", plainly),
        Column("calibration", "force calibration"),
        Column("note", "note"),
    )
    begun = [one.begun_at for one in results.sessions]
    ends = [*begun[1:], None]
    rows = tuple(
        (
            f"{one.begun_at:%Y-%m-%d %H:%M:%S}",
            one.plan.name,
            f"{one.backend}, double" if one.double else one.backend,
            one.operator,
            sum(one.begun_at <= run.header.start_time and (end is None or run.header.start_time < end)
                for run in results.found.runs),
            one.calibration_id,
            one.note,
        )
        for one, end in zip(results.sessions, ends, strict=True)
    )  # fmt: skip
    return Table("sessions", "Each time that somebody began or went on", columns, rows)


def left_out(results: CampaignResults) -> Table:
    """Tabulate what takes no part in means and figures, and why."""
    columns = (Column("file", "file"), Column("kind", "kind"), Column("why", "why"))
    return Table("left-out", "In no mean and no figure of the campaign", columns, tuple(_left_out(results)))


def _left_out(results: CampaignResults) -> Iterator[tuple[Cell, ...]]:
    for info in results.readable:
        why = _why(info, results)
        if why:
            yield info.path.name, info.kind, why
    for row in results.rows:
        if row.status == UNREADABLE:
            yield row.file, row.kind, row.remark
    for path in results.found.recordings:
        yield path.name, "", "is being recorded, or was left so by a crash: dragrig recover finishes it"
    for record in results.damaged:
        yield "session record", "", record


def _why(info: RunInfo, results: CampaignResults) -> str:
    bad = results.bad.get(info.path.name)
    if bad is not None:
        return f"marked bad: {bad}"
    if info.status is Status.COMPLETE:
        return ""
    return f"{info.status}: {info.reason}" if info.reason else str(info.status)
