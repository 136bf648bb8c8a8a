"""The picture of a relaxation: a ramp of a tenth of a second and the twenty seconds after it, both to be seen."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dragrig.figures import phases
from dragrig.figures.columns import BETWEEN_IN, FOOT_IN, LEFT_IN, NAMES_IN, RIGHT_IN, WIDTH_IN, column
from dragrig.figures.envelope import envelope
from dragrig.figures.header import header_in, write_header
from dragrig.figures.panels import Place, add_panel, draw, label_y, plain_log_x, write_words
from dragrig.figures.style import new_figure
from dragrig.figures.views import Panel
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Run

FREE_IN, SMALL_IN = 6.7, 1.75
"""Height of a column with two panels below the force, and of each of these."""
COLUMN_IN, GUTTER_IN = 5.5, 1.25
SHORTEST_HOLD = 4.0
"""In lengths of the ramp: a hold shorter than this needs no magnified ramp."""


def ramp_of(run: Run) -> tuple[float, float] | None:
    """Return begin and end [s] of a relaxation's ramp; None for another kind of run, or when little follows it."""
    if run.info.kind != "relaxation":
        return None
    moving = (run.trace.phase > Phase.REST) & (run.trace.phase < Phase.HOLD)
    if not moving.any():
        return None
    time, first = run.trace.time, int(moving.argmax())
    still = np.flatnonzero(~moving[first:])
    if still.size < 2:
        return None
    begin, end = float(time[first]), float(time[first + still[0]])
    return (begin, end) if time[-1] - end > SHORTEST_HOLD * (end - begin) else None


def draw_relaxation(run: Run, panels: Sequence[Panel], ramp: tuple[float, float], trouble: str) -> Figure:
    """Draw a relaxation: the whole of it, the time since the ramp on a logarithmic axis, and the ramp magnified.

    The first panel is the force's; call it while `drawing`.
    """
    force, time = panels[0], run.trace.time
    right_in = LEFT_IN + COLUMN_IN + GUTTER_IN
    below = len(panels) - 1
    free = FREE_IN + (below - 2) * (SMALL_IN + BETWEEN_IN)
    half = (free - FOOT_IN) / 2
    begin, end = ramp
    window = max(1.5 * begin - 0.5 * end, float(time[0])), min(2.5 * end - 1.5 * begin, float(time[-1]))

    figure = new_figure(WIDTH_IN, header_in(trouble) + NAMES_IN + free + FOOT_IN)
    write_header(figure, LEFT_IN, run.info, trouble)
    upper = Place(LEFT_IN, FOOT_IN + half + FOOT_IN, COLUMN_IN, 0.0)
    (whole,) = column(figure, run, [force], [half], upper, name_ramp=True)
    since = add_panel(figure, Place(LEFT_IN, FOOT_IN, COLUMN_IN, half), share_y=whole)
    _since_the_ramp(since, force, end)
    heights = [free - below * (SMALL_IN + BETWEEN_IN), *[SMALL_IN] * below]
    right = Place(right_in, FOOT_IN, WIDTH_IN - right_in - RIGHT_IN, 0.0)
    column(figure, run, panels, heights, right, window)[-1].set_xlabel("Time (s), the ramp magnified")
    return figure


def _since_the_ramp(axes: Axes, panel: Panel, end_s: float) -> None:
    first, last = np.inf, 0.0
    for curve in panel.curves:
        after = curve.time > end_s
        since = curve.time[after] - end_s
        log_time, value = envelope(np.log10(since), curve.value[after], curve.gap[np.flatnonzero(after)[:-1]])
        draw(axes, 10**log_time, value, curve.pen)
        first, last = min(first, float(since[0])), max(last, float(since[-1]))
    plain_log_x(axes, first, last)
    axes.axvspan(first, last, color=phases.TINTS[Phase.HOLD], linewidth=0, zorder=0)
    axes.set_xlabel("Time since the end of the ramp (s)")
    label_y(axes, panel.label)
    write_words(axes, [curve.pen for curve in panel.curves])
