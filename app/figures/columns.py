"""Panels of a run stacked over one time axis, shaded, named and marked."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.figures import phases
from dragrig.figures.envelope import gap_after
from dragrig.figures.marks import draw_marks, marks_of
from dragrig.figures.panels import Place, add_panel, hide_time, time_axis
from dragrig.figures.views import Panel, draw_panel
from dragrig.rig.runfile.model import Run

WIDTH_IN = 12.0
LEFT_IN, RIGHT_IN, FOOT_IN = 1.15, 0.35, 0.75
BETWEEN_IN, NAMES_IN = 0.17, 0.55
MARKS_IN = 0.34
"""Room for the names of marks at the foot of the first panel."""


def column(
    figure: Figure,
    run: Run,
    panels: Sequence[Panel],
    heights: Sequence[float],
    foot: Place,
    window: tuple[float, float] | None = None,
    name_ramp: bool = False,
) -> list[Axes]:
    """Stack panels that share their time axis, the first on top, and shade, name and mark them.

    Parameters
    ----------
    foot
        Where the lowest panel stands; its height is not looked at.
    window
        The time shown [s]; the whole run unless given.
    name_ramp
        Take the phases in motion together.
    """
    time = run.trace.time
    gap = gap_after(time, run.trace.sample_rate_hz)
    marks = marks_of(run.events, time, gap, run.trace.sample_rate_hz)
    stack = _stacked(figure, heights, foot)
    for axes, panel in zip(stack, panels, strict=True):
        draw_panel(axes, panel, MARKS_IN if marks and axes is stack[0] else 0.1, window)
    whole = (float(time[0]), float(time[-1])) if time.size else (0.0, 1.0)
    time_axis(stack[0], *(window or whole))
    for axes in stack[:-1]:
        hide_time(axes)
    stack[-1].set_xlabel("Time (s)")
    parts = phases.stretches(time, run.trace.phase)
    for axes in stack:
        phases.shade(axes, parts)
    phases.name_above(stack[0], phases.with_ramp(parts) if name_ramp else parts)
    draw_marks(stack, marks)
    return stack


def _stacked(figure: Figure, heights: Sequence[float], foot: Place) -> list[Axes]:
    stack: list[Axes] = []
    top = foot.bottom + sum(heights) + BETWEEN_IN * (len(heights) - 1)
    for height in heights:
        place = Place(foot.left, top - height, foot.width, height)
        stack.append(add_panel(figure, place, stack[0] if stack else None))
        top -= height + BETWEEN_IN
    return stack
