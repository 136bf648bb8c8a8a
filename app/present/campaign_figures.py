"""Figures of campaigns: overview of one, differences of two, and a pair of runs on one clock."""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis import (
    NORMAL_95,
    AlignedRuns,
    Comparison,
    DifferenceVerdict,
    Estimate,
    GroupDifference,
    MeasureDifference,
    RunPair,
    measure,
)
from dragrig.present import (
    BLACK,
    BLUE,
    GREY,
    PURPLE,
    SMALL_PT,
    TEXT_PT,
    VERMILLION,
    CurveLabel,
    LineStyle,
    PanelBox,
    add_panel,
    figure_style,
    fit_y_range,
    header_height_in,
    label_curves,
    new_figure,
    panel_height_in,
    panel_width_in,
    sequential_colours,
    set_log_x,
    set_time_range,
    set_y_label,
    shortened_to_width,
    text_width_in,
    value_with_error,
    write_badge,
    write_problem,
    write_title,
)
from dragrig.present.model_figures import spread_selection
from dragrig.present.run_figures import (
    CHANNEL_LABELS,
    FOOT_IN,
    LEFT_IN,
    PANEL_SPACING_IN,
    PHASE_NAMES_IN,
    RAW_FORCE,
    RIGHT_IN,
    WIDTH_IN,
    TraceCurve,
    TracePanel,
    draw_panel_column,
    gaps_after_samples,
    relaxation_ramp,
)
from dragrig.rig import AnyFloatArray, FloatArray, Phase, Run, RunStatus

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


_OVERVIEW_PANELS: tuple[tuple[Callable[[Axes, Sequence[RunSummary]], None], Callable[[RunSummary], bool]], ...] = (
    (_draw_steady_forces, lambda one: one.steady is not None and one.speed_mm_s > 0),
    (_draw_relaxations, lambda one: one.kind == "relaxation" and one.x.size > 1),
    (_draw_drags, lambda one: one.kind == "drag" and one.x.size > 1),
)
"""What draws a panel, and which runs it draws."""

RAW_FORCE_B = "#F0B48C"

PAIR_FORCE_IN, PAIR_DIFFERENCE_IN, PAIR_FOLLOWING_IN = 3.6, 2.0, 1.45

PAIR_GUTTER_IN = 1.25


def comparison_figure(pair: RunPair, names: tuple[str, str] = ("", "")) -> Figure:
    """Draw a pair of runs: forces raw and filtered, B − A below them with what equal runs may differ by, and position.

    A relaxation is drawn twice over: the whole of it, and its ramp magnified.

    Parameters
    ----------
    names
        What the two sides are called; nothing for runs that are told apart by their files alone.

    Raises
    ------
    AnalysisError
        Where the two traces cannot be laid over each other.
    RunFileError
        When a run cannot be read any more.
    """
    overlay = pair.overlay()
    clocked = _shift_clock(overlay.a, overlay.start_a_s)
    panels, heights = _pair_panels(pair, overlay)
    trouble = "; ".join(pair.remarks)
    ramp = relaxation_ramp(clocked)
    with figure_style():
        free = sum(heights) + PANEL_SPACING_IN * (len(heights) - 1)
        figure = new_figure(WIDTH_IN, header_height_in(trouble) + PHASE_NAMES_IN + free + FOOT_IN)
        _write_pair_header(figure, pair, names, trouble)
        room = WIDTH_IN - LEFT_IN - RIGHT_IN
        if ramp is None:
            axes = draw_panel_column(
                figure, clocked, panels, heights, PanelBox(LEFT_IN, FOOT_IN, room, 0.0), _overlay_range(overlay)
            )
            _mark_repeatability(axes, pair)
            return figure
        half = (room - PAIR_GUTTER_IN) / 2
        left = PanelBox(LEFT_IN, FOOT_IN, half, 0.0)
        _mark_repeatability(
            draw_panel_column(figure, clocked, panels, heights, left, _overlay_range(overlay), name_ramp=True), pair
        )
        begin, end = ramp
        window = 1.5 * begin - 0.5 * end, 3.5 * end - 2.5 * begin
        right = PanelBox(LEFT_IN + half + PAIR_GUTTER_IN, FOOT_IN, half, 0.0)
        magnified = draw_panel_column(figure, clocked, panels, heights, right, window)
        _mark_repeatability(magnified, pair)
        magnified[-1].set_xlabel("Time (s), the ramp magnified")
        return figure


