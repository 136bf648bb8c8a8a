"""Figures of campaigns: overview of a campaign, differences of two, and a pair of runs on a common clock."""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import product
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
    RunMeasures,
    RunPair,
    measure,
    set_values,
    value_with_error,
)
from dragrig.present import (
    BLACK,
    BLUE,
    GREY,
    KIND_MARKERS,
    SMALL_PT,
    VERMILLION,
    CurveLabel,
    LineStyle,
    PanelLayout,
    SpeedPanel,
    SteadyForces,
    current_figure_form,
    draw_forces,
    figure_style,
    fit_y_range,
    kind_label,
    label_curves,
    new_figure,
    sequential_colours,
    set_log_x,
    set_time_range,
    speed_figure,
    spread_selection,
)
from dragrig.present.run_figures import (
    CHANNEL_LABELS,
    RAW_FORCE,
    WIDTH_IN,
    TraceCurve,
    TracePanel,
    draw_panel_column,
    gaps_after_samples,
    relaxation_ramp,
)
from dragrig.rig import AnyFloatArray, FloatArray, Phase, Run, RunStatus, specimen_key

STEADY_ABOVE_REST = "Steady − rest (mN)"
POSITION_BINS = 250


def _empty_array() -> FloatArray:
    return np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class RunSummary:
    """What the overview of a campaign needs of a run."""

    kind: str
    started: datetime
    backend: str
    specimen: str
    good: bool
    """Whether it is complete and not marked bad; only then are the other fields filled in."""
    speed_mm_s: float = 0.0
    """The speed that was set, or else measured, without sign; 0 where neither is known."""
    strain: float = 0.0
    """Shear strain of a relaxation, 1 being 100 %."""
    steady: Estimate | None = None
    """Steady force with that at rest taken off [mN]."""
    x: FloatArray = field(default_factory=_empty_array)
    force_mN: FloatArray = field(default_factory=_empty_array)
    """`x`, `force_mN`: a relaxation's force against the time since its ramp [s], or a drag's mean force against
    position [mm].
    """


def summarise_run(run: Run, bad: Collection[Path] = (), measures: RunMeasures | None = None) -> RunSummary:
    """Reduce a run; `bad` holds the files of runs marked bad, `measures` are those of the run if known already."""
    info = run.info
    good = info.status is RunStatus.COMPLETE and info.path not in bad
    head = (info.kind, info.header.start_time, info.header.backend, specimen_key(info), good)
    if not good or info.is_sentinel:
        return RunSummary(*head)
    if info.kind == "relaxation":
        x, force = _force_since_ramp(run)
        return RunSummary(*head, strain=_protocol_number(run, "shear_strain"), x=x, force_mN=force)
    if info.kind not in KIND_MARKERS:
        return RunSummary(*head)
    measures = measures or measure(run)
    speed = _protocol_number(run, "speed_mm_s") or measures.speed.value or 0.0
    x, force = _force_against_position(run) if info.kind == "drag" else (_empty_array(), _empty_array())
    steady = measures.steady_above_rest if measures.steady_above_rest.value is not None else None
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
    sums = [np.histogram(place, edges, weights=values)[0] for values in (place, weight)]
    filled = count > 0
    return np.asarray(sums[0][filled] / count[filled]), np.asarray(sums[1][filled] / count[filled])


def _protocol_number(run: Run, name: str) -> float:
    value = run.info.header.protocol.get(name)
    return float(value) if isinstance(value, int | float) else 0.0


def campaign_figure(runs: Iterable[Run], name: str = "", bad: Collection[Path] = ()) -> Figure:
    """Draw an overview of a campaign or, for the column of a journal, its steady forces against speed.

    Parameters
    ----------
    runs
        Read in turn; only a summary of each stays in memory.
    name
        Name of the campaign.
    bad
        Files of runs that were marked bad; they are counted and not drawn, as are those that ended early.
    """
    digests = [summarise_run(run, bad) for run in runs]
    if current_figure_form().width_mm is not None and any(map(_is_sliding, digests)):
        return campaign_speed_figure(digests, name)
    return overview_figure(digests, name)


