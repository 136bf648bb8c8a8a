"""Sines of one period for all runs, in position or in time, with an amplitude and a phase for each run."""

from collections.abc import Sequence

import numpy as np

from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.rig.profile import Phase

WAVENUMBERS_PER_MM = np.geomspace(1 / 20, 1.0, 120)
FREQUENCIES_HZ = np.geomspace(1 / 30, 3.0, 120)
FEWEST = 8
"""Least blocks for a sine."""

PERIODS = 2.0
"""Fewest periods of a sine that a run must hold to have a say on it."""


def periodic_share(blocks: Sequence[ResidualBlocks]) -> tuple[float, float]:
    """Return which part of all squares the best sine accounts for, in position and in time."""
    in_position, in_time = periodic_shares(blocks)
    return float(in_position.max()), float(in_time.max())


def periodic_shares(blocks: Sequence[ResidualBlocks]) -> tuple[FloatArray, FloatArray]:
    """Return that part for a sine of each of `WAVENUMBERS_PER_MM` in position, and of `FREQUENCIES_HZ` in time."""
    total = sum(float((one.weight * one.deviation**2).sum()) for one in blocks)
    in_position, in_time = np.zeros(WAVENUMBERS_PER_MM.size), np.zeros(FREQUENCIES_HZ.size)
    if total <= 0:
        return in_position, in_time
    for one in blocks:
        steady, begun = one.phase == Phase.STEADY, one.phase != Phase.REST
        in_position += _power(one, np.abs(one.position_mm), steady, WAVENUMBERS_PER_MM)
        in_time += _power(one, one.time_s, begun, FREQUENCIES_HZ)
    return in_position / total, in_time / total


def _power(one: ResidualBlocks, coordinate: FloatArray, inside: BoolArray, rates: FloatArray) -> FloatArray:
    """Return the squares that a sine of each rate accounts for, beyond a straight line, in a part of a run."""
    if np.count_nonzero(inside) < FEWEST:
        return np.zeros_like(rates)
    at, deviation, weight = coordinate[inside], one.deviation[inside], one.weight[inside]
    root = np.sqrt(weight)
    line = np.linalg.qr(np.stack((root, root * (at - at.mean())), axis=1))[0]
    left = root * deviation
    left = left - line @ (line.T @ left)
    wave = np.exp(-2j * np.pi * rates[:, None] * at) @ (root * left)
    share = 2 * np.abs(wave) ** 2 / weight.sum()
    widest = float(np.diff(np.sort(at)).max())
    allowed = (rates * np.ptp(at) >= PERIODS) & (rates * widest < 0.5)
    return np.where(allowed, np.minimum(share, float(left @ left)), 0.0)