def _write_pair_header(figure: Figure, pair: RunPair, names: tuple[str, str], trouble: str) -> None:
    condition = str(pair.condition)
    a, b = (
        ", ".join(dict.fromkeys(part for part in (name, file) if part))
        for name, file in zip(names, (pair.a.file, pair.b.file), strict=True)
    )
    parts = [f"A: {a}", f"B: {names[1] or 'model'}, on the recorded motion" if pair.b_is_model else f"B: {b}"]
    if pair.shift_s is not None and not pair.b_is_model:
        parts.append(f"B shifted by {_shift_text(pair.shift_s)}")
    subtitle = shortened_to_width("  ·  ".join(parts), SMALL_PT, WIDTH_IN - LEFT_IN - RIGHT_IN)
    write_title(figure, LEFT_IN, f"{condition[:1].upper()}{condition[1:]}", subtitle)
    write_problem(figure, LEFT_IN, trouble)
    other = "model" if pair.b_is_model else pair.b.info.header.backend
    write_badge(figure, " / ".join(dict.fromkeys((pair.a.info.header.backend, other))))


def _shift_text(shift_s: float) -> str:
    spelt = f"{1e3 * shift_s:+.1f} ms" if abs(shift_s) < 1 else f"{shift_s:+.3f} s"
    return "0 ms" if spelt in {"+0.0 ms", "-0.0 ms"} else spelt.replace("-", "−")


def _shift_clock(run: Run, start_s: float) -> Run:
    return replace(run, trace=replace(run.trace, time=np.asarray(run.trace.time - start_s)), events=(), filtered=None)


def _overlay_range(overlay: AlignedRuns) -> tuple[float, float]:
    return float(overlay.time_s[0]), float(overlay.time_s[-1])


def _pair_panels(pair: RunPair, overlay: AlignedRuns) -> tuple[list[TracePanel], list[float]]:
    a, b = _shift_clock(overlay.a, overlay.start_a_s), _shift_clock(overlay.b, overlay.start_b_s)
    panels, heights = (
        [_force_panel(pair, overlay, a, b), _difference_panel(pair, overlay)],
        [PAIR_FORCE_IN, PAIR_DIFFERENCE_IN],
    )
    followed = [
        _following_error_curve(name, run, colour)
        for name, run, colour, found in (("A", a, BLUE, pair.motion.a), ("B", b, VERMILLION, pair.motion.b))
        if found is not None
    ]
    if followed:
        panels.append(TracePanel("Error (µm)", tuple(followed), 20.0, level=0.0))
        heights.append(PAIR_FOLLOWING_IN)
    return panels, heights


def _force_panel(pair: RunPair, overlay: AlignedRuns, a: Run, b: Run) -> TracePanel:
    main = pair.main[-1]
    zero_a, zero_b = main.zeros or (0.0, 0.0)
    curves = [_raw_curve("A raw", a, zero_a, RAW_FORCE)]
    if not pair.b_is_model:
        curves.append(_raw_curve("B raw", b, zero_b, RAW_FORCE_B))
    curves += [
        _filtered_curve("A", overlay, overlay.force_a - zero_a, BLUE, _steady_level_text(main, main.a, zero_a)),
        _filtered_curve("B", overlay, overlay.force_b - zero_b, VERMILLION, _steady_level_text(main, main.b, zero_b)),
    ]
    label = CHANNEL_LABELS.get(a.trace.signal, a.trace.signal)
    return TracePanel(label, tuple(curves), 1.0)


def _difference_panel(pair: RunPair, overlay: AlignedRuns) -> TracePanel:
    main = pair.main[-1]
    zero_a, zero_b = main.zeros or (0.0, 0.0)
    detail = " of the filtered traces" + ("" if main.zeros is None else " less their rests")
    if main.error is not None:
        detail += f"; grey: {main.measure} of equal runs, ± {NORMAL_95 * main.error:.3g} mN"
    apart = _filtered_curve("B − A", overlay, (overlay.force_b - zero_b) - (overlay.force_a - zero_a), BLACK, detail)
    return TracePanel("B − A (mN)", (apart,), 1.0, level=0.0)


