"""Figures of campaigns: overview of a campaign, differences of two, and a pair of runs on a common clock."""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from operator import itemgetter
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
    mean_of_specimens,
    means_of_repeats,
    measure,
    set_values,
    value_with_error,
)
from dragrig.present import (
    BLACK,
    BLUE,
    GREY,
    PURPLE,
    SMALL_PT,
    VERMILLION,
    CurveLabel,
    LineStyle,
    PanelLayout,
    figure_style,
    fit_y_range,
    label_curves,
    new_figure,
    sequential_colours,
    set_log_x,
    set_time_range,
)
from dragrig.present.model_figures import spread_selection
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

STEADY_KINDS = ("drag", "coulomb", "blank")
"""Kinds of run with a steady force that stands in a campaign's picture."""

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
    if info.kind not in STEADY_KINDS:
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


KIND_MARKERS = {"drag": (BLUE, "o"), "coulomb": (VERMILLION, "s"), "blank": (GREY, "^")}
"""Colour and marker of each kind."""


def campaign_figure(runs: Iterable[Run], name: str = "", bad: Collection[Path] = ()) -> Figure:
    """Draw an overview of a campaign.

    Parameters
    ----------
    runs
        Read in turn; only a summary of each stays in memory.
    name
        Name of the campaign.
    bad
        Files of runs that were marked bad; they are counted and not drawn, as are those that ended early.
    """
    return overview_figure([summarise_run(run, bad) for run in runs], name)


def overview_figure(digests: Sequence[RunSummary], name: str = "") -> Figure:
    """Draw an overview of a campaign from what `summarise_run` kept of its runs."""
    title = " · ".join(part for part in ("Campaign", name) if part)
    backends = ", ".join(sorted({run.backend for run in digests}))
    chosen = [(draw, [run for run in digests if has(run)]) for draw, has in _OVERVIEW_PANELS]
    drawn = [(draw, panel_runs) for draw, panel_runs in chosen if panel_runs]
    with figure_style():
        figure = _overview_sheet(title, _overview_subtitle(digests), _overview_problem(digests), backends)
        if not drawn:
            figure.text(0.5, 0.45, "no complete drag, Coulomb, blank or relaxation run", ha="center", color=GREY)
        for axes, (draw, panel_runs) in zip(_overview_panels(figure, len(drawn)), drawn, strict=True):
            draw(axes, panel_runs)
        return figure


def _overview_sheet(title: str, subtitle: str, problem: str, backends: str) -> Figure:
    return new_figure(14.0, 8.2, title, subtitle, problem, backends)


def _overview_panels(figure: Figure, count: int) -> list[Axes]:
    """Return up to three panels, the first over the figure's whole height."""
    if not count:
        return []
    panels = figure.subplot_mosaic(("A", "AB", "AB;AC")[count - 1])
    return list(panels.values())


def _draw_steady_forces(axes: Axes, digests: Sequence[RunSummary]) -> None:
    labels: list[CurveLabel] = []
    shown: list[FloatArray] = [np.zeros(1)]
    for kind, (colour, marker) in KIND_MARKERS.items():
        for runs, way in _split_by_direction([run for run in digests if run.kind == kind]):
            forces = _forces_at_speeds(runs)
            every = [(speed, force) for speed, of in forces.items() for values in of.values() for force in values]
            speed, force = (np.array(column) for column in zip(*every, strict=True))
            axes.plot(speed, force, marker, color=colour, markersize=4.5, alpha=0.45, markeredgecolor="none")
            means = _means_at_speeds(dict(sorted(forces.items())))
            levels, half = np.array([mean for mean, _ in means.values()]), np.array([h for _, h in means.values()])
            axes.errorbar(
                list(means), levels, yerr=half, fmt=marker, color=colour, markersize=8,
                linestyle="--" if way else "-", linewidth=1.3,
                markerfacecolor="white" if way else colour, markeredgecolor=colour if way else "white",
            )  # fmt: skip
            shown += [force, levels - np.nan_to_num(half), levels + np.nan_to_num(half)]
            labels.append(CurveLabel(float(levels[-1]), _kind_label(kind) + way, colour))
    _finish_speed_panel(axes, [run.speed_mm_s for run in digests], shown, "Steady − rest (mN)")
    over = "specimens" if len({run.specimen for run in digests}) > 1 else "repeats"
    _write_panel_heading(axes, "Steady force", f"less that at rest; bars 95 %, Student's t over {over}")
    label_curves(axes, labels)


def _forces_at_speeds(runs: Sequence[RunSummary]) -> dict[float, dict[str, list[float]]]:
    """Return the sizes of the steady forces by speed and specimen."""
    forces: dict[float, dict[str, list[float]]] = {}
    for run, speed_mm_s in zip(runs, set_values(run.speed_mm_s for run in runs), strict=True):
        if run.steady is not None and run.steady.value is not None:
            value = run.steady.value if run.kind == "blank" else abs(run.steady.value)
            forces.setdefault(speed_mm_s, {}).setdefault(run.specimen, []).append(value)
    return forces


