"""Figures of an identification: joint fit, relaxation fits with strain laws, Coulomb test, steady drag."""

import re
import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.gridspec import SubplotSpec
from matplotlib.ticker import MaxNLocator

from dragrig.analysis import (
    ELEMENT_NAMES,
    NORMAL_95,
    DragResult,
    EstimatedQuantity,
    Experiment,
    JointFit,
    ParameterEstimate,
    RelaxationFit,
    RelaxationResiduals,
    RelaxationResult,
    RunResidual,
    RunSelection,
    SpeedBoundary,
    SpeedPoint,
    StrainLaw,
    count_text,
    estimate_noise,
    evaluate_strain_law,
    relaxation_residuals,
    value_with_error,
)
from dragrig.config import AnalysisError
from dragrig.present import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    PURPLE,
    SMALL_PT,
    TEXT_PT,
    VERMILLION,
    CurveLabel,
    ModelForces,
    SpeedPanel,
    SteadyForces,
    figure_style,
    fit_y_range,
    gaps_after_samples,
    min_max_envelope,
    new_figure,
    parameter_symbol,
    set_log_x,
    significant,
    speed_figure,
    unit_text,
)
from dragrig.rig import FloatArray
from dragrig.sim_backend.friction import EQ14, TABLE1, TABLE1_STRAIN

TABLE1_DASHES = (0, (4, 2))
JOINT_ROOMY_RUNS, JOINT_MAX_RUNS = 32, 60
LONGEST_NAME = 32
"""Characters of a name or a file; longer ones are cut in the middle."""
JOINT_MIN_SD, JOINT_MAX_SD = 3.0, 10.0
"""Shortest and longest axis of the parameters, in standard deviations."""
JOINT_MIN_PERCENT, JOINT_MAX_PERCENT = 2.0, 100.0
LOG_AXIS_CHI2 = 5.0
"""χ² above which the axis of the runs is logarithmic."""
PRIOR_COLOUR = "#E3E7EC"


def joint_fit_figure(fit: JointFit) -> Figure:
    """Draw a joint fit.

    Left, each parameter with its 95 % interval, in standard deviations of its prior; below, the intervals of products
    of parameters. Right, χ² per degree of freedom of each run, 1 where only noise and repeatability remain; of more
    than 60 runs those with the largest.
    """
    runs = _largest_chi2_runs(fit.runs)
    left = [0.36 * len(rows) for rows in (fit.parameters, fit.combinations) if rows]
    right = len(runs) * (0.36 if len(runs) <= JOINT_ROOMY_RUNS else 0.23)
    # Title and label of a second panel are about 1.1 in high.
    left_in = sum(left) + 1.1 * (len(left) - 1)
    body_in = max(left_in, right)
    with figure_style():
        figure = new_figure(
            16.0,
            body_in + 1.3,
            f"Joint fit of the {fit.nominal} model",
            _joint_subtitle(fit, len(runs)),
            _joint_problem(fit),
        )
        columns = figure.add_gridspec(1, 2, width_ratios=(1.2, 1.0))
        panels = _rows_from_top(figure, columns[0], left, body_in - left_in)
        _draw_joint_parameters(panels[0], fit)
        if fit.combinations:
            _draw_combinations(panels[1], fit)
        (panel,) = _rows_from_top(figure, columns[1], [right], body_in - right)
        _draw_run_chi2(panel, runs)
        return figure


def _rows_from_top(figure: Figure, column: SubplotSpec, heights_in: Sequence[float], spare_in: float) -> list[Axes]:
    """Return panels of these heights above an empty rest, so that rows are equally high in both columns."""
    ratios = [*heights_in, spare_in] if spare_in > 0.5 else list(heights_in)
    grid = column.subgridspec(len(ratios), 1, height_ratios=ratios, hspace=0.08)
    return [figure.add_subplot(grid[row]) for row in range(len(heights_in))]


