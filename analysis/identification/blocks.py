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


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Means of a channel over `B` blocks.

    Attributes
    ----------
    start_s, end_s
        Begin and end of each block, half a sample beyond its first and last valid one.
    samples
        Valid samples in each.
    mean
        Their mean.
    nodes_s
        Times at which a prediction is to be evaluated, two in each block, rising, shape `(2 B,)`. They have the mean
        and the scatter of the times that the block covers.
    """

    start_s: FloatArray
    end_s: FloatArray
    samples: FloatArray
    mean: FloatArray
    nodes_s: FloatArray

    @property
    def middle_s(self) -> FloatArray:
        """Middle of each block."""
        return 0.5 * (self.start_s + self.end_s)

    def of(self, predicted: FloatArray) -> FloatArray:
        """Return block means of what was predicted at `nodes_s`, shape `(…, 2 B)` to `(…, B)`."""
        return np.asarray(0.5 * (predicted[..., ::2] + predicted[..., 1::2]))


def divide(experiment: Experiment, channel: str, events_s: FloatArray, *, jumps: bool) -> Blocks:
    """Average a channel over blocks that are one sample short after each event and grow from there.

    Parameters
    ----------
    jumps
        Whether parameters move a jump of the prediction in time. Each sample then covers the time up to its
        neighbours, so that the mean follows such a parameter gradually. Else it is an instant, which keeps the
        sharp peak of a relaxation.
    """
    values = np.asarray(experiment.run.trace.channels[channel], dtype=np.float64)
    usable = np.flatnonzero(experiment.valid & np.isfinite(values))
    time, values = experiment.time_s[usable], values[usable]
    step = 1.0 / experiment.run.trace.sample_rate_hz
    edges = _edges(events_s, float(experiment.time_s[-1]), step) - 0.5 * step
    starts = np.unique(np.searchsorted(time, edges))
    starts = starts[starts < time.size]
    samples = np.diff(np.append(starts, time.size))
    first, last = time[starts], time[starts + samples - 1]
    covered = step if jumps else 0.0
    mean_s = np.add.reduceat(time, starts) / samples
    square = np.add.reduceat((time - np.repeat(mean_s, samples)) ** 2, starts) / samples
    scatter = np.sqrt(square + covered**2 / 12)
    early = np.maximum(mean_s - scatter, np.maximum(first - 0.5 * covered, 0.0))
    late = np.minimum(mean_s + scatter, last + 0.5 * covered)
    return Blocks(
        start_s=np.maximum(first - 0.5 * step, 0.0),
        end_s=np.minimum(last + 0.5 * step, float(experiment.time_s[-1])),
        samples=samples.astype(np.float64),
        mean=np.add.reduceat(values, starts) / samples,
        nodes_s=np.stack((early, late), axis=1).ravel(),
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
