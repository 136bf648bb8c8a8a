"""A campaign: overview figure (steady force, relaxations, drags), tables of runs and sessions, and its page."""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.campaign_table import UNREADABLE, TableRow, mean_per_speed
from dragrig.analysis.computation import Progress, no_progress
from dragrig.analysis.estimates import NORMAL_95, Estimate
from dragrig.analysis.measures import measure
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
    SMALL_PT,
    TEXT_PT,
    CurveLabel,
    PanelBox,
    add_panel,
    figure_style,
    fit_y_range,
    header_height_in,
    label_curves,
    new_figure,
    panel_height_in,
    panel_width_in,
    run_title,
    sequential_colours,
    set_log_x,
    set_time_range,
    set_y_label,
    text_width_in,
    write_badge,
    write_problem,
    write_title,
)
from dragrig.present.figure_files import inline_figure
from dragrig.present.friction_model import spread_selection
from dragrig.present.html_page import render_template
from dragrig.present.palette import BLUE, GREY, VERMILLION
from dragrig.present.run import inline_run_figure, relaxation_ramp
from dragrig.present.traces import FOOT_IN, LEFT_IN, RIGHT_IN
from dragrig.rig.arrays import AnyFloatArray, FloatArray
from dragrig.rig.profile import Phase
from dragrig.rig.protocols.return_stroke import ReturnProtocol
from dragrig.rig.runfile import Campaign, read_run
from dragrig.rig.runfile.model import Run, RunInfo, RunStatus
from dragrig.rig.runfile.schema import run_name
from dragrig.rig.session import SessionRecord

STEADY_KINDS = ("drag", "coulomb", "blank")
"""Kinds of run with a steady force that stands in a campaign's picture."""
POSITION_BINS = 250


def _empty_array() -> FloatArray:
    return np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class RunSummary:
    """A run, much reduced.

    Attributes
    ----------
    good
        Whether it is complete and was not marked bad; only then the rest is filled in.
    speed_mm_s
        The speed that was set, or else measured, without sign; 0 where neither is known.
    strain
        Shear strain of a relaxation, 1 being 100 %.
    steady
        Steady force [mN] as recorded.
    x, force_mN
        A relaxation's force against the time since its ramp [s], or a drag's mean force against position [mm].
    """

    kind: str
    started: datetime
    backend: str
    specimen: str
    good: bool
    speed_mm_s: float = 0.0
    strain: float = 0.0
    steady: Estimate | None = None
    x: FloatArray = field(default_factory=_empty_array)
    force_mN: FloatArray = field(default_factory=_empty_array)


def summarise_run(run: Run, bad: Collection[Path] = ()) -> RunSummary:
    """Reduce a run; `bad` holds the files of runs that were marked bad."""
    info = run.info
    good = info.status is RunStatus.COMPLETE and info.path not in bad
    head = (info.kind, info.header.start_time, info.header.backend, str(info.header.specimen.get("name", "")), good)
    if not good:
        return RunSummary(*head)
    if info.kind == "relaxation":
        x, force = _force_since_ramp(run)
        return RunSummary(*head, strain=_protocol_number(run, "shear_strain"), x=x, force_mN=force)
    if info.kind not in STEADY_KINDS:
        return RunSummary(*head)
    measures = measure(run)
    speed = _protocol_number(run, "speed_mm_s") or measures.speed.value or 0.0
    x, force = _force_against_position(run) if info.kind == "drag" else (_empty_array(), _empty_array())
    steady = measures.steady_force if measures.steady_force.value is not None else None
    return RunSummary(*head, speed_mm_s=abs(speed), steady=steady, x=x, force_mN=force)


def _force_since_ramp(run: Run) -> tuple[FloatArray, FloatArray]:
    """Mean force in equal stretches of the logarithm of time."""
    ramp = relaxation_ramp(run)
    if ramp is None:
        return _empty_array(), _empty_array()
    after = run.trace.time > ramp[1]
    log_time, force = _bin_means(np.log10(run.trace.time[after] - ramp[1]), run.trace.force[after])
    return np.asarray(10**log_time), force


def _force_against_position(run: Run) -> tuple[FloatArray, FloatArray]:
    """Mean force in equal stretches of the way, while in motion."""
    moving = (run.trace.phase > Phase.REST) & (run.trace.phase < Phase.HOLD)
    return _bin_means(run.trace.position[moving], run.trace.force[moving])


def _bin_means(x: AnyFloatArray, force: AnyFloatArray) -> tuple[FloatArray, FloatArray]:
    finite = np.isfinite(x) & np.isfinite(force)
    if not finite.any():
        return _empty_array(), _empty_array()
    place, weight = np.asarray(x[finite], dtype=np.float64), force[finite]
    edges = np.linspace(place.min(), place.max(), POSITION_BINS + 1)
    count, _ = np.histogram(place, edges)
    sums = [np.histogram(place, edges, weights=one)[0] for one in (place, weight)]
    filled = count > 0
    return np.asarray(sums[0][filled] / count[filled]), np.asarray(sums[1][filled] / count[filled])


