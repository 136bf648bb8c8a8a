"""Scaling of volts and counts to forces, positions and further quantities, and detection of sensor overload."""

from collections.abc import Mapping
from dataclasses import dataclass

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

    def sensor_fault(self, volts: FloatArray) -> Trip | None:
        """Return the overload or wire break that the force input's voltages, shape `(n,)`, show; None when fine."""
        largest_V = max(float(volts.max()), -float(volts.min()))
        if largest_V < self.force.overload_V:
            return None
        where = f"force input {self.force.channel} is at {largest_V:.2f} V"
        if largest_V < self.force.open_V:
            return Trip(TripCause.SENSOR_OVERLOAD, f"{where}: the force sensor is overloaded")
        return Trip(
            TripCause.SENSOR_OPEN, f"{where}, the amplifier's rail: the force sensor is unplugged or a wire is broken"
        )


def _scale_linearly(volts: FloatArray, gain: float, zero: float) -> npt.NDArray[np.float32]:
    scaled = volts * gain
    scaled += zero
    return scaled.astype(np.float32)
