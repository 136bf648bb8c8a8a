"""A run: its figure, its tables of measures and events, its settings and checks, and its page."""

from collections.abc import Mapping, Sequence
from math import floor, log10
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.measures import RunMeasures, measure
from dragrig.present import traces as phases
from dragrig.present.document import Cell, Column, InlineFigure, Table, decimals, general_format, significant
from dragrig.present.drawing import (
    PanelBox,
    add_panel,
    draw_line,
    figure_style,
    header_height_in,
    new_figure,
    run_problem,
    run_title,
    set_log_x,
    set_y_label,
    write_legend,
    write_run_header,
)
from dragrig.present.figure_files import inline_figure
from dragrig.present.html_page import render_template
from dragrig.present.traces import (
    FOOT_IN,
    LEFT_IN,
    PANEL_SPACING_IN,
    PHASE_NAMES_IN,
    RIGHT_IN,
    WIDTH_IN,
    TracePanel,
    draw_panel_column,
    filtered_trace,
    force_panel,
    gaps_after_samples,
    measured_speed,
    min_max_envelope,
    position_panel,
    speed_panel,
    steady_level,
)
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Attribute, Run, RunEvent, RunInfo

RELAXATION_FREE_IN, RELAXATION_SMALL_IN = 6.7, 1.75
"""Height of a column with two panels below the force, and of each of these."""
RELAXATION_COLUMN_IN, RELAXATION_GUTTER_IN = 5.5, 1.25
MIN_HOLD_IN_RAMPS = 4.0
"""In lengths of the ramp: a hold shorter than this needs no magnified ramp."""


def relaxation_ramp(run: Run) -> tuple[float, float] | None:
    """Return begin and end [s] of a relaxation's ramp; None for another kind of run, or when little follows it."""
    if run.info.kind != "relaxation":
        return None
    moving = (run.trace.phase > Phase.REST) & (run.trace.phase < Phase.HOLD)
    if not moving.any():
        return None
    time, first = run.trace.time, int(moving.argmax())
    still = np.flatnonzero(~moving[first:])
    if still.size < 2:
        return None
    begin, end = float(time[first]), float(time[first + still[0]])
    return (begin, end) if time[-1] - end > MIN_HOLD_IN_RAMPS * (end - begin) else None


def draw_relaxation(run: Run, panels: Sequence[TracePanel], ramp: tuple[float, float], trouble: str) -> Figure:
    """Draw a relaxation: the whole of it, the time since the ramp on a logarithmic axis, and the ramp magnified.

    The first panel is the force's; call it while `drawing`.
    """
    force, time = panels[0], run.trace.time
    right_in = LEFT_IN + RELAXATION_COLUMN_IN + RELAXATION_GUTTER_IN
    below = len(panels) - 1
    free = RELAXATION_FREE_IN + (below - 2) * (RELAXATION_SMALL_IN + PANEL_SPACING_IN)
    half = (free - FOOT_IN) / 2
    begin, end = ramp
    window = max(1.5 * begin - 0.5 * end, float(time[0])), min(2.5 * end - 1.5 * begin, float(time[-1]))

    figure = new_figure(WIDTH_IN, header_height_in(trouble) + PHASE_NAMES_IN + free + FOOT_IN)
    write_run_header(figure, LEFT_IN, run.info, trouble)
    upper = PanelBox(LEFT_IN, FOOT_IN + half + FOOT_IN, RELAXATION_COLUMN_IN, 0.0)
    (whole,) = draw_panel_column(figure, run, [force], [half], upper, name_ramp=True)
    since = add_panel(figure, PanelBox(LEFT_IN, FOOT_IN, RELAXATION_COLUMN_IN, half), share_y=whole)
    _draw_since_ramp(since, force, end)
    heights = [free - below * (RELAXATION_SMALL_IN + PANEL_SPACING_IN), *[RELAXATION_SMALL_IN] * below]
    right = PanelBox(right_in, FOOT_IN, WIDTH_IN - right_in - RIGHT_IN, 0.0)
    draw_panel_column(figure, run, panels, heights, right, window)[-1].set_xlabel("Time (s), the ramp magnified")
    return figure


def _draw_since_ramp(axes: Axes, panel: TracePanel, end_s: float) -> None:
    first, last = np.inf, 0.0
    for curve in panel.curves:
        after = curve.time > end_s
        since = curve.time[after] - end_s
        log_time, value = min_max_envelope(np.log10(since), curve.value[after], curve.gap[np.flatnonzero(after)[:-1]])
        draw_line(axes, 10**log_time, value, curve.pen)
        first, last = min(first, float(since[0])), max(last, float(since[-1]))
    set_log_x(axes, first, last)
    axes.axvspan(first, last, color=phases.PHASE_TINTS[Phase.HOLD], linewidth=0, zorder=0)
    axes.set_xlabel("Time since the end of the ramp (s)")
    set_y_label(axes, panel.label)
    write_legend(axes, [curve.pen for curve in panel.curves])


