"""Figures of a gap diagnosis: budget, location map, ranking, runs before and after."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import PurePath
from textwrap import wrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MultipleLocator
from matplotlib.transforms import offset_copy

from dragrig.analysis import NORMAL_95, capitalise
from dragrig.analysis.gap import (
    CHANNELS,
    PROTOCOLS,
    AxisLocation,
    BudgetEntry,
    Diagnosis,
    GapBudget,
    GapLocation,
    PhaseCell,
    PooledDiagnosis,
    PooledEffect,
    PopulationSize,
    RankedHypothesis,
    RunContributions,
    RunTraces,
    display_name,
)
from dragrig.present import (
    BLACK,
    BLUE,
    CYCLE,
    GREY,
    KIND_MARKERS,
    ORANGE,
    PALE,
    PAPER,
    SKY,
    SMALL_PT,
    TEXT_PT,
    VERMILLION,
    Bar,
    BarPart,
    CurveLabel,
    LineStyle,
    ModelForces,
    SpeedPanel,
    SteadyForces,
    draw_line,
    figure_style,
    fit_y_range,
    kind_label,
    label_times,
    new_figure,
    p_value_text,
    panel_size_in,
    probability_text,
    set_time_range,
    shortened_to_width,
    significant,
    speed_figure,
    text_width_in,
    tint,
    write_legend,
)
from dragrig.present.diagnosis_sentences import (
    DOMAIN_NAMES,
    MAIN_SCORE,
    excess_text,
    is_stated_verdict,
    verdict_sentences,
)
from dragrig.present.gap_budget import (
    ChannelBudget,
    budget_bars,
    budget_sentences,
    budgets_by_channel,
    cause_colours,
    part_name,
)
from dragrig.rig import FloatArray

BAR_ROW_IN, RUNS_ROW_IN = 1.75, 3.3
SUBTITLE_IN = 12.0
MIN_BUDGET_RUNS, MAX_BUDGET_RUNS = 3, 4
BAR_THICKNESS = 0.86
BOLD_WIDTH = 1.12
"""Width of bold letters, in widths of others."""
NAME_LINES = 3
"""Lines that a name may take inside its part of the bar; longer ones stand above it."""
LIGHT_COLOURS = frozenset({SKY, ORANGE, PALE})
"""Colours on which black is read better than white."""
GAP_LINE = LineStyle("gap", PALE, 4.0)
PART_WIDTH = 1.8
ELSEWHERE = 0.25
"""A part is shown in a kind of run that is not shown yet, if it adds at least this share of its most there."""
MIN_DRAWN = 0.01
"""A part that is smaller than this share of the gap in a run is not drawn there."""


@dataclass(frozen=True, slots=True)
class PlottedRun:
    """A run of a budget's picture, and the part of the gap that it is shown for; None for the gap itself."""

    run: RunContributions
    part: BudgetEntry | None


def budget_figure(budget: GapBudget) -> Figure:
    """Draw the gap of each channel as a bar cut into its parts, above what each part looks like in the runs.

    Parameters
    ----------
    budget
        Of a gap: with parts. For each part, the run is shown where it adds most; no run twice.
    """
    bars, channels = budget_bars(budget), budgets_by_channel(budget)
    rows = [(bar, here, runs_showing_parts(budget.runs, here)) for bar, here in zip(bars, channels, strict=True)]
    heights = [height for _, _, runs in rows for height in (BAR_ROW_IN, *((RUNS_ROW_IN,) if runs else ()))]
    colours = cause_colours(budget)
    with figure_style():
        whole = "the gap" if len(rows) > 1 else f"{bars[0].whole[:1].lower()}{bars[0].whole[1:]}"
        sentences = " ".join(budget_sentences(budget)[: len(rows)])
        # The page has them above; cut off they would say half of it.
        subtitle = sentences if text_width_in(sentences, SMALL_PT) < SUBTITLE_IN else ""
        figure = new_figure(13.0, sum(heights), f"What {whole} is made of", subtitle)
        grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
        row = 0
        for bar, here, runs in rows:
            _draw_budget_bar(figure.add_subplot(grid[row, 0]), bar, titled=len(rows) > 1)
            row += 1
            if runs:
                panels = grid[row, 0].subgridspec(1, len(runs))
                _draw_runs([figure.add_subplot(panels[0, number]) for number in range(len(runs))], runs, here, colours)
                row += 1
        return figure