def _cut_middle(name: str) -> str:
    """Cut the middle out of a long name: runs differ at its ends."""
    half = LONGEST_NAME // 2
    return name if len(name) <= LONGEST_NAME else f"{name[:half]}…{name[-half:]}"


def _largest_chi2_runs(runs: Sequence[RunResidual]) -> list[RunResidual]:
    largest = sorted(range(len(runs)), key=lambda at: -runs[at].chi2)[:JOINT_MAX_RUNS]
    return [runs[at] for at in sorted(largest)]


def _joint_subtitle(fit: JointFit, shown: int) -> str:
    runs = count_text(len({run.file for run in fit.runs}), "run")
    if shown < len(fit.runs):
        runs += f", the {shown} with the largest χ² shown"
    return f"χ² {_chi2_text(fit.chi2 / max(fit.degrees, 1))} per degree of freedom ({fit.degrees})  ·  {runs}"


def _joint_problem(fit: JointFit) -> str:
    if not fit.converged:
        return "did not converge: no interval is valid"
    return "the residuals exceed the noise: the intervals may be too narrow" if not fit.holds else ""


def _chi2_text(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


def _identified_text(parameter: ParameterEstimate, fit: JointFit) -> str:
    """Return a value as text: none that the runs do not determine, no error of a fit that did not converge."""
    if not parameter.determined:
        return "not determined"
    error = parameter.standard_error if fit.converged else None
    return f"{value_with_error(parameter.value, error)} {unit_text(parameter.unit)}".rstrip()


SESSION_TIME = re.compile(r"^\d{8}-\d{6}-")
"""Begin of the names of run files, the same for all of a session."""


def _run_names(runs: Sequence[RunResidual]) -> list[str]:
    several = len({run.channel for run in runs}) > 1
    names = [SESSION_TIME.sub("", run.file.removesuffix(".h5")) for run in runs]
    return [f"{name} {run.channel}" if several else name for name, run in zip(names, runs, strict=True)]


def _draw_joint_parameters(axes: Axes, fit: JointFit) -> None:
    places = [_in_prior_sd(parameter) for parameter in fit.parameters]
    reach = _axis_reach(places, JOINT_MIN_SD, JOINT_MAX_SD)
    axes.axvspan(-NORMAL_95, NORMAL_95, color=PRIOR_COLOUR, linewidth=0)
    axes.axvline(0.0, color=PALE, linewidth=1.0)
    _draw_intervals(axes, fit, fit.parameters, places, reach, BLUE)
    axes.set_xlabel("Difference from the prior mean (standard deviations)")
    axes.set_title("95 % intervals before (grey) and after the runs")


def _in_prior_sd(parameter: ParameterEstimate) -> tuple[float, float, float]:
    """Return low end, value and high end in standard deviations of the prior, logarithmically where it is positive."""
    ends = np.array([*parameter.prior, parameter.interval[0], parameter.value, parameter.interval[1]])
    known = np.log(ends) if (ends > 0).all() else ends
    middle, half = (known[0] + known[1]) / 2, (known[1] - known[0]) / 2
    low, value, high = (NORMAL_95 * (known[2:] - middle) / half).tolist() if half > 0 else (0.0, 0.0, 0.0)
    return low, value, high


def _draw_combinations(axes: Axes, fit: JointFit) -> None:
    places = [
        (_percent_from_value(product, product.interval[0]), 0.0, _percent_from_value(product, product.interval[1]))
        for product in fit.combinations
    ]
    determined = [place for place, product in zip(places, fit.combinations, strict=True) if product.determined]
    reach = _axis_reach(determined, JOINT_MIN_PERCENT, JOINT_MAX_PERCENT)
    axes.axvline(0.0, color=PALE, linewidth=1.0)
    _draw_intervals(axes, fit, fit.combinations, places, reach, PURPLE)
    axes.set_xlabel("Difference from the value (%)")
    axes.set_title("95 % intervals of products of parameters")


def _percent_from_value(quantity: EstimatedQuantity, end: float) -> float:
    return 100 * (end - quantity.value) / (abs(quantity.value) or 1.0)


def _axis_reach(places: Sequence[tuple[float, float, float]], minimum: float, maximum: float) -> float:
    return min(max([minimum, *(1.08 * abs(end) for ends in places for end in ends)]), maximum)


def _draw_intervals(
    axes: Axes,
    fit: JointFit,
    rows: Sequence[ParameterEstimate],
    places: Sequence[tuple[float, float, float]],
    reach: float,
    colour: str,
) -> None:
    """Draw the intervals of determined parameters, with names at the left and numbers at the right."""
    for row, (parameter, (low, value, high)) in enumerate(zip(rows, places, strict=True)):
        if parameter.determined:
            _draw_interval(axes, row, (low, value, high) if fit.converged else (value, value, value), reach, colour)
    axes.set_yticks(
        range(len(rows)), [_cut_middle(parameter_symbol(parameter.name)) for parameter in rows], fontsize=TEXT_PT
    )
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlim(-reach, reach)
    axes.grid(visible=False, axis="y")
    for row, parameter in enumerate(rows):
        axes.annotate(
            _identified_text(parameter, fit), (1.0, row), (10, 0), xycoords=("axes fraction", "data"),
            textcoords="offset points", va="center", fontsize=SMALL_PT, color=BLACK if parameter.determined else GREY,
        )  # fmt: skip


def _draw_interval(axes: Axes, row: int, ends: tuple[float, float, float], reach: float, colour: str) -> None:
    """Draw value and interval; an arrow points to ends beyond the axis."""
    low, value, high = (min(max(end, -reach), reach) for end in ends)
    axes.plot([low, high], [row, row], color=colour, linewidth=3.0, solid_capstyle="butt")
    for end, edge, marker in ((ends[0], -reach, "<"), (ends[2], reach, ">")):
        if abs(end) > reach and np.sign(end) == np.sign(edge):
            axes.plot(edge, row, marker, color=colour, markersize=9, clip_on=False)
    if abs(ends[1]) <= reach:
        axes.plot(value, row, "o", color=colour, markersize=7, markeredgecolor="white")


def _draw_run_chi2(axes: Axes, runs: Sequence[RunResidual]) -> None:
    largest = max(run.chi2 for run in runs)
    if largest > LOG_AXIS_CHI2:
        set_log_x(axes, 0.3, 1.3 * largest)
    else:
        axes.set_xlim(0.0, max(2.0, 1.08 * largest))
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5))
    for row, run in enumerate(runs):
        error = float(np.sqrt(2 / max(run.blocks, 1)))
        low, high = max(1 - NORMAL_95 * error, 0.0), 1 + NORMAL_95 * error
        colour = VERMILLION if run.exceeds_noise else BLACK
        axes.barh(row, high - low, left=low, height=0.5, color=PRIOR_COLOUR, linewidth=0)
        axes.plot(max(run.chi2, axes.get_xlim()[0]), row, "o", color=colour, markersize=6.5, clip_on=False)
    axes.axvline(1.0, color=GREY, linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set_yticks(range(len(runs)), [_cut_middle(name) for name in _run_names(runs)], fontsize=SMALL_PT)
    axes.set_ylim(len(runs) - 0.5, -0.5)
    axes.set_xlabel("χ² per degree of freedom")
    axes.set_title("Residual of each run (grey: noise)")
    axes.grid(visible=False, axis="y")


ELEMENT_TITLES = ("E₁ (kPa)", "E₂ (kPa)", "E₃ (kPa)", "η₁ (kPa·s)", "η₂ (kPa·s)")


def wall_figure(fits: Sequence[RelaxationFit] = (), laws: Sequence[StrainLaw] = ()) -> Figure:
    """Draw the wall's five elements against strain: Table 1, Eq. 14, and those of relaxations with their laws."""
    with figure_style():
        figure = new_figure(15.0, 4.6, "Wall parameters: Eq. 14 does not follow Table 1")
        draw_strain_laws(figure, fits, laws)
        return figure


def draw_strain_laws(figure: Figure | SubFigure, fits: Sequence[RelaxationFit], laws: Sequence[StrainLaw]) -> None:
    """Draw the five elements side by side."""
    usable = [fit for fit in fits if fit.elements]
    strain = np.array([fit.shear_strain for fit in usable])
    furthest = max([TABLE1_STRAIN[-1], *strain.tolist()])
    panels = figure.subplots(1, len(ELEMENT_NAMES))
    for index, (axes, name) in enumerate(zip(panels, ELEMENT_NAMES, strict=True)):
        shown = [*_draw_published_walls(axes, index), np.zeros(1)]
        points = [fit.elements[index] for fit in usable]
        if points:
            value = np.array([point.value for point in points])
            ends = np.abs(np.array([point.interval for point in points]).T - value)
            axes.errorbar(100 * strain, value, ends, fmt="s", color=VERMILLION, markersize=7, markeredgecolor="white",
                          capsize=4, label="this specimen, each run")  # fmt: skip
            shown.append(value + ends[1])
        shown += [_draw_strain_law(axes, law) for law in laws if law.element == name]
        fit_y_range(axes, shown, 0.01, 0.0)
        axes.set_xlim(0, 110 * furthest)
        axes.set_xlabel("Strain (%)")
        axes.set_title(ELEMENT_TITLES[index])
    handles, words = panels[0].get_legend_handles_labels()
    figure.legend(handles, words, loc="outside lower left", ncols=len(words))


def _draw_published_walls(axes: Axes, index: int) -> list[FloatArray]:
    strain = np.linspace(TABLE1_STRAIN[0], TABLE1_STRAIN[-1], 100)
    eq14, table1 = np.polyval(EQ14[index], strain), np.array(TABLE1[index])
    axes.plot(100 * np.array(TABLE1_STRAIN), table1, "o", color=BLACK, markersize=6.5, mfc="white", label="Table 1")
    axes.plot(100 * strain, eq14, color=BLUE, linestyle=TABLE1_DASHES, linewidth=1.8, label="Eq. 14, as printed")
    fitted = np.polyval(np.polyfit(TABLE1_STRAIN, table1, 2), strain)
    axes.plot(100 * strain, fitted, color=GREY, linewidth=1.2, label="quadratic through Table 1")
    return [eq14, table1, fitted]


def _draw_strain_law(axes: Axes, law: StrainLaw) -> FloatArray:
    strain = np.linspace(min(law.strains), max(law.strains), 100)
    value, error = evaluate_strain_law(law, strain)
    axes.fill_between(
        100 * strain, value - 1.96 * error, value + 1.96 * error, color=VERMILLION, alpha=0.18, linewidth=0
    )
    axes.plot(100 * strain, value, color=VERMILLION, label="law over strain, 95 % band")
    return np.concatenate((value - 1.96 * error, value + 1.96 * error))


RELAXATION_FIT_MAX_COLUMNS = 4
MIN_RESIDUAL_RANGE = 4.0


def relaxation_fit_figure(relaxation: RelaxationResult, selection: RunSelection) -> Figure:
    """Draw identified relaxations.

    Above, for up to four runs of different strain, the measured force, the fit and its whitened residuals against the
    time since the ramp began; below, the five elements against strain beside Table 1 and Eq. 14.

    Raises
    ------
    AnalysisError
        Where there is no relaxation run.
    """
    chosen = _fits_to_draw(relaxation)
    if not chosen:
        raise AnalysisError("There is no relaxation run to draw; name a campaign that has some")
    experiments = {experiment.file: experiment for experiment in selection.of_kind("relaxation")}
    noise = estimate_noise(experiments.values(), "force")
    title = f"Five elements from relaxation · {selection.specimen}"
    with figure_style():
        figure = new_figure(15.0, 9.8, title, _relaxation_fit_subtitle(relaxation))
        above, below = figure.subfigures(2, 1, height_ratios=(6.2, 3.6), squeeze=False)[:, 0]
        forces, left_overs = above.subplots(
            2, len(chosen), sharex="col", sharey="row", height_ratios=(2.9, 1.6), squeeze=False
        )
        fit_residuals = [
            relaxation_residuals(fit, experiments[fit.file], noise) if fit.elements else None for fit in chosen
        ]
        for force, left_over, fit, residuals in zip(forces, left_overs, chosen, fit_residuals, strict=True):
            _draw_relaxation_fit(force, left_over, fit, experiments[fit.file], residuals)
        forces[0].set_ylabel("Force (mN)")
        left_overs[0].set_ylabel("Residual (σ)")
        above.align_ylabels([forces[0], left_overs[0]])
        drawn = [residuals for residuals in fit_residuals if residuals is not None]
        _share_ranges(forces, left_overs[0], drawn)
        if not drawn:
            left_overs[0].set_yticks([])
        draw_strain_laws(below, relaxation.fits, relaxation.laws)
        return figure


def _fits_to_draw(relaxation: RelaxationResult) -> list[RelaxationFit]:
    """Return a fit for each strain, or a selection spread over the strains where there are too many."""
    rising = sorted(relaxation.fits, key=lambda fit: (not fit.elements, fit.shear_strain))
    by_strain = {round(fit.shear_strain, 2): fit for fit in reversed(rising)}
    fits = sorted(by_strain.values(), key=lambda fit: fit.shear_strain)
    if len(fits) > RELAXATION_FIT_MAX_COLUMNS:
        fits = [fits[round(place)] for place in np.linspace(0, len(fits) - 1, RELAXATION_FIT_MAX_COLUMNS)]
    return fits


def _relaxation_fit_subtitle(relaxation: RelaxationResult) -> str:
    identified = sum(bool(fit.elements) for fit in relaxation.fits)
    runs = count_text(len(relaxation.fits), "run")
    summary = runs if identified == len(relaxation.fits) else f"{identified} of {runs} identified"
    if not identified:
        return f"{summary}  ·  grey: measured"
    return f"{summary}  ·  grey: measured  ·  orange: spring and two Maxwell branches, driven through the measured ramp"


def _draw_relaxation_fit(
    force: Axes, left_over: Axes, fit: RelaxationFit, experiment: Experiment, residuals: RelaxationResiduals | None
) -> None:
    begin = residuals.ramp_s[0] if residuals else _first_motion_s(experiment)
    _draw_measured_force(force, experiment, begin)
    title = f"{100 * fit.shear_strain:g} % strain"
    force.set_title(title, fontweight="bold")
    left_over.set_xlabel("Time since the ramp began (s)")
    if residuals is None:
        words = textwrap.fill(f"not identified: {fit.remark}", 34)
        left_over.grid(visible=False)
        left_over.text(0.5, 0.5, words, transform=left_over.transAxes, ha="center", va="center", fontsize=SMALL_PT)
        return
    force.plot(residuals.time_s - begin, residuals.predicted_mN, color=VERMILLION, linewidth=1.8)
    force.text(
        0.97, 0.98, _time_constants_text(fit), transform=force.transAxes, ha="right", va="top", fontsize=SMALL_PT
    )
    shown = residuals.middle_s > begin
    left_over.axhspan(-2, 2, color=PALE, alpha=0.35, linewidth=0, zorder=0)
    left_over.plot(residuals.middle_s[shown] - begin, residuals.whitened[shown], ".", color=BLACK, markersize=4)
    left_over.text(
        0.03, 0.97, _fit_quality_text(fit), transform=left_over.transAxes, va="top", fontsize=SMALL_PT, color=GREY
    )


def _draw_measured_force(force: Axes, experiment: Experiment, begin_s: float) -> None:
    trace, time = experiment.run.trace, experiment.time_s
    after = np.flatnonzero(time > begin_s)
    since = time[after] - begin_s
    gap = gaps_after_samples(time, trace.sample_rate_hz)[after[:-1]]
    values = np.where(experiment.valid[after], np.asarray(trace.force, dtype=np.float64)[after], np.nan)
    log_time, value = min_max_envelope(np.log10(since), values, gap)
    set_log_x(force, float(since[0]), float(since[-1]))
    force.plot(10**log_time, value, color=PALE, linewidth=5.0)


def _share_ranges(forces: Sequence[Axes], left_over: Axes, fit_residuals: Sequence[RelaxationResiduals]) -> None:
    """Give all columns a common range, with room for text along the upper edges."""
    low = min(axes.dataLim.ymin for axes in forces)
    high = max(axes.dataLim.ymax for axes in forces)
    forces[0].set_ylim(low - 0.04 * (high - low), high + 0.16 * (high - low))
    largest = max((float(np.abs(residuals.whitened).max()) for residuals in fit_residuals), default=0.0)
    furthest = max(MIN_RESIDUAL_RANGE, 1.05 * largest)
    left_over.set_ylim(-furthest, 1.45 * furthest)


def _first_motion_s(experiment: Experiment) -> float:
    moving = np.flatnonzero(experiment.motion.signs)
    return float(experiment.motion.breaks_s[moving[0]]) if moving.size else 0.0


def _time_constants_text(fit: RelaxationFit) -> str:
    digits = significant(3)
    fast, slow = (f"{digits(1e3 * tau.value)} ms" if tau.value < 0.1 else f"{digits(tau.value)} s" for tau in fit.times)
    return f"τ₁ {fast}\nτ₂ {slow}"


def _fit_quality_text(fit: RelaxationFit) -> str:
    per_degree = (fit.chi2 or 0.0) / max(fit.degrees, 1)
    quality = f"χ²/ν {_chi2_text(per_degree)}"
    if fit.test is None or fit.test.suffices is None:
        return quality
    return f"{quality} · five suffice" if fit.test.suffices else f"{quality} · a third branch shows"


DRAG_PART_TINTS = (("f_c", "$f_c$  Coulomb", VERMILLION, "#F8E0D3"), ("f_e", "$f_e$  environmental", BLUE, "#D8E8F3"),
         ("f_v", "$f_v$  viscous", GREEN, "#CDEBE0"))  # fmt: skip
"""The model's parts from below: name, words, colour of the words and of the area."""


def drag_figure(
    drag: DragResult,
    *,
    before: str = "model before",
    boundary_mm_s: float | None = None,
    accuracy_mN: float | None = None,
) -> Figure:
    """Draw the measured drag with its 95 % intervals over the identified model's parts, and the law of ln v.

    Below, the differences from the model. An estimated boundary is marked with its interval. Backward speeds are drawn
    hollow.

    Parameters
    ----------
    before
        Name of the model that the runs were fitted from.
    boundary_mm_s
        The paper's boundary speed, to mark as well.
    accuracy_mN
        The sensor's accuracy, drawn as a band around no difference.

    Raises
    ------
    AnalysisError
        Where there is no drag.
    """
    if drag.model is None:
        raise AnalysisError("There is no drag to draw; name a campaign that has some")
    curve, speed = drag.model, drag.model.speed_mm_s
    lines = [ModelForces("model", BLACK, speed, curve.total, width=2.6)]
    if drag.log_law is not None:
        lines.append(ModelForces("law of ln v", PURPLE, speed, drag.log_law.force_mN(speed), (5, 2), 1.8))
    if drag.before_mN is not None:
        lines.append(ModelForces(before, GREY, speed, drag.before_mN, (2, 2), 1.6))
    off = [
        ModelForces("", line.colour, speed, line.force_mN - curve.total, line.dash, line.width) for line in lines[1:]
    ]
    band = () if accuracy_mN is None else (CurveLabel(0.0, f"± {accuracy_mN:g} mN", GREY),)
    off_points = _drag_points(drag.points, less_model=True)
    below = SpeedPanel(off_points, off, "Measured − model (mN)", band, accuracy_mN)
    tops = np.cumsum([getattr(curve, name) for name, *_ in DRAG_PART_TINTS], axis=0)
    feet = np.vstack((np.zeros_like(speed), tops[:-1]))
    labels = [
        CurveLabel(float(foot[-1] + top[-1]) / 2, words, colour, math=True)
        for (_, words, colour, _), foot, top in zip(DRAG_PART_TINTS, feet, tops, strict=True)
    ]
    with figure_style():
        figure = speed_figure(
            SpeedPanel(_drag_points(drag.points), lines, labels=labels),
            below,
            title="Drag against speed, measured and by the model",
            subtitle="points: measured, 95 % intervals; open: backwards  ·  areas: the model's parts",
        )
        for (*_, tint), foot, top in zip(DRAG_PART_TINTS, feet, tops, strict=True):
            figure.axes[0].fill_between(speed, foot, top, color=tint, linewidth=0, zorder=0.5)
        figure.axes[0].set_ylim(bottom=0.0)
        _draw_boundaries(figure.axes, drag.boundary, boundary_mm_s)
        return figure


def _drag_points(points: Sequence[SpeedPoint], *, less_model: bool = False) -> list[SteadyForces]:
    """Return the measured points, backward ones apart, or their differences from the model."""
    shown = list[SteadyForces]()
    for sign in (1, -1):
        own = [point for point in points if sign * point.speed_mm_s > 0 and point.force.value is not None]
        if own:
            force = np.array([(point.force.value or 0.0) - less_model * point.model_mN for point in own])
            half = NORMAL_95 * np.array([point.force.standard_error for point in own], dtype=float)
            speed = np.array([abs(point.speed_mm_s) for point in own])
            shown.append(SteadyForces("", BLACK, speed, force, half, hollow=sign < 0, joined=False))
    return shown


def _draw_boundaries(panels: Sequence[Axes], boundary: SpeedBoundary | None, printed_mm_s: float | None) -> None:
    if boundary is not None and boundary.speed_mm_s is not None:
        for axes in panels:
            if boundary.interval is not None:
                axes.axvspan(*boundary.interval, color=ORANGE, alpha=0.22, linewidth=0, zorder=1)
            axes.axvline(boundary.speed_mm_s, color=ORANGE, linewidth=2.0, zorder=2)
        words = f"estimated boundary\n{boundary.speed_mm_s:.3g} mm/s"
        if boundary.interval is not None:
            words += f" ({boundary.interval[0]:.3g} to {boundary.interval[1]:.3g})"
        _name_boundary(panels[0], boundary.speed_mm_s, words, 0.94, 0.3)
    if printed_mm_s is not None:
        for axes in panels:
            axes.axvline(printed_mm_s, color=GREY, linewidth=1.2, linestyle=(0, (2, 2)), zorder=2)
        _name_boundary(panels[0], printed_mm_s, f"the paper's boundary\n{printed_mm_s:g} mm/s", 0.06, 0.78)


def _name_boundary(axes: Axes, speed_mm_s: float, words: str, height: float, right_below: float) -> None:
    """Write words beside a vertical line: to its right below a share of the axis, to its left beyond."""
    low, high = np.log(axes.get_xlim())
    right = (np.log(speed_mm_s) - low) / (high - low) < right_below
    axes.annotate(
        words,
        xy=(speed_mm_s, height),
        xycoords=("data", "axes fraction"),
        xytext=(9 if right else -9, 0),
        textcoords="offset points",
        ha="left" if right else "right",
        va="center",
        fontsize=SMALL_PT,
        color=BLACK,
        zorder=6,
        bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
    )
