"""Laws that bear no name, tried beside the catalogue.

An effect that the catalogue lacks passes for the one that resembles it most. If a force that is any smooth function of
one coordinate explains more than that, the one that resembles it is not what acts.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from dragrig.analysis.gap.acting import rms_where_acting
from dragrig.analysis.gap.coordinate_laws import law_columns
from dragrig.analysis.gap.design import Design, IndexArray, Part
from dragrig.analysis.gap.evidence import Nameless
from dragrig.analysis.gap.sights import Sight
from dragrig.analysis.gap.solving import taken_out
from dragrig.rig.arrays import FloatArray

GAIN, GAIN_SD = "gain of a run", 0.2
"""The law by which every run has a gain of its own, and the prior of that."""


def nameless(
    design: Design, sights: Sequence[Sight], period_s: float = 0.0, beside: IndexArray | None = None
) -> tuple[Nameless, ...]:
    """Try every law beside what a design explains.

    Parameters
    ----------
    design
        A campaign, linearised.
    sights
        Its runs.
    period_s
        The period at which a swing on the session's clock is looked for that is in all runs; 0 for none.
    beside
        The design's columns that take what they can; those of the nominal model unless given.

    Returns
    -------
    laws
        All of them, the best first.
    """
    predicted = [part.predicted for part in design.parts]
    columns = law_columns(sights, predicted, period_s)
    nuisances = design.of(Part.NOMINAL, Part.DETAIL) if beside is None else beside
    own = 1 + np.arange(nuisances.size)
    edges = 1 + own.size + np.cumsum([0, *(one[0].shape[1] for one in columns.values())])
    total = np.zeros((edges[-1] + len(predicted), edges[-1] + len(predicted)))
    for number, part in enumerate(design.parts):
        shared = (part.residual, part.columns[:, nuisances], *(one[number] for one in columns.values()))
        white = part.whitening.whole(np.column_stack((*shared, GAIN_SD * predicted[number])))
        rows = np.append(np.arange(edges[-1]), edges[-1] + number)
        total[np.ix_(rows, rows)] += white.T @ white
    left = taken_out(design, total, nuisances, np.arange(edges[0], len(total)), own)
    widths = np.concatenate([one.coordinates.width_s for one in sights])

    def law(name: str, low: int, high: int) -> Nameless:
        taken, values = _fitted(left, slice(low - own.size, high - own.size))
        if name == GAIN:
            more = [GAIN_SD * value * force for value, force in zip(values.tolist(), predicted, strict=True)]
        else:
            more = [one @ values for one in columns[name]]
        return Nameless(name, float(left[0, 0]) - taken, rms_where_acting(np.concatenate(more), widths))

    ends = [*edges.tolist(), len(total)]
    found = [law(name, *each) for name, each in zip((*columns, GAIN), pairwise(ends), strict=True)]
    return tuple(sorted(found, key=lambda one: one.squares))


def _fitted(left: FloatArray, rows: slice) -> tuple[float, FloatArray]:
    """Return squares that columns in units of their priors take away, less what their number costs, and their values.

    Both together are twice the logarithm of the evidence for them.
    """
    gram, along = left[rows, rows], left[rows, 0]
    whole = gram + np.eye(gram.shape[0])
    values = np.asarray(np.linalg.solve(whole, along), dtype=np.float64)
    return float(along @ values) - float(np.linalg.slogdet(whole)[1]), values