def _draw_budget_bar(axes: Axes, bar: Bar, *, titled: bool) -> None:
    """Draw the parts with their names inside, or above where there is no room."""
    whole = max(sum(part.share for part in bar.parts), 1.0)
    left, outside = 0.0, []
    for part in bar.parts:
        face = tint(part.colour, 0.15) if part.hatched else part.colour
        axes.barh(0.0, 100 * part.share, left=100 * left, height=BAR_THICKNESS, facecolor=face,
                  edgecolor=tint(GREY, 0.5) if part.hatched else "white", linewidth=1.5 * (not part.hatched),
                  hatch="//" if part.hatched else None)  # fmt: skip
        middle = 100 * (left + part.share / 2)
        room_in = 0.88 * panel_size_in(axes)[0] * part.share / whole - 0.16
        if not _write_name_inside(axes, part, middle, room_in):
            colour = BLACK if part.colour in LIGHT_COLOURS else part.colour
            outside.append(CurveLabel(middle, f"{part.name} {part.size}", colour))
        left += part.share
    axes.set_xlim(0.0, 100 * whole)
    axes.set_ylim(-0.5, 0.5)
    axes.set_yticks([])
    axes.set_xticks(range(0, 101, 25), [f"{tick} %" for tick in range(0, 101, 25)])
    axes.grid(visible=False)
    axes.spines[["left", "bottom"]].set_visible(False)
    label_times(axes, outside, 0.5 + BAR_THICKNESS / 2, 16)
    if titled:
        axes.set_title(bar.whole, pad=32.0 if outside else 8.0)


def _write_name_inside(axes: Axes, part: BarPart, middle: float, room_in: float) -> bool:
    """Write name and share into a part of the bar; False where they do not fit."""
    words = next(
        (
            lines
            for width in range(60, 3, -1)
            if max(map(len, part.name.split())) <= width
            and len(lines := wrap(part.name, width, break_on_hyphens=False)) <= NAME_LINES
            and BOLD_WIDTH * max(text_width_in(line, TEXT_PT) for line in (*lines, part.size)) <= room_in
        ),
        None,
    )
    if words is None:
        return False
    colour = BLACK if part.hatched or part.colour in LIGHT_COLOURS else "white"
    box = {"boxstyle": "round,pad=0.3", "facecolor": PAPER, "edgecolor": "none"} if part.hatched else None
    text = "\n".join((*words, part.size))
    axes.text(middle, 0.0, text, ha="center", va="center", fontsize=TEXT_PT, fontweight="bold", color=colour, bbox=box,
              linespacing=1.3)  # fmt: skip
    return True


def runs_showing_parts(runs: Sequence[RunContributions], here: ChannelBudget) -> tuple[PlottedRun, ...]:
    """Choose for each large part of a channel's gap the run where it acts most, of a kind that is not shown yet.

    A part misleads the fit of the nominal parameters, so that it shows in runs where it does not act itself, often
    most of all in relaxations, whose forces are the largest. These are left out.

    Returns
    -------
    At most four runs, none of them twice, and repeats only where there is no other condition; fewer where a part acts
    in no further ones. Of a gap without a name, the runs where it is largest.
    """
    left = [run for run in runs if run.channel == here.channel]
    parts = [entry for entry in here.large if any(run.rms(entry.cause) > 0 for run in left)]
    if here.named and not parts:
        return ()  # a spectral line, which block means do not show
    chosen: list[PlottedRun] = []
    rounds: tuple[BudgetEntry | None, ...] = tuple(parts[:MAX_BUDGET_RUNS]) or (None,)
    while left and len(chosen) < max(MIN_BUDGET_RUNS, len(rounds)):
        size = partial(_size_of, part=rounds[len(chosen) % len(rounds)])
        kinds, most = {shown.run.kind for shown in chosen}, max(map(size, left))
        conditions = {(shown.run.kind, shown.run.label) for shown in chosen}
        others = [run for run in left if run.kind not in kinds and size(run) >= ELSEWHERE * most]
        new = [run for run in left if (run.kind, run.label) not in conditions]
        best = max(others or new or left, key=size)
        if best.acting_mN and size(best) <= 0:
            break
        chosen.append(PlottedRun(best, rounds[len(chosen) % len(rounds)]))
        left.remove(best)
    return tuple(chosen)


