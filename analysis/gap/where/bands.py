"""Mean squares of a signal by frequency."""

from typing import Final

import numpy as np

from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase

BANDS_HZ: Final = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Edges of the bands; the constant part belongs to none."""

FEWEST = 4


def band_powers(signal: FloatArray, rate_hz: float) -> FloatArray:
    """Return the mean square of an even signal in each band, its mean taken off, shape `(n,)` to `(bands,)`.

    All bands together have the signal's variance, but for what lies above the last edge.
    """
    spectrum = np.abs(np.fft.rfft(signal - signal.mean())) ** 2 / signal.size**2
    spectrum[1:] *= 2.0
    if signal.size % 2 == 0:
        spectrum[-1] /= 2.0
    frequency = np.fft.rfftfreq(signal.size, 1 / rate_hz)
    return np.asarray(np.histogram(frequency[1:], BANDS_HZ, weights=spectrum[1:])[0])


def band_excess(blocks: ResidualBlocks) -> FloatArray:
    """Return the excess of the steady phase by band, as a part of the run's expected mean square, shape `(bands,)`.

    Without the trace's own powers the blocks are read as a staircase at their usual width, with white noise.
    """
    steady = blocks.phase == Phase.STEADY
    nothing = np.zeros(len(BANDS_HZ) - 1)
    if not steady.any():
        return nothing
    share = float(blocks.weight[steady].sum())
    if blocks.bands is not None:
        expected = float(np.average(blocks.noise_sd[steady] ** 2, weights=blocks.width_s[steady]))
        return np.asarray(share * (blocks.bands.shown - blocks.bands.expected) / expected)
    step = float(np.median(blocks.width_s[steady]))
    time, value = blocks.time_s[steady], blocks.deviation[steady]
    count = int((time[-1] - time[0]) / step + 1e-6) + 1
    if count < FEWEST:
        return nothing
    grid = time[0] + step * np.arange(count)
    nearest = np.clip(np.searchsorted(0.5 * (time[1:] + time[:-1]), grid), 0, time.size - 1)
    lines = np.histogram(np.fft.rfftfreq(count, step)[1:], BANDS_HZ)[0]
    return np.asarray(share * (band_powers(value[nearest], 1 / step) - lines / max(int(lines.sum()), 1)))
