"""Keeps the velocity's output a little ahead of what is put out: speeds from the follower, as voltages, to the card."""

import threading

import numpy as np

from dragrig.config.hardware import VelocityOutputSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Clock
from dragrig.rig.hardware.card.voltage import RANGE_V, UnderflowError, VoltageOutput
from dragrig.rig.hardware.drive.follower import Command, Follower

_LOOKS_PER_UPDATE = 4


class Feeder:
    """A follower and the output that it speaks through. Belongs to one thread at a time."""

    def __init__(
        self, output: VoltageOutput, follower: Follower, velocity: VelocityOutputSettings, clock: Clock
    ) -> None:
        self._output, self._follower, self._clock = output, follower, clock
        self._velocity = velocity
        self._ahead = velocity.ahead * velocity.update_samples
        self.error_mm = 0.0
        """How far the stage is behind its command, as seen last."""

    @property
    def written(self) -> int:
        """Samples of the present waveform that were written."""
        return self._output.written

    @property
    def generated(self) -> int:
        """Samples of the present waveform that were put out; raises what the output does."""
        return self._output.generated

    def begin(self, command: Command, trigger: str = "") -> None:
        """End the waveform where it is, at 0 V, and begin one that does `command`; see `VoltageOutput.begin`."""
        self._output.end()
        self._follower.begin()
        self._follower.follow(command)
        self.error_mm = 0.0
        self._output.begin(self._volts(self._ahead), trigger)

    def fill(self, generated: int) -> float:
        """Write what is due, and return how long nothing will be.

        Raises
        ------
        UnderflowError
            When it ran dry.
        DeviceError
            When the card refuses.
        """
        update = self._velocity.update_samples
        while self._output.written - generated <= self._ahead - update:
            self._output.write(self._volts(update))
        left = self._output.written - generated - self._ahead + update if generated else 0
        return max(left, update / _LOOKS_PER_UPDATE) / self._velocity.rate_hz

    def drain(self) -> None:
        """Brake, and end the waveform at 0 V."""
        self._follower.brake()
        while not self._follower.stands:
            self._wait(self.fill(self._output.generated))
        zero_from = self._output.written
        try:
            self._output.write(np.zeros(2 * self._ahead))
            while (left := zero_from + 1 - self._output.generated) > 0:
                self._wait(left / self._velocity.rate_hz)
        except UnderflowError:
            # It ran dry at 0 V, where it was to end.
            return
        finally:
            self._output.end()

    def zero(self) -> None:
        """Put out 0 V at once."""
        self._output.zero()

    def _volts(self, samples: int) -> FloatArray:
        speeds = self._follower.speeds(samples, self.error_mm)
        return np.ascontiguousarray(np.clip(speeds / self._velocity.per_V, -RANGE_V, RANGE_V))

    def _wait(self, duration_s: float) -> None:
        self._clock.sleep(duration_s, threading.Event())