def _size_of(run: RunContributions, part: BudgetEntry | None) -> float:
    return run.rms() if part is None else run.acting_mN.get(part.cause, run.rms(part.cause))


def _draw_runs(
    panels: Sequence[Axes], runs: Sequence[PlottedRun], here: ChannelBudget, colours: Mapping[str, str]
) -> None:
    """Draw each run in a panel with a scale of its own: the gap behind, the parts in the colours of the bar."""
    for axes, shown in zip(panels, runs, strict=True):
        _draw_parts(axes, shown, [entry.cause for entry in here.large], colours)
    panels[0].set_ylabel(f"Gap ({runs[0].run.unit})")
    if len(panels) > MIN_BUDGET_RUNS:
        write_legend(panels[0], (GAP_LINE,))
        return
    # Beside the run's name there is room, and no peak is covered.
    above = offset_copy(panels[0].transAxes, panels[0].get_figure(root=True), y=20.0, units="points")
    handle = Line2D([], [], color=GAP_LINE.colour, linewidth=GAP_LINE.width)
    panels[0].legend([handle], [GAP_LINE.word], loc="lower right", bbox_to_anchor=(1.0, 1.0), bbox_transform=above)


def _draw_parts(axes: Axes, shown: PlottedRun, causes: Sequence[str], colours: Mapping[str, str]) -> None:
    run = shown.run
    first, last = _shown_range_s(run)
    inside = (run.time_s >= first) & (run.time_s <= last)
    time, gap = run.time_s[inside], run.gap[inside]
    drawn = [cause for cause in causes if run.rms(cause) > MIN_DRAWN * run.rms()]
    parts = {cause: run.parts[cause][inside] for cause in drawn}
    draw_line(axes, time, gap, GAP_LINE)
    for cause, part in parts.items():
        draw_line(axes, time, part, LineStyle(cause, colours[cause], PART_WIDTH))
    axes.axhline(0.0, color=GREY, linewidth=0.9, zorder=1)
    fit_y_range(axes, (gap, *parts.values()), MIN_SPAN.get(run.unit, 0.0))
    room_in = 0.95 * panel_size_in(axes)[0]
    label = f"{run.kind.replace('_', ' ')}, {run.label}"
    axes.set_title(shortened_to_width(capitalise(label), SMALL_PT, room_in), pad=26.0, fontsize=SMALL_PT)
    name = "gap" if shown.part is None else part_name(shown.part)
    size = f": {significant(2)(_size_of(run, shown.part))} {run.unit}"
    room_in -= text_width_in(size, SMALL_PT)
    if shown.part is not None and shown.part.not_separable_from and text_width_in(name, SMALL_PT) > room_in:
        name = display_name(shown.part.cause)
    words = shortened_to_width(name, SMALL_PT, room_in) + size
    colour = GREY if shown.part is None else colours[shown.part.cause]
    axes.annotate(words, (0.0, 1.0), (0.0, 8.0), "axes fraction", "offset points", fontsize=SMALL_PT, color=colour)
    axes.set_xlabel("Time (s)")
    set_time_range(axes, first, last)


DARKEST_SD = 30.0
"""Excess at which a cell of the map is darkest."""

FAINT_SD = 0.5
"""Smaller excesses are written in grey."""

WHITE_TEXT_SD = 6.0
"""Excess from which the text of a cell is white."""

LOCATION_AXES = {
    "speed_mm_s": ("Speed (mm/s)", 1.0),
    "position": ("Position (mm)", 1.0),
    "session": ("Session time (min)", 1 / 60),
    "strain": ("Shear strain (%)", 100.0),
    "band_hz": ("Frequency (Hz)", 1.0),
}
"""Titles, and factors to the displayed unit."""

_EXCESS_COLOURS = LinearSegmentedColormap.from_list("excess", ["#FFFFFF", "#F6C9A8", VERMILLION, "#7A2E00"])


