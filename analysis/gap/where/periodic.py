"""Sines of one period for all runs, in position or in time, with an amplitude and a phase for each run."""

from collections.abc import Sequence

import numpy as np

from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.rig.profile import Phase

WAVENUMBERS_PER_MM = np.geomspace(1 / 20, 1.0, 120)
FREQUENCIES_HZ = np.geomspace(1 / 30, 3.0, 120)
FINER, MOST = 0.4, 200
"""Beyond these, wave numbers lie so many waves over the longest run apart, and are so many at most."""
SHARPER = 41
"""So many rates about the best one are tried to tell it exactly."""
FEWEST = 8
"""Least blocks for a sine."""

PERIODS = 2.0
"""Fewest periods of a sine that a run must hold to have a say on it."""


def periodic_share(blocks: Sequence[ResidualBlocks]) -> tuple[float, float]:
    """Return which part of all squares the best sine accounts for, in position and in time."""
    in_position, in_time = periodic_shares(blocks)
    return float(in_position.max()), float(in_time.max())


def wavenumbers(blocks: Sequence[ResidualBlocks]) -> FloatArray:
    """Return the wave numbers per mm that are tried: the usual ones, and shorter waves as far as blocks show them."""
    steady = [np.abs(one.position_mm[one.phase == Phase.STEADY]) for one in blocks]
    steady = [one for one in steady if one.size >= FEWEST and np.ptp(one) > 0]
    if not steady:
        return WAVENUMBERS_PER_MM
    shortest = float(np.median([np.median(np.diff(np.sort(one))) for one in steady]))
    step = FINER / max(float(np.ptp(one)) for one in steady)
    last = float(WAVENUMBERS_PER_MM[-1])
    highest = min(0.5 / max(shortest, 1e-9), last + MOST * step)
    return np.concatenate((WAVENUMBERS_PER_MM, np.arange(last + step, highest, step)))


def periodic_shares(blocks: Sequence[ResidualBlocks]) -> tuple[FloatArray, FloatArray]:
    """Return that part for a sine of each of `wavenumbers` in position, and of `FREQUENCIES_HZ` in time."""
    total = sum(float((one.weight * one.deviation**2).sum()) for one in blocks)
    waves = wavenumbers(blocks)
    in_position, in_time = np.zeros(waves.size), np.zeros(FREQUENCIES_HZ.size)
    if total <= 0:
        return in_position, in_time
    for one in blocks:
        steady, begun = one.phase == Phase.STEADY, one.phase != Phase.REST
        in_position += _power(one, np.abs(one.position_mm), steady, waves)
        in_time += _power(one, one.time_s, begun, FREQUENCIES_HZ)
    return in_position / total, in_time / total


def best_wave(blocks: Sequence[ResidualBlocks]) -> float:
    """Return the wave number per mm of which a sine accounts for most, told as exactly as runs tell it."""
    waves, found = wavenumbers(blocks), periodic_shares(blocks)[0]
    at = int(found.argmax())
    low, high = waves[max(at - 1, 0)], waves[min(at + 1, waves.size - 1)]
    near = np.linspace(low, high, SHARPER)
    moving = [(one, one.phase == Phase.STEADY) for one in blocks]
    taken = np.sum([_power(one, np.abs(one.position_mm), steady, near) for one, steady in moving], axis=0)
    return float(near[int(taken.argmax())])


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
