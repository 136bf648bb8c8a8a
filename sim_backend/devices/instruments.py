"""What converters and encoder make of forces and positions, and what the motor must give."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dragrig.config.rig import EncoderSettings, ForceSensorSettings, MotorSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.devices.kinematics import Motion

BEARING_SPEED_MM_S = 0.05
"""Speed over which the Coulomb friction of the stage's bearing turns its sign."""

NEWTONS_PER_G_MM_S2 = 1e-3
"""Millinewtons that accelerate one gram by one mm/s²."""


@dataclass(frozen=True, slots=True)
class Converter:
    """A force sensor's converter: `2^bits` codes over both signs of the range."""

    step_mN: float
    lowest_code: int
    highest_code: int

    @classmethod
    def of(cls, settings: ForceSensorSettings) -> "Converter":
        """Return the converter that the settings name."""
        half = 2 ** (settings.bits - 1)
        return cls(step_mN=settings.range_mN / half, lowest_code=-half, highest_code=half - 1)

    @property
    def range_mN(self) -> tuple[float, float]:
        """Least and greatest force that can come out, as they come out: in single precision."""
        ends = np.array([self.lowest_code * self.step_mN, self.highest_code * self.step_mN], dtype=np.float32)
        return float(ends[0]), float(ends[1])

    def convert(self, force_mN: FloatArray) -> npt.NDArray[np.float32]:
        """Return the force in steps of the converter, clipped at its range; `force_mN` is used up."""
        force_mN /= self.step_mN
        np.rint(force_mN, out=force_mN)
        np.clip(force_mN, self.lowest_code, self.highest_code, out=force_mN)
        force_mN *= self.step_mN
        return force_mN.astype(np.float32)


@dataclass(frozen=True, slots=True)
class Encoder:
    """An incremental encoder that counts from the stage's origin."""

    counts_per_mm: float

    @classmethod
    def of(cls, settings: EncoderSettings) -> "Encoder":
        """Return the encoder that the settings name."""
        return cls(counts_per_mm=1000.0 / settings.resolution_um)

    def read(self, position_mm: float) -> float:
        """Return an absolute position as the encoder shows it."""
        return round(position_mm * self.counts_per_mm) / self.counts_per_mm

    def record(self, position_mm: FloatArray, origin_mm: float) -> FloatArray:
        """Return positions as counted since `origin_mm`; `position_mm`, relative to it, is used up.

        Double precision: at 300 mm, single precision would be off by 15 nm.
        """
        position_mm += origin_mm
        position_mm *= self.counts_per_mm
        np.rint(position_mm, out=position_mm)
        position_mm -= round(origin_mm * self.counts_per_mm)
        position_mm /= self.counts_per_mm
        return position_mm


def motor_force(settings: MotorSettings, motion: Motion, load_mN: FloatArray) -> FloatArray:
    """Return the force [mN] that the motor gives: inertia, bearing friction, offset and the load it pulls."""
    force = np.tanh(motion.velocity / BEARING_SPEED_MM_S)
    force *= settings.coulomb_mN
    force += settings.offset_mN
    force += settings.viscous_mN_s_mm * motion.velocity
    force += (settings.moving_mass_g * NEWTONS_PER_G_MM_S2) * motion.acceleration
    force += load_mN
    return force