def location_figure(where: GapLocation, name: str = "") -> Figure:
    """Draw where a gap is.

    Above, how far each channel exceeds what is expected of it, in standard deviations, by protocol and phase; beside
    it, how much of the residual each domain accounts for. Below, shares of the excess along speed, position, session,
    strain and frequency; below each panel the narrowest neighbouring bins that have most of it, which are dark where
    they stand out beyond chance.

    Parameters
    ----------
    where
        Result of `locate`.
    name
        Name of the campaign.
    """
    rows = _map_rows(where.cells)
    map_in = max(0.46 * len(rows), 2.1) + 1.0
    excess = f"{excess_text(where, p_value_text(where.p))}, Bonferroni; p of places by max-T" if where.present else ""
    with figure_style():
        subtitle = "  ·  ".join(part for part in (shortened_to_width(name, SMALL_PT, 4.5), excess) if part)
        figure = new_figure(14.0, map_in + 3.0, _location_title(where), subtitle)
        above, below = figure.subfigures(2, 1, height_ratios=(map_in, 3.0), squeeze=False)[:, 0]
        excess, domains = above.subplots(1, 2, width_ratios=(2.2, 1.0))
        _draw_excess_map(excess, where.cells, rows)
        _draw_domain_scores(domains, where)
        panels = below.subplots(1, len(LOCATION_AXES))
        for axes, (axis, (title, unit)) in zip(panels, LOCATION_AXES.items(), strict=True):
            _draw_axis_shares(axes, where.location(axis), title, unit)
        panels[0].set_ylabel("Share (%)")
        return figure


def _location_title(where: GapLocation) -> str:
    if not where.present:
        return "Means over blocks: nothing beyond noise and scatter of repeats"
    channel, protocol = (where.location(axis).shares for axis in ("channel", "protocol"))
    in_channel, in_runs = (max(shares, key=lambda name: shares[name]) for shares in (channel, protocol))
    if not any(location.significant for location in where.locations):
        return f"A gap in the {in_channel.replace('_', ' ')}, at no place beyond chance"
    in_one = where.location("protocol").significant
    share = f", {100 * protocol[in_runs]:.0f} % of it in {in_runs} runs" if in_one else ""
    main = where.domain_scores.get(where.domain, 0.0) >= MAIN_SCORE
    matter = f", above all a matter of {DOMAIN_NAMES.get(where.domain, where.domain)}" if main else ""
    return f"Gap in the {in_channel.replace('_', ' ')}{share}{matter}"


def _map_rows(cells: Sequence[PhaseCell]) -> list[tuple[str, str]]:
    """Return protocols and channels in the order of a report, user-defined ones last."""
    known = [*PROTOCOLS, *(cell.protocol for cell in cells)], [*CHANNELS, *(cell.channel for cell in cells)]
    rows = {(cell.protocol, cell.channel) for cell in cells}
    return sorted(rows, key=lambda row: (known[0].index(row[0]), known[1].index(row[1])))


def _draw_excess_map(axes: Axes, cells: Sequence[PhaseCell], rows: Sequence[tuple[str, str]]) -> None:
    """Draw a cell for each phase of each protocol and channel with its excess; hatched where there is no data."""
    phases = list(dict.fromkeys(cell.phase for cell in cells))
    shade = Normalize(0.0, np.log1p(DARKEST_SD), clip=True)
    for cell in cells:
        row, column = rows.index((cell.protocol, cell.channel)), phases.index(cell.phase)
        seen = cell.rms is not None
        colour = _EXCESS_COLOURS(shade(np.log1p(cell.rms))) if cell.rms is not None else "#FFFFFF"
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=colour, edgecolor="#D3D9DF",
                                 hatch=None if seen else "///"))  # fmt: skip
        if cell.rms is not None:
            faint, dark = cell.rms < FAINT_SD, cell.rms >= WHITE_TEXT_SD
            axes.text(column, row, _sd_text(cell.rms), ha="center", va="center", fontsize=SMALL_PT,
                      color="white" if dark else GREY if faint else BLACK)  # fmt: skip
    axes.set_xlim(-0.5, len(phases) - 0.5)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xticks(range(len(phases)), phases)
    axes.set_yticks(range(len(rows)), [", ".join(row) for row in rows], fontsize=TEXT_PT)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.set_title("Excess over noise and scatter of repeats, in standard deviations")


