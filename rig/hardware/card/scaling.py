"""Scaling of volts and counts to forces, positions and further quantities, and what volts show of the force sensor."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan, sqrt

import numpy as np
import numpy.typing as npt

from dragrig.config import AnalogInputSettings, Calibration, ForceInputSettings, RigSettings
from dragrig.rig import AnyFloatArray, FloatArray, RecordedChannel, Trip, TripCause, read_only


@dataclass(frozen=True, slots=True)
class Scaling:
    """The rig's scales: the latest calibrations where there are any, else the settings."""

    mN_per_V: float
    zero_mN: float
    """`mN_per_V`, `zero_mN`: the force is `mN_per_V` times the voltage plus `zero_mN`."""
    mm_per_count: float
    """Signed: negative where the encoder is mounted the other way round."""
    force: ForceInputSettings
    inputs: tuple[AnalogInputSettings, ...]

    @classmethod
    def from_settings(cls, rig: RigSettings, calibrations: Mapping[str, Calibration]) -> "Scaling":
        """Return the scales of the settings, overridden by the calibrations in force (keys force, encoder)."""
        card = rig.hardware.card
        force, encoder = calibrations.get("force"), calibrations.get("encoder")
        mm = rig.encoder.resolution_um / 1000.0 if encoder is None else encoder.gain
        return cls(
            mN_per_V=card.force.per_V if force is None else force.gain,
            zero_mN=-card.force.per_V * card.force.zero_V if force is None else force.zero,
            mm_per_count=-mm if card.encoder.reversed else mm,
            force=card.force,
            inputs=card.inputs,
        )

    @property
    def channels(self) -> tuple[RecordedChannel, ...]:
        """Force, position, then the further inputs in the settings' order."""
        return (
            RecordedChannel("force", "mN"),
            RecordedChannel("position", "mm"),
            *(RecordedChannel(channel.name, channel.unit) for channel in self.inputs),
        )

    @property
    def force_range_mN(self) -> tuple[float, float]:
        """Forces at the two ends of the input's range, in the single precision of the recorded force."""
        at_rails = np.array([-self.force.range_V, self.force.range_V]) * self.mN_per_V + self.zero_mN
        low, high = np.sort(at_rails).astype(np.float32)
        return float(low), float(high)

    def scale(self, volts: FloatArray, counts: FloatArray, origin: float) -> Mapping[str, AnyFloatArray]:
        """Return a block's channels, read-only.

        Parameters
        ----------
        volts
            Shape `(1 + inputs, n)`, force first.
        counts, origin
            Counts, shape `(n,)`, and the count of position 0.
        """
        channels: dict[str, AnyFloatArray] = {
            "force": _scale_linearly(volts[0], self.mN_per_V, self.zero_mN),
            "position": (counts - origin) * self.mm_per_count,
        }
        for channel, row in zip(self.inputs, volts[1:], strict=True):
            channels[channel.name] = _scale_linearly(row, channel.per_V, -channel.per_V * channel.zero_V)
        for array in channels.values():
            read_only(array)
        return channels


_WINDOW_S = 0.1
_MIN_WINDOW_SAMPLES = 50
_CONVERTER_NOISE_STEPS = 0.8
"""The converter's own noise (standard deviation) in its steps, in every range (PCI-6229 specifications)."""
_DEAD_SHARE = 0.5
"""Share of the converter's own noise below which an input is no living one."""


def least_noise_V(rig: RigSettings) -> float:
    """Return the noise from sample to sample below which the force input counts as dead [V]."""
    force = rig.hardware.card.force
    step_V = 2 * force.range_V / 2**rig.force_sensor.bits
    return 1e-6 * force.least_noise_uV or _DEAD_SHARE * _CONVERTER_NOISE_STEPS * step_V


class ForceInputMonitor:
    """Judges the force sensor by its input's volts, unfiltered: overloaded, unplugged or dead. Belongs to one thread.

    A sensor that lives has noise, at rest too; an input that repeats itself is cut off, frozen, or stuck at a rail.
    Noise is the standard deviation from sample to sample, so that no force hides its absence.
    """

    def __init__(self, rig: RigSettings, rate_hz: float) -> None:
        self._force = rig.hardware.card.force
        self._least_noise_V = least_noise_V(rig)
        self._window = max(round(_WINDOW_S * rate_hz), _MIN_WINDOW_SAMPLES)
        self._duration_s = self._window / rate_hz
        self._previous: FloatArray = np.zeros(0)
        self._steps = 0
        self._sum_V2 = 0.0
        self.noise_V = nan
        """The noise over the last whole window; NaN before the first."""

    def add(self, volts: FloatArray) -> Trip | None:
        """Take the next volts, shape `(n,)`; return what is wrong with the sensor, None when nothing is."""
        if not len(volts):
            return None
        trip = self._level_fault(max(float(volts.max()), -float(volts.min())))
        steps = np.diff(volts, prepend=self._previous)
        self._previous = volts[-1:].copy()
        # Not with @: from 10,000 samples on, BLAS would spread the sum over threads that spin.
        self._sum_V2 += float(np.einsum("i,i", steps, steps))
        self._steps += len(steps)
        if self._steps < self._window:
            return trip
        self.noise_V = sqrt(self._sum_V2 / self._steps / 2)
        self._steps, self._sum_V2 = 0, 0.0
        return trip or self._noise_fault(float(volts[-1]))

    def _level_fault(self, largest_V: float) -> Trip | None:
        if largest_V < self._force.overload_V:
            return None
        where = f"force input {self._force.channel} is at {largest_V:.2f} V"
        if largest_V < self._force.open_V:
            return Trip(TripCause.SENSOR_OVERLOAD, f"{where}: the force sensor is overloaded")
        return Trip(
            TripCause.SENSOR_OPEN, f"{where}, the end of its range: the force sensor is unplugged or a wire is broken"
        )

    def _noise_fault(self, volts_V: float) -> Trip | None:
        if self.noise_V >= self._least_noise_V:
            return None
        return Trip(
            TripCause.SENSOR_DEAD,
            f"force input {self._force.channel} shows {1e6 * self.noise_V:.0f} µV of noise at {volts_V:.3f} V, and a "
            f"living sensor at least {1e6 * self._least_noise_V:.0f} µV (hardware.card.force.least_noise_uV): the "
            "sensor's amplifier is off or saturated, or its cable is pulled",
        )


def _scale_linearly(volts: FloatArray, gain: float, zero: float) -> npt.NDArray[np.float32]:
    scaled = volts * gain
    scaled += zero
    return scaled.astype(np.float32)
