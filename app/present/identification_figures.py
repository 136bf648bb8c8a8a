"""Figures of an identification: joint fit, relaxation fits with strain laws, Coulomb test, steady drag."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dragrig.analysis import (
    ELEMENT_NAMES,
    NORMAL_95,
    CoulombRun,
    DragResult,
    DragSetup,
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
    estimate_noise,
    evaluate_strain_law,
    relaxation_residuals,
    steady_force_parts,
)
from dragrig.config import AnalysisError, Capsule, FrictionModelSettings
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
    LineStyle,
    PanelBox,
    add_panel,
    figure_style,
    fit_y_range,
    header_height_in,
    hide_time_labels,
    label_curves,
    new_figure,
    run_problem,
    set_log_x,
    set_y_label,
    shortened_to_width,
    text_width_in,
    value_with_error,
    write_badge,
    write_problem,
    write_title,
)
from dragrig.present.model_figures import TABLE1_DASHES, model_text
from dragrig.present.run_figures import (
    FOOT_IN,
    LEFT_IN,
    PHASE_NAMES_IN,
    RIGHT_IN,
    WIDTH_IN,
    TraceCurve,
    draw_panel_column,
    filtered_trace,
    force_panel,
    gaps_after_samples,
    min_max_envelope,
    steady_level,
    write_run_header,
)
from dragrig.rig import FloatArray, Run
from dragrig.sim_backend.friction import EQ14, TABLE1, TABLE1_STRAIN, SteadyFriction

JOINT_ROW_IN, JOINT_TIGHT_ROW_IN = 0.36, 0.23
JOINT_ROOMY_RUNS, JOINT_MAX_RUNS = 32, 60
JOINT_PANEL_IN, JOINT_RUNS_IN, JOINT_BETWEEN_IN, JOINT_RIGHT_IN, JOINT_NUMBERS_IN, JOINT_ABOVE_IN = (
    4.4,
    3.7,
    0.5,
    0.4,
    0.12,
    0.3,
)
JOINT_HEAD_IN, JOINT_FOOT_IN, JOINT_COMBINED_HEAD_IN, JOINT_TROUBLE_IN = 1.55, 0.8, 1.25, 0.3
JOINT_LONGEST_IN = 3.6
"""Room for a name or a file; longer ones are cut off."""
JOINT_MIN_SD, JOINT_MAX_SD = 3.0, 10.0
"""How far the axis of the parameters goes at least and at most."""
JOINT_MIN_PERCENT, JOINT_MAX_PERCENT = 2.0, 100.0
LOG_AXIS_CHI2 = 5.0
"""From here on the axis of the runs is logarithmic."""
CHI2_MARK_SD = 4.0
PRIOR_COLOUR = "#E3E7EC"


def joint_fit_figure(fit: JointFit) -> Figure:
    """Draw a joint fit.

    Left, each parameter with its 95 % interval, on a scale on which what was known before is the same for all; below,
    the intervals of what they combine to. Right, χ² per degree of freedom of each run, 1 where nothing but noise and
    repeatability is left; of more than 60 runs those with the largest.
    """
    runs = _largest_chi2_runs(fit.runs)
    sheet = _JointLayout.of(fit, runs)
    with figure_style():
        figure = new_figure(sheet.wide, sheet.tall)
        write_title(figure, JOINT_ABOVE_IN, f"Joint fit of the {fit.nominal} model", _joint_subtitle(fit, len(runs)))
        write_problem(figure, JOINT_ABOVE_IN, _joint_problem(fit))
        parameters, combined, left = sheet.places
        _draw_joint_parameters(add_panel(figure, parameters), fit)
        if fit.combinations:
            _draw_combinations(add_panel(figure, combined), fit)
        _draw_run_chi2(add_panel(figure, left), runs)
        return figure


@dataclass(frozen=True, slots=True)
class _JointLayout:
    """Size of the picture and where its panels stand [inch]."""

    wide: float
    tall: float
    places: tuple[PanelBox, PanelBox, PanelBox]

    @classmethod
    def of(cls, fit: JointFit, runs: Sequence[RunResidual]) -> "_JointLayout":
        """Make room for names, numbers and rows."""
        rows = [*fit.parameters, *fit.combinations]
        names = JOINT_ABOVE_IN + max(_name_width_in(one.name, TEXT_PT) for one in rows) + 0.15
        numbers = JOINT_NUMBERS_IN + max(text_width_in(_identified_text(one, fit), SMALL_PT) for one in rows)
        files = max(_name_width_in(one, SMALL_PT) for one in _run_names(runs)) + 0.15
        upper, lower = JOINT_ROW_IN * len(fit.parameters), JOINT_ROW_IN * len(fit.combinations)
        right = len(runs) * (JOINT_ROW_IN if len(runs) <= JOINT_ROOMY_RUNS else JOINT_TIGHT_ROW_IN)
        left = upper + (lower + JOINT_COMBINED_HEAD_IN if fit.combinations else 0.0)
        top = JOINT_FOOT_IN + max(left, right)
        runs_at = names + JOINT_PANEL_IN + numbers + JOINT_BETWEEN_IN + files
        places = (
            PanelBox(names, top - upper, JOINT_PANEL_IN, upper),
            PanelBox(names, top - left, JOINT_PANEL_IN, lower),
            PanelBox(runs_at, top - right, JOINT_RUNS_IN, right),
        )
        tall = top + JOINT_HEAD_IN + (JOINT_TROUBLE_IN if _joint_problem(fit) else 0.0)
        return cls(runs_at + JOINT_RUNS_IN + JOINT_RIGHT_IN, tall, places)


def _name_width_in(text: str, size_pt: float) -> float:
    return min(text_width_in(text, size_pt), JOINT_LONGEST_IN)


def _cut_middle(text: str, size_pt: float) -> str:
    """Leave out the middle of a long name: what tells runs apart stands at its ends."""
    wide = text_width_in(text, size_pt)
    if wide <= JOINT_LONGEST_IN:
        return text
    half = int(0.47 * len(text) * JOINT_LONGEST_IN / wide)
    return f"{text[:half]}…{text[-half:]}"


def _largest_chi2_runs(runs: Sequence[RunResidual]) -> list[RunResidual]:
    if len(runs) <= JOINT_MAX_RUNS:
        return list(runs)
    least = sorted((one.chi2 for one in runs), reverse=True)[JOINT_MAX_RUNS - 1]
    return [one for one in runs if one.chi2 >= least][:JOINT_MAX_RUNS]


def _joint_subtitle(fit: JointFit, shown: int) -> str:
    total = len({one.file for one in fit.runs})
    runs = f"{total} run{'' if total == 1 else 's'}"
    if shown < len(fit.runs):
        runs += f", the {shown} that are left worst shown"
    return f"χ² {_chi2_text(fit.chi2 / max(fit.degrees, 1))} per degree of freedom ({fit.degrees})  ·  {runs}"


def _joint_problem(fit: JointFit) -> str:
    if not fit.converged:
        return "did not converge: no interval holds"
    return "the model leaves more than noise: the intervals need not hold" if not fit.holds else ""


def _chi2_text(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


def _identified_text(one: ParameterEstimate, fit: JointFit) -> str:
    """Spell a value: none that the runs do not determine, no error of a fit that did not converge."""
    if not one.determined:
        return "not determined"
    error = one.standard_error if fit.converged else None
    return value_with_error(one.value, error) + ("" if one.unit == "1" else f" {one.unit}")


def _run_names(runs: Sequence[RunResidual]) -> list[str]:
    several = len({one.channel for one in runs}) > 1
    return [f"{one.file} {one.channel}" if several else one.file for one in runs]


def _draw_joint_parameters(axes: Axes, fit: JointFit) -> None:
    places = [_in_prior_sd(one) for one in fit.parameters]
    reach = _axis_reach(places, JOINT_MIN_SD, JOINT_MAX_SD)
    axes.axvspan(-NORMAL_95, NORMAL_95, color=PRIOR_COLOUR, linewidth=0)
    axes.axvline(0.0, color=PALE, linewidth=1.0)
    _draw_intervals(axes, fit, fit.parameters, places, reach, BLUE)
    axes.set_xlabel("Standard deviations from what was known before")
    axes.set_title("95 % intervals, before (grey) and after the runs", loc="left", fontsize=TEXT_PT)


def _in_prior_sd(one: ParameterEstimate) -> tuple[float, float, float]:
    """Return low end, value and high end in standard deviations of the prior, logarithmically where it is positive."""
    ends = np.array([*one.prior, one.interval[0], one.value, one.interval[1]])
    known = np.log(ends) if (ends > 0).all() else ends
    middle, half = (known[0] + known[1]) / 2, (known[1] - known[0]) / 2
    low, value, high = (NORMAL_95 * (known[2:] - middle) / half).tolist() if half > 0 else (0.0, 0.0, 0.0)
    return low, value, high


def _draw_combinations(axes: Axes, fit: JointFit) -> None:
    places = [
        (_percent_from_value(one, one.interval[0]), 0.0, _percent_from_value(one, one.interval[1]))
        for one in fit.combinations
    ]
    reach = _axis_reach([place for place, one in zip(places, fit.combinations, strict=True) if one.determined],
                   JOINT_MIN_PERCENT, JOINT_MAX_PERCENT)  # fmt: skip
    axes.axvline(0.0, color=PALE, linewidth=1.0)
    _draw_intervals(axes, fit, fit.combinations, places, reach, PURPLE)
    axes.set_xlabel("Difference from the value (%)")
    axes.set_title("95 % intervals of what they combine to", loc="left", fontsize=TEXT_PT)


def _percent_from_value(one: EstimatedQuantity, end: float) -> float:
    return 100 * (end - one.value) / (abs(one.value) or 1.0)


def _axis_reach(places: Sequence[tuple[float, float, float]], least: float, most: float) -> float:
    return min(max([least, *(1.08 * abs(end) for ends in places for end in ends)]), most)


def _draw_intervals(
    axes: Axes,
    fit: JointFit,
    rows: Sequence[ParameterEstimate],
    places: Sequence[tuple[float, float, float]],
    reach: float,
    colour: str,
) -> None:
    """Draw what is determined, name the rows at the left, and write their numbers at the right."""
    for row, (one, (low, value, high)) in enumerate(zip(rows, places, strict=True)):
        if one.determined:
            _draw_interval(axes, row, (low, value, high) if fit.converged else (value, value, value), reach, colour)
    axes.set_yticks(range(len(rows)), [_cut_middle(one.name, TEXT_PT) for one in rows], fontsize=TEXT_PT)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlim(-reach, reach)
    axes.grid(visible=False, axis="y")
    x = 1 + JOINT_NUMBERS_IN / JOINT_PANEL_IN
    for row, one in enumerate(rows):
        words, colour = _identified_text(one, fit), BLACK if one.determined else GREY
        place = axes.get_yaxis_transform()
        axes.text(x, row, words, transform=place, va="center_baseline", fontsize=SMALL_PT, color=colour)


def _draw_interval(axes: Axes, row: int, ends: tuple[float, float, float], reach: float, colour: str) -> None:
    """Draw value and interval; an arrow points to what lies beyond the axis."""
    low, value, high = (min(max(end, -reach), reach) for end in ends)
    axes.plot([low, high], [row, row], color=colour, linewidth=3.0, solid_capstyle="butt")
    for end, edge, marker in ((ends[0], -reach, "<"), (ends[2], reach, ">")):
        if abs(end) > reach and np.sign(end) == np.sign(edge):
            axes.plot(edge, row, marker, color=colour, markersize=9, clip_on=False)
    if abs(ends[1]) <= reach:
        axes.plot(value, row, "o", color=colour, markersize=7, markeredgecolor="white")


def _draw_run_chi2(axes: Axes, runs: Sequence[RunResidual]) -> None:
    most = max(one.chi2 for one in runs)
    if most > LOG_AXIS_CHI2:
        set_log_x(axes, 0.3, 1.3 * most)
    else:
        axes.set_xlim(0.0, max(2.0, 1.08 * most))
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5))
    for row, one in enumerate(runs):
        error = float(np.sqrt(2 / max(one.blocks, 1)))
        low, high = max(1 - NORMAL_95 * error, 0.0), 1 + NORMAL_95 * error
        colour = VERMILLION if one.chi2 > 1 + CHI2_MARK_SD * error else BLACK
        axes.barh(row, high - low, left=low, height=0.5, color=PRIOR_COLOUR, linewidth=0)
        axes.plot(max(one.chi2, axes.get_xlim()[0]), row, "o", color=colour, markersize=6.5, clip_on=False)
    axes.axvline(1.0, color=GREY, linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set_yticks(range(len(runs)), [_cut_middle(one, SMALL_PT) for one in _run_names(runs)], fontsize=SMALL_PT)
    axes.set_ylim(len(runs) - 0.5, -0.5)
    axes.set_xlabel("χ² per degree of freedom")
    axes.set_title("What each run leaves (grey: noise)", loc="left", fontsize=TEXT_PT)
    axes.grid(visible=False, axis="y")


ELEMENT_TITLES = ("E₁ (kPa)", "E₂ (kPa)", "E₃ (kPa)", "η₁ (kPa·s)", "η₂ (kPa·s)")
LAWS_GAP_IN = 0.72


def draw_strain_laws(figure: Figure, place: PanelBox, fits: Sequence[RelaxationFit], laws: Sequence[StrainLaw]) -> None:
    """Draw the five elements side by side within a place."""
    width = (place.width - (len(ELEMENT_NAMES) - 1) * LAWS_GAP_IN) / len(ELEMENT_NAMES)
    usable = [fit for fit in fits if fit.elements]
    strain = np.array([fit.shear_strain for fit in usable])
    furthest = max([TABLE1_STRAIN[-1], *strain.tolist()])
    for index, name in enumerate(ELEMENT_NAMES):
        cell = PanelBox(place.left + index * (width + LAWS_GAP_IN), place.bottom, width, place.height)
        axes = add_panel(figure, cell)
        shown = [*_draw_published_walls(axes, index), np.zeros(1)]
        shown += [_draw_strain_law(axes, law) for law in laws if law.element == name]
        points = [fit.elements[index] for fit in usable]
        if points:
            value = np.array([one.value for one in points])
            ends = np.abs(np.array([one.interval for one in points]).T - value)
            axes.errorbar(
                100 * strain, value, ends, fmt="s", color=VERMILLION, markersize=7, markeredgecolor="white", capsize=4
            )
            shown.append(value + ends[1])
        fit_y_range(axes, shown, 0.01, 0.0)
        axes.set_xlim(0, 110 * furthest)
        axes.set_xlabel("Strain (%)")
        axes.set_title(ELEMENT_TITLES[index], loc="left", fontsize=TEXT_PT)
    _draw_laws_legend(figure, place, bool(usable), bool(laws))


def _draw_published_walls(axes: Axes, index: int) -> list[FloatArray]:
    strain = np.linspace(TABLE1_STRAIN[0], TABLE1_STRAIN[-1], 100)
    eq14, table1 = np.polyval(EQ14[index], strain), np.array(TABLE1[index])
    axes.plot(100 * strain, eq14, color=BLUE, linestyle=TABLE1_DASHES, linewidth=1.8)
    axes.plot(100 * np.array(TABLE1_STRAIN), table1, "o", color=BLACK, markersize=6.5, markerfacecolor="white")
    return [eq14, table1]


def _draw_strain_law(axes: Axes, law: StrainLaw) -> FloatArray:
    strain = np.linspace(min(law.strains), max(law.strains), 100)
    value, error = evaluate_strain_law(law, strain)
    axes.fill_between(
        100 * strain, value - 1.96 * error, value + 1.96 * error, color=VERMILLION, alpha=0.18, linewidth=0
    )
    axes.plot(100 * strain, value, color=VERMILLION)
    return np.concatenate((value - 1.96 * error, value + 1.96 * error))


def _draw_laws_legend(figure: Figure, place: PanelBox, identified: bool, laws: bool) -> None:
    """Name points and lines in one row above the panels."""
    key = add_panel(figure, PanelBox(place.left, place.bottom + place.height + 0.42, place.width, 0.3))
    key.set_axis_off()
    key.set_xlim(0, place.width)
    key.set_ylim(0, 1)
    x = 0.0
    rows = [("Table 1", BLACK, "o", "none", 1.15), ("Eq. 14, as printed", BLUE, "", TABLE1_DASHES, 2.1)]
    if identified:
        rows.append(("this specimen, each run", VERMILLION, "s", "none", 2.6))
    if laws:
        rows.append(("its law over strain, 95 % band", VERMILLION, "", "-", 3.2))
    for text, colour, marker, dashes, room in rows:
        face = "white" if marker == "o" else colour
        key.plot([x, x + 0.3] if not marker else [x + 0.15], [0.5] * (1 if marker else 2), marker=marker,
                 color=colour, markerfacecolor=face, markersize=7, linestyle=dashes)  # fmt: skip
        key.text(x + 0.42, 0.5, text, va="center", fontsize=SMALL_PT, color=colour)
        x += room + 0.35


RELAXATION_FIT_MAX_COLUMNS = 4
RELAXATION_FIT_LEFT_IN, RELAXATION_FIT_RIGHT_IN, RELAXATION_FIT_WIDTH_IN, RELAXATION_FIT_BETWEEN_IN = (
    1.15,
    0.45,
    15.0,
    0.3,
)
RELAXATION_FIT_LAWS_IN, RELAXATION_FIT_LAWS_FOOT_IN = 2.5, 0.85
RELAXATION_FIT_RESIDUAL_IN, RELAXATION_FIT_FORCE_IN, RELAXATION_FIT_HEAD_IN = 1.6, 2.9, 1.55
MIN_RESIDUAL_RANGE = 4.0
RELAXATION_FIT_RUNS_FOOT_IN = RELAXATION_FIT_LAWS_FOOT_IN + RELAXATION_FIT_LAWS_IN + 1.75


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
    experiments = {one.file: one for one in selection.of_kind("relaxation")}
    noise = estimate_noise(experiments.values(), "force")
    with figure_style():
        figure = new_figure(
            RELAXATION_FIT_WIDTH_IN,
            RELAXATION_FIT_RUNS_FOOT_IN
            + RELAXATION_FIT_RESIDUAL_IN
            + 0.15
            + RELAXATION_FIT_FORCE_IN
            + RELAXATION_FIT_HEAD_IN,
        )
        write_title(
            figure,
            RELAXATION_FIT_LEFT_IN,
            f"Five elements from relaxation · {selection.specimen}",
            _relaxation_fit_subtitle(relaxation),
        )
        width = (
            RELAXATION_FIT_WIDTH_IN
            - RELAXATION_FIT_LEFT_IN
            - RELAXATION_FIT_RIGHT_IN
            - (RELAXATION_FIT_MAX_COLUMNS - 1) * RELAXATION_FIT_BETWEEN_IN
        ) / RELAXATION_FIT_MAX_COLUMNS
        forces: list[Axes] = []
        left_overs: list[Axes] = []
        drawn: list[RelaxationResiduals] = []
        for column, fit in enumerate(chosen):
            left = RELAXATION_FIT_LEFT_IN + column * (width + RELAXATION_FIT_BETWEEN_IN)
            above = PanelBox(
                left, RELAXATION_FIT_RUNS_FOOT_IN + RELAXATION_FIT_RESIDUAL_IN + 0.15, width, RELAXATION_FIT_FORCE_IN
            )
            forces.append(add_panel(figure, above, share_y=forces[0] if forces else None))
            below = PanelBox(left, RELAXATION_FIT_RUNS_FOOT_IN, width, RELAXATION_FIT_RESIDUAL_IN)
            left_overs.append(add_panel(figure, below, forces[-1], left_overs[0] if left_overs else None))
            found = relaxation_residuals(fit, experiments[fit.file], noise) if fit.elements else None
            drawn += [found] if found else []
            _draw_relaxation_fit(forces[-1], left_overs[-1], fit, experiments[fit.file], found)
        for axes in (*forces[1:], *left_overs[1:]):
            axes.tick_params(labelleft=False)
        set_y_label(forces[0], "Force (mN)")
        set_y_label(left_overs[0], "Residual (σ)")
        _share_ranges(forces, left_overs[0], drawn)
        if not drawn:
            left_overs[0].set_yticks([])
        laws = PanelBox(
            RELAXATION_FIT_LEFT_IN,
            RELAXATION_FIT_LAWS_FOOT_IN,
            RELAXATION_FIT_WIDTH_IN - RELAXATION_FIT_LEFT_IN - RELAXATION_FIT_RIGHT_IN,
            RELAXATION_FIT_LAWS_IN,
        )
        draw_strain_laws(figure, laws, relaxation.fits, relaxation.laws)
        return figure


def _fits_to_draw(relaxation: RelaxationResult) -> list[RelaxationFit]:
    """Return the fits to draw, one for each strain where there are enough, spread over the strains."""
    rising = sorted(relaxation.fits, key=lambda fit: (not fit.elements, fit.shear_strain))
    by_strain = {round(fit.shear_strain, 2): fit for fit in reversed(rising)}
    fits = sorted(by_strain.values(), key=lambda fit: fit.shear_strain)
    if len(fits) > RELAXATION_FIT_MAX_COLUMNS:
        fits = [fits[round(place)] for place in np.linspace(0, len(fits) - 1, RELAXATION_FIT_MAX_COLUMNS)]
    return fits


def _relaxation_fit_subtitle(relaxation: RelaxationResult) -> str:
    identified = sum(bool(fit.elements) for fit in relaxation.fits)
    total = len(relaxation.fits)
    runs = f"{total} run{'' if total == 1 else 's'}"
    told = runs if identified == total else f"{identified} of {runs} identified"
    if not identified:
        return f"{told}  ·  grey: measured"
    return f"{told}  ·  grey: measured  ·  orange: spring and two Maxwell branches, driven through the measured ramp"


def _draw_relaxation_fit(
    force: Axes, left_over: Axes, fit: RelaxationFit, experiment: Experiment, found: RelaxationResiduals | None
) -> None:
    begin = found.ramp_s[0] if found else _first_motion_s(experiment)
    _draw_measured_force(force, experiment, begin)
    title = f"{100 * fit.shear_strain:g} % strain"
    force.set_title(title, loc="left", fontsize=TEXT_PT, fontweight="bold", color=BLACK)
    force.tick_params(labelbottom=False)
    left_over.set_xlabel("Time since the ramp began (s)")
    if found is None:
        words = textwrap.fill(f"no numbers: {fit.remark}", 34)
        left_over.grid(visible=False)
        left_over.text(0.5, 0.5, words, transform=left_over.transAxes, ha="center", va="center", fontsize=SMALL_PT)
        return
    force.plot(found.time_s - begin, found.predicted_mN, color=VERMILLION, linewidth=1.8)
    force.text(
        0.97, 0.98, _time_constants_text(fit), transform=force.transAxes, ha="right", va="top", fontsize=SMALL_PT
    )
    shown = found.middle_s > begin
    left_over.axhspan(-2, 2, color=PALE, alpha=0.35, linewidth=0, zorder=0)
    left_over.plot(found.middle_s[shown] - begin, found.whitened[shown], ".", color=BLACK, markersize=4)
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


def _share_ranges(forces: Sequence[Axes], left_over: Axes, found: Sequence[RelaxationResiduals]) -> None:
    """Give all columns one range, with room for words along the upper edges."""
    low = min(axes.dataLim.ymin for axes in forces)
    high = max(axes.dataLim.ymax for axes in forces)
    forces[0].set_ylim(low - 0.04 * (high - low), high + 0.16 * (high - low))
    largest = max((float(np.abs(one.whitened).max()) for one in found), default=0.0)
    furthest = max(MIN_RESIDUAL_RANGE, 1.05 * largest)
    left_over.set_ylim(-furthest, 1.45 * furthest)


def _first_motion_s(experiment: Experiment) -> float:
    moving = np.flatnonzero(experiment.motion.signs)
    return float(experiment.motion.breaks_s[moving[0]]) if moving.size else 0.0


def _time_constants_text(fit: RelaxationFit) -> str:
    fast, slow = (f"{1e3 * one.value:.3g} ms" if one.value < 0.1 else f"{one.value:.3g} s" for one in fit.times)
    return f"τ₁ {fast}\nτ₂ {slow}"


def _fit_quality_text(fit: RelaxationFit) -> str:
    per_degree = (fit.chi2 or 0.0) / max(fit.degrees, 1)
    told = f"χ²/ν {per_degree:.3g}" if per_degree < 1000 else f"χ²/ν {per_degree:.0f}"
    if fit.test is None or fit.test.suffices is None:
        return told
    return f"{told} · five suffice" if fit.test.suffices else f"{told} · a third branch shows"


COULOMB_FORCE_IN = 4.4


def coulomb_figure(run: Run, found: CoulombRun | None, printed_mN: float | None = None) -> Figure:
    """Draw the force of a Coulomb test.

    Parameters
    ----------
    found
        What was identified from it, for the sensor's zero; without it the force is drawn as recorded.
    printed_mN
        A mean to compare with, drawn as a line.
    """
    shown = _without_zero(run, found)
    gap = gaps_after_samples(shown.trace.time, shown.trace.sample_rate_hz)
    level = steady_level(shown)
    if level is not None and found is not None and found.force.value is not None:
        level = replace(
            level, text=f"mean {value_with_error(found.force.value, found.force.standard_error)} mN{_mu_text(found)}"
        )
    panel = force_panel(shown, filtered_trace(shown), gap, steady=level)
    if printed_mN is not None:
        ends, printed = shown.trace.time[[0, -1]], np.full(2, printed_mN)
        pen = LineStyle(f"the paper’s mean {printed_mN:g} mN", VERMILLION, 1.2, dashed=True)
        panel = replace(panel, curves=(*panel.curves, TraceCurve(ends, printed, np.zeros(1, dtype=np.bool_), pen)))
    trouble = run_problem(run.info)
    with figure_style():
        figure = new_figure(WIDTH_IN, header_height_in(trouble) + PHASE_NAMES_IN + COULOMB_FORCE_IN + FOOT_IN)
        write_run_header(figure, LEFT_IN, run.info, trouble)
        draw_panel_column(
            figure, shown, [panel], [COULOMB_FORCE_IN], PanelBox(LEFT_IN, FOOT_IN, WIDTH_IN - LEFT_IN - RIGHT_IN, 0.0)
        )
        return figure


def _mu_text(found: CoulombRun) -> str:
    return "" if found.mu.value is None else f", μ = {value_with_error(found.mu.value, found.mu.standard_error)}"


def _without_zero(run: Run, found: CoulombRun | None) -> Run:
    level = steady_level(run)
    if found is None or found.force.value is None or level is None:
        return run
    zero = level.force_mN - float(np.copysign(found.force.value, found.speed_mm_s))
    channels = {**run.trace.channels, run.trace.signal: np.asarray(run.trace.force, dtype=np.float64) - zero}
    return replace(run, trace=replace(run.trace, channels=channels), filtered=None)


DRAG_WIDTH_IN, DRAG_LEFT_IN, DRAG_FOOT_IN, DRAG_WIDE_IN = 12.4, 1.15, 0.85, 9.0
DRAG_FORCE_IN, DRAG_LEFT_OVER_IN, DRAG_BETWEEN_IN = 4.9, 2.2, 0.2
DRAG_MARGIN = 1.25
"""How far the speed axis goes beyond the measured speeds, as a factor."""
DRAG_PART_TINTS = (("f_c", "$f_c$  Coulomb", VERMILLION, "#F8E0D3"), ("f_e", "$f_e$  environmental", BLUE, "#D8E8F3"),
         ("f_v", "$f_v$  viscous", GREEN, "#CDEBE0"))  # fmt: skip
"""The model's parts from below: name, words, colour of the words and of the area."""
DRAG_MIN_NAME_SPACE = 0.12
"""Room above the highest force, as a share of it."""