def _sd_text(value: float) -> str:
    if value < 0.05:
        return "0"
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"


def _draw_domain_scores(axes: Axes, where: GapLocation) -> None:
    """Draw the share of the residual that each coordinate predicts from the other runs."""
    axes.set_title("Predictable from other runs by")
    if not where.domain_scores:
        _write_empty_panel(axes, "nothing to predict")
        return
    names = sorted(where.domain_scores, key=lambda domain: where.domain_scores[domain])
    scores = [100 * where.domain_scores[domain] for domain in names]
    colours = [VERMILLION if domain == where.domain else PALE for domain in names]
    axes.barh(range(len(names)), scores, color=colours, height=0.7)
    axes.set_yticks(range(len(names)), names)
    axes.set_xlim(0, 100)
    axes.xaxis.set_major_locator(MultipleLocator(25))
    axes.set_xlabel("Share of the squared residual (%)", fontsize=SMALL_PT)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)


def _draw_axis_shares(axes: Axes, location: AxisLocation, title: str, unit: float) -> None:
    """Draw shares along an axis, and highlight the narrowest range of bins that has most of the excess."""
    axes.set_title(title)
    if location.low is None or location.high is None:
        _write_empty_panel(axes, "no excess here")
        return
    low, high = location.low, location.high
    inside = [axis_bin.low is not None and axis_bin.high is not None and axis_bin.low >= low and axis_bin.high <= high
              for axis_bin in location.bins]  # fmt: skip
    colours = [VERMILLION if marked and location.significant else PALE for marked in inside]
    axes.bar(range(len(location.bins)), [100 * axis_bin.share for axis_bin in location.bins], color=colours, width=0.86)
    _set_bin_ticks(axes, location, unit)
    axes.set_ylim(0, 118 * max(axis_bin.share for axis_bin in location.bins))
    axes.grid(visible=False, axis="x")
    colour = VERMILLION if location.significant else GREY
    axes.set_xlabel(_location_text(location, unit), fontsize=SMALL_PT, color=colour)


def _set_bin_ticks(axes: Axes, location: AxisLocation, unit: float) -> None:
    """Label levels below their bars, and bin edges between them, as many as there is room for."""
    levels = all(axis_bin.low == axis_bin.high for axis_bin in location.bins)
    ends = [axis_bin.low for axis_bin in location.bins] + ([] if levels else [location.bins[-1].high])
    words = [_three_digits(unit * end) for end in ends if end is not None]
    places = np.arange(len(words)) - (0.0 if levels else 0.5)
    room = panel_size_in(axes)[0] / max(len(location.bins), 1)
    step = max(1, int(np.ceil((max(text_width_in(word, SMALL_PT) for word in words) + 0.08) / room)))
    shown = sorted({*range(0, len(words) - step, step), len(words) - 1})
    axes.set_xticks(places[shown].tolist(), [words[index] for index in shown])
    axes.set_xlim(-0.6, len(location.bins) - 0.4)


def _location_text(location: AxisLocation, unit: float) -> str:
    ends = [_three_digits(unit * end) for end in (location.low, location.high) if end is not None]
    where = ends[0] if ends[0] == ends[-1] else f"{ends[0]} to {ends[-1]}"
    return f"{100 * location.share:.0f} % in {where}, {p_value_text(location.p)}"


def _three_digits(value: float) -> str:
    return f"{value:.3g}"


def _write_empty_panel(axes: Axes, words: str) -> None:
    axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center", va="center", color=GREY)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(visible=False)


RANKING_MIN_ROWS, RANKING_MAX_ROWS, RANKING_MIN_PROBABILITY = 3, 10, 0.002