def _means_at_speeds(forces: Mapping[float, Mapping[str, Sequence[float]]]) -> dict[float, tuple[float, float]]:
    """Return mean and half of its 95 % interval over specimens or, of one, over its repeats; NaN for no interval."""
    specimens = {specimen for of in forces.values() for specimen in of}
    if len(specimens) > 1:
        found = [mean_of_specimens([float(np.mean(values)) for values in of.values()]) for of in forces.values()]
    else:
        found = means_of_repeats([next(iter(of.values())) for of in forces.values()])
    return {speed: (mean, np.nan if half is None else half) for speed, (mean, half) in zip(forces, found, strict=True)}


def _draw_points(
    axes: Axes, speed: FloatArray, force: FloatArray, half: FloatArray, colour: str, marker: str, *,
    hollow: bool, beside: float = 1.0,
) -> float:  # fmt: skip
    """Draw forces with their 95 % bars and a line through their means; return the mean at the highest speed."""
    level_of = np.array(set_values(speed))
    levels = np.unique(level_of)
    means = [float(force[level_of == level].mean()) for level in levels]
    axes.plot(levels, means, color=colour, linewidth=1.3, alpha=0.55, linestyle="--" if hollow else "-")
    axes.errorbar(
        speed * beside, force, yerr=half, fmt=marker, color=colour, markersize=8,
        markerfacecolor="white" if hollow else colour, markeredgecolor=colour if hollow else "white",
    )  # fmt: skip
    return means[-1]


def _finish_speed_panel(axes: Axes, speeds: Sequence[float], shown: Sequence[FloatArray], quantity: str) -> None:
    """Make the speed axis logarithmic, centred on the speeds and at least a decade long."""
    middle = float(np.sqrt(min(speeds) * max(speeds)))
    half = max(1.3 * max(speeds) / middle, float(np.sqrt(10.0)))
    set_log_x(axes, middle / half, middle * half)
    fit_y_range(axes, shown, 1.0)
    axes.set_xlabel("Speed (mm/s)")
    axes.set_ylabel(quantity)


def _split_by_direction(runs: Sequence[RunSummary]) -> Iterator[tuple[Sequence[RunSummary], str]]:
    """Separate runs forward and backward by the sign of their force."""
    known = [(run, run.steady.value or 0.0) for run in runs if run.steady is not None]
    backward = [run for run, force in known if run.kind != "blank" and force < 0]
    forward = [run for run, force in known if run.kind == "blank" or force >= 0]
    if forward:
        yield forward, ""
    if backward:
        yield backward, " back"


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
    (_draw_steady_forces, lambda run: run.steady is not None and run.speed_mm_s > 0),
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
    """Mark what equal runs may differ by."""
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

RELAXATION_MEASURES = {"peak": ("peak", PURPLE, "v", -1.5), "hold": ("hold", BLUE, "D", 1.5)}
"""Label, colour, marker and place beside the strain [%]."""


def comparison_overview_figure(comparison: Comparison) -> Figure:
    """Draw steady force against speed of both sides with its errors, and B − A by kind, speed and strain.

    Bars hold 95 %: of noise in the left panel, of noise and run-to-run scatter in the others.
    """
    drawn = [draw for draw, has in _DIFFERENCE_PANELS if has(comparison)]
    title = f"A: {comparison.a.name}  ·  B: {comparison.b.name}"
    with figure_style():
        figure = _overview_sheet(
            title, _differences_subtitle(comparison), _differences_problem(comparison), " / ".join(comparison.backends)
        )
        if not drawn:
            figure.text(0.5, 0.45, "no steady, peak or hold force to be compared", ha="center", color=GREY)
        for axes, draw in zip(_overview_panels(figure, len(drawn)), drawn, strict=True):
            draw(axes, comparison)
        return figure


def _sliding_pairs(comparison: Comparison) -> list[RunPair]:
    """Pairs with a steady force of both at a known speed, of the kinds that have a look of their own."""
    return [
        pair
        for pair in comparison.pairs
        if pair.condition.kind in KIND_MARKERS
        and pair.condition.speed_mm_s
        and any(None not in difference.compared for difference in pair.main)
    ]


