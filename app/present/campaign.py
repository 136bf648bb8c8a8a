"""A campaign laid out for a reader: mean forces, runs, sessions, and what was left out."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from math import hypot
from typing import TYPE_CHECKING

from dragrig import present
from dragrig.analysis import (
    UNREADABLE,
    Progress,
    SpecimensMean,
    SpeedMean,
    TableRow,
    campaign_rows,
    count_text,
    counted,
    mean_over_specimens,
    mean_per_speed,
    measure,
    no_progress,
    table_row,
    unreadable_row,
    value_with_error,
)
from dragrig.config import RunFileError
from dragrig.parallel import open_executor, parallel_map
from dragrig.present import (
    Column,
    Document,
    Field,
    Figure,
    FigureForm,
    FormattedNumber,
    Items,
    Section,
    Table,
    Text,
    current_figure_form,
    decimals,
    figure_form,
    grouped_files,
    run_problem,
    run_title,
    shortest,
    shortest_percent,
    svg_text,
)
from dragrig.present.run import run_drawing
from dragrig.rig import (
    Campaign,
    ReturnProtocol,
    RunInfo,
    RunStatus,
    SessionRecord,
    read_campaign,
    read_run,
    read_session_records,
    run_name,
)

if TYPE_CHECKING:
    from pathlib import Path

    from dragrig.present.campaign_figures import RunSummary
    from dragrig.run_listing import CampaignSummary

STEADY_FORCE = (
    "Steady force: mean over the constant speed, of a drag after the first contact length, as recorded. Steady − rest: "
    "the mean at rest before the motion (the sensor's zero, the relaxed wall) taken off"
)
MAX_DRAWN_RUNS = 100
"""Runs that a report draws one by one; a page that is mailed must stay small."""


MEASURING_COST, DRAWING_COST, OVERVIEW_COST = 60, 400, 500
"""User CPU time [ms] of measuring a run, of drawing it, and of drawing the overview: the weights of the progress."""
RUNS_PER_WORKER = 6
"""Fewer are drawn in the time that a process takes to start and to load matplotlib."""


@dataclass(frozen=True, slots=True)
class CampaignReportData:
    """A campaign with what was measured and drawn of its runs."""

    name: str
    campaign: Campaign
    rows: tuple[TableRow, ...]
    """Measures of its runs."""
    drawings: Mapping[str, str]
    """SVG of the overview, under the name `overview`, and of runs, under the names of their files."""
    sessions: tuple[SessionRecord, ...] = ()
    """Records of its sessions that can be read, the earliest first."""
    damaged: tuple[str, ...] = ()
    """Records that cannot be read, each with what is wrong."""

    @property
    def readable(self) -> tuple[RunInfo, ...]:
        """Runs whose samples can be read."""
        lost = {row.file for row in self.rows if row.status == UNREADABLE}
        return tuple(info for info in self.campaign.runs if info.path.name not in lost)

    @property
    def bad(self) -> Mapping[str, str]:
        """Why runs were marked bad, by the names of their files."""
        return {path.name: mark.reason for path, mark in self.campaign.marks.items()}


@dataclass(frozen=True, slots=True)
class _RunTask:
    """A run to be measured, and to be drawn in a form, or not."""

    info: RunInfo
    bad_reason: str | None
    form: FigureForm | None

    @property
    def cost(self) -> int:
        return MEASURING_COST + (0 if self.form is None else DRAWING_COST)


@dataclass(frozen=True, slots=True, eq=False)
class _ExaminedRun:
    """What a report shows of a run, from reading its file once."""

    row: TableRow
    summary: "RunSummary | None" = None
    drawing: str = ""


def _examine_run(task: _RunTask) -> _ExaminedRun:
    info = task.info
    try:
        run = read_run(info.path, info)
    except RunFileError as error:
        return _ExaminedRun(unreadable_row(info.path, error))
    measures, bad = measure(run), () if task.bad_reason is None else (info.path,)
    row, summary = table_row(run, task.bad_reason, measures), present.summarise_run(run, bad, measures)
    if task.form is None:
        return _ExaminedRun(row, summary)
    figure = run_drawing(info, lambda: present.run_figure(run, bad_reason=task.bad_reason, measures=measures))
    with figure_form(task.form):
        return _ExaminedRun(row, summary, svg_text(figure))


def _draw_overview(summaries: "Sequence[RunSummary]", name: str, form: FigureForm) -> str:
    with figure_form(form):
        return svg_text(replace(_OVERVIEW, drawing=lambda: present.overview_figure(summaries, name)))


def examine_campaign(folder: "Path", workers: int | None = 1, progress: Progress = no_progress) -> CampaignReportData:
    """Measure and draw the runs of a campaign, each read once.

    Parameters
    ----------
    workers
        Processes that do so (None: as many as there are cores).

    Raises
    ------
    RunFileError
        When there is no such folder.
    """
    campaign, name = read_campaign(folder), folder.resolve().name
    sessions, damaged = read_session_records(folder)
    drawn = [info.path for info in campaign.runs if info.kind != ReturnProtocol.kind][:MAX_DRAWN_RUNS]
    marks, form = campaign.marks, current_figure_form()
    tasks = [
        _RunTask(
            info,
            marks[info.path].reason if info.path in marks else None,
            form if info.path in drawn else None,
        )
        for info in campaign.runs
    ]
    advance = counted(progress, sum(task.cost for task in tasks) + OVERVIEW_COST)
    with open_executor(workers, tasks=len(drawn) // RUNS_PER_WORKER) as executor:
        examined = parallel_map(executor, _examine_run, tasks, lambda task, _: advance(task.cost))
        summaries = [run.summary for run in examined if run.summary is not None]
        draw = partial(_draw_overview, name=name, form=form)
        [overview] = parallel_map(executor, draw, [summaries], lambda *_: advance(OVERVIEW_COST))
    rows = campaign_rows(campaign, [run.row for run in examined])
    drawings = {run.row.file: run.drawing for run in examined if run.drawing}
    return CampaignReportData(name, campaign, rows, {**drawings, _OVERVIEW.name: overview}, sessions, damaged)


def campaign_document(data: CampaignReportData) -> Document:
    """Lay out a campaign."""
    runs = data.campaign.runs
    drawn = tuple(info for info in runs if info.path.name in data.drawings)
    left_out = _left_out_table(data)
    singles = tuple(
        Section(
            _anchor(info.path.name),
            run_title(info) + (f" ({problem})" if (problem := _short_problem(info, data)) else ""),
            (run_drawing(info, data.drawings[info.path.name], f"figure-{run_name(info.path)}"),),
            collapsed=True,
            note=info.path.name,
        )
        for info in drawn
    )
    not_drawn = _not_drawn_text(data, len(drawn))
    count = sum(1 for _ in _left_out_runs(data))
    problem = f"{count} left out: bad, aborted and unreadable runs are in no mean and no figure."
    return Document(
        title=f"Campaign {data.name}",
        source=f"Campaign {data.name}",
        badges=tuple(sorted({info.header.backend for info in runs})),
        answer=steady_force_answer(data.rows),
        lead=tuple(filter(None, (_summary(data), _drift_text(data.rows)))),
        problem=problem if left_out else "",
        sections=(
            Section("overview", "Overview", (replace(_OVERVIEW, drawing=data.drawings[_OVERVIEW.name]),)),
            Section("means", "Steady force", mean_tables(data.rows)),
            Section(
                "runs",
                "Runs",
                (
                    run_table(data.rows, frozenset(_anchor(info.path.name) for info in drawn)),
                    run_remarks(data.rows),
                ),
            ),
            Section("left-out", "Left out", (left_out,)),
            Section("sessions", "Sessions", (_session_table(data),)),
            Section("one-by-one", "Individual runs", (Text(not_drawn), *singles) if singles else ()),
        ),
    )


def campaign_table_document(rows: Sequence[TableRow]) -> Document:
    """Lay out the measures of the runs of one or several campaigns, and their means."""
    means = mean_per_speed(rows)
    return Document(
        title=f"{len(rows)} run{'' if len(rows) == 1 else 's'}",
        sections=(
            Section("runs", "", (run_table(rows), run_remarks(rows))),
            Section("means", "Means", mean_tables(rows)),
        ),
        data={"runs": rows, "means": means, "means_over_specimens": mean_over_specimens(means)},
    )


def campaign_runs_document(campaign: Campaign) -> Document:
    """List the runs of a campaign, as far as their files state them."""
    marks = {path: mark.reason for path, mark in campaign.marks.items()}
    table = Table.of(
        "runs",
        "",
        campaign.runs,
        Field("run", "run", lambda run: run.path.name),
        Field("what", "what", run_title),
        Field("began", "began", lambda run: f"{run.header.start_time:%Y-%m-%d %H:%M:%S}"),
        Field("status", "status", lambda run: run_problem(run, marks.get(run.path)) or run.status.value),
    )
    return Document(title=repr(campaign).strip("<>"), sections=(Section("runs", "", (table,)),))


def campaigns_list_document(campaigns: "Sequence[CampaignSummary]") -> Document:
    """Lay out the campaigns of a folder, a line each, and count those without a run."""
    shown = [campaign for campaign in campaigns if campaign.kinds or campaign.unreadable]
    empty = f", and {len(campaigns) - len(shown)} without a run" if len(shown) < len(campaigns) else ""
    table = Table.of(
        "campaigns",
        "",
        shown,
        Field("folder", "campaign", lambda campaign: str(campaign.folder)),
        Field("began", "began", lambda campaign: f"{campaign.began:%Y-%m-%d %H:%M}" if campaign.began else ""),
        Field("specimens", "specimen", lambda campaign: ", ".join(campaign.specimens)),
        Field(
            "kinds",
            "runs",
            lambda campaign: ", ".join(f"{count} {kind}" for kind, count in Counter(campaign.kinds).most_common()),
        ),
        Field("operators", "operator", lambda campaign: ", ".join(campaign.operators)),
        Field("bad", "marked bad", lambda campaign: campaign.bad, shortest()),
        Field("unreadable", "unreadable", lambda campaign: campaign.unreadable, shortest()),
    )
    return Document(
        title=f"{count_text(len(shown), 'campaign')}{empty}",
        sections=(Section("campaigns", "", (table,)),),
        data=campaigns,
    )


def mean_tables(rows: Sequence[TableRow]) -> tuple[Table, ...]:
    """Tabulate the mean steady force of each specimen's repeats and, of several specimens, over them."""
    means = mean_per_speed(rows)
    without_rest = sum(
        row.counts and not row.role and row.steady_force_mN is not None and row.steady_above_rest_mN is None
        for row in rows
    )
    no_rest = f", and {count_text(without_rest, 'run')} whose force at rest is not known" if without_rest else ""
    of_specimens = Table.of(
        "means",
        "Mean of steady − rest over the repeats on a specimen; ± is the 95 % interval by Student's t from their "
        "scatter, pooled over speeds where it may be the same share of the force, or the same force (Bartlett's test "
        f"at 1 %); n the runs; without bad and unfinished runs and sentinels{no_rest}",
        means,
        Field("specimen", "specimen", lambda mean: mean.specimen),
        Field("kind", "kind", lambda mean: mean.kind),
        Field("capsule", "capsule", lambda mean: mean.capsule),
        Field("speed_mm_s", "mm/s", lambda mean: mean.speed_mm_s, shortest(3)),
        Field("direction", "direction", lambda mean: "forward" if mean.direction > 0 else "backward"),
        Field("runs", "n, runs", lambda mean: mean.runs, shortest()),
        Field(
            "steady_above_rest_mN",
            "steady − rest, mN ± 95 %",
            lambda mean: _with_interval(mean.steady_above_rest_mN, mean.half_width_95_mN, "one run: no interval"),
        ),
    )
    over_specimens = Table.of(
        "means-over-specimens",
        "Mean over specimens, each specimen's mean counting once; ± is the 95 % interval by Student's t from their "
        "scatter, n the specimens, not the runs",
        mean_over_specimens(means),
        Field("kind", "kind", lambda mean: mean.kind),
        Field("capsule", "capsule", lambda mean: mean.capsule),
        Field("speed_mm_s", "mm/s", lambda mean: mean.speed_mm_s, shortest(3)),
        Field("direction", "direction", lambda mean: "forward" if mean.direction > 0 else "backward"),
        Field("specimens", "n, specimens", lambda mean: mean.specimens, shortest()),
        Field("runs", "runs", lambda mean: mean.runs, shortest()),
        Field(
            "steady_above_rest_mN",
            "steady − rest, mN ± 95 %",
            lambda mean: _with_interval(
                mean.steady_above_rest_mN,
                mean.half_width_95_mN,
                f"{'one specimen' if mean.specimens == 1 else f'n = {mean.specimens}'}: no interval",
            ),
        ),
    )
    return of_specimens, over_specimens