def drag_figure(
    drag: DragResult,
    model: FrictionModelSettings,
    capsule: Capsule,
    wall_thickness_mm: float,
    boundary_mm_s: float | None = None,
    accuracy_mN: float | None = None,
    backend: str = "",
    simulated: FrictionModelSettings | None = None,
) -> Figure:
    """Draw the measured drag with its 95 % intervals over the model's parts, and the law of ln v; below, what differs.

    An estimated boundary is marked with its interval. Backward speeds are drawn hollow.

    Parameters
    ----------
    boundary_mm_s
        A speed to mark besides, the paper's.
    accuracy_mN
        The sensor's accuracy, drawn as a band around no difference.
    backend
        Where the runs come from, said in the corner.
    simulated
        The model that the runs were simulated with, drawn as a line beside the one that was identified.
    """
    points = [one for one in drag.points if one.force.value is not None]
    speeds = [abs(one.speed_mm_s) for one in points] or [0.5, 60.0]
    low, high = min(speeds) / DRAG_MARGIN, max(speeds) * DRAG_MARGIN
    speed = np.geomspace(low, high, 400)
    curve = steady_force_parts(DragSetup(capsule, wall_thickness_mm), model, speed)
    with figure_style():
        figure = new_figure(DRAG_WIDTH_IN, DRAG_FOOT_IN + DRAG_LEFT_OVER_IN + DRAG_BETWEEN_IN + DRAG_FORCE_IN + 1.15)
        room = DRAG_WIDTH_IN - DRAG_LEFT_IN - 0.3
        told = shortened_to_width(model_text(model, room), SMALL_PT, room)
        write_title(figure, DRAG_LEFT_IN, "Drag against speed, measured and by the model", told)
        if backend:
            write_badge(figure, backend)
        below = add_panel(figure, PanelBox(DRAG_LEFT_IN, DRAG_FOOT_IN, DRAG_WIDE_IN, DRAG_LEFT_OVER_IN))
        above = add_panel(
            figure,
            PanelBox(DRAG_LEFT_IN, DRAG_FOOT_IN + DRAG_LEFT_OVER_IN + DRAG_BETWEEN_IN, DRAG_WIDE_IN, DRAG_FORCE_IN),
            below,
        )
        labels = _draw_model_parts(above, speed, curve)
        if drag.log_law is not None:
            law = drag.log_law.force_mN(speed)
            above.plot(speed, law, color=PURPLE, linewidth=1.8, linestyle=(0, (5, 3)))
            below.plot(speed, law - curve.total, color=PURPLE, linewidth=1.8, linestyle=(0, (5, 3)))
            labels.append(CurveLabel(float(law[-1]), "law of ln v", PURPLE))
        if simulated is not None:
            truth = steady_force_parts(DragSetup(capsule, wall_thickness_mm), simulated, speed).total
            above.plot(speed, truth, color=GREY, linewidth=1.6, linestyle=(0, (2, 2)))
            below.plot(speed, truth - curve.total, color=GREY, linewidth=1.6, linestyle=(0, (2, 2)))
            labels.append(CurveLabel(float(truth[-1]), "as simulated", GREY))
        _draw_drag_points(above, points, [0.0] * len(points))
        _draw_drag_points(below, points, [one.model_mN for one in points])
        if points:
            nearest = max(points, key=lambda one: abs(one.speed_mm_s))
            labels.append(CurveLabel(float(nearest.force.value or 0.0), "measured", BLACK))
        _finish_drag_axes(above, below, (low, high), accuracy_mN)
        _draw_boundaries(above, below, drag.boundary, boundary_mm_s)
        label_curves(above, labels)
        return figure


