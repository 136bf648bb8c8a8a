"""Scaling of volts and counts to forces, positions and further quantities, and the sensor's state by its volts."""

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


_BIN_S = 1e-3
"""The sensor's noise is judged in means over this time, which leave little of the converter's own."""
_LEVEL_WINDOW_BINS = 100
_REPEAT_WINDOW_S = 0.02
_MIN_WINDOW_SAMPLES = 100
"""Fewer would now and then look quiet by chance."""
_CONVERTER_NOISE_STEPS = 0.8
"""The converter's own noise (standard deviation) in its steps, in every range (PCI-6229 specifications)."""
_REPEAT_SHARE = 0.5
"""Share of the converter's own noise below which an input only repeats itself."""
_MIN_LIVE_RATIO = 4.0
"""A sensor whose noise is less above the converter's own cannot be told from a dead one by it."""


class NoiseLimits:
    """How little noise of the force input says that its sensor is dead.

    Parameters
    ----------
    alive_uV
        Noise with the sensor alive, from the calibration in force; 0 where it is not known.
    rate_hz
        Samples per second that the card takes of the input.
    """

    def __init__(self, rig: RigSettings, alive_uV: float, rate_hz: float) -> None:
        force = rig.hardware.card.force
        converter_V = _CONVERTER_NOISE_STEPS * 2 * force.range_V / 2**rig.force_sensor.bits
        self.bin_samples = max(int(_BIN_S * rate_hz + 1e-6), 1)
        """Samples in a mean."""
        self.converter_V = converter_V / sqrt(self.bin_samples)
        """The converter's own noise in the means."""
        self.least_sample_V = _REPEAT_SHARE * converter_V
        """Noise from sample to sample below which the input repeats itself."""
        self.least_V = 1e-6 * force.least_noise_uV
        """Noise of the means below which the sensor is dead; 0 where that is not known."""
        if not self.least_V and 1e-6 * alive_uV >= _MIN_LIVE_RATIO * self.converter_V:
            self.least_V = sqrt(1e-6 * alive_uV * self.converter_V)


class ForceInputMonitor:
    """Judges the force sensor by its input's volts, unfiltered: overloaded, unplugged or dead. Belongs to one thread.

    An input that repeats itself is frozen, or stuck at a value of the converter: nothing alive does that. A sensor that
    lives has noise of its own, at rest too; an amplifier that is off or saturated shows only the converter's. Noise is
    the standard deviation from a value to the next, so that no force hides its absence.
    """

    def __init__(self, rig: RigSettings, limits: NoiseLimits, rate_hz: float) -> None:
        self._force, self._limits = rig.hardware.card.force, limits
        self._samples = _NoiseWindow(max(round(_REPEAT_WINDOW_S * rate_hz), _MIN_WINDOW_SAMPLES))
        self._means = _NoiseWindow(_LEVEL_WINDOW_BINS)
        self._unbinned: FloatArray = np.zeros(0)

    @property
    def noise_V(self) -> float:
        """Noise of the means over 1 ms, over the last whole window; NaN before the first."""
        return self._means.noise

    def add(self, volts: FloatArray) -> Trip | None:
        """Take the next volts, shape `(n,)`; return the sensor's fault, None where there is none."""
        if not len(volts):
            return None
        limits, last_V = self._limits, float(volts[-1])
        trip = self._level_fault(max(float(volts.max()), -float(volts.min())))
        if self._samples.add(volts) and self._samples.noise < limits.least_sample_V:
            trip = trip or self._dead(f"repeats {last_V:.3f} V, without even the converter's own noise")
        if self._means.add(self._binned(volts)) and self._means.noise < limits.least_V:
            trip = trip or self._dead(
                f"shows {1e6 * self._means.noise:.0f} µV of noise at {last_V:.3f} V, and a living sensor at least "
                f"{1e6 * limits.least_V:.0f} (hardware.card.force.least_noise_uV)"
            )
        return trip

    def _binned(self, volts: FloatArray) -> FloatArray:
        """Return the means that the next volts complete."""
        size = self._limits.bin_samples
        if size == 1:
            return volts
        joined = np.concatenate((self._unbinned, volts))
        whole = len(joined) // size * size
        self._unbinned = joined[whole:]
        return np.asarray(joined[:whole].reshape(-1, size).mean(axis=1))

    def _dead(self, seen: str) -> Trip:
        return Trip(
            TripCause.SENSOR_DEAD,
            f"force input {self._force.channel} {seen}: the sensor's amplifier is off or saturated, or its cable is "
            "pulled",
        )

    def _level_fault(self, largest_V: float) -> Trip | None:
        if largest_V < self._force.overload_V:
            return None
        where = f"force input {self._force.channel} is at {largest_V:.2f} V"
        if largest_V < self._force.open_V:
            return Trip(TripCause.SENSOR_OVERLOAD, f"{where}: the force sensor is overloaded")
        return Trip(
            TripCause.SENSOR_OPEN, f"{where}, the end of its range: the force sensor is unplugged or a wire is broken"
        )


class _NoiseWindow:
    """Noise from value to value, over windows of at least so many steps one after another."""

    def __init__(self, steps: int) -> None:
        self._window, self._steps, self._sum = steps, 0, 0.0
        self._previous: FloatArray = np.zeros(0)
        self.noise = nan

    def add(self, values: FloatArray) -> bool:
        """Take the next values; return whether they complete a window."""
        if not len(values):
            return False
        steps = np.diff(values, prepend=self._previous)
        self._previous = values[-1:].copy()
        # Not with @: from 10,000 samples on, BLAS would spread the sum over threads that spin.
        self._sum += float(np.einsum("i,i", steps, steps))
        self._steps += len(steps)
        if self._steps < self._window:
            return False
        self.noise = sqrt(self._sum / self._steps / 2)
        self._steps, self._sum = 0, 0.0
        return True


def _scale_linearly(volts: FloatArray, gain: float, zero: float) -> npt.NDArray[np.float32]:
    scaled = volts * gain
    scaled += zero
    return scaled.astype(np.float32)