def run_table(rows: Sequence[TableRow], anchors: frozenset[str] = frozenset()) -> Table:
    """Tabulate the measures of each run; the first cell links to the runs that have an anchor."""
    age: Field[TableRow] = Field(
        "minutes_since_excision", "min since excision", lambda row: row.minutes_since_excision, decimals(0)
    )
    campaign: Field[TableRow] = Field("campaign", "campaign", lambda row: row.campaign)
    drift: Field[TableRow] = Field(
        "drift_percent", "drift, %", lambda row: FormattedNumber.with_error(row.drift_percent, row.drift_error_percent)
    )
    mark: Field[TableRow] = Field("mark", "mark", lambda row: f"marked bad: {row.mark}" if row.bad else "")
    return Table.of(
        "runs",
        f"{STEADY_FORCE}. ± is one standard error",
        rows,
        *((campaign,) if any(row.campaign for row in rows) else ()),
        Field("file", "run", lambda row: row.file),
        Field("kind", "kind", lambda row: " ".join(filter(None, (row.role, row.kind)))),
        Field(
            "speed_mm_s",
            "mm/s",
            lambda row: row.measured_speed_mm_s if row.speed_mm_s is None else row.speed_mm_s,
            shortest(3),
        ),
        Field("shear_strain", "strain", lambda row: row.shear_strain, shortest_percent),
        Field(
            "steady_force_mN",
            "steady force, mN",
            lambda row: FormattedNumber.with_error(row.steady_force_mN, row.steady_force_error_mN),
        ),
        Field("rest_offset_mN", "at rest, mN", lambda row: row.rest_offset_mN, decimals(1)),
        Field(
            "steady_above_rest_mN",
            "steady − rest, mN",
            lambda row: FormattedNumber.with_error(row.steady_above_rest_mN, row.steady_above_rest_error_mN),
        ),
        *((drift,) if any(row.drift_percent is not None for row in rows) else ()),
        Field("peak_force_mN", "peak, mN", lambda row: row.peak_force_mN, decimals(1)),
        Field("status", "status", lambda row: row.status),
        Field("checks", "checks", lambda row: row.checks),
        Field("began", "began", lambda row: "" if row.start_time is None else f"{row.start_time:%H:%M:%S}"),
        *((age,) if any(row.minutes_since_excision is not None for row in rows) else ()),
        *((mark,) if any(row.bad for row in rows) else ()),
        links=tuple(_anchor(row.file) if _anchor(row.file) in anchors else "" for row in rows),
    )


