"""Figures of the friction model: forces against speed, skew resistance, wall parameters (the paper's Figs. 9 and 7)."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis import EstimatedQuantity
from dragrig.analysis.paper import SKEW_SPEEDS_MM_S, WALL_UNITS
from dragrig.config import Capsule, FrictionModelSettings
from dragrig.present import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    SMALL_PT,
    TEXT_PT,
    VERMILLION,
    CurveLabel,
    figure_style,
    fit_y_range,
    label_curves,
    layout_of,
    new_figure,
    percent_difference,
    sequential_colours,
    set_log_x,
)
from dragrig.rig import FloatArray
from dragrig.sim_backend.friction import (
    ParameterSetDifference,
    WallKind,
    parameter_set_differences,
    skew_resistance,
    steady_forces,
    wall_parameters,
)

MIN_SPEED_MM_S, MAX_SPEED_MM_S = 0.5, 100.0
"""Range of the speed axis, extended to any speed beyond it."""
MAX_CURVES = 7
MAX_SCALES = 3


def forces_figure(
    model: FrictionModelSettings,
    capsule: Capsule,
    wall_thickness_mm: float,
    speeds_mm_s: Sequence[float] = (),
) -> Figure:
    """Draw f_e, f_v, f_c and their sum against speed (the paper's Fig. 9), with dots at `speeds_mm_s`.

    Raises
    ------
    SettingsError
        For a speed that is not positive.
    """
    dots = steady_forces(np.asarray(speeds_mm_s, dtype=float), model, capsule, wall_thickness_mm)
    low, high = min([MIN_SPEED_MM_S, *speeds_mm_s]), max([MAX_SPEED_MM_S, *speeds_mm_s])
    speed = np.geomspace(low, high, 600)
    line = steady_forces(speed, model, capsule, wall_thickness_mm)
    with figure_style():
        figure = new_figure(12.0, 6.6, "Friction against speed", model_text(model), narrow=True)
        axes = figure.add_subplot()
        labels = []
        for text, values, at_dots, colour, width in (
            ("total", line.total, dots.total, BLACK, 3.4),
            ("$f_c$  Coulomb", line.f_c, dots.f_c, VERMILLION, 2.4),
            ("$f_e$  environmental", line.f_e, dots.f_e, BLUE, 2.4),
            ("$f_v$  viscous", line.f_v, dots.f_v, GREEN, 2.4),
        ):
            axes.plot(speed, values, color=colour, linewidth=width)
            axes.plot(dots.speed_mm_s, at_dots, "o", color=colour, markersize=8, markeredgecolor="white", clip_on=False)
            labels.append(CurveLabel(float(values[-1]), text, colour, math=True))
        axes.set_ylim(0, 1.06 * float(line.total.max()))
        set_log_x(axes, low, high)
        axes.set_xlabel("Speed (mm/s)")
        axes.set_ylabel("Force (mN)")
        label_curves(axes, labels)
        return figure


def skew_figure(
    model: FrictionModelSettings,
    capsule: Capsule,
    wall_thickness_mm: float,
    speeds_mm_s: Sequence[float] = SKEW_SPEEDS_MM_S,
) -> Figure:
    """Draw the skew resistance P(x) S along the capsule at several speeds (the paper's Fig. 7).

    The hemisphere and the side of the capsule have scales of their own; a dot marks each curve's
    largest value. Of more than seven speeds, seven are drawn.

    Raises
    ------
    SettingsError
        For a speed that is not positive.
    """
    speeds = spread_selection(speeds_mm_s)
    steady = steady_forces(np.asarray(speeds), model, capsule, wall_thickness_mm)
    equator = (
        0.5
        * capsule.diameter_mm
        * float(np.sin(np.radians(capsule.contact_angle_deg + model.contact_angle_offset_deg)))
    )
    end = equator + model.side_contact_mm
    front = np.linspace(0.0, equator, 800)
    side = np.array([equator, end - 1e-6, end + 1e-6, end + 3.0])
    with figure_style():
        figure = new_figure(12.0, 6.6, "Skew resistance along the capsule", model_text(model))
        layout_of(figure).set(w_pad=0.0, wspace=0.0)
        left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.9, 1.0))
        labels = []
        for speed, top, at, colour in zip(
            speeds, steady.max_skew, steady.x_of_max_skew, sequential_colours(len(speeds)), strict=True
        ):
            beside = skew_resistance(side, speed, model, capsule, wall_thickness_mm)
            left.plot(front, skew_resistance(front, speed, model, capsule, wall_thickness_mm), color=colour)
            left.plot([at], [top], "o", color=colour, markersize=8, markeredgecolor="white")
            right.plot(side, beside, color=colour)
            labels.append(CurveLabel(float(beside[0]), f"{speed:g} mm/s", colour))
        left.set_ylim(0, 1.08 * float(steady.max_skew.max()))
        _label_skew_axes(left, right, equator, float(side[-1]))
        label_curves(right, labels)
        return figure


def model_text(model: FrictionModelSettings) -> str:
    """Describe a model on a line: its choices, and up to three scales that are not 1, or their number."""
    wall = {"eq14": "Eq. 14", "table1": "Table 1", "polynomial": "polynomials"}[model.wall]
    scales = [
        f"{name.removesuffix('_scale').replace('_', ' ')} × {value:.3g}"
        for name, value in model
        if name.endswith("_scale") and value != 1
    ]
    friction = f"μ = {model.friction_coefficient:.3g}"
    choices = (f"model {model.name}", f"wall {wall}", f"viscous {model.viscous}", friction)
    return "  ·  ".join(
        (*choices, *(scales if len(scales) <= MAX_SCALES else [f"{len(scales)} scales that are not 1"]))
    )


def spread_selection(speeds_mm_s: Sequence[float]) -> tuple[float, ...]:
    """Return the distinct speeds, rising; of more than seven, seven spread over all."""
    speeds = sorted(set(speeds_mm_s))
    if len(speeds) <= MAX_CURVES:
        return tuple(speeds)
    chosen: FloatArray = np.linspace(0, len(speeds) - 1, MAX_CURVES)
    return tuple(speeds[round(place)] for place in chosen)


def _label_skew_axes(left: Axes, right: Axes, equator_mm: float, end_mm: float) -> None:
    left.set_xlim(0, equator_mm)
    right.set_xlim(equator_mm, end_mm)
    right.tick_params(left=False)
    right.spines["left"].set_color(GREY)
    right.spines["left"].set_linestyle((0, (3, 2)))
    right.set_facecolor("#F5F6F7")
    left.set_ylabel("Skew resistance P(x) S (mN)")
    left.set_xlabel("x on the hemisphere (mm)")
    right.set_xlabel("x beside the capsule (mm)")
    left.text(0.985, 0.03, "equator", transform=left.transAxes, ha="right", fontsize=SMALL_PT, color=GREY)


_WALL_SYMBOLS = {"E1": "$E_1$", "E2": "$E_2$", "E3": "$E_3$", "eta1": r"$\eta_1$", "eta2": r"$\eta_2$"}

TABLE1_DASHES = (0, (4, 2))
WALL_CURVES: tuple[WallKind, WallKind] = ("eq14", "table1")


def wall_figure(identified: Mapping[str, Sequence[tuple[float, EstimatedQuantity]]] | None = None) -> Figure:
    """Draw each wall parameter against strain: Table 1, Eq. 14, and the quadratic through Table 1.

    Parameters
    ----------
    identified
        Results of relaxations by parameter: strain and value, drawn with its interval.
    """
    entries, estimates = parameter_set_differences(), identified or {}
    with figure_style():
        figure = new_figure(
            12.0,
            7.2,
            "Wall parameters: Eq. 14 does not follow Table 1",
            "of the five-element wall; in each panel the largest differences from Table 1",
        )
        *panels, key = figure.subplots(2, 3).flat
        for axes, name in zip(panels, WALL_UNITS, strict=True):
            _draw_wall_parameter(
                axes, name, [entry for entry in entries if entry.parameter == name], estimates.get(name, ())
            )
        handles, words = panels[0].get_legend_handles_labels()
        key.legend(handles, words, loc="center left", labelcolor="linecolor", fontsize=TEXT_PT, labelspacing=1.2)
        key.set_title("Table 1 prints η in kPa; it is kPa·s.", fontsize=SMALL_PT, color=GREY)
        key.set_axis_off()
        return figure


def _draw_wall_parameter(
    axes: Axes, name: str, entries: list[ParameterSetDifference], identified: Sequence[tuple[float, EstimatedQuantity]]
) -> None:
    strain = np.linspace(0.0, 2.2, 200)
    printed, fitted_curve = (
        np.asarray(getattr(wall_parameters(kind, strain), name), dtype=np.float64) for kind in WALL_CURVES
    )
    points = np.array([entry.table1 for entry in entries])
    at = [100 * entry.strain for entry in entries]
    axes.plot(at, points, "o", color=BLACK, markersize=8, markeredgecolor="white", label="Table 1")
    axes.plot(100 * strain, printed, color=BLUE, label="Eq. 14, as printed")
    fit = "least-squares fit\nof a quadratic"
    axes.plot(100 * strain, fitted_curve, color=VERMILLION, linestyle=TABLE1_DASHES, label=fit)
    for number, (strain_of, estimate) in enumerate(identified):
        axes.plot([100 * strain_of] * 2, estimate.interval, color=GREEN, linewidth=1.8)
        label = "" if number else "identified,\nsimulated runs"
        axes.plot(
            [100 * strain_of], [estimate.value], "D", color=GREEN, markersize=7, markeredgecolor="white", label=label
        )
    ends = [np.array(estimate.interval) for _, estimate in identified]
    fit_y_range(axes, [np.zeros(1), points, printed, fitted_curve, *ends], 0.01, 0.0)
    axes.set_xlim(0, 220)
    axes.set_xticks([0, 50, 100, 150, 200])
    axes.set_xlabel("Strain (%)")
    axes.set_ylabel(f"{_WALL_SYMBOLS[name]} ({WALL_UNITS[name]})", parse_math=True)
    eq14 = max((entry.eq14_difference for entry in entries), key=abs)
    fitted = max((entry.quadratic_difference for entry in entries), key=abs)
    axes.set_title(f"Eq. 14 {percent_difference(eq14)}", fontsize=SMALL_PT, color=BLUE)
    axes.set_title(f"fit {percent_difference(fitted)}", loc="right", fontsize=SMALL_PT, color=VERMILLION)