def _protocol_number(run: Run, name: str) -> float:
    value = run.info.header.protocol.get(name)
    return float(value) if isinstance(value, int | float) else 0.0


OVERVIEW_WIDTH_IN, OVERVIEW_TALL_IN = 14.0, 7.0
OVERVIEW_HEADING_IN = 0.5
OVERVIEW_LABELS_IN = 1.25
"""Room right of a panel for the names of its curves."""
KIND_MARKERS = {"drag": (BLUE, "o"), "coulomb": (VERMILLION, "s"), "blank": (GREY, "^")}
"""Colour and marker of each kind."""


def campaign_figure(runs: Iterable[Run], name: str = "", bad: Collection[Path] = ()) -> Figure:
    """Draw an overview of a campaign.

    Parameters
    ----------
    runs
        Read one after the other and not kept.
    name
        What to call the campaign.
    bad
        Files of runs that were marked bad; they are counted and not drawn, as are those that ended early.
    """
    digests = [summarise_run(run, bad) for run in runs]
    with figure_style():
        figure = new_figure(
            OVERVIEW_WIDTH_IN,
            header_height_in(_overview_problem(digests)) + OVERVIEW_HEADING_IN + OVERVIEW_TALL_IN + FOOT_IN,
        )
        write_title(
            figure, LEFT_IN, " · ".join(part for part in ("Campaign", name) if part), _overview_subtitle(digests)
        )
        write_problem(figure, LEFT_IN, _overview_problem(digests))
        write_badge(figure, ", ".join(sorted({one.backend for one in digests})))
        drawn = [
            (draw, found) for draw, chosen in _OVERVIEW_PANELS if (found := [one for one in digests if chosen(one)])
        ]
        for (draw, found), place in zip(drawn, _panel_boxes(len(drawn)), strict=True):
            draw(add_panel(figure, place), found)
        if not drawn:
            figure.text(0.5, 0.45, "no complete drag, Coulomb, blank or relaxation run", ha="center", color=GREY)
        return figure


def _panel_boxes(count: int) -> tuple[PanelBox, ...]:
    room = OVERVIEW_WIDTH_IN - LEFT_IN - RIGHT_IN - OVERVIEW_LABELS_IN
    if count <= 1:
        return (PanelBox(LEFT_IN, FOOT_IN, room, OVERVIEW_TALL_IN),)[:count]
    half = (room - OVERVIEW_LABELS_IN - LEFT_IN) / 2
    right = LEFT_IN + half + OVERVIEW_LABELS_IN + LEFT_IN
    low = (OVERVIEW_TALL_IN - FOOT_IN - OVERVIEW_HEADING_IN) / 2
    left_place = PanelBox(LEFT_IN, FOOT_IN, half, OVERVIEW_TALL_IN)
    if count == 2:
        return left_place, PanelBox(right, FOOT_IN, half, OVERVIEW_TALL_IN)
    return left_place, PanelBox(right, FOOT_IN + OVERVIEW_TALL_IN - low, half, low), PanelBox(right, FOOT_IN, half, low)


def _draw_steady_forces(axes: Axes, digests: Sequence[RunSummary]) -> None:
    labels: list[CurveLabel] = []
    shown: list[FloatArray] = []
    for kind, (colour, marker) in KIND_MARKERS.items():
        steady = [(one.speed_mm_s, one.steady) for one in digests if one.kind == kind and one.steady is not None]
        for points, way in _split_by_direction(kind, steady):
            speed = np.array([speed for speed, _ in points])
            force = np.array([estimate.value for _, estimate in points], dtype=float)
            half = np.array([NORMAL_95 * (estimate.standard_error or 0.0) for _, estimate in points])
            if way:
                force = np.abs(force)
            shown += [force - half, force + half]
            rounded = np.array([_three_digit_speed(one) for one in speed])
            levels = np.unique(rounded)
            means = [float(force[rounded == level].mean()) for level in levels]
            axes.plot(levels, means, color=colour, linewidth=1.2, alpha=0.5, linestyle="--" if way else "-")
            axes.errorbar(
                speed,
                force,
                yerr=half,
                fmt=marker,
                color=colour,
                markersize=8,
                markerfacecolor="white" if way else colour,
                markeredgecolor=colour if way else "white",
                capsize=3,
            )
            labels.append(CurveLabel(means[-1], (kind if kind != "coulomb" else "Coulomb") + way, colour))
    speeds = [one.speed_mm_s for one in digests]
    set_log_x(axes, *_speed_limits(speeds))
    fit_y_range(axes, [*shown, np.zeros(1)], 1.0)
    axes.set_xlabel("Speed (mm/s)")
    set_y_label(axes, "Force (mN)")
    _write_panel_heading(axes, "Steady force", "zero offsets included, bars 95 %")
    label_curves(axes, labels)


