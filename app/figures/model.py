"""Pictures of the friction model: the paper's Figs. 9 and 7."""

from collections.abc import Sequence
from math import inf

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.config.capsule import Capsule
from dragrig.config.model import FrictionModelSettings
from dragrig.figures.header import headline
from dragrig.figures.labels import EndLabel, label_ends
from dragrig.figures.panels import Place, add_panel, label_y, plain_log_x
from dragrig.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    SMALL_PT,
    VERMILLION,
    drawing,
    new_figure,
    sequence,
    text_width_in,
)
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction import skew_resistance, steady_forces

LOWEST_MM_S, HIGHEST_MM_S = 0.5, 100.0
"""Range of the speed axis, unless speeds beyond it are asked for."""
SKEW_SPEEDS = (0.5, 2.0, 5.0, 10.0, 20.0, 60.0)
"""Speeds of the skew-resistance curves, unless others are asked for."""
MOST_CURVES = 7

LEFT_IN, FOOT_IN = 1.15, 0.85


def forces_figure(
    model: FrictionModelSettings,
    capsule: Capsule,
    wall_thickness_mm: float,
    speeds_mm_s: Sequence[float] = (),
    log_speed: bool = True,
) -> Figure:
    """Draw f_e, f_v, f_c and their sum against speed (the paper's Fig. 9), with dots at the speeds given.

    Raises
    ------
    SettingsError
        For a speed that is not positive.
    """
    dots = steady_forces(np.asarray(speeds_mm_s, dtype=float), model, capsule, wall_thickness_mm)
    low, high = min([LOWEST_MM_S, *speeds_mm_s]), max([HIGHEST_MM_S, *speeds_mm_s])
    speed = np.geomspace(low, high, 600)
    line = steady_forces(speed, model, capsule, wall_thickness_mm)
    with drawing():
        figure = new_figure(12.0, 7.6)
        headline(figure, LEFT_IN, "Friction against speed", described(model))
        axes = add_panel(figure, Place(LEFT_IN, FOOT_IN, 8.6, 5.6))
        labels = []
        for text, values, at_dots, colour, width in (
            ("total", line.total, dots.total, BLACK, 3.4),
            ("$f_c$  Coulomb", line.f_c, dots.f_c, VERMILLION, 2.4),
            ("$f_e$  environmental", line.f_e, dots.f_e, BLUE, 2.4),
            ("$f_v$  viscous", line.f_v, dots.f_v, GREEN, 2.4),
        ):
            axes.plot(speed, values, color=colour, linewidth=width)
            axes.plot(dots.speed_mm_s, at_dots, "o", color=colour, markersize=8, markeredgecolor="white", clip_on=False)
            labels.append(EndLabel(float(values[-1]), text, colour, math=True))
        axes.set_ylim(0, 1.06 * float(line.total.max()))
        if log_speed:
            plain_log_x(axes, low, high)
        else:
            axes.set_xlim(0, high)
        axes.set_xlabel("Speed (mm/s)")
        label_y(axes, "Force (mN)")
        label_ends(axes, labels)
        return figure


def skew_figure(
    model: FrictionModelSettings,
    capsule: Capsule,
    wall_thickness_mm: float,
    speeds_mm_s: Sequence[float] = SKEW_SPEEDS,
) -> Figure:
    """Draw the skew resistance P(x) S along the capsule at several speeds (the paper's Fig. 7).

    The hemisphere and the side of the capsule have scales of their own; a dot marks each curve's
    largest value. Of more than seven speeds, seven are drawn.

    Raises
    ------
    SettingsError
        For a speed that is not positive.
    """
    speeds = few_of(speeds_mm_s)
    steady = steady_forces(np.asarray(speeds), model, capsule, wall_thickness_mm)
    equator = (
        0.5
        * capsule.diameter_mm
        * float(np.sin(np.radians(capsule.contact_angle_deg + model.contact_angle_offset_deg)))
    )
    end = equator + model.side_contact_mm
    front = np.linspace(0.0, equator, 800)
    side = np.array([equator, end - 1e-6, end + 1e-6, end + 3.0])
    with drawing():
        figure = new_figure(12.0, 7.6)
        headline(figure, LEFT_IN, "Skew resistance along the capsule", described(model))
        left = add_panel(figure, Place(LEFT_IN, FOOT_IN, 5.9, 5.6))
        right = add_panel(figure, Place(LEFT_IN + 5.9, FOOT_IN, 3.2, 5.6), share_y=left)
        labels = []
        for speed, top, at, colour in zip(
            speeds, steady.max_skew, steady.x_of_max_skew, sequence(len(speeds)), strict=True
        ):
            beside = skew_resistance(side, speed, model, capsule, wall_thickness_mm)
            left.plot(front, skew_resistance(front, speed, model, capsule, wall_thickness_mm), color=colour)
            left.plot([at], [top], "o", color=colour, markersize=8, markeredgecolor="white")
            right.plot(side, beside, color=colour)
            labels.append(EndLabel(float(beside[0]), f"{speed:g} mm/s", colour))
        left.set_ylim(0, 1.08 * float(steady.max_skew.max()))
        _finish_skew(left, right, equator, float(side[-1]))
        label_ends(right, labels)
        return figure


def described(model: FrictionModelSettings, room_in: float = inf) -> str:
    """Say in a line which model a picture shows: its choices, and the scales that are not 1, at least how many."""
    wall = {"eq14": "Eq. 14", "table1": "Table 1", "polynomial": "polynomials"}[model.wall]
    scales = [
        f"{name.removesuffix('_scale').replace('_', ' ')} × {value:.3g}"
        for name, value in model
        if name.endswith("_scale") and value != 1
    ]
    friction = f"μ = {model.friction_coefficient:.3g}"
    choices = (f"model {model.name}", f"wall {wall}", f"viscous {model.viscous}", friction)
    whole = "  ·  ".join((*choices, *scales))
    if text_width_in(whole, SMALL_PT) <= room_in:
        return whole
    return "  ·  ".join((*choices, f"{len(scales)} scales that are not 1"))


def few_of(speeds_mm_s: Sequence[float]) -> tuple[float, ...]:
    """Return the speeds, rising and each once, or seven of them spread over all when there are more."""
    speeds = sorted(set(speeds_mm_s))
    if len(speeds) <= MOST_CURVES:
        return tuple(speeds)
    chosen: FloatArray = np.linspace(0, len(speeds) - 1, MOST_CURVES)
    return tuple(speeds[round(place)] for place in chosen)


def _finish_skew(left: Axes, right: Axes, equator_mm: float, end_mm: float) -> None:
    left.set_xlim(0, equator_mm)
    right.set_xlim(equator_mm, end_mm)
    right.tick_params(labelleft=False, left=False)
    right.spines["left"].set_color(GREY)
    right.spines["left"].set_linestyle((0, (3, 2)))
    right.set_facecolor("#F5F6F7")
    label_y(left, "Skew resistance P(x) S (mN)")
    left.set_xlabel("x on the hemisphere (mm)")
    right.set_xlabel("x beside the capsule (mm)")
    left.text(0.985, 0.03, "equator", transform=left.transAxes, ha="right", fontsize=SMALL_PT, color=GREY)