def _with_interval(value: float, half_width: float | None, without: str) -> FormattedNumber:
    if half_width is None:
        return FormattedNumber(value, f"{decimals(1)(value)} ({without})")
    return FormattedNumber.with_error(value, half_width)


def run_remarks(rows: Sequence[TableRow]) -> Items:
    """List why measures are missing, each reason once with its runs."""
    files: dict[str, list[str]] = {}
    for row in rows:
        for remark in filter(None, row.remark.split("; ")):
            files.setdefault(remark, []).append(row.file)
    return Items(tuple(f"{remark}: {grouped_files(names)}" for remark, names in files.items()), remarks=True)


def _session_table(data: CampaignReportData) -> Table:
    times = [info.header.start_time for info in data.campaign.runs]
    ends = [*(session.begun_at for session in data.sessions), None][1:]
    return Table.of(
        "sessions",
        "Each start or continuation of the campaign",
        tuple(zip(data.sessions, ends, strict=True)),
        Field("begun", "begun", lambda row: f"{row[0].begun_at:%Y-%m-%d %H:%M:%S}"),
        Field("plan", "plan", lambda row: row[0].plan.name),
        Field("rig", "rig", lambda row: f"{row[0].backend}, double" if row[0].double else row[0].backend),
        Field("operator", "operator", lambda row: row[0].operator),
        Field(
            "runs",
            "runs",
            lambda row: sum(row[0].begun_at <= time and (row[1] is None or time < row[1]) for time in times),
            shortest(),
        ),
        Field("calibration", "force calibration", lambda row: row[0].calibration_id),
        Field("note", "note", lambda row: row[0].note),
    )


