"""The picture of a Coulomb test: raw and filtered force, its zero taken off, and its mean (the paper's Fig. 8)."""

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from dragrig.analysis.identification.results import CoulombRun
from dragrig.figures.columns import FOOT_IN, LEFT_IN, NAMES_IN, RIGHT_IN, WIDTH_IN, column
from dragrig.figures.derived import filtered_of, steady_level, with_error
from dragrig.figures.envelope import gap_after
from dragrig.figures.header import header_in, trouble_of, write_header
from dragrig.figures.panels import Pen, Place
from dragrig.figures.style import VERMILLION, drawing, new_figure
from dragrig.figures.views import Curve, force_panel
from dragrig.rig.runfile.model import Run

FORCE_IN = 4.4


def coulomb_figure(run: Run, found: CoulombRun | None, printed_mN: float | None = None) -> Figure:
    """Draw the force of a Coulomb test.

    Parameters
    ----------
    found
        What was identified from it, for the sensor's zero; without it the force is drawn as recorded.
    printed_mN
        A mean to compare with, drawn as a line.
    """
    shown = _zeroed(run, found)
    gap = gap_after(shown.trace.time, shown.trace.sample_rate_hz)
    level = steady_level(shown)
    if level is not None and found is not None and found.force.value is not None:
        level = replace(level, text=f"mean {with_error(found.force.value, found.force.standard_error)} mN{_mu(found)}")
    panel = force_panel(shown, filtered_of(shown), gap, steady=level)
    if printed_mN is not None:
        ends, printed = shown.trace.time[[0, -1]], np.full(2, printed_mN)
        pen = Pen(f"the paper’s mean {printed_mN:g} mN", VERMILLION, 1.2, dashed=True)
        panel = replace(panel, curves=(*panel.curves, Curve(ends, printed, np.zeros(1, dtype=np.bool_), pen)))
    trouble = trouble_of(run.info)
    with drawing():
        figure = new_figure(WIDTH_IN, header_in(trouble) + NAMES_IN + FORCE_IN + FOOT_IN)
        write_header(figure, LEFT_IN, run.info, trouble)
        column(figure, shown, [panel], [FORCE_IN], Place(LEFT_IN, FOOT_IN, WIDTH_IN - LEFT_IN - RIGHT_IN, 0.0))
        return figure


def _mu(found: CoulombRun) -> str:
    return "" if found.mu.value is None else f", μ = {with_error(found.mu.value, found.mu.standard_error)}"


def _zeroed(run: Run, found: CoulombRun | None) -> Run:
    level = steady_level(run)
    if found is None or found.force.value is None or level is None:
        return run
    zero = level.force_mN - float(np.copysign(found.force.value, found.speed_mm_s))
    channels = {**run.trace.channels, run.trace.signal: np.asarray(run.trace.force, dtype=np.float64) - zero}
    return replace(run, trace=replace(run.trace, channels=channels), filtered=None)
