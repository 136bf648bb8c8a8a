"""Figure of a run: force, position and speed against time, with its phases and events."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec

from dragrig.analysis import RunMeasures, filter_run, measure, steady_stretch, value_with_error
from dragrig.config import AnalysisError
from dragrig.present import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    PALE,
    PAPER,
    PURPLE,
    VERMILLION,
    CurveLabel,
    LineStyle,
    PanelLayout,
    draw_line,
    figure_style,
    fit_y_range,
    label_times,
    new_figure,
    panel_size_in,
    run_problem,
    run_subtitle,
    run_title,
    set_log_x,
    set_time_range,
    start_position_mm,
    write_legend,
)
from dragrig.rig import (
    PHASE_NAMES,
    AnyFloatArray,
    Attribute,
    BoolArray,
    FilteredTrace,
    FloatArray,
    Phase,
    PhaseArray,
    Run,
    RunEvent,
    RunInfo,
    RunStatus,
)

ENVELOPE_COLUMNS = 2000
"""Columns that an envelope keeps; about the pixels that a picture is wide."""

GAP_PERIODS = 1.5
"""Time between samples, in sample periods, beyond which there is a gap."""


def gaps_after_samples(time: FloatArray, sample_rate_hz: float) -> BoolArray:
    """Return after which samples others are missing.

    Parameters
    ----------
    time
        Shape `(N,)`, rising [s].

    Returns
    -------
    Shape `(N - 1,)`: where the next sample is more than one and a half periods later, by the rate or by the median
    time between samples, whichever is longer.
    """
    if time.size < 2:
        return np.zeros(0, dtype=np.bool_)
    step = np.diff(time)
    usual = max(1.0 / sample_rate_hz, float(np.median(step)))
    return np.asarray(step > GAP_PERIODS * usual)


def min_max_envelope(
    time: FloatArray, value: AnyFloatArray, gap: BoolArray, columns: int = ENVELOPE_COLUMNS
) -> tuple[FloatArray, FloatArray]:
    """Return a line `(t, y)` that looks like the trace at `columns` pixels' width.

    Each column keeps its smallest and its largest value. The line is broken (by NaN) at gaps and
    where the trace itself is not finite. A trace of at most `4 * columns` samples comes back whole.

    Parameters
    ----------
    time, value
        Shape `(N,)`.
    gap
        Shape `(N - 1,)`, as from `gaps_after_samples`.
    """
    finite = np.isfinite(value)
    if finite.all():
        t, y, breaks = time, value, np.flatnonzero(gap) + 1
    else:
        whole = np.flatnonzero(finite)
        lost = np.concatenate(([0], np.cumsum(gap)))
        t, y = time[whole], value[whole]
        breaks = np.flatnonzero((np.diff(whole) > 1) | (np.diff(lost[whole]) > 0)) + 1
    if t.size > 4 * columns:
        t, y, breaks = _column_extremes(t, y, breaks, columns)
    return np.insert(t, breaks, t[breaks]), np.insert(np.asarray(y, dtype=np.float64), breaks, np.nan)


def _column_extremes(
    t: FloatArray, y: AnyFloatArray, breaks: "np.ndarray[tuple[int], np.dtype[np.intp]]", columns: int
) -> tuple[FloatArray, FloatArray, "np.ndarray[tuple[int], np.dtype[np.intp]]"]:
    regular = np.searchsorted(t, np.linspace(t[0], t[-1], columns, endpoint=False))
    starts = np.union1d(regular, breaks)
    ends = np.append(starts[1:], t.size)
    low, high = np.minimum.reduceat(y, starts), np.maximum.reduceat(y, starts)
    # A rising column is drawn from below, a falling one from above, so that neighbours join up.
    rising = y[ends - 1] >= y[starts]
    line = np.empty((starts.size, 2))
    line[:, 0] = np.where(rising, low, high)
    line[:, 1] = np.where(rising, high, low)
    times = np.column_stack((t[starts], t[ends - 1]))
    return times.ravel(), line.ravel(), 2 * np.searchsorted(starts, breaks)


SLIDING_KINDS = frozenset({"drag", "coulomb", "blank", "return"})
"""Kinds of run whose steady phase is one stretch of steady sliding."""


@dataclass(frozen=True, slots=True)
class SteadyLevel:
    """Mean force of steady sliding [mN], from when to when it was taken [s], and that at rest; NaN if not known."""

    begin_s: float
    end_s: float
    force_mN: float
    text: str
    rest_mN: float
    above_rest_text: str


def filtered_trace(run: Run) -> FilteredTrace | None:
    """Return what the filter stored in the run's file, or else what it makes of the run by itself.

    A stored derivative of the force is passed over. None for a run that is shorter than the filter's window.
    """
    if run.filtered is not None and run.filtered.units.get(run.trace.signal) == "mN":
        return run.filtered
    try:
        return filter_run(run).trace
    except AnalysisError:
        return None


def measured_speed(run: Run, filtered: FilteredTrace | None) -> FloatArray:
    """Speed [mm/s] from the encoder's position, shape `(N,)`; NaN for a run that is too short."""
    if filtered is not None and "speed" in filtered.channels and filtered.time.shape == run.trace.time.shape:
        return filtered.channels["speed"]
    return np.full(run.trace.time.shape, np.nan)


