"""Hysteresis that does not depend on rate, from one turning point of the input to the next."""

from collections.abc import Iterator

import numpy as np

from dragrig.sim_backend.blind.motion import Floats


def play(values: Floats, half: float) -> Floats:
    """Return the output of a play of half-width `half`: it follows only once the gap is taken up."""
    out = np.empty_like(values)
    last = float(values[0])
    for piece, way in _pieces(values):
        follows = values[piece] - way * half
        out[piece] = np.maximum(last, follows) if way > 0 else np.minimum(last, follows)
        last = float(out[piece][-1])
    return out


def dahl(values: Floats, width: float) -> Floats:
    """Return a state within −1 to 1 that approaches the sign of the input's motion over `width` of the input."""
    state = np.empty_like(values)
    last = 0.0
    for piece, way in _pieces(values):
        passed = np.abs(values[piece] - values[max(piece.start - 1, 0)])
        state[piece] = way - (way - last) * np.exp(-passed / width)
        last = float(state[piece][-1])
    return state


def _pieces(values: Floats) -> Iterator[tuple[slice, int]]:
    """Give the stretches in which the input goes one way, and which way."""
    ways = np.sign(np.diff(values, prepend=values[0]))
    moved = np.flatnonzero(ways)
    if not moved.size:
        yield slice(0, values.size), 1
        return
    filled = ways[moved[np.clip(np.searchsorted(moved, np.arange(values.size), side="right") - 1, 0, None)]]
    starts = np.concatenate([[0], np.flatnonzero(np.diff(filled)) + 1, [values.size]])
    for start, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        yield slice(start, end), int(filled[start])
