"""Piecewise polynomial interpolation of a function that relaxes after each event."""

from collections.abc import Callable

import numpy as np
from scipy.interpolate import PPoly

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.quadrature import chebyshev

FIRST_PANEL = 0.3
"""Width of the first panel after an event, in relaxation times of the fastest branch."""

PANEL_RATIO = 2.0
"""How much later each panel ends than its predecessor, both counted from the event."""


def graded_edges(begin_s: float, end_s: float, fastest_rate: float) -> FloatArray:
    """Return the ends of panels from `begin_s` to `end_s`, shortest at the beginning."""
    first = FIRST_PANEL / fastest_rate
    count = max(0, int(np.ceil(np.log((end_s - begin_s) / first) / np.log(PANEL_RATIO))))
    inner = begin_s + first * PANEL_RATIO ** np.arange(count)
    return np.concatenate(([begin_s], inner[inner < end_s], [end_s]))


def interpolate(evaluate: Callable[[FloatArray], FloatArray], edges_s: FloatArray, nodes_per_panel: int) -> PPoly:
    """Interpolate `evaluate`, from times of shape `(n,)` to values of shape `(…, n)`, between strictly rising edges.

    The nodes lie inside the panels, so that a jump at an edge is never asked about.
    """
    nodes, to_powers = chebyshev(nodes_per_panel)
    width = np.diff(edges_s)
    times = edges_s[:-1, None] + width[:, None] * nodes
    found = evaluate(times.ravel())
    values = found.reshape(*found.shape[:-1], *times.shape)
    coefficients = (values @ to_powers.T) / width[:, None] ** np.arange(nodes.size)
    return PPoly(np.moveaxis(coefficients, (-1, -2), (0, 1))[::-1], edges_s)
