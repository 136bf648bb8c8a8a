"""Where labels go so that they stay clear of each other."""

from collections.abc import Sequence

import numpy as np

from dragrig.rig.arrays import FloatArray


def spread(centres: Sequence[float], widths: Sequence[float], low: float, high: float) -> FloatArray:
    """Move labels along a line, as little as possible, until none covers another.

    Parameters
    ----------
    centres, widths
        Where each label would like to be, in rising order, and the room it takes.
    low, high
        Ends of the line. Where the labels do not fit between them all, they run over `high`.

    Returns
    -------
    The labels' centres, shape `(K,)`. The sum of squared displacements is the smallest possible.
    """
    from scipy.optimize import isotonic_regression

    wanted, width = np.asarray(centres, dtype=float), np.asarray(widths, dtype=float)
    if wanted.size == 0:
        return wanted
    # Measured from where each would stand in a closed row, "no overlap" reads "never falling".
    row = np.concatenate(([0.0], np.cumsum((width[:-1] + width[1:]) / 2)))
    placed = np.asarray(isotonic_regression(wanted - row).x)
    first, last = low + width[0] / 2, high - width[-1] / 2 - row[-1]
    return np.asarray(np.clip(placed, first, max(first, last)) + row)