def _left_out_table(data: CampaignReportData) -> Table:
    columns = (Column("file", "file"), Column("kind", "kind"), Column("reason", "reason"))
    runs: dict[tuple[str, str], list[str]] = {}
    for file, kind, reason in _left_out_runs(data):
        runs.setdefault((kind, reason), []).append(file)
    rows = tuple((grouped_files(files), kind, reason) for (kind, reason), files in runs.items())
    return Table("left-out", "In no mean and no figure of the campaign", columns, rows)


def _left_out_runs(data: CampaignReportData) -> Iterator[tuple[str, str, str]]:
    for info in data.readable:
        problem = run_problem(info, data.bad.get(info.path.name))
        if problem:
            yield info.path.name, info.kind, problem
    for row in data.rows:
        if row.status == UNREADABLE:
            yield row.file, row.kind, row.remark
    for path in data.campaign.recordings:
        yield path.name, "", "is being recorded, or was left so by a crash: dragrig recover finishes it"
    for record in data.damaged:
        yield "session record", "", record


_OVERVIEW = Figure(
    "overview",
    "Steady force against speed, relaxation of the force against time since the ramp, and force along the way at a "
    "few speeds.",
    "Runs that are complete and not marked bad, without sentinels. Steady forces have the force at rest taken off: "
    "small markers are runs, large ones means, bars their 95 % intervals by Student's t over the repeats on a "
    "specimen, their scatter pooled over speeds where it may be the same, or, of three or more specimens, over the "
    "specimens' means; other values have no bar. The other forces are as recorded, the sensor's zero included.",
    "",
)


