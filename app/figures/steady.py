"""Measured steady drag beside the model's curve (the paper's Fig. 11), and what is left between them."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.identification.results import Drag, LogLaw, SpeedPoint
from dragrig.config.capsule import Capsule
from dragrig.config.model import FrictionModelSettings
from dragrig.figures.header import headline
from dragrig.figures.labels import EndLabel, label_ends
from dragrig.figures.model import described
from dragrig.figures.panels import Place, add_panel, hide_time, label_y, plain_log_x
from dragrig.figures.style import BLACK, BLUE, GREY, SMALL_PT, VERMILLION, drawing, new_figure
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction import steady_forces

LEFT_IN, FOOT_IN, WIDE_IN = 1.15, 0.85, 8.6
FORCE_IN, LEFT_OVER_IN, BETWEEN_IN = 4.6, 1.9, 0.2
MARGIN = 1.25
"""How far the speed axis goes beyond the measured speeds, as a factor."""


def drag_figure(
    drag: Drag,
    model: FrictionModelSettings,
    capsule: Capsule,
    wall_thickness_mm: float,
    boundary_mm_s: float | None = None,
    accuracy_mN: float | None = None,
) -> Figure:
    """Draw the measured drag with its 95 % intervals, the model's curve and the law of ln v; below, the differences.

    Parameters
    ----------
    boundary_mm_s
        A speed to mark.
    accuracy_mN
        The sensor's accuracy, drawn as a band around no difference.
    """
    points = [one for one in drag.points if one.force.value is not None]
    speeds = [one.speed_mm_s for one in points] or [0.5, 60.0]
    low, high = min(speeds) / MARGIN, max(speeds) * MARGIN
    speed = np.geomspace(low, high, 400)
    curve = steady_forces(speed, model, capsule, wall_thickness_mm).total
    with drawing():
        figure = new_figure(12.0, FOOT_IN + LEFT_OVER_IN + BETWEEN_IN + FORCE_IN + 1.15)
        headline(figure, LEFT_IN, "Drag against speed, measured and by the model", described(model))
        below = add_panel(figure, Place(LEFT_IN, FOOT_IN, WIDE_IN, LEFT_OVER_IN))
        above = add_panel(figure, Place(LEFT_IN, FOOT_IN + LEFT_OVER_IN + BETWEEN_IN, WIDE_IN, FORCE_IN), below)
        above.plot(speed, curve, color=BLACK, linewidth=2.8)
        labels = [EndLabel(float(curve[-1]), "model", BLACK)]
        if drag.log_law is not None:
            law = _law(drag.log_law, speed)
            above.plot(speed, law, color=VERMILLION, linewidth=1.6, linestyle=(0, (5, 3)))
            below.plot(speed, law - curve, color=VERMILLION, linewidth=1.6, linestyle=(0, (5, 3)))
            labels.append(EndLabel(float(law[-1]), "law of ln v", VERMILLION))
        _points(above, points, [0.0] * len(points))
        _points(below, points, [one.model_mN for one in points])
        _finish(above, below, low, high)
        if accuracy_mN is not None:
            below.axhspan(-accuracy_mN, accuracy_mN, color="#EEF0F3", linewidth=0, zorder=0)
            labels_below = [EndLabel(0.0, f"± {accuracy_mN:g} mN,\nsensor accuracy", GREY)]
            label_ends(below, labels_below, SMALL_PT)
        if boundary_mm_s is not None:
            _mark(above, below, boundary_mm_s)
        if points:
            last = points[-1]
            labels.append(EndLabel(float(last.force.value or 0.0), "measured", BLUE))
        label_ends(above, labels)
        return figure


def _law(law: LogLaw, speed: FloatArray) -> FloatArray:
    return np.asarray(law.intercept.value + law.slope.value * np.log(speed))


def _points(axes: Axes, points: list[SpeedPoint], taken_off: list[float]) -> None:
    for one, less in zip(points, taken_off, strict=True):
        value, interval = (one.force.value or 0.0) - less, one.force.interval
        if interval is not None:
            axes.plot([one.speed_mm_s] * 2, [interval[0] - less, interval[1] - less], color=BLUE, linewidth=1.8)
        axes.plot([one.speed_mm_s], [value], "o", color=BLUE, markersize=6)


def _finish(above: Axes, below: Axes, low: float, high: float) -> None:
    plain_log_x(below, low, high)
    hide_time(above)
    above.set_ylim(bottom=0)
    below.axhline(0.0, color=BLACK, linewidth=1.2)
    most = max(abs(one) for one in below.get_ylim())
    below.set_ylim(-most, most)
    below.set_xlabel("Speed (mm/s)")
    label_y(above, "Force (mN)")
    label_y(below, "Measured − model")


def _mark(above: Axes, below: Axes, boundary_mm_s: float) -> None:
    for axes in (above, below):
        axes.axvline(boundary_mm_s, color=GREY, linewidth=1.2, linestyle=(0, (2, 2)))
    above.annotate(
        f"the paper's boundary, {boundary_mm_s:g} mm/s ",
        xy=(boundary_mm_s, 0.03),
        xycoords=("data", "axes fraction"),
        ha="right",
        fontsize=SMALL_PT,
        color=GREY,
    )
