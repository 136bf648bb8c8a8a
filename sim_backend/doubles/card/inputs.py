"""Analog inputs: what the converter makes of the bench's volts."""

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.doubles.card import pci6229
from dragrig.sim_backend.doubles.card.channels import signal_of
from dragrig.sim_backend.doubles.card.tasks import Channel
from dragrig.sim_backend.doubles.card.wires import Bench


class AnalogSource:
    """Volts of analog inputs, as the converter tells them."""

    def __init__(self, bench: Bench, channels: list[Channel], rate_hz: float) -> None:
        self._bench = bench
        self._signals = [(signal_of(one, bench.rig.hardware.card), one.range_V) for one in channels]
        self._rate_hz = rate_hz

    @property
    def rate_hz(self) -> float:
        """Samples per second."""
        return self._rate_hz

    def total(self) -> int:
        """Return how many samples per channel were taken."""
        return self._bench.available()

    def fetch(self, first: int, end: int) -> list[FloatArray]:
        """Return volts of each channel; 0 where nothing is wired."""
        shown = self._bench.sample(first, end)
        return [
            pci6229.quantised(shown[signal], range_V) if signal is not None else np.zeros(end - first)
            for signal, range_V in self._signals
        ]