def _summary(data: CampaignReportData) -> str:
    runs = data.campaign.runs
    if not runs:
        return "No run in this folder can be read."
    counts = Counter("return" if info.kind == ReturnProtocol.kind else info.kind for info in runs)
    kinds = ", ".join(f"{count} {kind}" for kind, count in counts.most_common())
    specimens = sorted({str(info.header.specimen.get("name", "")) for info in runs} - {""})
    begun, last = (pick(info.header.start_time for info in runs) for pick in (min, max))
    until = f"{last:%H:%M}" if last.date() == begun.date() else _date_text(last)
    specimen_text = f" of {' and '.join(specimens)}" if specimens else ""
    return f"{len(runs)} run{'' if len(runs) == 1 else 's'}{specimen_text} ({kinds}), {_date_text(begun)} to {until}."


def _drift_text(rows: Sequence[TableRow]) -> str:
    """Say how far the specimen had drifted at the last sentinel, and at most."""
    drifted = [row for row in rows if row.drift_percent is not None]
    if not drifted:
        return ""
    last, farthest = drifted[-1], max(drifted, key=lambda row: abs(row.drift_percent or 0.0))
    text = f"Sentinels: the specimen's steady force had changed by {_drift_of(last)} at the last of them"
    more = "" if farthest is last else f", by {_drift_of(farthest)} at most (run {farthest.order})"
    return f"{text}{more}; ± is one standard error."


