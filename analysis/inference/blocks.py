"""A trace as means over blocks of time: short where the prediction changes fast, long where it does not."""

from dataclasses import dataclass

import numpy as np

from dragrig.analysis.models.experiment import Experiment
from dragrig.rig.arrays import FloatArray

BLOCK_GROWTH = 0.1
"""Width of a block relative to the time since the last event."""
MAX_BLOCK_S = 0.25
MAX_BLOCK_SHARE = 0.01
"""In records of minutes a block may be longer: this share of the time since the last event."""

MAX_BLOCKS = 800
"""Work grows with the cube of the number of blocks. A motion of so many bends that there would be more has coarser
blocks after bends at which the stage does not start, stop or turn."""
COARSENING_FACTORS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)


@dataclass(frozen=True, slots=True, eq=False)
class BlockMeans:
    """Means of a channel over `B` blocks.

    Attributes
    ----------
    start_s, end_s
        Start and end of each block, half a sample beyond its first and last valid sample.
    samples
        Valid samples of each block.
    mean
        Their mean.
    nodes_s
        Times at which a prediction is to be evaluated, two in each block, rising, shape `(2 B,)`. They have the mean
        and the standard deviation of the times that the block covers.
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
        """Return block means of a prediction at `nodes_s`, shape `(…, 2 B)` to `(…, B)`."""
        return np.asarray(0.5 * (predicted[..., ::2] + predicted[..., 1::2]))


def average_in_blocks(
    experiment: Experiment, channel: str, events_s: FloatArray, *, jumps: bool, longest_mm: float = np.inf
) -> BlockMeans:
    """Average a channel over blocks of one sample after each event, which grow with the time since.

    Parameters
    ----------
    jumps
        Whether parameters move a jump of the prediction in time. Each sample then covers the time up to its
        neighbours, so that the mean follows such a parameter gradually. Otherwise it is an instant, which preserves
        the sharp peak of a relaxation.
    longest_mm
        Longest travel within a block, so that periodic functions of position show.
    """
    values = np.asarray(experiment.run.trace.channels[channel], dtype=np.float64)
    usable = np.flatnonzero(experiment.valid & np.isfinite(values))
    time, values = experiment.time_s[usable], values[usable]
    step = 1.0 / experiment.run.trace.sample_rate_hz
    edges = _block_edges(experiment, events_s, longest_mm, step) - 0.5 * step
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
    return BlockMeans(
        start_s=np.maximum(first - 0.5 * step, 0.0),
        end_s=np.minimum(last + 0.5 * step, float(experiment.time_s[-1])),
        samples=samples.astype(np.float64),
        mean=np.add.reduceat(values, starts) / samples,
        nodes_s=np.stack((early, late), axis=1).ravel(),
    )


def _block_edges(experiment: Experiment, events_s: FloatArray, longest_mm: float, step_s: float) -> FloatArray:
    """Edges of the blocks, coarser after mere bends of the motion if there would be too many."""
    end_s = float(experiment.time_s[-1])
    inside = events_s[(events_s > 0) & (events_s < end_s)]
    # The motion is known to a sample or so; a block must not reach across its event.
    starts = np.unique(np.concatenate(([0.0], np.maximum(inside - step_s, 0.0), [end_s])))
    longest_s = np.full(len(starts) - 1, np.inf)
    if np.isfinite(longest_mm):
        speed = np.abs(np.diff(experiment.position(starts))) / np.diff(starts)
        longest_s = longest_mm / np.maximum(speed, 1e-9)
    motion = experiment.motion
    turns = np.append(motion.breaks_s[1:-1][np.diff(motion.signs) != 0], starts[0])
    is_turn = np.abs(starts[:-1, None] - turns).min(axis=1) <= 1.5 * step_s
    edges = np.zeros(0)
    for factor in COARSENING_FACTORS:
        coarsening = np.where(is_turn, 1.0, factor)
        stretches = zip(starts[:-1].tolist(), starts[1:].tolist(), longest_s.tolist(), coarsening.tolist(), strict=True)
        edges = np.unique(np.concatenate([_graded_edges(*stretch, step_s) for stretch in stretches]))
        if len(edges) <= MAX_BLOCKS:
            break
    return edges


def _graded_edges(start_s: float, end_s: float, longest_s: float, coarsening: float, step_s: float) -> FloatArray:
    edges = [start_s]
    while edges[-1] < end_s:
        since = edges[-1] - start_s
        width = min(coarsening * max(BLOCK_GROWTH * since, step_s), max(MAX_BLOCK_S, MAX_BLOCK_SHARE * since))
        edges.append(edges[-1] + max(min(width, longest_s), step_s))
    return np.array(edges[:-1])