def overview_figure(digests: Sequence[RunSummary], name: str = "") -> Figure:
    """Draw an overview of a campaign from the digests of its runs."""
    title = " · ".join(part for part in ("Campaign", name) if part)
    backends = ", ".join(sorted({run.backend for run in digests}))
    chosen = [(draw, [run for run in digests if has(run)]) for draw, has in _OVERVIEW_PANELS]
    drawn = [(draw, panel_runs) for draw, panel_runs in chosen if panel_runs]
    with figure_style():
        figure = new_figure(14.0, 8.2, title, _overview_subtitle(digests), _overview_problem(digests), backends)
        if not drawn:
            figure.text(0.5, 0.45, "no complete drag, Coulomb, blank or relaxation run", ha="center", color=GREY)
        for axes, (draw, panel_runs) in zip(_overview_panels(figure, len(drawn)), drawn, strict=True):
            draw(axes, panel_runs)
        return figure


def _overview_panels(figure: Figure, count: int) -> list[Axes]:
    """Return up to three panels, the first over the figure's whole height."""
    if not count:
        return []
    panels = figure.subplot_mosaic(("A", "AB", "AB;AC")[count - 1])
    return list(panels.values())


def campaign_speed_figure(digests: Sequence[RunSummary], name: str = "") -> Figure:
    """Draw the steady forces of a campaign against speed, from the digests of its runs."""
    sliding = list(filter(_is_sliding, digests))
    return speed_figure(
        SpeedPanel(_steady_forces(sliding), quantity=STEADY_ABOVE_REST),
        title=" · ".join(("Steady force against speed", *filter(None, (name,)))),
        subtitle=f"steady − rest; {_intervals_text(sliding)}",
        backend=", ".join(sorted({run.backend for run in digests})),
    )


def _draw_steady_forces(axes: Axes, digests: Sequence[RunSummary]) -> None:
    draw_forces(axes, SpeedPanel(_steady_forces(digests), quantity=STEADY_ABOVE_REST))
    _write_panel_heading(axes, "Steady force", f"less that at rest; {_intervals_text(digests)}")


def _is_sliding(run: RunSummary) -> bool:
    return run.steady is not None and run.speed_mm_s > 0


def _intervals_text(digests: Sequence[RunSummary]) -> str:
    over = "specimens" if len({run.specimen for run in digests}) > 1 else "repeats"
    return f"bars 95 %, Student's t over {over}"


def _steady_forces(digests: Sequence[RunSummary]) -> list[SteadyForces]:
    """Return the sizes of the steady forces of each kind and direction."""
    return [
        SteadyForces.of_runs(
            kind_label(kind) + way,
            colour,
            [(run.speed_mm_s, run.specimen, force if kind == "blank" else abs(force)) for run, force in runs],
            marker,
            hollow=bool(way),
        )
        for kind, (colour, marker) in KIND_MARKERS.items()
        for runs, way in _split_by_direction([run for run in digests if run.kind == kind])
    ]


def _split_by_direction(runs: Sequence[RunSummary]) -> Iterator[tuple[Sequence[tuple[RunSummary, float]], str]]:
    """Separate runs, with their forces, forward and backward by the sign of their force."""
    known = [(run, run.steady.value) for run in runs if run.steady is not None and run.steady.value is not None]
    for way in ("", " back"):
        chosen = [(run, force) for run, force in known if (run.kind != "blank" and force < 0) == bool(way)]
        if chosen:
            yield chosen, way