def _draw_model_parts(axes: Axes, speed: FloatArray, curve: SteadyFriction) -> list[CurveLabel]:
    """Fill the areas of the model's parts on one another under the line of their sum, and say where to name them."""
    foot, labels = np.zeros_like(speed), list[CurveLabel]()
    for name, words, colour, tint in DRAG_PART_TINTS:
        top = foot + getattr(curve, name)
        axes.fill_between(speed, foot, top, color=tint, linewidth=0, zorder=0.5)
        labels.append(CurveLabel(float(foot[-1] + top[-1]) / 2, words, colour, math=True))
        foot = top
    axes.plot(speed, curve.total, color=BLACK, linewidth=2.6)
    labels.append(CurveLabel(float(curve.total[-1]), "model", BLACK))
    return labels


def _draw_drag_points(axes: Axes, points: Sequence[SpeedPoint], taken_off: Sequence[float]) -> None:
    for one, less in zip(points, taken_off, strict=True):
        speed, value, interval = abs(one.speed_mm_s), (one.force.value or 0.0) - less, one.force.interval
        if interval is not None:
            axes.plot([speed] * 2, [interval[0] - less, interval[1] - less], color=BLACK, linewidth=2.0, zorder=4)
        fill = BLACK if one.speed_mm_s > 0 else "white"
        axes.plot([speed], [value], "o", color=BLACK, markerfacecolor=fill, markersize=7, zorder=5)