def _raw_curve(word: str, run: Run, zero_mN: float, colour: str) -> TraceCurve:
    trace = run.trace
    force = np.asarray(trace.force, dtype=np.float64) - zero_mN
    return TraceCurve(
        trace.time, force, gaps_after_samples(trace.time, trace.sample_rate_hz), LineStyle(word, colour, 0.9)
    )


def _filtered_curve(word: str, overlay: AlignedRuns, force: FloatArray, colour: str, detail: str) -> TraceCurve:
    rate = min(overlay.a.trace.sample_rate_hz, overlay.b.trace.sample_rate_hz)
    return TraceCurve(
        overlay.time_s, force, gaps_after_samples(overlay.time_s, rate), LineStyle(word, colour, 1.8, detail=detail)
    )


def _steady_level_text(main: MeasureDifference, estimate: Estimate, zero_mN: float) -> str:
    if estimate.value is None:
        return ""
    return f", {main.measure} {value_with_error(estimate.value - zero_mN, estimate.standard_error)} mN"


def _following_error_curve(name: str, run: Run, colour: str) -> TraceCurve:
    trace = run.trace
    off = 1e3 * (np.asarray(trace.position, dtype=np.float64) - np.asarray(trace.command, dtype=np.float64))
    pen = LineStyle(name, colour, 1.4, detail=" position − command")
    return TraceCurve(trace.time, off, gaps_after_samples(trace.time, trace.sample_rate_hz), pen)


def _mark_repeatability(axes: Sequence[Axes], pair: RunPair) -> None:
    """Mark what equal runs may differ by, and say what the time counts from."""
    main = pair.main[-1]
    apart = axes[1]
    apart.axhline(0.0, color=GREY, linewidth=0.9, zorder=1)
    if main.error is not None:
        half = NORMAL_95 * main.error
        apart.axhspan(-half, half, facecolor=GREY, alpha=0.18, linewidth=0.0, zorder=0.6)
        low, high = apart.get_ylim()
        apart.set_ylim(min(low, -1.15 * half), max(high, 1.15 * half))
    axes[-1].set_xlabel("Time since the start of motion (s)")


DIFFERENCES_WIDTH_IN, DIFFERENCES_TALL_IN = 14.0, 7.0

DIFFERENCES_HEADING_IN = 0.5

DIFFERENCES_LABELS_IN = 1.3

SIDE_COLOURS = (BLUE, VERMILLION)

SPEED_OFFSET_FACTOR = 1.02
"""B's points stand this factor beside A's on the speed axis, so that neither hides the other."""

RELAXATION_MEASURES = {"peak": ("v", PURPLE, -1.5), "hold": ("D", BLUE, 1.5)}
"""Marker, colour and place beside the strain [%]."""


def comparison_overview_figure(comparison: Comparison) -> Figure:
    """Draw steady force against speed of both sides with its errors, and B − A by kind, speed and strain.

    Bars hold 95 %: of noise in the left panel, of noise and run-to-run scatter in the others.
    """
    with figure_style():
        trouble = _differences_problem(comparison)
        figure = new_figure(
            DIFFERENCES_WIDTH_IN, header_height_in(trouble) + DIFFERENCES_HEADING_IN + DIFFERENCES_TALL_IN + FOOT_IN
        )
        title = shortened_to_width(
            f"A: {comparison.a.name}  ·  B: {comparison.b.name}", 1.6 * TEXT_PT, DIFFERENCES_WIDTH_IN - LEFT_IN - 2.5
        )
        write_title(
            figure,
            LEFT_IN,
            title,
            shortened_to_width(_differences_subtitle(comparison), SMALL_PT, DIFFERENCES_WIDTH_IN - LEFT_IN - RIGHT_IN),
        )
        write_problem(figure, LEFT_IN, trouble)
        write_badge(figure, _backends_text(comparison))
        drawn = [draw for draw, has in _DIFFERENCE_PANELS if has(comparison)]
        for draw, place in zip(drawn, _difference_boxes(len(drawn)), strict=True):
            draw(add_panel(figure, place), comparison)
        if not drawn:
            figure.text(0.5, 0.45, "no steady, peak or hold force to be compared", ha="center", color=GREY)
        return figure


