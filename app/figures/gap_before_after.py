"""Runs before and after an effect is in the model: what was measured, both predictions, and what each leaves."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.analysis.gap.results import RunView
from dragrig.figures.header import fitting, headline
from dragrig.figures.panels import Pen, Place, add_panel, draw, fit_y, label_y, time_axis, write_words
from dragrig.figures.style import BLUE, GREY, PALE, SMALL_PT, TEXT_PT, VERMILLION, drawing, new_figure
from dragrig.rig.arrays import FloatArray

WIDTH_IN, ROW_IN, HEAD_IN, FOOT_IN, BETWEEN_IN = 13.0, 2.2, 1.75, 0.8, 0.8
LEFT_IN, GUTTER_IN, RIGHT_IN = 1.15, 1.15, 0.35
MEASURED = Pen("measured", PALE, 4.0)
BEFORE = Pen("model before", VERMILLION, 1.9, dashed=True)
AFTER = Pen("model after", BLUE, 1.6)
LEFT_BEFORE = Pen("left before", VERMILLION, 2.2)
LEFT_AFTER = Pen("left after", BLUE, 1.2)
MODEL = Pen("model", BLUE, 1.6)
LEFT_OVER = Pen("left", BLUE, 1.4)
MOVED = 0.01
"""Part of the travel by which motion has begun, and that is missing while it has not ended."""
SLIDING = frozenset({"drag", "coulomb", "blank"})


def gap_before_after_figure(views: Sequence[RunView], floor_mN: float | None = None, *, named: bool = True) -> Figure:
    """Draw runs in rows.

    Parameters
    ----------
    views
        One row each: left what was measured and both predictions, right what each of them leaves. Of a run that
        slides, as much rest and hold is shown as it takes to slide.
    floor_mN
        Noise and scatter of repeats, marked in grey beside forces.
    named
        Whether an effect is named; only the model without one is drawn otherwise.
    """
    rows = len(views)
    with drawing():
        tall = HEAD_IN + ROW_IN * rows + BETWEEN_IN * (rows - 1) + FOOT_IN
        figure = new_figure(WIDTH_IN, tall)
        told = "Left, what was measured and what the model says; right, measured − model"
        headline(figure, LEFT_IN, "Before and after" if named else "The model beside the runs", told)
        wide = (WIDTH_IN - LEFT_IN - GUTTER_IN - RIGHT_IN) / 2
        for row, view in enumerate(views):
            bottom = FOOT_IN + (rows - 1 - row) * (ROW_IN + BETWEEN_IN)
            left = add_panel(figure, Place(LEFT_IN, bottom, wide, ROW_IN))
            right = add_panel(figure, Place(LEFT_IN + wide + GUTTER_IN, bottom, wide, ROW_IN), left)
            _row(left, right, view, floor_mN if view.unit == "mN" else None, named=named)
            if row == 0 and floor_mN is not None:
                right.set_title("grey: noise and scatter of repeats", loc="right", fontsize=SMALL_PT, color=GREY)
            if row == rows - 1:
                left.set_xlabel("Time (s)")
                right.set_xlabel("Time (s)")
        return figure


def representative(views: Sequence[RunView], most: int = 7) -> tuple[RunView, ...]:
    """Choose runs to show: drags at the lowest, a middle and the highest speed, and of each other kind the worst left.

    Returns
    -------
    At most `most` views, drags first; of each channel that views were made of.
    """
    chosen: list[RunView] = []
    for channel in dict.fromkeys(view.channel for view in views):
        here = [view for view in views if view.channel == channel]
        drags = sorted((view for view in here if view.kind == "drag"), key=_speed)
        middle = len(drags) // 2
        chosen += [drags[at] for at in dict.fromkeys((0, middle, len(drags) - 1)) if drags]
        for kind in dict.fromkeys(view.kind for view in here if view.kind != "drag"):
            chosen.append(max((view for view in here if view.kind == kind), key=_left_before))
    return tuple(chosen[:most])


def _row(left: Axes, right: Axes, view: RunView, floor_mN: float | None, *, named: bool) -> None:
    shown = _window(view)
    inside = (view.time_s >= shown[0]) & (view.time_s <= shown[1])
    time, measured = view.time_s[inside], view.measured[inside]
    models = [(view.before[inside], BEFORE, LEFT_BEFORE), (view.after[inside], AFTER, LEFT_AFTER)]
    if not named:
        models = [(view.before[inside], MODEL, LEFT_OVER)]
    draw(left, time, measured, MEASURED)
    for values, pen, _ in models:
        draw(left, time, values, pen)
    fit_y(left, (measured, *(values for values, _, _ in models)), _least_span(view))
    for values, _, pen in models:
        draw(right, time, measured - values, pen)
    fit_y(right, [measured - values for values, _, _ in models], _least_span(view))
    right.axhline(0.0, color=GREY, linewidth=0.9, zorder=1)
    if floor_mN is not None and np.isfinite(floor_mN):
        right.axhspan(-floor_mN, floor_mN, facecolor=GREY, alpha=0.18, linewidth=0.0, zorder=0.6)
    quantity = f"{view.channel.replace('_', ' ').capitalize()} ({view.unit})"
    label_y(left, quantity)
    label_y(right, f"Left ({view.unit})")
    write_words(left, (MEASURED, *(pen for _, pen, _ in models)))
    if named:
        write_words(right, [pen for _, _, pen in models])
    left.set_title(fitting(f"{view.label}, {view.file}", TEXT_PT, WIDTH_IN / 2 - 1), loc="left", fontsize=TEXT_PT)
    time_axis(left, *shown)


def _window(view: RunView) -> tuple[float, float]:
    """Return from when to when [s] a run is shown."""
    first, last = float(view.time_s[0]), float(view.time_s[-1])
    begin, end = _motion(view)
    if view.kind not in SLIDING or not end > begin:
        return first, last
    apart = end - begin
    return max(first, begin - 0.4 * apart), min(last, end + 0.8 * apart)


def _motion(view: RunView) -> tuple[float, float]:
    moved = np.abs(view.position_mm - view.position_mm[0])
    travel = float(moved.max(initial=0.0))
    if not travel > 0:
        return 0.0, 0.0
    under_way = np.flatnonzero((moved > MOVED * travel) & (moved < (1 - MOVED) * travel))
    if under_way.size == 0:
        return 0.0, 0.0
    return float(view.time_s[under_way[0]]), float(view.time_s[under_way[-1]])


def _speed(view: RunView) -> float:
    begin, end = _motion(view)
    travel = float(np.ptp(view.position_mm)) if view.position_mm.size else 0.0
    return travel / (end - begin) if end > begin else 0.0


def _left_before(view: RunView) -> float:
    left: FloatArray = view.measured - view.before
    return float(np.sqrt(np.nanmean(left**2))) if np.isfinite(left).any() else 0.0


def _least_span(view: RunView) -> float:
    return 4.0 if view.unit == "mN" else 0.004