def _draw_relaxations(axes: Axes, digests: Sequence[RunSummary]) -> None:
    rising = sorted(digests, key=lambda run: run.strain)
    strain_of_run = set_values(run.strain for run in rising)
    strains = sorted(set(strain_of_run))
    colours = dict(zip(strains, sequential_colours(len(strains)), strict=True))
    ends: dict[float, float] = {}
    for run, strain in zip(rising, strain_of_run, strict=True):
        axes.plot(run.x, run.force_mN, color=colours[strain], linewidth=1.8)
        ends[strain] = float(run.force_mN[np.isfinite(run.force_mN)][-1])
    set_log_x(axes, min(float(run.x[0]) for run in rising), max(float(run.x[-1]) for run in rising))
    fit_y_range(axes, [run.force_mN for run in rising], 1.0)
    axes.set_xlabel("Time since the end of the ramp (s)")
    axes.set_ylabel("Force (mN)")
    _write_panel_heading(axes, "Relaxation", "at each shear strain")
    label_curves(axes, [CurveLabel(end, f"{100 * strain:g} %", colours[strain]) for strain, end in ends.items()])


def _draw_drags(axes: Axes, digests: Sequence[RunSummary]) -> None:
    speeds_of_runs = set_values(run.speed_mm_s for run in digests)
    first_of = dict(zip(reversed(speeds_of_runs), reversed(digests), strict=True))
    speeds = spread_selection(list(first_of))
    labels = []
    for speed, colour in zip(speeds, sequential_colours(len(speeds)), strict=True):
        run = first_of[speed]
        axes.plot(run.x, run.force_mN, color=colour, linewidth=1.8)
        middle = run.force_mN[run.force_mN.size // 2 :]
        labels.append(CurveLabel(float(np.median(middle)), f"{speed:.3g} mm/s", colour))
    shown = [first_of[speed] for speed in speeds]
    set_time_range(axes, min(0.0, *(float(run.x.min()) for run in shown)), max(float(run.x.max()) for run in shown))
    fit_y_range(axes, [run.force_mN for run in shown], 1.0)
    axes.set_xlabel("Position (mm)")
    axes.set_ylabel("Force (mN)")
    _write_panel_heading(axes, "Drag along the way", "first run at each speed")
    label_curves(axes, labels)


def _write_panel_heading(axes: Axes, text: str, remark: str) -> None:
    title = axes.set_title(text, fontweight="bold")
    axes.annotate(
        remark, (1.0, 0.0), xycoords=title, xytext=(8, 0), textcoords="offset points", va="bottom", fontsize=SMALL_PT,
        color=GREY,
    )  # fmt: skip


def _overview_subtitle(digests: Sequence[RunSummary]) -> str:
    if not digests:
        return "no runs"
    counts = Counter(run.kind for run in digests)
    kinds = ", ".join(f"{count} {kind}" for kind, count in counts.most_common())
    begin, end = min(run.started for run in digests), max(run.started for run in digests)
    specimens = ", ".join(sorted({run.specimen for run in digests}))
    until = f"{end:%H:%M}" if end.date() == begin.date() else f"{end:%Y-%m-%d %H:%M}"
    return f"{len(digests)} runs ({kinds})  ·  {specimens}  ·  {begin:%Y-%m-%d %H:%M} – {until}"


def _overview_problem(digests: Sequence[RunSummary]) -> str:
    left_out = sum(not run.good for run in digests)
    return f"{left_out} of them ended early or are marked bad, and are not drawn" if left_out else ""


_OVERVIEW_PANELS: tuple[tuple[Callable[[Axes, Sequence[RunSummary]], None], Callable[[RunSummary], bool]], ...] = (
    (_draw_steady_forces, _is_sliding),
    (_draw_relaxations, lambda run: run.kind == "relaxation" and run.x.size > 1),
    (_draw_drags, lambda run: run.kind == "drag" and run.x.size > 1),
)
"""What draws a panel, and which runs it draws."""

RAW_FORCE_B = "#F0B48C"


def comparison_figure(pair: RunPair, names: tuple[str, str] = ("", "")) -> Figure:
    """Draw a pair of runs: forces raw and filtered, B − A below them with what equal runs may differ by, and position.

    A relaxation is drawn twice over: the whole of it, and its ramp magnified.

    Parameters
    ----------
    names
        Names of the two sides; empty where the file names suffice.

    Raises
    ------
    AnalysisError
        Where the two traces cannot be laid over each other.
    RunFileError
        When a run cannot be read any more.
    """
    overlay = pair.overlay()
    clocked = _shift_clock(overlay.a, overlay.start_a_s)
    panels = _pair_panels(pair, overlay)
    ramp = relaxation_ramp(clocked)
    with figure_style():
        figure = _pair_sheet(pair, names, 1.0 + sum(panel.height_in + 0.25 for panel in panels))
        grid = figure.add_gridspec(1, 1 if ramp is None else 2)
        windows = [(float(overlay.time_s[0]), float(overlay.time_s[-1]))]
        if ramp is not None:
            begin, end = ramp
            windows.append((1.5 * begin - 0.5 * end, 3.5 * end - 2.5 * begin))
        for number, window in enumerate(windows):
            axes = draw_panel_column(
                grid[0, number], clocked, panels, window, name_ramp=ramp is not None and not number
            )
            _mark_repeatability(axes[1], pair)
            axes[-1].set_xlabel("Time (s), the ramp magnified" if number else "Time since the start of motion (s)")
        return figure


def _pair_sheet(pair: RunPair, names: tuple[str, str], height_in: float) -> Figure:
    condition = str(pair.condition)
    a, b = (
        ", ".join(dict.fromkeys(part for part in (name, file) if part))
        for name, file in zip(names, (pair.a.file, pair.b.file), strict=True)
    )
    parts = [f"A: {a}", f"B: {names[1] or 'model'}, on the recorded motion" if pair.b_is_model else f"B: {b}"]
    if pair.shift_s is not None and not pair.b_is_model:
        parts.append(f"B shifted by {_shift_text(pair.shift_s)}")
    backend_b = "model" if pair.b_is_model else pair.b.info.header.backend
    backends = " / ".join(dict.fromkeys((pair.a.info.header.backend, backend_b)))
    title = f"{condition[:1].upper()}{condition[1:]}"
    subtitle, problem = "  ·  ".join(parts), "; ".join(pair.remarks)
    return new_figure(WIDTH_IN, height_in, title, subtitle, problem, backends, layout=PanelLayout)


def _shift_text(shift_s: float) -> str:
    spelt = f"{1e3 * shift_s:+.1f} ms" if abs(shift_s) < 1 else f"{shift_s:+.3f} s"
    return "0 ms" if spelt in {"+0.0 ms", "-0.0 ms"} else spelt.replace("-", "−")


def _shift_clock(run: Run, start_s: float) -> Run:
    return replace(run, trace=replace(run.trace, time=np.asarray(run.trace.time - start_s)), events=(), filtered=None)


def _pair_panels(pair: RunPair, overlay: AlignedRuns) -> list[TracePanel]:
    a, b = _shift_clock(overlay.a, overlay.start_a_s), _shift_clock(overlay.b, overlay.start_b_s)
    panels = [_force_panel(pair, overlay, a, b), _difference_panel(pair, overlay)]
    followed = tuple(
        _following_error_curve(name, run, colour)
        for name, run, colour, motion in (("A", a, BLUE, pair.motion.a), ("B", b, VERMILLION, pair.motion.b))
        if motion is not None
    )
    return [*panels, TracePanel("Error (µm)", followed, 20.0, level=0.0)] if followed else panels


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
    return TracePanel(label, tuple(curves), 1.0, height_in=3.6)


def _difference_panel(pair: RunPair, overlay: AlignedRuns) -> TracePanel:
    main = pair.main[-1]
    zero_a, zero_b = main.zeros or (0.0, 0.0)
    detail = " of the filtered traces" + ("" if main.zeros is None else " less their rests")
    if main.error is not None:
        detail += f"; grey: {main.measure} of equal runs, ± {NORMAL_95 * main.error:.3g} mN (95 %)"
    apart = _filtered_curve("B − A", overlay, (overlay.force_b - zero_b) - (overlay.force_a - zero_a), BLACK, detail)
    return TracePanel("B − A (mN)", (apart,), 1.0, level=0.0, height_in=2.0)


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


def _mark_repeatability(difference: Axes, pair: RunPair) -> None:
    """Mark the difference that equal runs may have."""
    main = pair.main[-1]
    difference.axhline(0.0, color=GREY, linewidth=0.9, zorder=1)
    if main.error is not None:
        half = NORMAL_95 * main.error
        difference.axhspan(-half, half, facecolor=GREY, alpha=0.18, linewidth=0.0, zorder=0.6)
        low, high = difference.get_ylim()
        difference.set_ylim(min(low, -1.15 * half), max(high, 1.15 * half))


SIDE_COLOURS = (BLUE, VERMILLION)

SPEED_OFFSET_FACTOR = 1.02
"""Factor on the speed axis between B's points and A's, so that neither hides the other."""


def comparison_speed_figure(comparison: Comparison) -> Figure:
    """Draw the steady forces of both sides against speed, and below them B − A.

    Bars hold 95 %: above by Student's t over repeats, below of noise and scatter of repeats.
    """
    measured, differences = list[SteadyForces](), list[SteadyForces]()
    for (kind, (colour, marker)), way in product(KIND_MARKERS.items(), (1, -1)):
        sign = way if kind != "blank" else 1
        pairs = [pair for pair in sliding_pairs(comparison) if _is_like(pair, kind, way)]
        for side, side_colour in enumerate(SIDE_COLOURS if pairs else ()):
            forces = [
                (
                    pair.condition.speed_mm_s or 0.0,
                    specimen_key((pair.a, pair.b)[side].info),
                    sign * (pair.main[0].compared[side] or 0.0),
                )
                for pair in pairs
            ]
            name = f"{'AB'[side]} {kind_label(kind)}{' back' * (way < 0)}"
            beside = SPEED_OFFSET_FACTOR ** (2 * side - 1)
            measured.append(SteadyForces.of_runs(name, side_colour, forces, marker, hollow=bool(side), beside=beside))
        alike = [group for group in comparison.groups if _is_like(group, kind, way)]
        for beyond in (True, False):
            chosen = [group for group in alike if (group.verdict is DifferenceVerdict.BEYOND) == beyond]
            rows = [(group.condition.speed_mm_s, sign * group.value, NORMAL_95 * group.error) for group in chosen]
            speeds, values, halves = np.array(rows, dtype=float).reshape(-1, 3).T
            differences.append(
                SteadyForces("", colour, speeds, values, halves, marker, hollow=not beyond, joined=False)
            )
    return speed_figure(
        SpeedPanel(measured),
        SpeedPanel(differences, quantity="B − A (mN)"),
        title=f"A: {comparison.a.name}  ·  B: {comparison.b.name}",
        subtitle="A filled, B open; bars 95 %, Student's t; below, filled: beyond noise and scatter",
        backend=" / ".join(comparison.backends),
    )


def sliding_pairs(comparison: Comparison) -> list[RunPair]:
    """Pairs with a steady force of both at a known speed, of the kinds that have a look of their own."""
    return [
        pair
        for pair in comparison.pairs
        if pair.condition.kind in KIND_MARKERS
        and pair.condition.speed_mm_s
        and any(None not in difference.compared for difference in pair.main)
    ]


def _is_like(entry: RunPair | GroupDifference, kind: str, way: int) -> bool:
    condition = entry.condition
    return condition.kind == kind and bool(condition.speed_mm_s) and ((condition.travel_mm or 0.0) < 0) == (way < 0)