def _difference_boxes(count: int) -> tuple[PanelBox, ...]:
    room = DIFFERENCES_WIDTH_IN - LEFT_IN - RIGHT_IN - DIFFERENCES_LABELS_IN
    half = (room - DIFFERENCES_LABELS_IN - LEFT_IN) / 2
    right = LEFT_IN + half + DIFFERENCES_LABELS_IN + LEFT_IN
    low = (DIFFERENCES_TALL_IN - FOOT_IN - DIFFERENCES_HEADING_IN) / 2
    if count <= 1:
        return (PanelBox(LEFT_IN, FOOT_IN, room, DIFFERENCES_TALL_IN),)[:count]
    left = PanelBox(LEFT_IN, FOOT_IN, half, DIFFERENCES_TALL_IN)
    if count == 2:
        return left, PanelBox(right, FOOT_IN, half, DIFFERENCES_TALL_IN)
    return left, PanelBox(right, FOOT_IN + DIFFERENCES_TALL_IN - low, half, low), PanelBox(right, FOOT_IN, half, low)


def _sliding_pairs(comparison: Comparison) -> list[RunPair]:
    """Pairs with a steady force of both at a known speed, of the kinds that have a look of their own."""
    return [
        pair
        for pair in comparison.pairs
        if pair.condition.kind in KIND_MARKERS
        and pair.condition.speed_mm_s
        and any(None not in one.compared for one in pair.main)
    ]


def _draw_steady_pairs(axes: Axes, comparison: Comparison) -> None:
    labels: list[CurveLabel] = []
    shown = [np.zeros(1)]
    pairs = _sliding_pairs(comparison)
    for kind, (_, marker) in KIND_MARKERS.items():
        mine = [pair for pair in pairs if pair.condition.kind == kind]
        for side, colour in enumerate(SIDE_COLOURS):
            speed = np.array([pair.condition.speed_mm_s for pair in mine], dtype=float)
            force = np.array([pair.main[0].compared[side] for pair in mine], dtype=float)
            errors = [(pair.main[0].a, pair.main[0].b)[side].standard_error or 0.0 for pair in mine]
            half = NORMAL_95 * np.array(errors, dtype=float)
            if not mine:
                continue
            levels = np.unique(speed)
            means = [float(force[speed == level].mean()) for level in levels]
            axes.plot(levels, means, color=colour, linewidth=1.4, alpha=0.6, linestyle="--" if side else "-")
            axes.errorbar(
                speed * SPEED_OFFSET_FACTOR ** (2 * side - 1), force, yerr=half,
                fmt=marker, color=colour, markersize=8, capsize=3,
                markerfacecolor="white" if side else colour, markeredgecolor=colour if side else "white",
            )  # fmt: skip
            shown += [force - half, force + half]
            labels.append(CurveLabel(means[-1], f"{'AB'[side]} {_kind_label(kind)}", colour))
    _set_speed_axis(axes, [pair.condition.speed_mm_s or 1.0 for pair in pairs])
    fit_y_range(axes, shown, 1.0)
    set_y_label(axes, "Force (mN)")
    _write_difference_heading(axes, "Steady force", "A filled, B open; bars 95 %, noise")
    label_curves(axes, labels)


def _draw_steady_differences(axes: Axes, comparison: Comparison) -> None:
    labels, shown = [], [np.zeros(1)]
    groups = [one for one in comparison.groups if one.condition.kind in KIND_MARKERS and one.condition.speed_mm_s]
    for kind, (colour, marker) in KIND_MARKERS.items():
        mine = sorted(
            (one for one in groups if one.condition.kind == kind), key=lambda one: one.condition.speed_mm_s or 0.0
        )
        if not mine:
            continue
        speed = np.array([one.condition.speed_mm_s for one in mine], dtype=float)
        shown += _draw_differences(axes, speed, mine, colour, marker, percent=False)
        labels.append(CurveLabel(mine[-1].value, _kind_label(kind), colour))
    axes.axhline(0.0, color=GREY, linewidth=1.0, zorder=1)
    _set_speed_axis(axes, [one.condition.speed_mm_s or 1.0 for one in groups])
    fit_y_range(axes, shown, 1.0)
    set_y_label(axes, "B − A (mN)")
    _write_difference_heading(axes, "Difference of steady forces", "filled: beyond scatter; bars 95 %")
    label_curves(axes, labels)


