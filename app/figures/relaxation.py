"""The picture of a relaxation: a ramp of a tenth of a second and the twenty seconds after it, both to be seen."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.figures import phases
from dragrig.figures.envelope import envelope, gap_after
from dragrig.figures.header import HEADER_IN
from dragrig.figures.panels import Place, add_panel, draw, label_y, plain_log_x, write_words
from dragrig.figures.run import BETWEEN_IN, FOOT_IN, LEFT_IN, NAMES_IN, RIGHT_IN, WIDTH_IN, column, header
from dragrig.figures.style import drawing, new_figure
from dragrig.figures.views import Panel, force_panel, position_panel, speed_panel
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import FilteredTrace, Run

HEIGHT_IN = 9.0
GUTTER_IN = 1.25


def ramp_of(run: Run) -> tuple[float, float] | None:
    """Return when the first ramp began and when it ended [s]; None where there is no ramp or nothing after it."""
    moving = (run.trace.phase > Phase.REST) & (run.trace.phase < Phase.HOLD)
    if not moving.any():
        return None
    first = int(moving.argmax())
    still = np.flatnonzero(~moving[first:])
    if still.size < 2:
        return None
    return float(run.trace.time[first]), float(run.trace.time[first + still[0]])


def draw_relaxation(
    run: Run, ramp: tuple[float, float], speed: FloatArray, filtered: FilteredTrace | None, bad_reason: str
) -> Figure:
    """Draw a relaxation: the whole of it, the time since the ramp on a logarithmic axis, and the ramp magnified."""
    gap = gap_after(run.trace.time, run.trace.sample_rate_hz)
    force = force_panel(run, filtered, gap)
    left = Place(LEFT_IN, FOOT_IN, 5.5, 0.0)
    right_in = left.left + left.width + GUTTER_IN
    right = Place(right_in, FOOT_IN, WIDTH_IN - right_in - RIGHT_IN, 0.0)
    free = HEIGHT_IN - HEADER_IN - NAMES_IN - FOOT_IN
    half = (free - FOOT_IN) / 2
    small = (free - 2 * BETWEEN_IN) * 0.27
    begin, end = ramp
    length = end - begin
    window = (max(begin - 0.5 * length, float(run.trace.time[0])), min(end + 1.5 * length, float(run.trace.time[-1])))
    with drawing():
        figure = new_figure(WIDTH_IN, HEIGHT_IN)
        header(figure, run, bad_reason)
        upper = Place(left.left, left.bottom + half + FOOT_IN, left.width, 0.0)
        whole = column(figure, run, [force], [half], upper, name_ramp=True)
        since = add_panel(figure, Place(left.left, left.bottom, left.width, half), share_y=whole[0])
        _since_the_ramp(since, force, end)
        panels = [force, position_panel(run, gap), speed_panel(run, speed, gap)]
        magnified = column(figure, run, panels, [free - 2 * BETWEEN_IN - 2 * small, small, small], right, window)
        magnified[-1].set_xlabel("Time (s), the ramp magnified")
        return figure


def _since_the_ramp(axes: Axes, panel: Panel, end_s: float) -> None:
    first, last = np.inf, 0.0
    for curve in panel.curves:
        after = curve.time > end_s
        since = curve.time[after] - end_s
        gap = curve.gap[np.flatnonzero(after)[:-1]]
        log_time, value = envelope(np.log10(since), curve.value[after], gap)
        draw(axes, 10**log_time, value, curve.pen)
        first, last = min(first, float(since[0])), max(last, float(since[-1]))
    plain_log_x(axes, first, last)
    axes.axvspan(first, last, color=phases.TINTS[Phase.HOLD], linewidth=0, zorder=0)
    axes.set_xlabel("Time since the end of the ramp (s)")
    label_y(axes, panel.label)
    write_words(axes, [curve.pen for curve in panel.curves])
