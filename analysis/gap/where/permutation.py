"""Whether the excess lies where it does by chance: whole runs permuted, with the largest statistic over all bins.

Runs are what repeats; blocks of one run are not independent. Energies have long tails, so that their square roots, with
sign, are compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dragrig.analysis.gap.where.axes import Against, Axis, IndexArray
from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.rig.arrays import FloatArray

PERMUTATIONS = 999


@dataclass(frozen=True, slots=True, eq=False)
class Significance:
    """Familywise p-values of windows of neighbouring bins, or of single bins where they have no order.

    Attributes
    ----------
    windows
        First and last bin of each window, shape `(K, 2)`.
    p
        Chance of a statistic as large anywhere on the axis without a gap, shape `(K,)`.
    """

    windows: npt.NDArray[np.intp]
    p: FloatArray

    def of(self, first: int, last: int) -> float:
        """Return the p-value of a window; 1 for the whole axis, which nothing stands out from."""
        found = np.flatnonzero((self.windows == (first, last)).all(axis=1))
        return float(self.p[found[0]]) if found.size else 1.0

    @property
    def least(self) -> float:
        """The smallest of them, which is the axis' own."""
        return float(self.p.min(initial=1.0))


def significance(axis: Axis, stratum: IndexArray, generator: np.random.Generator) -> Significance:
    """Test all windows of an axis.

    Between runs, their excess is permuted among runs of one kind (of all kinds, for the protocol): it stands out where
    it belongs to the bin. Within runs, the sign of what a window has more than the rest of its run, and more than is
    expected, is flipped run by run. Less than expected is no excess, whatever stands out in it.
    """
    windows = _windows(axis)
    if not windows.size:
        return Significance(windows, np.zeros(0))
    bins = np.arange(axis.energy.shape[1])[:, None]
    inside = ((bins >= windows[:, 0]) & (bins <= windows[:, 1])).astype(np.float64)
    if axis.against is Against.RUNS:
        kinds = np.zeros_like(stratum) if axis.name == "protocol" else stratum
        statistic = _permuted(axis, inside, kinds, generator)
    else:
        statistic = _flipped(axis, inside, generator)
    above = (axis.energy.sum(axis=0) @ inside) > 0
    return Significance(windows, np.where(above, _familywise(statistic), 1.0))


def overall(energy: FloatArray, generator: np.random.Generator) -> float:
    """Return the p-value of an excess in all runs together, the sign of each run's flipped."""
    return float(_familywise(_signs(_amplitude(energy)[:, None], generator))[0])


def loudest(blocks: Sequence[ResidualBlocks]) -> float:
    """Return the p-value of the largest mean square of all, as if all blocks of a run were one: no test is milder.

    Permutations cannot tell few runs from chance, however large their excess.
    """
    from scipy.special import chdtrc

    largest = max(1 + float(one.excess.sum()) for one in blocks)
    return min(1.0, len(blocks) * float(chdtrc(1, largest)))


def _windows(axis: Axis) -> IndexArray:
    """Return windows that leave something outside; bins of no run are none."""
    count = axis.energy.shape[1]
    if not axis.ordered:
        used = np.flatnonzero(axis.time.any(axis=0))
        return np.stack((used, used), axis=1) if used.size > 1 else np.zeros((0, 2), dtype=np.intp)
    first, last = np.triu_indices(count)
    kept = last - first < count - 1
    return np.stack((first[kept], last[kept]), axis=1)


def _permuted(axis: Axis, inside: FloatArray, stratum: IndexArray, generator: np.random.Generator) -> FloatArray:
    """Return standardised sums over each window, shape `(1 + PERMUTATIONS, K)`, the first as found."""
    part = axis.time.sum(axis=1) > 0
    member = (axis.time @ inside)[part]
    amplitude = _amplitude(axis.energy.sum(axis=1))[part]
    kinds = np.unique(stratum[part], return_inverse=True)[1]
    if not kinds.size:
        return np.zeros((1 + PERMUTATIONS, inside.shape[1]))
    centred = amplitude - (np.bincount(kinds, amplitude) / np.bincount(kinds))[kinds]
    order = np.argsort(kinds + generator.random((PERMUTATIONS, kinds.size)), axis=1)
    sums = np.vstack((centred, centred[order])) @ member
    spread = sums[1:].std(axis=0)
    return np.asarray(np.divide(sums, spread, out=np.zeros_like(sums), where=spread > 1e-9))


def _flipped(axis: Axis, inside: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Return statistics of what each window has more than the rest of its run, shape `(1 + PERMUTATIONS, K)`."""
    time, energy = axis.time @ inside, axis.energy @ inside
    if axis.against is Against.NOISE:
        return _signs(_amplitude(energy), generator)
    rest_time, rest_energy = axis.time @ (1 - inside), axis.energy @ (1 - inside)
    both = (time > 0) & (rest_time > 0)
    safe = np.where(both, time, 1.0), np.where(both, rest_time, 1.0)
    more = _amplitude(energy / safe[0]) - np.maximum(_amplitude(rest_energy / safe[1]), 0.0)
    return _signs(np.where(both, more, 0.0), generator)


def _signs(values: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Return sums over runs over the root of their squares, as found and under random signs of the runs."""
    signs = np.where(generator.random((PERMUTATIONS, values.shape[0])) < 0.5, -1.0, 1.0)
    scale = np.sqrt((values**2).sum(axis=0))
    sums = np.vstack((values.sum(axis=0), signs @ values))
    return np.asarray(np.divide(sums, scale, out=np.zeros_like(sums), where=scale > 0))


def _familywise(statistic: FloatArray) -> FloatArray:
    found, largest = statistic[0], statistic[1:].max(axis=1)
    at_least = (largest[:, None] >= found - 1e-12).sum(axis=0)
    return np.asarray((1 + at_least) / (1 + largest.size))


def _amplitude(energy: FloatArray) -> FloatArray:
    return np.asarray(np.sign(energy) * np.sqrt(np.abs(energy)))