def _split_by_direction(
    kind: str, points: Sequence[tuple[float, Estimate]]
) -> Iterator[tuple[Sequence[tuple[float, Estimate]], str]]:
    """Keep the two ways of a capsule apart: a force of the other sign is that of a run backward."""
    backward = [one for one in points if kind != "blank" and (one[1].value or 0.0) < 0]
    forward = [one for one in points if one not in backward]
    if forward:
        yield forward, ""
    if backward:
        yield backward, " back"


def _draw_relaxations(axes: Axes, digests: Sequence[RunSummary]) -> None:
    rising = sorted(digests, key=lambda one: one.strain)
    strains = sorted({one.strain for one in rising})
    colours = dict(zip(strains, sequential_colours(len(strains)), strict=True))
    ends: dict[float, float] = {}
    for one in rising:
        axes.plot(one.x, one.force_mN, color=colours[one.strain], linewidth=1.8)
        ends[one.strain] = float(one.force_mN[np.isfinite(one.force_mN)][-1])
    set_log_x(axes, min(float(one.x[0]) for one in rising), max(float(one.x[-1]) for one in rising))
    fit_y_range(axes, [one.force_mN for one in rising], 1.0)
    axes.set_xlabel("Time since the end of the ramp (s)")
    set_y_label(axes, "Force (mN)")
    _write_panel_heading(axes, "Relaxation", "at each shear strain")
    label_curves(axes, [CurveLabel(end, f"{100 * strain:g} %", colours[strain]) for strain, end in ends.items()])


def _draw_drags(axes: Axes, digests: Sequence[RunSummary]) -> None:
    first_of = {_three_digit_speed(one.speed_mm_s): one for one in reversed(digests)}
    speeds = spread_selection(list(first_of))
    labels = []
    for speed, colour in zip(speeds, sequential_colours(len(speeds)), strict=True):
        one = first_of[speed]
        axes.plot(one.x, one.force_mN, color=colour, linewidth=1.8)
        middle = one.force_mN[one.force_mN.size // 2 :]
        labels.append(CurveLabel(float(np.median(middle)), f"{speed:g} mm/s", colour))
    shown = [first_of[speed] for speed in speeds]
    set_time_range(axes, min(0.0, *(float(one.x.min()) for one in shown)), max(float(one.x.max()) for one in shown))
    fit_y_range(axes, [one.force_mN for one in shown], 1.0)
    axes.set_xlabel("Position (mm)")
    set_y_label(axes, "Force (mN)")
    _write_panel_heading(axes, "Drag along the way", "first run at each speed")
    label_curves(axes, labels)


_OVERVIEW_PANELS: tuple[tuple[Callable[[Axes, Sequence[RunSummary]], None], Callable[[RunSummary], bool]], ...] = (
    (_draw_steady_forces, lambda one: one.steady is not None and one.speed_mm_s > 0),
    (_draw_relaxations, lambda one: one.kind == "relaxation" and one.x.size > 1),
    (_draw_drags, lambda one: one.kind == "drag" and one.x.size > 1),
)
"""What draws a panel, and which runs it draws."""


def _write_panel_heading(axes: Axes, text: str, remark: str = "") -> None:
    y = 1 + 0.13 / panel_height_in(axes)
    axes.text(0.0, y, text, transform=axes.transAxes, fontsize=TEXT_PT, fontweight="bold")
    after = 1.1 * text_width_in(text, TEXT_PT) + 0.25
    axes.text(after / panel_width_in(axes), y, remark, transform=axes.transAxes, fontsize=SMALL_PT, color=GREY)


def _speed_limits(speeds: Sequence[float]) -> tuple[float, float]:
    """Range of a logarithmic axis around some speeds, at least a decade."""
    middle = float(np.sqrt(min(speeds) * max(speeds)))
    half = max(1.3 * max(speeds) / middle, float(np.sqrt(10.0)))
    return middle / half, middle * half


def _three_digit_speed(speed_mm_s: float) -> float:
    """Where no speed was set, the measured ones of equal runs differ in the fourth digit."""
    return float(f"{speed_mm_s:.3g}")


def _overview_subtitle(digests: Sequence[RunSummary]) -> str:
    if not digests:
        return "no runs"
    counts = Counter(one.kind for one in digests)
    kinds = ", ".join(f"{count} {kind}" for kind, count in counts.most_common())
    begin, end = min(one.started for one in digests), max(one.started for one in digests)
    specimens = ", ".join(sorted({one.specimen for one in digests}))
    until = f"{end:%H:%M}" if end.date() == begin.date() else f"{end:%Y-%m-%d %H:%M}"
    return f"{len(digests)} runs ({kinds})  ·  {specimens}  ·  {begin:%Y-%m-%d %H:%M} – {until}"


def _overview_problem(digests: Sequence[RunSummary]) -> str:
    left_out = sum(not one.good for one in digests)
    return f"{left_out} of them ended early or are marked bad, and are not drawn" if left_out else ""


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