def ranking_figure(diagnosis: Diagnosis) -> Figure:
    """Draw the hypotheses of a diagnosis that have at least 0.2 % probability, or else the first three.

    Dark: the verdict; light blue: what these runs cannot distinguish from it; grey: the others.
    """
    rows = _ranking_rows(diagnosis.ranking)
    with figure_style():
        figure = new_figure(
            13.0,
            0.42 * len(rows) + 1.5,
            "How probable each hypothesis is",
            verdict_sentences(diagnosis)[0],
            narrow=True,
        )
        axes = figure.add_subplot()
        names = [capitalise(display_name(ranked.hypothesis)) for ranked in rows]
        colours = [_ranking_colour(ranked, diagnosis) for ranked in rows]
        bars = axes.barh(range(len(rows)), [ranked.probability for ranked in rows], height=0.62, color=colours)
        axes.bar_label(bars, [probability_text(ranked.probability) for ranked in rows], padding=6, fontsize=TEXT_PT)
        axes.set_yticks(range(len(rows)), names, fontsize=TEXT_PT)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlim(0.0, 1.0)
        axes.set_xlabel("Probability")
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)
        meanings = {BLUE: "the verdict", SKY: "not distinguishable from it with these runs", PALE: "others"}
        keys = [Patch(color=colour, label=words) for colour, words in meanings.items()
                if colour != SKY or diagnosis.confusable_with]  # fmt: skip
        axes.legend(handles=keys, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(keys))
        return figure


def _ranking_rows(ranking: Sequence[RankedHypothesis]) -> list[RankedHypothesis]:
    ordered = sorted(ranking, key=lambda ranked: -ranked.probability)
    probable = [ranked for ranked in ordered if ranked.probability >= RANKING_MIN_PROBABILITY]
    return ordered[: min(max(len(probable), RANKING_MIN_ROWS), RANKING_MAX_ROWS)]


def _ranking_colour(ranked: RankedHypothesis, diagnosis: Diagnosis) -> str:
    if is_stated_verdict(ranked, diagnosis):
        return BLUE
    return SKY if set(ranked.hypothesis.split("+")) & set(diagnosis.confusable_with) else PALE


MEASURED_LINE = LineStyle("measured", PALE, 4.0)

BEFORE_LINE = LineStyle("model before", VERMILLION, 1.9, dashed=True)

AFTER_LINE = LineStyle("model after", BLUE, 1.6)

RESIDUAL_BEFORE_LINE = LineStyle("residual before", VERMILLION, 2.2)

RESIDUAL_AFTER_LINE = LineStyle("residual after", BLUE, 1.2)

MODEL_LINE = LineStyle("model", BLUE, 1.6)

RESIDUAL_LINE = LineStyle("residual", BLUE, 1.4)

MOTION_SHARE = 0.01
"""Share of the travel at which motion begins, and short of its end at which motion ends."""

SLIDING_RUN_KINDS = frozenset({"drag", "coulomb", "blank"})


def before_after_figure(views: Sequence[RunTraces], floor_mN: float | None = None, *, named: bool = True) -> Figure:
    """Draw runs in rows.

    Parameters
    ----------
    views
        A row for each run: left the measurement and both predictions, right the residual of each. Of a sliding run,
        rest and hold are shown in proportion to the time of sliding.
    floor_mN
        Noise and scatter of repeats, marked in grey beside forces.
    named
        Whether an effect is named; otherwise only the model without effects is drawn.
    """
    title = "Before and after" if named else "The model beside the runs"
    subtitle = "Left: measurement and model; right: measured − model"
    with figure_style():
        figure = new_figure(13.0, 3.0 * len(views) + 0.4, title, subtitle)
        grid = figure.subplots(len(views), 2, sharex="row", squeeze=False)
        for (left, right), view in zip(grid, views, strict=True):
            _draw_run_row(left, right, view, floor_mN if view.unit == "mN" else None, named=named)
        for axes in grid[-1]:
            axes.set_xlabel("Time (s)")
        if floor_mN is not None:
            grid[0, 1].set_title("grey: noise and scatter of repeats", loc="right", fontsize=SMALL_PT, color=GREY)
        figure.align_ylabels(grid)
        return figure


def representative_runs(views: Sequence[RunTraces], limit: int = 7) -> tuple[RunTraces, ...]:
    """Choose drags at the lowest, a middle and the highest speed, and the largest residual of each other kind.

    Returns
    -------
    At most `limit` views, drags first, of each channel.
    """
    chosen: list[RunTraces] = []
    for channel in dict.fromkeys(view.channel for view in views):
        here = [view for view in views if view.channel == channel]
        drags = sorted((view for view in here if view.kind == "drag"), key=_mean_speed)
        middle = len(drags) // 2
        chosen += [drags[at] for at in dict.fromkeys((0, middle, len(drags) - 1)) if drags]
        for kind in dict.fromkeys(view.kind for view in here if view.kind != "drag"):
            chosen.append(max((view for view in here if view.kind == kind), key=_rms_before))
    return tuple(chosen[:limit])


