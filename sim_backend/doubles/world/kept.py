"""Samples that the bench keeps, in the pieces in which they were computed."""

from collections.abc import Mapping, Sequence

import numpy as np

from dragrig.rig.arrays import FloatArray

Chunk = tuple[int, Mapping[str, FloatArray]]
"""Index of its first sample, and the samples by quantity."""


def joined(chunks: Sequence[Chunk], first: int, end: int) -> Mapping[str, FloatArray]:
    """Return samples `first` to before `end`, shape `(end - first,)` each, of chunks that follow one another."""
    pieces: dict[str, list[FloatArray]] = {name: [] for name in chunks[0][1]}
    for begin, chunk in chunks:
        for name, values in chunk.items():
            here = values[max(first - begin, 0) : max(end - begin, 0)]
            if len(here):
                pieces[name].append(here)
    return {name: np.concatenate(parts) if parts else np.zeros(0) for name, parts in pieces.items()}
