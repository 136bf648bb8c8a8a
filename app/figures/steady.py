"""Measured steady drag over the model's parts (the paper's Fig. 11 over its Fig. 9), and what is left between them."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.identification.nominal_drag import Parts, Setup, parts
from dragrig.analysis.identification.results import Boundary, Drag, LogLaw, SpeedPoint
from dragrig.config.capsule import Capsule
from dragrig.config.model import FrictionModelSettings
from dragrig.figures.header import fitting, headline, write_badge
from dragrig.figures.labels import EndLabel, label_ends
from dragrig.figures.model import described
from dragrig.figures.panels import Place, add_panel, hide_time, label_y, plain_log_x
from dragrig.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SMALL_PT,
    VERMILLION,
    drawing,
    new_figure,
)
from dragrig.rig.arrays import FloatArray

WIDTH_IN, LEFT_IN, FOOT_IN, WIDE_IN = 12.4, 1.15, 0.85, 9.0
FORCE_IN, LEFT_OVER_IN, BETWEEN_IN = 4.9, 2.2, 0.2
MARGIN = 1.25
"""How far the speed axis goes beyond the measured speeds, as a factor."""
TINTS = (("f_c", "$f_c$  Coulomb", VERMILLION, "#F8E0D3"), ("f_e", "$f_e$  environmental", BLUE, "#D8E8F3"),
         ("f_v", "$f_v$  viscous", GREEN, "#CDEBE0"))  # fmt: skip
"""The model's parts from below: name, words, colour of the words and of the area."""
LEAST_ROOM = 0.12
"""Room above the highest force, as a share of it."""


def drag_figure(
    drag: Drag,
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
    low, high = min(speeds) / MARGIN, max(speeds) * MARGIN
    speed = np.geomspace(low, high, 400)
    curve = parts(Setup(capsule, wall_thickness_mm), model, speed)
    with drawing():
        figure = new_figure(WIDTH_IN, FOOT_IN + LEFT_OVER_IN + BETWEEN_IN + FORCE_IN + 1.15)
        room = WIDTH_IN - LEFT_IN - 0.3
        told = fitting(described(model, room), SMALL_PT, room)
        headline(figure, LEFT_IN, "Drag against speed, measured and by the model", told)
        if backend:
            write_badge(figure, backend)
        below = add_panel(figure, Place(LEFT_IN, FOOT_IN, WIDE_IN, LEFT_OVER_IN))
        above = add_panel(figure, Place(LEFT_IN, FOOT_IN + LEFT_OVER_IN + BETWEEN_IN, WIDE_IN, FORCE_IN), below)
        labels = _stacked(above, speed, curve)
        if drag.log_law is not None:
            law = _law(drag.log_law, speed)
            above.plot(speed, law, color=PURPLE, linewidth=1.8, linestyle=(0, (5, 3)))
            below.plot(speed, law - curve.total, color=PURPLE, linewidth=1.8, linestyle=(0, (5, 3)))
            labels.append(EndLabel(float(law[-1]), "law of ln v", PURPLE))
        if simulated is not None:
            truth = parts(Setup(capsule, wall_thickness_mm), simulated, speed).total
            above.plot(speed, truth, color=GREY, linewidth=1.6, linestyle=(0, (2, 2)))
            below.plot(speed, truth - curve.total, color=GREY, linewidth=1.6, linestyle=(0, (2, 2)))
            labels.append(EndLabel(float(truth[-1]), "as simulated", GREY))
        _points(above, points, [0.0] * len(points))
        _points(below, points, [one.model_mN for one in points])
        if points:
            nearest = max(points, key=lambda one: abs(one.speed_mm_s))
            labels.append(EndLabel(float(nearest.force.value or 0.0), "measured", BLACK))
        _finish(above, below, (low, high), accuracy_mN)
        _boundaries(above, below, drag.boundary, boundary_mm_s)
        label_ends(above, labels)
        return figure


def _stacked(axes: Axes, speed: FloatArray, curve: Parts) -> list[EndLabel]:
    """Fill the areas of the model's parts on one another under the line of their sum, and say where to name them."""
    foot, labels = np.zeros_like(speed), list[EndLabel]()
    for name, words, colour, tint in TINTS:
        top = foot + getattr(curve, name)
        axes.fill_between(speed, foot, top, color=tint, linewidth=0, zorder=0.5)
        labels.append(EndLabel(float(foot[-1] + top[-1]) / 2, words, colour, math=True))
        foot = top
    axes.plot(speed, curve.total, color=BLACK, linewidth=2.6)
    labels.append(EndLabel(float(curve.total[-1]), "model", BLACK))
    return labels


def _law(law: LogLaw, speed: FloatArray) -> FloatArray:
    return np.asarray(law.intercept.value + law.slope.value * np.log(speed))


def _points(axes: Axes, points: Sequence[SpeedPoint], taken_off: Sequence[float]) -> None:
    for one, less in zip(points, taken_off, strict=True):
        speed, value, interval = abs(one.speed_mm_s), (one.force.value or 0.0) - less, one.force.interval
        if interval is not None:
            axes.plot([speed] * 2, [interval[0] - less, interval[1] - less], color=BLACK, linewidth=2.0, zorder=4)
        fill = BLACK if one.speed_mm_s > 0 else "white"
        axes.plot([speed], [value], "o", color=BLACK, markerfacecolor=fill, markersize=7, zorder=5)


def _finish(above: Axes, below: Axes, speeds: tuple[float, float], accuracy_mN: float | None) -> None:
    plain_log_x(below, *speeds)
    hide_time(above)
    above.set_ylim(0, (1 + LEAST_ROOM) * above.dataLim.y1)
    if accuracy_mN is not None:
        below.axhspan(-accuracy_mN, accuracy_mN, color="#E8EBEE", linewidth=0, zorder=0)
    below.axhline(0.0, color=BLACK, linewidth=1.2)
    most = max(abs(one) for one in below.get_ylim())
    below.set_ylim(-most, most)
    if accuracy_mN is not None:
        label_ends(below, [EndLabel(0.0, f"± {accuracy_mN:g} mN,\nsensor accuracy", GREY)], SMALL_PT)
    below.set_xlabel("Speed (mm/s)")
    label_y(above, "Force (mN)")
    label_y(below, "Measured − model (mN)")


def _boundaries(above: Axes, below: Axes, found: Boundary | None, printed_mm_s: float | None) -> None:
    if found is not None and found.speed_mm_s is not None:
        for axes in (above, below):
            if found.interval is not None:
                axes.axvspan(*found.interval, color=ORANGE, alpha=0.22, linewidth=0, zorder=1)
            axes.axvline(found.speed_mm_s, color=ORANGE, linewidth=2.0, zorder=2)
        words = f"estimated boundary\n{found.speed_mm_s:.3g} mm/s"
        if found.interval is not None:
            words += f" ({found.interval[0]:.3g} to {found.interval[1]:.3g})"
        _name(above, found.speed_mm_s, words, 0.94, 0.3)
    if printed_mm_s is not None:
        for axes in (above, below):
            axes.axvline(printed_mm_s, color=GREY, linewidth=1.2, linestyle=(0, (2, 2)), zorder=2)
        _name(above, printed_mm_s, f"the paper's boundary\n{printed_mm_s:g} mm/s", 0.06, 0.78)


def _name(axes: Axes, speed_mm_s: float, words: str, height: float, right_below: float) -> None:
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
