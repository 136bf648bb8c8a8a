"""Figures of the friction model: forces against speed, skew resistance, wall parameters (the paper's Figs. 9 and 7)."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.paper import SKEW_SPEEDS_MM_S
from dragrig.config import Capsule, FrictionModelSettings
from dragrig.present import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    SMALL_PT,
    VERMILLION,
    CurveLabel,
    ModelForces,
    SpeedPanel,
    SteadyForces,
    figure_style,
    label_curves,
    layout_of,
    new_figure,
    sequential_colours,
    speed_figure,
)
from dragrig.rig import FloatArray
from dragrig.sim_backend.friction import (
    skew_resistance,
    steady_forces,
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
    parts = (
        ("total", "total", BLACK, 3.4),
        ("f_c", "$f_c$  Coulomb", VERMILLION, 2.4),
        ("f_e", "$f_e$  environmental", BLUE, 2.4),
        ("f_v", "$f_v$  viscous", GREEN, 2.4),
    )
    lines = [ModelForces(text, colour, speed, getattr(line, name), width=width) for name, text, colour, width in parts]
    none = np.full(len(dots.speed_mm_s), np.nan)
    marked = [
        SteadyForces("", colour, dots.speed_mm_s, getattr(dots, name), none, joined=False)
        for name, _, colour, _ in parts
    ]
    return speed_figure(SpeedPanel(marked, lines), title="Friction against speed", subtitle=model_text(model))


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
