"""Samples of a relaxation in adaptive block means: single ones where the motion bends, ever longer ones after."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.rig.arrays import FloatArray

IndexArray = npt.NDArray[np.intp]

GROWTH = 0.07
"""Length of a block as a share of the time since the last bend of the motion."""
MOST_BLOCKS = 900
REST_BLOCKS = 12
NODES = 8
"""Times per block at which the model is evaluated and averaged; a block of fewer samples has one per sample."""
LEAST_WAY_MM = 0.01
"""A shorter way between rests is an encoder that wavers, and no motion."""


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Means over `n` blocks of valid samples.

    Attributes
    ----------
    begin_s, end_s
        Time that each covers, the samples' own width included, shape `(n,)`.
    samples
        Valid samples in each.
    force_mN
        Their mean.
    nodes_s, first_node
        Times at which a model is evaluated, shape `(M,)`, and where those of each block begin, `(n,)`.
    """

    begin_s: FloatArray
    end_s: FloatArray
    samples: FloatArray
    force_mN: FloatArray
    nodes_s: FloatArray
    first_node: IndexArray

    @property
    def middle_s(self) -> FloatArray:
        """Middle of each block."""
        return 0.5 * (self.begin_s + self.end_s)

    def mean(self, at_nodes: FloatArray) -> FloatArray:
        """Average over each block what was evaluated at the nodes, shape `(…, M)`, to `(…, n)`."""
        count = np.diff(np.append(self.first_node, self.nodes_s.size))
        return np.asarray(np.add.reduceat(at_nodes, self.first_node, axis=-1) / count)


def bends(experiment: Experiment) -> FloatArray:
    """Return when the motion begins, bends and ends; empty where it does not move."""
    motion = experiment.motion
    ways = np.abs(np.diff(motion.position(motion.breaks_s)))
    moving = np.flatnonzero((motion.signs != 0) & (ways >= LEAST_WAY_MM))
    return np.unique(motion.breaks_s[np.concatenate((moving, moving + 1))])


def divide(experiment: Experiment, bends_s: FloatArray) -> Blocks:
    """Average the valid samples of a run between the bends of its motion."""
    time = experiment.time_s
    valid = np.flatnonzero(experiment.valid)
    at_bends = np.searchsorted(time, bends_s)
    growth = GROWTH
    while (edges := _edges(at_bends, time.size, growth)).size > MOST_BLOCKS:
        growth *= 1.3
    starts = np.searchsorted(valid, edges)
    starts = starts[:-1][np.diff(starts) > 0]
    stops = np.append(starts[1:], valid.size)
    force = np.asarray(experiment.run.trace.force, dtype=np.float64)[valid]
    samples = np.diff(np.append(starts, valid.size)).astype(float)
    half = 0.5 / experiment.run.trace.sample_rate_hz
    nodes = [_nodes(start, stop) for start, stop in zip(starts.tolist(), stops.tolist(), strict=True)]
    first_node = np.cumsum([0, *(one.size for one in nodes[:-1])])
    return Blocks(
        begin_s=time[valid[starts]] - half,
        end_s=time[valid[stops - 1]] + half,
        samples=samples,
        force_mN=np.add.reduceat(force, starts) / samples,
        nodes_s=time[valid[np.concatenate(nodes)]],
        first_node=first_node,
    )


def _edges(bends: IndexArray, samples: int, growth: float) -> IndexArray:
    edges = [np.linspace(0, bends[0], REST_BLOCKS + 1).astype(np.intp)]
    for begin, end in zip(bends.tolist(), [*bends[1:].tolist(), samples], strict=True):
        steps, at = [], 0
        while begin + at < end:
            steps.append(begin + at)
            at += max(1, int(growth * at))
        edges.append(np.array(steps, dtype=np.intp))
    return np.unique(np.concatenate((*edges, [samples])))


def _nodes(start: int, stop: int) -> IndexArray:
    """Return indices spread evenly over a block, each in the middle of its share."""
    count = min(stop - start, NODES)
    return np.asarray(start + ((np.arange(count) + 0.5) * (stop - start) / count).astype(np.intp))