def steady_level(run: Run, measures: RunMeasures | None = None) -> SteadyLevel | None:
    """Return the mean force of steady sliding; None for other kinds, or with too little steady sliding."""
    if run.info.kind not in SLIDING_KINDS:
        return None
    known = measure(run) if measures is None else measures
    steady, rest, above = known.steady_force, known.rest_offset.value, known.steady_above_rest
    stretch, _ = steady_stretch(run)
    if steady.value is None or not stretch.any():
        return None
    inside = run.trace.time[stretch]
    return SteadyLevel(
        float(inside[0]),
        float(inside[-1]),
        steady.value,
        f"steady {value_with_error(steady.value, steady.standard_error)} mN",
        np.nan if rest is None else rest,
        f"steady − rest {value_with_error(above.value, above.standard_error)} mN",
    )


MIN_BRACKET = 0.2
"""Share of the panel's height from which on the bracket between rest and steady sliding has room for its text."""


def _draw_bracket(axes: Axes, level: SteadyLevel) -> None:
    """Draw the force at rest, and a bracket from there to that of steady sliding."""
    low, high = axes.get_ylim()
    if not abs(level.force_mN - level.rest_mN) > MIN_BRACKET * (high - low):
        return
    at = level.begin_s + (level.end_s - level.begin_s) / 4
    axes.plot([axes.get_xlim()[0], at], [level.rest_mN] * 2, color=BLACK, linestyle=":", linewidth=1.2)
    axes.annotate(
        "", (at, level.force_mN), (at, level.rest_mN), arrowprops={"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0}
    )
    middle = at, (level.force_mN + level.rest_mN) / 2
    axes.annotate(level.above_rest_text, middle, (8, 0), textcoords="offset points", va="center")


PHASE_TINTS = ("#F5F6F7", "#FCEED3", "#EAF4FB", "#FBE4D6", "#F3EEF7")
"""A colour for each phase, in the file's order."""

PHASE_BAND_COLOURS = ("#B9BFC7", "#E69F00", "#56B4E9", "#D55E00", "#B38FC4")
"""Likewise, for the band above the panel."""

MAX_PHASE_NAMES = 8

RAMP = "ramp"

_MOVING = (Phase.ACCELERATE, Phase.STEADY, Phase.DECELERATE)


@dataclass(frozen=True, slots=True)
class PhaseInterval:
    """Consecutive samples of a phase, and their name."""

    phase: int
    start_s: float
    end_s: float
    name: str


def phase_intervals(time: FloatArray, phase: PhaseArray) -> tuple[PhaseInterval, ...]:
    """Divide a run into stretches of a constant phase; each ends where the next begins."""
    if time.size == 0:
        return ()
    firsts = np.concatenate(([0], np.flatnonzero(np.diff(phase)) + 1))
    ends = np.append(time[firsts[1:]], time[-1])
    return tuple(
        PhaseInterval(int(number), float(start), float(end), PHASE_NAMES[number])
        for number, start, end in zip(phase[firsts], time[firsts], ends, strict=True)
    )


def merge_ramp(parts: Sequence[PhaseInterval]) -> tuple[PhaseInterval, ...]:
    """Merge neighbouring phases in motion into the ramp."""
    merged: list[PhaseInterval] = []
    for part in parts:
        moving = part.phase in _MOVING
        if moving and merged and merged[-1].name == RAMP:
            merged[-1] = replace(merged[-1], end_s=part.end_s)
        else:
            merged.append(replace(part, name=RAMP, phase=Phase.STEADY) if moving else part)
    return tuple(merged)


def _draw_phases(axes: Axes, parts: Sequence[PhaseInterval], tints: Sequence[str], ends: tuple[float, float]) -> None:
    """Fill each stretch between two heights of the axes, as shares of it; what lies above them is not cut off."""
    for number, tint in enumerate(tints):
        bars = [(part.start_s, part.end_s - part.start_s) for part in parts if part.phase == number]
        if bars:
            axes.broken_barh(
                bars,
                (ends[0], ends[1] - ends[0]),
                transform=axes.get_xaxis_transform(),
                facecolor=tint,
                edgecolor="none",
                zorder=0,
                clip_on=ends[1] <= 1.0,
            )


def name_phases(axes: Axes, parts: Sequence[PhaseInterval]) -> None:
    """Draw a band of the phases' colours along the axes' upper edge and their names above it.

    Names that do not fit over their stretch move aside and keep a thin line to it. Of many
    stretches only the longest of each phase is named.
    """
    band = 0.07 / panel_size_in(axes)[1]
    low, high = axes.get_xlim()
    shown = [part for part in parts if part.end_s > low and part.start_s < high]

    def inside(some: Sequence[PhaseInterval]) -> list[PhaseInterval]:
        return [replace(part, start_s=max(part.start_s, low), end_s=min(part.end_s, high)) for part in some]

    _draw_phases(axes, inside(shown), PHASE_BAND_COLOURS, (1.0, 1.0 + band))
    if len(shown) > MAX_PHASE_NAMES:
        longest = {part.phase: part for part in sorted(shown, key=lambda part: part.end_s - part.start_s)}
        shown = sorted(longest.values(), key=lambda part: part.start_s)
    names = [CurveLabel((part.start_s + part.end_s) / 2, part.name, GREY) for part in inside(shown)]
    label_times(axes, names, 1.0 + band, 19)


ORDINARY_EVENTS = frozenset({"start", "phase", "stopped", "end", "import", "filter"})
"""Kinds of events that are no alarm: phases are shaded, remarks of an import or the filter are listed by `info`."""

GAP = "gap"

MAX_MARK_LABELS = 6

MAX_HATCHED_GAPS = 40

_NARROW_GAP_SHARE = 0.004
"""A gap of a smaller share of the time shown is a line; a longer one is hatched."""


@dataclass(frozen=True, slots=True, order=True)
class EventMark:
    """A time, its label, and a duration."""

    time_s: float
    word: str
    lasted_s: float = 0.0

    @property
    def colour(self) -> str:
        """Colour of line and word: missing samples are no alarm."""
        return GREY if self.lasted_s else VERMILLION


def event_marks(
    events: Sequence[RunEvent], time: FloatArray, gap: BoolArray, sample_rate_hz: float
) -> tuple[EventMark, ...]:
    """Gather what is out of the ordinary: gaps, as the sample times show them, and events."""
    if time.size == 0:
        return ()
    before = np.flatnonzero(gap)
    starts, ends = time[before], time[before + 1]
    missing = ends - starts - 1 / sample_rate_hz
    marks = [
        EventMark(float(start), f"gap {_gap_duration_text(float(length))}", float(length))
        for start, length in zip(starts, missing, strict=True)
    ]
    for event in events:
        out_of_ordinary = event.kind not in ORDINARY_EVENTS and time[0] <= event.time_s <= time[-1]
        seen = event.kind == GAP and bool(((starts <= event.time_s) & (event.time_s <= ends)).any())
        if out_of_ordinary and not seen:
            marks.append(EventMark(event.time_s, event.kind))
    return tuple(sorted(marks))


def draw_event_marks(panels: Sequence[Axes], marks: Sequence[EventMark]) -> None:
    """Draw a line through all panels at each mark, or hatch the time it lasted, and name it in the first panel.

    Of very many the first are named, and the rest counted; very many gaps are shaded and summed up.
    """
    low, high = panels[0].get_xlim()
    gaps = [mark for mark in marks if mark.lasted_s]
    crowded = len(gaps) > MAX_HATCHED_GAPS
    long = [mark for mark in gaps if crowded or mark.lasted_s > _NARROW_GAP_SHARE * (high - low)]
    short = [mark for mark in marks if mark not in long]
    for axes in panels:
        _shade_gaps(axes, long, hatched=not crowded)
        _draw_mark_lines(axes, short)
    seen = [mark for mark in (short if crowded else marks) if low <= mark.time_s <= high]
    named = seen[:MAX_MARK_LABELS]
    if len(seen) > MAX_MARK_LABELS:
        named[-1] = replace(named[-1], word=f"{named[-1].word} + {len(seen) - MAX_MARK_LABELS} more")
    if crowded:
        missing = _gap_duration_text(sum(gap.lasted_s for gap in gaps))
        named = sorted([EventMark(gaps[0].time_s, f"{len(gaps)} gaps, {missing} missing", gaps[0].lasted_s), *named])
    names = [CurveLabel(mark.time_s + mark.lasted_s / 2, mark.word, mark.colour) for mark in named]
    label_times(panels[0], names, 0.0, 12, boxed=True)


def _draw_mark_lines(axes: Axes, marks: Sequence[EventMark]) -> None:
    if marks:
        axes.vlines(
            [mark.time_s for mark in marks],
            0,
            1,
            transform=axes.get_xaxis_transform(),
            colors=[mark.colour for mark in marks],
            linewidth=1.3,
            linestyle=(0, (4, 2)),
            zorder=3,
        )


def _shade_gaps(axes: Axes, marks: Sequence[EventMark], *, hatched: bool) -> None:
    if marks:
        axes.broken_barh(
            [(mark.time_s, mark.lasted_s) for mark in marks],
            (0, 1),
            transform=axes.get_xaxis_transform(),
            facecolor=PAPER if hatched else "#D5DAE0",
            edgecolor=PALE,
            hatch="////" if hatched else None,
            linewidth=0.0,
            zorder=0.5,
        )


def _gap_duration_text(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 0.1 else f"{1e3 * seconds:.3g} ms"


RAW_FORCE = "#7DB3DA"

RAW_MOTOR_FORCE = "#CFA3BC"

CHANNEL_LABELS = {"force": "Force (mN)", "motor_force": "Motor force (mN)"}


@dataclass(frozen=True, slots=True, eq=False)
class TraceCurve:
    """A line of a panel: times and values of one shape, where samples are missing, and how it is drawn."""

    time: FloatArray
    value: AnyFloatArray
    gap: BoolArray
    pen: LineStyle


@dataclass(frozen=True, slots=True, eq=False)
class TracePanel:
    """One quantity against time; its range is at least `smallest_span` wide and holds `level`, if there is one."""

    label: str
    curves: tuple[TraceCurve, ...]
    smallest_span: float
    level: float = np.nan
    height_in: float = 1.45


def force_panel(
    run: Run, filtered: FilteredTrace | None, gap: BoolArray, channel: str = "", steady: SteadyLevel | None = None
) -> TracePanel:
    """Measured force, thin and light, with the filtered one over it and the level of steady sliding.

    `channel` names another than the run's signal.
    """
    name = channel or run.trace.signal
    motor = name == "motor_force"
    strong, light = (PURPLE, RAW_MOTOR_FORCE) if motor else (BLUE, RAW_FORCE)
    smooth = filtered.channels.get(name) if filtered is not None else None
    time = run.trace.time
    pen = LineStyle("raw", strong if smooth is None else light, 1.0)
    curves = [TraceCurve(time, run.trace.channels[name], gap, pen)]
    if filtered is not None and smooth is not None:
        smooth_gap = gaps_after_samples(filtered.time, run.trace.sample_rate_hz)
        pen = LineStyle("filtered", strong, 2.0, detail=_filter_text(filtered.parameters))
        curves.append(TraceCurve(filtered.time, smooth, smooth_gap, pen))
    if steady is not None:
        ends, level = np.array([steady.begin_s, steady.end_s]), np.full(2, steady.force_mN)
        pen = LineStyle(steady.text, BLACK, 1.2, dashed=True)
        curves.append(TraceCurve(ends, level, np.zeros(1, dtype=np.bool_), pen))
    return TracePanel(CHANNEL_LABELS.get(name, name), tuple(curves), 1.0, height_in=1.45 if channel else 3.5)


def position_panel(run: Run, gap: BoolArray) -> TracePanel:
    """Return encoder position, and the commanded position where the file has it, both absolute."""
    time, trace, start_mm = run.trace.time, run.trace, start_position_mm(run.info)
    curves = [TraceCurve(time, trace.position + start_mm, gap, LineStyle("encoder", "#59BFA0", 3.2))]
    # Of a foreign measurement without a command the position stands for it.
    if run.info.header.backend != "external" or not np.array_equal(trace.command, trace.position):
        curves.append(TraceCurve(time, trace.command + start_mm, gap, LineStyle("command", BLACK, 1.0, dashed=True)))
    return TracePanel("Position (mm)", tuple(curves), 2e-3)


def speed_panel(run: Run, speed: FloatArray, gap: BoolArray) -> TracePanel:
    """Measured speed, and the set speed where the protocol has it."""
    curves = [TraceCurve(run.trace.time, speed, gap, LineStyle("measured", GREEN, 1.8))]
    wanted, steady = _set_speed(run), run.trace.phase == Phase.STEADY
    if wanted is not None and steady.any():
        level = np.where(steady, wanted, np.nan)
        pen = LineStyle(f"set {wanted:g} mm/s".replace("-", "−"), BLACK, 1.0, dashed=True)
        curves.append(TraceCurve(run.trace.time, level, gap, pen))
    return TracePanel("Speed (mm/s)", tuple(curves), 2e-3, level=0.0)


def draw_trace_panel(
    axes: Axes, panel: TracePanel, below_in: float = 0.1, window: tuple[float, float] | None = None
) -> None:
    """Draw a panel's curves, or the part of them inside a window of time, and label it."""
    shown = []
    for curve in panel.curves:
        time, value, gap = _crop_curve(curve, window)
        shown.append(value)
        draw_line(axes, *min_max_envelope(time, value, gap), curve.pen)
    fit_y_range(axes, [*shown, np.array([panel.level])], panel.smallest_span, below_in)
    if not any(np.isfinite(value).any() for value in shown):
        axes.text(0.5, 0.5, "no samples", transform=axes.transAxes, ha="center", va="center", color=GREY)
    axes.set_ylabel(panel.label)
    write_legend(axes, [curve.pen for curve in panel.curves])


def _crop_curve(curve: TraceCurve, window: tuple[float, float] | None) -> tuple[FloatArray, AnyFloatArray, BoolArray]:
    if window is None or curve.time.size <= 2:
        return curve.time, curve.value, curve.gap
    first, last = np.searchsorted(curve.time, window)
    first, last = max(int(first) - 1, 0), min(int(last) + 1, curve.time.size)
    return curve.time[first:last], curve.value[first:last], curve.gap[first : max(last - 1, first)]


def _filter_text(parameters: Mapping[str, Attribute]) -> str:
    window, order = parameters.get("window_s"), parameters.get("order")
    if not isinstance(window, int | float) or not isinstance(order, int | float):
        return ""
    length = f"{window:g} s" if window >= 0.1 else f"{1e3 * window:g} ms"
    return f" by Savitzky–Golay, {length}, order {order:g}"


def _set_speed(run: Run) -> float | None:
    parameters = run.info.header.protocol
    speed = parameters.get("speed_mm_s", parameters.get("ramp_speed_mm_s"))
    travel = parameters.get("travel_mm", 1.0)
    if not isinstance(speed, int | float) or not isinstance(travel, int | float):
        return None
    return float(np.copysign(speed, travel))


WIDTH_IN = 12.0

MARKS_IN = 0.34
"""Room for the names of marks at the foot of the first panel."""


def draw_panel_column(
    cell: SubplotSpec,
    run: Run,
    panels: Sequence[TracePanel],
    window: tuple[float, float] | None = None,
    name_ramp: bool = False,
) -> list[Axes]:
    """Stack panels that share their time axis in a cell of a figure, the first on top, and shade, name and mark them.

    Parameters
    ----------
    window
        The time shown [s]; default: the whole run.
    name_ramp
        Take the phases in motion together.
    """
    time = run.trace.time
    gap = gaps_after_samples(time, run.trace.sample_rate_hz)
    marks = event_marks(run.events, time, gap, run.trace.sample_rate_hz)
    heights = [panel.height_in for panel in panels]
    column = cell.subgridspec(len(panels), 1, height_ratios=heights).subplots(sharex=True, squeeze=False)
    stack: list[Axes] = list(column[:, 0])
    for axes, panel in zip(stack, panels, strict=True):
        draw_trace_panel(axes, panel, MARKS_IN if marks and axes is stack[0] else 0.1, window)
    whole = (float(time[0]), float(time[-1])) if time.size else (0.0, 1.0)
    set_time_range(stack[0], *(window or whole))
    stack[-1].set_xlabel("Time (s)")
    parts = phase_intervals(time, run.trace.phase)
    for axes in stack:
        _draw_phases(axes, parts, PHASE_TINTS, (0.0, 1.0))
    name_phases(stack[0], merge_ramp(parts) if name_ramp else parts)
    draw_event_marks(stack, marks)
    return stack


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


def draw_relaxation(figure: Figure, run: Run, panels: Sequence[TracePanel], ramp: tuple[float, float]) -> None:
    """Draw a relaxation: the whole of it, the time since the ramp on a logarithmic axis, and the ramp magnified.

    The first panel is the force's; call it within `figure_style`.
    """
    time, (begin, end) = run.trace.time, ramp
    window = max(1.5 * begin - 0.5 * end, float(time[0])), min(2.5 * end - 1.5 * begin, float(time[-1]))
    grid = figure.add_gridspec(2, 2, width_ratios=[1.2, 1.0])
    (whole,) = draw_panel_column(grid[0, 0], run, panels[:1], name_ramp=True)
    since = figure.add_subplot(grid[1, 0], sharey=whole)
    _draw_since_ramp(since, panels[0], end)
    draw_panel_column(grid[:, 1], run, panels, window)[-1].set_xlabel("Time (s), the ramp magnified")


def _draw_since_ramp(axes: Axes, panel: TracePanel, end_s: float) -> None:
    first, last = np.inf, 0.0
    for curve in panel.curves:
        after = curve.time > end_s
        since = curve.time[after] - end_s
        log_time, value = min_max_envelope(np.log10(since), curve.value[after], curve.gap[np.flatnonzero(after)[:-1]])
        draw_line(axes, 10**log_time, value, curve.pen)
        first, last = min(first, float(since[0])), max(last, float(since[-1]))
    set_log_x(axes, first, last)
    axes.axvspan(first, last, color=PHASE_TINTS[Phase.HOLD], linewidth=0, zorder=0)
    axes.set_xlabel("Time since the end of the ramp (s)")
    axes.set_ylabel(panel.label)
    write_legend(axes, [curve.pen for curve in panel.curves])


def run_sheet(info: RunInfo, height_in: float, bad_reason: str | None = None, *, narrow: bool = False) -> Figure:
    """Return an empty figure with a run's title, subtitle and problem as its header; call it within `figure_style`."""
    complete = "  ·  complete" if info.status is RunStatus.COMPLETE else ""
    problem = run_problem(info, bad_reason)
    subtitle, backend = run_subtitle(info) + complete, info.header.backend
    title = run_title(info)
    return new_figure(WIDTH_IN, height_in, title, subtitle, problem, backend, narrow=narrow, layout=PanelLayout)


def run_figure(
    run: Run,
    *,
    filtered: bool = True,
    motor_force: bool = False,
    bad_reason: str | None = None,
    measures: RunMeasures | None = None,
) -> Figure:
    """Draw a run: force, position, measured speed, and on demand the motor's force, against time.

    A relaxation is drawn three times over: whole, since its ramp on a logarithmic axis, and its ramp magnified.

    Parameters
    ----------
    filtered
        Whether to draw the filtered force over the raw one: as stored in the file, or else filtered with the default
        settings.
    motor_force
        Whether to add the motor's force, where it was recorded beside the force.
    bad_reason
        Why the run was marked bad; None when it was not.
    measures
        Its measures, where they are known already.
    """
    filter_output = filtered_trace(run)
    smooth = filter_output if filtered else None
    gap = gaps_after_samples(run.trace.time, run.trace.sample_rate_hz)
    steady = steady_level(run, measures)
    panels = [
        force_panel(run, smooth, gap, steady=steady),
        position_panel(run, gap),
        speed_panel(run, measured_speed(run, filter_output), gap),
    ]
    if motor_force and run.trace.signal != "motor_force" and "motor_force" in run.trace.channels:
        panels.append(force_panel(run, smooth, gap, "motor_force"))
    ramp = relaxation_ramp(run)
    with figure_style():
        height_in = 1.0 + sum(panel.height_in for panel in panels) + 0.25 * len(panels)
        figure = run_sheet(run.info, height_in, bad_reason, narrow=ramp is None)
        if ramp is not None:
            draw_relaxation(figure, run, panels, ramp)
        else:
            first, *_ = draw_panel_column(figure.add_gridspec(1, 1)[0], run, panels)
            if steady is not None:
                _draw_bracket(first, steady)
        return figure