def _draw_run_row(left: Axes, right: Axes, view: RunTraces, floor_mN: float | None, *, named: bool) -> None:
    shown = _shown_range_s(view)
    inside = (view.time_s >= shown[0]) & (view.time_s <= shown[1])
    time, measured = view.time_s[inside], view.measured[inside]
    models = [
        (view.before[inside], BEFORE_LINE, RESIDUAL_BEFORE_LINE),
        (view.after[inside], AFTER_LINE, RESIDUAL_AFTER_LINE),
    ]
    if not named:
        models = [(view.before[inside], MODEL_LINE, RESIDUAL_LINE)]
    draw_line(left, time, measured, MEASURED_LINE)
    for values, pen, _ in models:
        draw_line(left, time, values, pen)
    least_span = MIN_SPAN.get(view.unit, 0.0)
    fit_y_range(left, (measured, *(values for values, _, _ in models)), least_span)
    for values, _, pen in models:
        draw_line(right, time, measured - values, pen)
    fit_y_range(right, [measured - values for values, _, _ in models], least_span)
    right.axhline(0.0, color=GREY, linewidth=0.9, zorder=1)
    if floor_mN is not None and np.isfinite(floor_mN):
        right.axhspan(-floor_mN, floor_mN, facecolor=GREY, alpha=0.18, linewidth=0.0, zorder=0.6)
    quantity = f"{view.channel.replace('_', ' ').capitalize()} ({view.unit})"
    left.set_ylabel(quantity)
    right.set_ylabel(f"Residual ({view.unit})")
    write_legend(left, (MEASURED_LINE, *(pen for _, pen, _ in models)))
    if named:
        write_legend(right, [pen for _, _, pen in models])
    left.set_title(shortened_to_width(f"{view.label}, {view.file}", TEXT_PT, panel_size_in(left)[0]))
    set_time_range(left, *shown)


def _shown_range_s(view: RunTraces | RunContributions) -> tuple[float, float]:
    """Return from when to when [s] a run is shown."""
    first, last = float(view.time_s[0]), float(view.time_s[-1])
    begin, end = _motion_range_s(view)
    if view.kind not in SLIDING_RUN_KINDS or not end > begin:
        return first, last
    apart = end - begin
    return max(first, begin - 0.4 * apart), min(last, end + 0.8 * apart)


def _motion_range_s(view: RunTraces | RunContributions) -> tuple[float, float]:
    moved = np.abs(view.position_mm - view.position_mm[0])
    travel = float(moved.max(initial=0.0))
    if not travel > 0:
        return 0.0, 0.0
    under_way = np.flatnonzero((moved > MOTION_SHARE * travel) & (moved < (1 - MOTION_SHARE) * travel))
    if under_way.size == 0:
        return 0.0, 0.0
    return float(view.time_s[under_way[0]]), float(view.time_s[under_way[-1]])


def _mean_speed(view: RunTraces) -> float:
    begin, end = _motion_range_s(view)
    travel = float(np.ptp(view.position_mm)) if view.position_mm.size else 0.0
    return travel / (end - begin) if end > begin else 0.0


def _rms_before(view: RunTraces) -> float:
    left: FloatArray = view.measured - view.before
    return float(np.sqrt(np.nanmean(left**2))) if np.isfinite(left).any() else 0.0


MIN_SPAN = {"mN": 4.0, "mm": 0.004, "µm": 4.0}
"""Smallest range of an ordinate by its unit: noise is not blown up."""