def _drift_of(row: TableRow) -> str:
    error = "" if row.drift_error_percent is None else f" ± {row.drift_error_percent:.1f}"
    return f"{row.drift_percent:+.1f}{error} %"


def steady_force_answer(rows: Sequence[TableRow]) -> str:
    """Say how the steady force of the kind with the most speeds changes with speed; "" where no run slides.

    Specimens are pooled where there are several.
    """
    of_specimens = [mean for mean in mean_per_speed(rows) if mean.kind != ReturnProtocol.kind]
    means: dict[tuple[str, ...], list[SpeedMean | SpecimensMean]] = {}
    for mean in mean_over_specimens(of_specimens) or of_specimens:
        specimen = mean.specimen if isinstance(mean, SpeedMean) else ""
        means.setdefault((specimen, mean.kind, mean.capsule, str(mean.direction)), []).append(mean)
    if not means:
        return ""
    slow, *_, fast = max(means.values(), key=len) * 2
    subject = f"The steady {_KIND_NAMES.get(slow.kind, slow.kind)} force above that at rest"
    force_slow, force_fast = (value_with_error(end.steady_above_rest_mN, end.half_width_95_mN) for end in (slow, fast))
    at_slow, at_fast = (f"{shortest(3)(end.speed_mm_s)} mm/s" for end in (slow, fast))
    counts = sorted({end.runs if isinstance(end, SpeedMean) else end.specimens for end in (slow, fast)})
    unit = "specimen" if isinstance(slow, SpecimensMean) else "run"
    n = f"n = {' and '.join(map(str, counts))} {unit}{'' if set(counts) == {1} else 's'}"
    if slow.half_width_95_mN is None or fast.half_width_95_mN is None:
        between = "" if slow is fast else f" and {force_fast} mN at {at_fast}"
        return f"{subject} is {force_slow} mN at {at_slow}{between} ({n}): too few to tell how sure that is."
    if slow is fast:
        return f"{subject} is {force_slow} mN at {at_slow} (± 95 %, {n})."
    change = abs(fast.steady_above_rest_mN) - abs(slow.steady_above_rest_mN)
    clear = abs(change) > hypot(slow.half_width_95_mN, fast.half_width_95_mN)
    verb = ("rises" if change > 0 else "falls") if clear else "does not change clearly with speed,"
    return f"{subject} {verb} from {force_slow} mN at {at_slow} to {force_fast} mN at {at_fast} (± 95 %, {n})."


_KIND_NAMES = {"coulomb": "Coulomb"}


def _date_text(when: datetime) -> str:
    return f"{when.day} {when:%B %Y, %H:%M}"


def _short_problem(info: RunInfo, data: CampaignReportData) -> str:
    if info.path.name in data.bad:
        return "marked bad"
    return "" if info.status is RunStatus.COMPLETE else str(info.status)


def _not_drawn_text(data: CampaignReportData, drawn: int) -> str:
    returns = sum(info.kind == ReturnProtocol.kind for info in data.readable)
    more = len(data.readable) - returns - drawn
    parts = [f"{returns} return stroke{'' if returns == 1 else 's'}"] if returns else []
    parts += [f"{more} more"] if more else []
    return f"Not drawn: {' and '.join(parts)}; see `dragrig show` and `dragrig report RUN`." if parts else ""


def _anchor(file: str) -> str:
    return f"run-{file.removesuffix('.h5')}"
