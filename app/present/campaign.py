"""A campaign laid out for a reader: mean forces, runs, sessions, and what was left out."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime

from dragrig.analysis.campaign_table import UNREADABLE, TableRow, mean_per_speed
from dragrig.analysis.computation import Progress, no_progress
from dragrig.present.document import (
    Cell,
    Column,
    InlineFigure,
    Table,
    decimals,
    general_format,
    significant,
    three_significant,
)
from dragrig.present.drawing import (
    run_title,
)
from dragrig.present.figure_files import inline_figure
from dragrig.present.html_page import render_template
from dragrig.present.run import inline_run_figure
from dragrig.rig.protocols.return_stroke import ReturnProtocol
from dragrig.rig.runfile import Campaign, read_run
from dragrig.rig.runfile.model import Run, RunInfo, RunStatus
from dragrig.rig.runfile.schema import run_name
from dragrig.rig.session import SessionRecord


@dataclass(frozen=True, slots=True)
class CampaignReportData:
    """A campaign, looked at whole.

    Attributes
    ----------
    rows
        Its runs in numbers, by the names of their files.
    sessions
        Records of its sessions that can be read, the earliest first.
    damaged
        Records that cannot be read, each with what is wrong.
    """

    name: str
    found: Campaign
    rows: tuple[TableRow, ...]
    sessions: tuple[SessionRecord, ...] = ()
    damaged: tuple[str, ...] = ()

    @property
    def readable(self) -> tuple[RunInfo, ...]:
        """Runs whose samples can be read."""
        lost = {row.file for row in self.rows if row.status == UNREADABLE}
        return tuple(one for one in self.found.runs if one.path.name not in lost)

    @property
    def bad(self) -> Mapping[str, str]:
        """Why runs were marked bad, by the names of their files."""
        return {path.name: mark.reason for path, mark in self.found.marks.items()}


def file_anchor(file: str) -> str:
    """Return the id that a run has in the page."""
    return f"run-{file.removesuffix('.h5')}"


def run_anchor(info: RunInfo) -> str:
    """Return the same of a run."""
    return f"run-{run_name(info.path)}"


_ONE_DECIMAL = decimals(1)

_SPEED = Column("speed_mm_s", "mm/s", three_significant)

_STEADY = Column("steady_force_mN", "steady, mN", _ONE_DECIMAL)


def campaign_tables(results: CampaignReportData, drawn: Collection[str]) -> dict[str, Table]:
    """Return all tables by name; `drawn` holds the ids of the runs that are drawn by themselves."""
    made = (_mean_table(results), _run_table(results, drawn), _session_table(results), left_out_table(results))
    return {table.name: table for table in made}


def _mean_table(results: CampaignReportData) -> Table:
    columns = (
        Column("specimen", "specimen"),
        Column("kind", "kind"),
        Column("capsule", "capsule"),
        _SPEED,
        Column("way", "way"),
        Column("runs", "runs", general_format),
        _STEADY,
        Column("standard_error_mN", "±", significant(2)),
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


def _run_table(results: CampaignReportData, drawn: Collection[str]) -> Table:
    columns = (
        Column("order", "run", lambda value: f"{value:03.0f}"),
        Column("kind", "kind"),
        _SPEED,
        Column("shear_strain", "strain", lambda value: f"{100 * value:g} %"),
        _STEADY,
        Column("steady_force_error_mN", "±", significant(2)),
        Column("rest_offset_mN", "at rest, mN", _ONE_DECIMAL),
        Column("peak_force_mN", "peak, mN", _ONE_DECIMAL),
        Column("status", "status"),
        Column("checks", "checks"),
        Column("began", "began"),
    )
    rows = tuple(_run_row(row) for row in results.rows if row.kind)
    ids = (file_anchor(row.file) for row in results.rows if row.kind)
    links = tuple(one if one in drawn else "" for one in ids)
    return Table("runs", "Every run, in order; ± is one standard error", columns, rows, links)


def _run_row(row: TableRow) -> tuple[Cell, ...]:
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


def _session_table(results: CampaignReportData) -> Table:
    columns = (
        Column("begun", "begun"),
        Column("plan", "plan"),
        Column("rig", "rig"),
        Column("operator", "operator"),
        Column("runs", "runs", general_format),
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


def left_out_table(results: CampaignReportData) -> Table:
    """Tabulate what takes no part in means and figures, and why."""
    columns = (Column("file", "file"), Column("kind", "kind"), Column("why", "why"))
    return Table("left-out", "In no mean and no figure of the campaign", columns, tuple(_left_out_rows(results)))


def _left_out_rows(results: CampaignReportData) -> Iterator[tuple[Cell, ...]]:
    for info in results.readable:
        why = _reason_left_out(info, results)
        if why:
            yield info.path.name, info.kind, why
    for row in results.rows:
        if row.status == UNREADABLE:
            yield row.file, row.kind, row.remark
    for path in results.found.recordings:
        yield path.name, "", "is being recorded, or was left so by a crash: dragrig recover finishes it"
    for record in results.damaged:
        yield "session record", "", record


def _reason_left_out(info: RunInfo, results: CampaignReportData) -> str:
    bad = results.bad.get(info.path.name)
    if bad is not None:
        return f"marked bad: {bad}"
    if info.status is RunStatus.COMPLETE:
        return ""
    return f"{info.status}: {info.reason}" if info.reason else str(info.status)


OVERVIEW_ID = "overview"

MAX_DRAWN_RUNS = 100
"""So many runs are drawn one by one; a page that is mailed must stay small."""


def inline_campaign_figures(results: CampaignReportData, progress: Progress = no_progress) -> dict[str, InlineFigure]:
    """Draw the overview, and each run that is drawn by itself, by its id in the page."""
    singles = drawn_runs(results)
    steps = len(results.readable) + len(singles)
    bad = list(results.found.marks)
    from dragrig.present.campaign_figures import campaign_figure

    overview = campaign_figure(_read_runs(results.readable, progress, steps), results.name, bad)
    drawn = {
        OVERVIEW_ID: inline_figure(
            overview,
            "Steady force against speed, relaxation of the force against time since the ramp, and force along the way "
            "at a few speeds.",
            "Runs that are complete and not marked bad. Bars are 95 % intervals; forces are as recorded, the sensor's "
            "zero included.",
        )
    }
    for done, info in enumerate(singles, len(results.readable)):
        progress(done, steps)
        drawn[run_anchor(info)] = inline_run_figure(read_run(info.path), results.bad.get(info.path.name))
    progress(steps, steps)
    return drawn


def drawn_runs(results: CampaignReportData) -> tuple[RunInfo, ...]:
    """Return the runs that are drawn one by one: the first ones, ways back left out."""
    return tuple(one for one in results.readable if one.kind != ReturnProtocol.kind)[:MAX_DRAWN_RUNS]


def _read_runs(infos: tuple[RunInfo, ...], progress: Progress, steps: int) -> Iterator[Run]:
    for done, info in enumerate(infos):
        progress(done, steps)
        yield read_run(info.path)


@dataclass(frozen=True, slots=True)
class CollapsedRun:
    """A run that is drawn by itself, folded away until somebody looks."""

    id: str
    title: str
    file: str
    trouble: str
    picture: InlineFigure


def campaign_page(results: CampaignReportData, pictures: Mapping[str, InlineFigure]) -> str:
    """Return the report on a campaign as one HTML page.

    Parameters
    ----------
    pictures
        From `pictures.pictures`: the overview, and runs by their ids.
    """
    tabulated = campaign_tables(results, frozenset(pictures) - {OVERVIEW_ID})
    backends = sorted({one.header.backend for one in results.found.runs})
    return render_template(
        "campaign.html",
        {
            "title": f"Campaign {results.name}",
            "lead": _campaign_summary(results),
            "backends": backends,
            "left_out": len(tabulated["left-out"].rows),
            "runs": _collapsed_runs(results, pictures),
            "not_drawn": _not_drawn_text(results, pictures),
            "tables": tabulated,
            "pictures": pictures,
        },
    )


def _campaign_summary(results: CampaignReportData) -> str:
    runs = results.found.runs
    if not runs:
        return "No run in this folder can be read."
    counts = Counter("way back" if one.kind == ReturnProtocol.kind else one.kind for one in runs)
    kinds = ", ".join(f"{count} {_kind_text(kind, count)}" for kind, count in counts.most_common())
    specimens = sorted({str(one.header.specimen.get("name", "")) for one in runs} - {""})
    begun, last = (pick(one.header.start_time for one in runs) for pick in (min, max))
    until = f"{last:%H:%M}" if last.date() == begun.date() else _date_text(last)
    on = f" of {' and '.join(specimens)}" if specimens else ""
    return f"{len(runs)} run{'' if len(runs) == 1 else 's'}{on} ({kinds}), {_date_text(begun)} to {until}."


def _date_text(when: datetime) -> str:
    return f"{when.day} {when:%B %Y, %H:%M}"


def _kind_text(kind: str, count: int) -> str:
    return "ways back" if kind == "way back" and count > 1 else kind


def _collapsed_runs(results: CampaignReportData, pictures: Mapping[str, InlineFigure]) -> list[CollapsedRun]:
    return [
        CollapsedRun(
            run_anchor(one),
            run_title(one),
            one.path.name,
            "marked bad" if one.path.name in results.bad else "" if one.status == "complete" else str(one.status),
            pictures[run_anchor(one)],
        )
        for one in results.readable
        if run_anchor(one) in pictures
    ]


def _not_drawn_text(results: CampaignReportData, pictures: Mapping[str, InlineFigure]) -> str:
    back = sum(one.kind == ReturnProtocol.kind for one in results.readable)
    others = sum(one.kind != ReturnProtocol.kind and run_anchor(one) not in pictures for one in results.readable)
    told = [f"{back} {_kind_text('way back', back)}"] if back else []
    told += [f"{others} more"] if others else []
    return " and ".join(told)