def diagnosis_speed_figure(traces: Sequence[RunTraces], floor_mN: float | None = None, *, named: bool = True) -> Figure:
    """Draw the steady forces of a diagnosis' sliding runs beside the model without and with the effects.

    Parameters
    ----------
    traces
        Runs, at least one of them with a steady force.
    floor_mN
        Noise and scatter of repeats, marked in grey.
    named
        Whether an effect is named; otherwise only the model without effects is drawn.
    """
    pens = (BEFORE_LINE, AFTER_LINE) if named else (MODEL_LINE,)
    measured, models, left_over = list[SteadyForces](), list[ModelForces](), list[SteadyForces]()
    for kind, (_, marker) in KIND_MARKERS.items():
        levels = [view.steady for view in traces if view.kind == kind and view.steady is not None]
        if not levels:
            continue
        of_kind = [(level.speed_mm_s, "", level.measured_mN) for level in levels]
        measured.append(replace(SteadyForces.of_runs(kind_label(kind), BLACK, of_kind, marker), joined=False))
        for number, pen in enumerate(pens):
            forces = [(level.speed_mm_s, "", level.models_mN[number]) for level in levels]
            model = SteadyForces.of_runs("", pen.colour, forces)
            words = "" if any(line.name == pen.word for line in models) else pen.word
            dash = (5, 3) if pen.dashed else ()
            models.append(ModelForces(words, pen.colour, model.speed_mm_s, model.force_mN, dash))
            off = [(level.speed_mm_s, "", level.measured_mN - level.models_mN[number]) for level in levels]
            left_over.append(SteadyForces.of_runs("", pen.colour, off, marker, hollow=pen.dashed))
    below = SpeedPanel(left_over, quantity="Measured − model (mN)", band_mN=floor_mN)
    return speed_figure(SpeedPanel(measured, models, "Steady − rest (mN)"), below)


MAX_POOLED_PANELS, MAX_LABELLED_CAMPAIGNS = 6, 12
MAX_LEVEL_CHARACTERS = 60
"""Names of campaigns that fit on one line; longer ones are slanted."""


def pooled_sizes_figure(pooled: PooledDiagnosis) -> Figure:
    """Draw the size of each established effect by campaign, with the population's mean and band."""
    shown = [(effect, effect.size) for effect in pooled.established if effect.size is not None][:MAX_POOLED_PANELS]
    names = _beyond_common_folder([campaign.source for campaign in pooled.campaigns])
    with figure_style():
        figure = new_figure(8.0, 0.9 + 2.0 * len(shown), "Sizes by campaign", narrow=True)
        for row, (effect, size) in enumerate(shown):
            axes = figure.add_subplot(len(shown), 1, row + 1)
            _draw_sizes(axes, effect, size, CYCLE[row % len(CYCLE)])
            if len(names) <= MAX_LABELLED_CAMPAIGNS:
                axes.set_xticks(range(len(names)), names if row + 1 == len(shown) else [""] * len(names))
                if sum(map(len, names)) > MAX_LEVEL_CHARACTERS:
                    axes.tick_params(axis="x", labelrotation=30)
                    for label in axes.get_xticklabels():
                        label.set_horizontalalignment("right")
            elif row + 1 == len(shown):
                axes.set_xlabel("campaign")
        return figure


def _beyond_common_folder(sources: Sequence[str]) -> list[str]:
    """Return folders without the common beginning of their paths."""
    parts = [PurePath(source).parts for source in sources]
    common = next((at for at, names in enumerate(zip(*parts, strict=False)) if len(set(names)) > 1), 0)
    return ["/".join(names[common:]) or source for names, source in zip(parts, sources, strict=True)]


def _draw_sizes(axes: Axes, effect: PooledEffect, size: PopulationSize, colour: str) -> None:
    half = NORMAL_95 * size.spread
    if len(effect.members) > 1:
        axes.axhspan(size.mean - half, size.mean + half, color=tint(colour, 0.25), linewidth=0)
        axes.axhline(size.mean, color=colour, linewidth=1.0)
    axes.axhline(0.0, color=GREY, linewidth=0.6)
    for at, own in enumerate(size.campaigns):
        if own is not None:
            fill = colour if at in effect.members else PAPER
            axes.errorbar(
                [at], [own[0]], yerr=NORMAL_95 * own[1], fmt="o", color=colour, markerfacecolor=fill, capsize=2.0
            )
    axes.set_xlim(-0.5, len(size.campaigns) - 0.5)
    unit = "" if size.unit == "1" else f", {size.unit}"
    axes.set_title(f"{capitalise(display_name(effect.effect))}: {size.parameter}{unit}", fontsize=TEXT_PT, loc="left")