def _finish_drag_axes(above: Axes, below: Axes, speeds: tuple[float, float], accuracy_mN: float | None) -> None:
    set_log_x(below, *speeds)
    hide_time_labels(above)
    above.set_ylim(0, (1 + DRAG_MIN_NAME_SPACE) * above.dataLim.y1)
    if accuracy_mN is not None:
        below.axhspan(-accuracy_mN, accuracy_mN, color="#E8EBEE", linewidth=0, zorder=0)
    below.axhline(0.0, color=BLACK, linewidth=1.2)
    most = max(abs(one) for one in below.get_ylim())
    below.set_ylim(-most, most)
    if accuracy_mN is not None:
        label_curves(below, [CurveLabel(0.0, f"± {accuracy_mN:g} mN,\nsensor accuracy", GREY)], SMALL_PT)
    below.set_xlabel("Speed (mm/s)")
    set_y_label(above, "Force (mN)")
    set_y_label(below, "Measured − model (mN)")


def _draw_boundaries(above: Axes, below: Axes, found: SpeedBoundary | None, printed_mm_s: float | None) -> None:
    if found is not None and found.speed_mm_s is not None:
        for axes in (above, below):
            if found.interval is not None:
                axes.axvspan(*found.interval, color=ORANGE, alpha=0.22, linewidth=0, zorder=1)
            axes.axvline(found.speed_mm_s, color=ORANGE, linewidth=2.0, zorder=2)
        words = f"estimated boundary\n{found.speed_mm_s:.3g} mm/s"
        if found.interval is not None:
            words += f" ({found.interval[0]:.3g} to {found.interval[1]:.3g})"
        _name_boundary(above, found.speed_mm_s, words, 0.94, 0.3)
    if printed_mm_s is not None:
        for axes in (above, below):
            axes.axvline(printed_mm_s, color=GREY, linewidth=1.2, linestyle=(0, (2, 2)), zorder=2)
        _name_boundary(above, printed_mm_s, f"the paper's boundary\n{printed_mm_s:g} mm/s", 0.06, 0.78)


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