def _draw_steady_pairs(axes: Axes, comparison: Comparison) -> None:
    labels: list[CurveLabel] = []
    shown = [np.zeros(1)]
    pairs = _sliding_pairs(comparison)
    for kind, (_, marker) in KIND_MARKERS.items():
        alike = [pair for pair in pairs if pair.condition.kind == kind]
        for side, colour in enumerate(SIDE_COLOURS if alike else ()):
            speed = np.array([pair.condition.speed_mm_s for pair in alike], dtype=float)
            force = np.array([pair.main[0].compared[side] for pair in alike], dtype=float)
            errors = [(pair.main[0].a, pair.main[0].b)[side].standard_error or 0.0 for pair in alike]
            half = NORMAL_95 * np.array(errors, dtype=float)
            beside = SPEED_OFFSET_FACTOR ** (2 * side - 1)
            last = _draw_points(axes, speed, force, half, colour, marker, hollow=bool(side), beside=beside)
            shown += [force - half, force + half]
            labels.append(CurveLabel(last, f"{'AB'[side]} {_kind_label(kind)}", colour))
    _finish_speed_panel(axes, [pair.condition.speed_mm_s or 1.0 for pair in pairs], shown, "Force (mN)")
    _write_panel_heading(axes, "Steady force", "A filled, B open; bars 95 %, noise")
    label_curves(axes, labels)


def _draw_steady_differences(axes: Axes, comparison: Comparison) -> None:
    groups = [
        (group, group.condition.speed_mm_s, group.condition.kind)
        for group in comparison.groups
        if group.condition.kind in KIND_MARKERS and group.condition.speed_mm_s
    ]
    looks = {kind: (_kind_label(kind), *look, 0.0) for kind, look in KIND_MARKERS.items()}
    shown = _draw_differences(axes, groups, looks, percent=False)
    _finish_speed_panel(axes, [speed for _, speed, _ in groups], shown, "B − A (mN)")
    _write_panel_heading(axes, "Difference of steady forces", "filled: beyond scatter; bars 95 %")


def _draw_relaxation_differences(axes: Axes, comparison: Comparison) -> None:
    groups = [
        (group, 100 * group.condition.shear_strain, group.measure)
        for group in comparison.groups
        if group.condition.shear_strain is not None and group.relative is not None
    ]
    shown = _draw_differences(axes, groups, RELAXATION_MEASURES, percent=True)
    axes.margins(x=0.08)
    fit_y_range(axes, shown, 1.0)
    axes.set_xlabel("Shear strain (%)")
    axes.set_ylabel("B over A (%)")
    _write_panel_heading(axes, "Difference of relaxations", "filled: beyond scatter; bars 95 %")


def _draw_differences(
    axes: Axes,
    groups: Sequence[tuple[GroupDifference, float, str]],
    looks: Mapping[str, tuple[str, str, str, float]],
    *,
    percent: bool,
) -> list[FloatArray]:
    """Draw groups at their places, with label, colour, marker and offset of their kind; return all that is shown."""
    shown, labels = [np.zeros(1)], []
    for name, (label, colour, marker, offset) in looks.items():
        alike = sorted(((group, place) for group, place, look in groups if look == name), key=itemgetter(1))
        if not alike:
            continue
        x = np.array([place + offset for _, place in alike])
        scale = np.array([100 / abs(group.a) if percent else 1.0 for group, _ in alike])
        value = scale * np.array([group.value for group, _ in alike])
        half = scale * NORMAL_95 * np.array([group.error for group, _ in alike])
        axes.plot(x, value, color=colour, linewidth=1.2, alpha=0.5)
        axes.errorbar(x, value, yerr=half, fmt="none", color=colour)
        beyond = np.array([group.verdict is DifferenceVerdict.BEYOND for group, _ in alike])
        axes.plot(x[beyond], value[beyond], marker, color=colour, markersize=8, markeredgecolor="white")
        axes.plot(x[~beyond], value[~beyond], marker, color=colour, markersize=8, markerfacecolor="white")
        shown += [value - half, value + half]
        labels.append(CurveLabel(float(value[-1]), label, colour))
    axes.axhline(0.0, color=GREY, linewidth=1.0, zorder=1)
    label_curves(axes, labels)
    return shown


_DIFFERENCE_PANELS: tuple[tuple[Callable[[Axes, Comparison], None], Callable[[Comparison], bool]], ...] = (
    (_draw_steady_pairs, lambda comparison: bool(_sliding_pairs(comparison))),
    (_draw_steady_differences, lambda comparison: bool(_sliding_pairs(comparison))),
    (
        _draw_relaxation_differences,
        lambda comparison: any(group.condition.shear_strain is not None for group in comparison.groups),
    ),
)


def _kind_label(kind: str) -> str:
    return "Coulomb" if kind == "coulomb" else kind


def _differences_subtitle(comparison: Comparison) -> str:
    count = len(comparison.pairs)
    beyond = sum(pair.verdict is DifferenceVerdict.BEYOND for pair in comparison.pairs)
    return f"{count} pair{'' if count == 1 else 's'} of runs, {beyond} of them differ by more than noise and scatter"


def _differences_problem(comparison: Comparison) -> str:
    alone = len(comparison.alone_a) + len(comparison.alone_b)
    left_out = len(comparison.a.left_out) + len(comparison.b.left_out)
    problems = [f"{alone} runs have no partner"] if alone else []
    problems += [f"{left_out} runs are left out"] if left_out else []
    return "; ".join((*problems, *comparison.remarks))