RUN_FORCE_IN, RUN_SMALL_IN = 3.5, 1.45


def run_figure(run: Run, *, filtered: bool = True, motor_force: bool = False, bad_reason: str | None = None) -> Figure:
    """Draw a run: force, position, measured speed, and on demand the motor's force, against time.

    A relaxation is drawn three times over: whole, since its ramp on a logarithmic axis, and its ramp magnified.

    Parameters
    ----------
    filtered
        Whether to draw the filtered force over the raw one: what the filter stored in the file, or else what
        its usual settings give.
    motor_force
        Whether to add the motor's force, where it was recorded beside the force.
    bad_reason
        Why the run was marked bad; None when it was not.
    """
    found = filtered_trace(run)
    smooth = found if filtered else None
    gap = gaps_after_samples(run.trace.time, run.trace.sample_rate_hz)
    panels = [
        force_panel(run, smooth, gap, steady=steady_level(run)),
        position_panel(run, gap),
        speed_panel(run, measured_speed(run, found), gap),
    ]
    if motor_force and run.trace.signal != "motor_force" and "motor_force" in run.trace.channels:
        panels.append(force_panel(run, smooth, gap, "motor_force"))
    ramp, trouble = relaxation_ramp(run), run_problem(run.info, bad_reason)
    with figure_style():
        if ramp is not None:
            return draw_relaxation(run, panels, ramp, trouble)
        heights = [RUN_FORCE_IN, *[RUN_SMALL_IN] * (len(panels) - 1)]
        height = (
            header_height_in(trouble) + PHASE_NAMES_IN + sum(heights) + PANEL_SPACING_IN * (len(panels) - 1) + FOOT_IN
        )
        figure = new_figure(WIDTH_IN, height)
        write_run_header(figure, LEFT_IN, run.info, trouble)
        draw_panel_column(figure, run, panels, heights, PanelBox(LEFT_IN, FOOT_IN, WIDTH_IN - LEFT_IN - RIGHT_IN, 0.0))
        return figure


UNIT_SUFFIXES: Final = {
    "_mm_s2": "mm/s²",
    "_mm_s": "mm/s",
    "_mm2": "mm²",
    "_deg": "°",
    "_kPa": "kPa",
    "_um": "µm",
    "_mN": "mN",
    "_mm": "mm",
    "_hz": "Hz",
    "_g": "g",
    "_s": "s",
}
"""Endings of names and the units that they stand for, longer ones first."""
_ATTRIBUTE_LABELS: Final = {"accel": "acceleration", "mass": "mass", "rest": "rest before", "hold": "hold after"}
_TIME_FORMAT: Final = "%Y-%m-%d %H:%M:%S %z"


def attribute_texts(values: Mapping[str, Attribute]) -> dict[str, str]:
    """Return attributes as a person reads them: `speed_mm_s = 5.0` as "speed": "5 mm/s"."""
    return {_attribute_label(name): _attribute_text(name, value) for name, value in values.items() if value != ""}


def check_texts(checks: Mapping[str, Attribute]) -> dict[str, str]:
    """Say what was looked at right after the run, each with what was seen."""
    told = {key: value for key, value in checks.items() if key not in {"slip_time_s", "following_error_mm"}}
    words = attribute_texts({key: float(f"{one:.3g}") if isinstance(one, float) else one for key, one in told.items()})
    following, slip = checks.get("following_error_mm"), checks.get("slip_time_s")
    if isinstance(following, int | float):
        words["largest distance from the command"] = f"{1000 * following:.1f} µm"
    if isinstance(slip, int | float):
        words["slip during the hold"] = f"at {slip:.1f} s" if slip >= 0 else "none seen"
    return words


def recording_texts(info: RunInfo) -> dict[str, str]:
    """Say when, by whom and with what a run was recorded."""
    header, entry = info.header, info.header.entry
    told = {
        "Run": header.run_id,
        "Began": f"{header.start_time:{_TIME_FORMAT}}",
        "Ended": "" if info.end_time is None else f"{info.end_time:{_TIME_FORMAT}}",
        "Operator": str(entry.get("operator", "")),
        "Note": str(entry.get("note", "")),
        "Plan": str(entry.get("plan", "")),
        "Samples": f"{info.samples} at {general_format(header.sample_rate_hz)} Hz",
        "Channels": ", ".join(f"{one.name} ({one.units})" for one in header.channels),
        "Software": str(entry.get("software", "")),
        "SHA-256 of the samples": info.raw_sha256,
    }
    return {name: value for name, value in told.items() if value}


