"""A trace as means over blocks of time: short where the prediction changes fast, long where it does not."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.rig.arrays import FloatArray

GROWTH = 0.1
"""Width of a block over the time since the last event."""
LONGEST_S = 0.25
LONGEST_SHARE = 0.01
"""In records of minutes a block may be longer, by this share of the time since the last event."""
GAUSS = (0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0))
"""Where in a block the prediction is taken, to make its mean."""


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Means of a channel over `B` blocks.

    Attributes
    ----------
    start_s, end_s
        Begin and end of each block, half a sample beyond its first and last one.
    samples
        Valid samples in each.
    mean
        Their mean.
    """

    start_s: FloatArray
    end_s: FloatArray
    samples: FloatArray
    mean: FloatArray

    @property
    def nodes_s(self) -> FloatArray:
        """Times at which a prediction is to be evaluated, two in each block, rising, shape `(2 B,)`."""
        width = self.end_s - self.start_s
        return np.stack([self.start_s + share * width for share in GAUSS], axis=1).ravel()

    def of(self, predicted: FloatArray) -> FloatArray:
        """Return block means of what was predicted at `nodes_s`, shape `(…, 2 B)` to `(…, B)`."""
        shape = (*predicted.shape[:-1], predicted.shape[-1] // len(GAUSS), len(GAUSS))
        return np.asarray(predicted.reshape(shape).mean(axis=-1))


def divide(experiment: Experiment, channel: str, events_s: FloatArray) -> Blocks:
    """Average a channel over blocks that are one sample short after each event and grow from there."""
    time = experiment.time_s
    step = 1.0 / experiment.run.trace.sample_rate_hz
    starts = np.searchsorted(time, _edges(events_s, float(time[-1]), step) - 0.5 * step)
    starts = np.unique(np.minimum(starts, len(time) - 1))
    values = np.asarray(experiment.run.trace.channels[channel], dtype=np.float64)
    valid = experiment.valid & np.isfinite(values)
    count = np.add.reduceat(valid.astype(np.float64), starts)
    total = np.add.reduceat(np.where(valid, values, 0.0), starts)
    last = np.append(starts[1:], len(time)) - 1
    kept = count > 0
    return Blocks(
        start_s=np.maximum(time[starts] - 0.5 * step, 0.0)[kept],
        end_s=np.minimum(time[last] + 0.5 * step, float(time[-1]))[kept],
        samples=count[kept],
        mean=total[kept] / count[kept],
    )


def _edges(events_s: FloatArray, end_s: float, step_s: float) -> FloatArray:
    inside = events_s[(events_s > 0) & (events_s < end_s)]
    # The motion is known to a sample or so; a block must not reach across its event.
    begins = np.unique(np.concatenate(([0.0], np.maximum(inside - step_s, 0.0), [end_s])))
    pieces = [_graded(begin, end, step_s) for begin, end in pairwise(begins.tolist())]
    return np.unique(np.concatenate(pieces))


def _graded(begin_s: float, end_s: float, step_s: float) -> FloatArray:
    edges = [begin_s]
    while edges[-1] < end_s:
        since = edges[-1] - begin_s
        edges.append(edges[-1] + min(max(GROWTH * since, step_s), max(LONGEST_S, LONGEST_SHARE * since)))
    return np.array(edges[:-1])