def _draw_relaxation_differences(axes: Axes, comparison: Comparison) -> None:
    labels, shown = [], [np.zeros(1)]
    groups = [one for one in comparison.groups if one.condition.shear_strain is not None and one.relative is not None]
    for quantity, (marker, colour, beside) in RELAXATION_MEASURES.items():
        mine = sorted(
            (one for one in groups if one.measure == quantity), key=lambda one: one.condition.shear_strain or 0.0
        )
        if not mine:
            continue
        strain = 100 * np.array([one.condition.shear_strain for one in mine], dtype=float)
        shown += _draw_differences(axes, strain + beside, mine, colour, marker, percent=True)
        labels.append(CurveLabel(100 * (mine[-1].relative or 0.0), quantity, colour))
    axes.axhline(0.0, color=GREY, linewidth=1.0, zorder=1)
    axes.margins(x=0.08)
    fit_y_range(axes, shown, 1.0)
    axes.set_xlabel("Shear strain (%)")
    set_y_label(axes, "B over A (%)")
    _write_difference_heading(axes, "Difference of relaxations", "filled: beyond scatter; bars 95 %")
    label_curves(axes, labels)


def _draw_differences(
    axes: Axes, x: np.ndarray, groups: Sequence[GroupDifference], colour: str, marker: str, *, percent: bool
) -> list[np.ndarray]:
    scale = np.array([100 / abs(one.a) if percent else 1.0 for one in groups])
    value = scale * np.array([one.value for one in groups])
    half = scale * NORMAL_95 * np.array([one.error for one in groups])
    axes.plot(x, value, color=colour, linewidth=1.2, alpha=0.5)
    axes.errorbar(x, value, yerr=half, fmt="none", color=colour, capsize=3)
    for at, mean, one in zip(x, value, groups, strict=True):
        beyond = one.verdict is DifferenceVerdict.BEYOND
        axes.plot(
            at, mean, marker, color=colour, markersize=8,
            markerfacecolor=colour if beyond else "white", markeredgecolor="white" if beyond else colour,
        )  # fmt: skip
    return [value - half, value + half]


_DIFFERENCE_PANELS: tuple[tuple[Callable[[Axes, Comparison], None], Callable[[Comparison], bool]], ...] = (
    (_draw_steady_pairs, lambda one: bool(_sliding_pairs(one))),
    (_draw_steady_differences, lambda one: bool(_sliding_pairs(one))),
    (_draw_relaxation_differences, lambda one: any(group.condition.shear_strain is not None for group in one.groups)),
)


def _set_speed_axis(axes: Axes, speeds: Sequence[float]) -> None:
    middle = float(np.sqrt(min(speeds) * max(speeds)))
    half = max(1.3 * max(speeds) / middle, float(np.sqrt(10.0)))
    set_log_x(axes, middle / half, middle * half)
    axes.set_xlabel("Speed (mm/s)")


def _kind_label(kind: str) -> str:
    return "Coulomb" if kind == "coulomb" else kind


def _write_difference_heading(axes: Axes, text: str, remark: str) -> None:
    y = 1 + 0.13 / panel_height_in(axes)
    axes.text(0.0, y, text, transform=axes.transAxes, fontsize=TEXT_PT, fontweight="bold")
    after = 1.1 * text_width_in(text, TEXT_PT) + 0.25
    axes.text(after / panel_width_in(axes), y, remark, transform=axes.transAxes, fontsize=SMALL_PT, color=GREY)


def _differences_subtitle(comparison: Comparison) -> str:
    count = len(comparison.pairs)
    beyond = sum(pair.verdict is DifferenceVerdict.BEYOND for pair in comparison.pairs)
    return f"{count} pair{'' if count == 1 else 's'} of runs, {beyond} of them differ by more than noise and scatter"


def _differences_problem(comparison: Comparison) -> str:
    alone = len(comparison.alone_a) + len(comparison.alone_b)
    left_out = len(comparison.a.left_out) + len(comparison.b.left_out)
    said = [f"{alone} runs have no partner"] if alone else []
    said += [f"{left_out} runs are left out"] if left_out else []
    return "; ".join((*said, *comparison.remarks))


def _backends_text(comparison: Comparison) -> str:
    found = [pair.a.info.header.backend for pair in comparison.pairs]
    found += ["model" if pair.b_is_model else pair.b.info.header.backend for pair in comparison.pairs]
    return " / ".join(dict.fromkeys(found))
