"""The picture of a run: force, raw and filtered, over position and speed, its phases shaded and named."""

from matplotlib.figure import Figure

from dragrig.figures.columns import (
    BETWEEN_IN,
    FOOT_IN,
    LEFT_IN,
    NAMES_IN,
    RIGHT_IN,
    WIDTH_IN,
    column,
)
from dragrig.figures.derived import filtered_of, measured_speed, steady_level
from dragrig.figures.envelope import gap_after
from dragrig.figures.header import header_in, trouble_of, write_header
from dragrig.figures.panels import Place
from dragrig.figures.relaxation import draw_relaxation, ramp_of
from dragrig.figures.style import drawing, new_figure
from dragrig.figures.views import force_panel, position_panel, speed_panel
from dragrig.rig.runfile.model import Run

FORCE_IN, SMALL_IN = 3.5, 1.45


def run_figure(run: Run, *, filtered: bool = True, motor_force: bool = False, bad_reason: str | None = None) -> Figure:
    """Draw a run: force, position, measured speed, and on demand the motor's force, against time.

    A relaxation is drawn three times over: whole, since its ramp on a logarithmic axis, and its ramp magnified.

    Parameters
    ----------
    filtered
        Whether to draw the filtered force over the raw one: what the filter stored in the file, or else what
        its usual settings give.
    motor_force
        Whether to add the motor's force, where it was recorded beside the force.
    bad_reason
        Why the run was marked bad; None when it was not.
    """
    found = filtered_of(run)
    smooth = found if filtered else None
    gap = gap_after(run.trace.time, run.trace.sample_rate_hz)
    panels = [
        force_panel(run, smooth, gap, steady=steady_level(run)),
        position_panel(run, gap),
        speed_panel(run, measured_speed(run, found), gap),
    ]
    if motor_force and run.trace.signal != "motor_force" and "motor_force" in run.trace.channels:
        panels.append(force_panel(run, smooth, gap, "motor_force"))
    ramp, trouble = ramp_of(run), trouble_of(run.info, bad_reason)
    with drawing():
        if ramp is not None:
            return draw_relaxation(run, panels, ramp, trouble)
        heights = [FORCE_IN, *[SMALL_IN] * (len(panels) - 1)]
        height = header_in(trouble) + NAMES_IN + sum(heights) + BETWEEN_IN * (len(panels) - 1) + FOOT_IN
        figure = new_figure(WIDTH_IN, height)
        write_header(figure, LEFT_IN, run.info, trouble)
        column(figure, run, panels, heights, Place(LEFT_IN, FOOT_IN, WIDTH_IN - LEFT_IN - RIGHT_IN, 0.0))
        return figure
