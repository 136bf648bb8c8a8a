"""A stretch of samples gathered whole, for measurements between acquisitions."""

import time
from collections.abc import Callable

import numpy as np

from dragrig.config.hardware import CardSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.hardware.card.faults import silent
from dragrig.rig.hardware.card.fetching import Fetcher


def gather(
    fetcher: Fetcher, samples: int, block_samples: int, stale_s: float, card: CardSettings, fed: Callable[[], None]
) -> tuple[FloatArray, FloatArray]:
    """Return the force's volts and the encoder's counts of the next samples, shape `(samples,)` each.

    Raises
    ------
    StaleDataError
        When nothing arrives for longer than `stale_s`, in the wall's time.
    """
    volts, counts = np.empty(samples), np.empty(samples)
    heard_s = time.monotonic()
    have = 0
    while have < samples:
        fed()
        fetched = fetcher.fetch(min(block_samples, samples - have))
        if fetched.samples:
            heard_s = time.monotonic()
        elif time.monotonic() - heard_s > stale_s:
            raise silent(card, stale_s)
        end = have + fetched.samples
        volts[have:end], counts[have:end] = fetched.volts[0], fetched.counts
        have = end
    return volts, counts