def further_attribute_texts(info: RunInfo) -> dict[str, str]:
    """Say what else stands in the file's head."""
    said = {"operator", "note", "plan", "software"}
    return attribute_texts({key: value for key, value in info.header.entry.items() if key not in said})


def _attribute_label(name: str) -> str:
    ending = _unit_suffix(name)
    bare = name.removesuffix(ending)
    return _ATTRIBUTE_LABELS.get(bare, bare.replace("_", " "))


def _attribute_text(name: str, value: Attribute) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    unit = UNIT_SUFFIXES.get(_unit_suffix(name), "")
    number = str(value) if isinstance(value, int) else general_format(value)
    if name == "shear_strain":
        return f"{general_format(100 * value)} %"
    return f"{number}{'' if unit == '°' else ' '}{unit}".rstrip()


def _unit_suffix(name: str) -> str:
    return next((one for one in UNIT_SUFFIXES if name.endswith(one) and name != one[1:]), "")


def measures_table(measures: RunMeasures) -> Table:
    """Tabulate what the run says in a few numbers, each with its uncertainty or why it is missing."""
    columns = (
        Column("quantity", "quantity"),
        Column("value", "value", _ten_significant),
        Column("standard_error", "±", significant(2)),
        Column("low", "95 % from", _ten_significant),
        Column("high", "to", _ten_significant),
        Column("unit", "unit"),
        Column("remark", "how"),
    )
    peak = "" if measures.peak_time_s is None else f"at {measures.peak_time_s:.3f} s"
    rows = (
        _measure_row("steady force", measures.steady_force, "mN", f"mean over {measures.steady_from}, as recorded"),
        _measure_row("force at rest", measures.rest_offset, "mN", "mean before the motion"),
        _measure_row("peak force", measures.peak_force, "mN", peak),
        _measure_row("force at the end of the hold", measures.hold_force, "mN", "mean"),
        _measure_row("speed", measures.speed, "mm/s", "slope of the position in the steady phase"),
    )
    return Table("measures", "± is one standard error", columns, rows)


def events_table(events: tuple[RunEvent, ...]) -> Table:
    """Tabulate what happened during the run."""
    columns = (Column("time_s", "time, s", decimals(3)), Column("kind", "what"), Column("message", "in words"))
    return Table(
        "events", "By the run's own clock", columns, tuple((one.time_s, one.kind, one.message) for one in events)
    )


def _measure_row(name: str, one: Estimate, unit: str, how: str) -> tuple[Cell, ...]:
    low, high = one.interval or (None, None)
    value, low, high = (_round_to_error(each, one.standard_error) for each in (one.value, low, high))
    return name, value, one.standard_error, low, high, unit, one.reason or how


def _round_to_error(value: float | None, error: float | None) -> float | None:
    """Round a number to the digits that its error leaves it, three decimal places at most."""
    if value is None or not error:
        return value
    return round(value, max(0, min(3, 1 - floor(log10(error)))))


def _ten_significant(value: float) -> str:
    return f"{value:.10g}".replace("-", "−")


def run_page(run: Run, bad_reason: str | None = None) -> str:
    """Return the report on a run as one HTML page.

    Parameters
    ----------
    bad_reason
        Why somebody marked the run bad; None when nobody did.
    """
    info = run.info
    tables = {one.name: one for one in (measures_table(measure(run)), events_table(run.events))}
    return render_template(
        "run.html",
        {
            "title": run_title(info),
            "info": info,
            "trouble": run_problem(info, bad_reason),
            "recorded": recording_texts(info),
            "checks": check_texts(info.checks),
            "protocol": attribute_texts(info.header.protocol),
            "capsule": attribute_texts(info.header.capsule),
            "specimen": attribute_texts(info.header.specimen),
            "further": further_attribute_texts(info),
            "tables": tables,
            "pictures": {"run": inline_run_figure(run, bad_reason)},
        },
    )


def inline_run_figure(run: Run, bad_reason: str | None = None) -> InlineFigure:
    """Draw a run, force over position and speed."""
    return inline_figure(
        run_figure(run, bad_reason=bad_reason),
        f"{run_title(run.info)}: force, position and speed against time, with the phases of the motion.",
        "Force as recorded (light) and filtered, position beside its command, and speed; shaded, the motion's phases.",
    )
