"""The picture of a run: force, raw and filtered, over position and speed, its phases shaded and named."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.figures import phases
from dragrig.figures.envelope import gap_after
from dragrig.figures.header import HEADER_IN, status_of, subtitle_of, title_of, write_header
from dragrig.figures.marks import draw_marks, mark_gaps, marks_of
from dragrig.figures.panels import Place, add_panel, hide_time, time_axis
from dragrig.figures.style import drawing, new_figure
from dragrig.figures.views import Panel, draw_panel, force_panel, position_panel, speed_panel
from dragrig.rig.arrays import FloatArray
from dragrig.rig.runfile.model import FilteredTrace, Run

WIDTH_IN = 12.0
LEFT_IN, RIGHT_IN, FOOT_IN = 1.15, 0.35, 0.75
BETWEEN_IN, NAMES_IN = 0.17, 0.55
FORCE_IN, SMALL_IN = 3.5, 1.45
MARKS_IN = 0.34
"""Room for the names of marks at the foot of the force."""


def draw_run(
    run: Run, speed: FloatArray, filtered: FilteredTrace | None = None, motor_force: bool = False, bad_reason: str = ""
) -> Figure:
    """Draw a run: force, position, measured speed, and on demand the motor's force.

    Parameters
    ----------
    speed
        Measured speed [mm/s], shape `(N,)`.
    filtered
        What to draw over the raw force.
    motor_force
        Whether to add the motor's force, where it was recorded.
    bad_reason
        Why the run was marked bad, if it was.
    """
    with drawing():
        gap = gap_after(run.trace.time, run.trace.sample_rate_hz)
        panels = [
            force_panel(run, filtered, gap),
            position_panel(run, gap),
            speed_panel(run, speed, gap),
        ]
        if motor_force and run.trace.signal != "motor_force" and "motor_force" in run.trace.channels:
            panels.append(force_panel(run, filtered, gap, "motor_force"))
        heights = [FORCE_IN, *[SMALL_IN] * (len(panels) - 1)]
        height = HEADER_IN + NAMES_IN + sum(heights) + BETWEEN_IN * (len(panels) - 1) + FOOT_IN
        figure = new_figure(WIDTH_IN, height)
        header(figure, run, bad_reason)
        column(figure, run, panels, heights, Place(LEFT_IN, FOOT_IN, WIDTH_IN - LEFT_IN - RIGHT_IN, 0.0))
        return figure


def header(figure: Figure, run: Run, bad_reason: str) -> None:
    """Write what the run is above its picture."""
    info = run.info
    write_header(figure, LEFT_IN, title_of(info), subtitle_of(info), status_of(info, bad_reason), info.header.backend)


def column(
    figure: Figure,
    run: Run,
    panels: list[Panel],
    heights: list[float],
    foot: Place,
    window: tuple[float, float] | None = None,
    name_ramp: bool = False,
) -> list[Axes]:
    """Stack panels that share their time axis, the first on top, and shade, name and mark them.

    `foot` says where the lowest stands; `window` is the time shown, the whole run unless given; `name_ramp`
    takes the phases in motion together.
    """
    time, phase = run.trace.time, run.trace.phase
    gap = gap_after(time, run.trace.sample_rate_hz)
    found = marks_of(run.events, time, gap)
    stack: list[Axes] = []
    bottom = foot.bottom + sum(heights) + BETWEEN_IN * (len(heights) - 1)
    for panel, height in zip(panels, heights, strict=True):
        bottom -= height
        axes = add_panel(figure, Place(foot.left, bottom, foot.width, height), stack[0] if stack else None)
        bottom -= BETWEEN_IN
        draw_panel(axes, panel, MARKS_IN if found and not stack else 0.1, window)
        stack.append(axes)
    low, high = window or ((float(time[0]), float(time[-1])) if time.size else (0.0, 1.0))
    time_axis(stack[0], low, high)
    for axes in stack[:-1]:
        hide_time(axes)
    stack[-1].set_xlabel("Time (s)")
    parts = phases.stretches(time, phase)
    for axes in stack:
        phases.shade(axes, parts)
    phases.name_above(stack[0], phases.with_ramp(parts) if name_ramp else parts)
    mark_gaps(stack, time, gap)
    draw_marks(stack, found)
    return stack
