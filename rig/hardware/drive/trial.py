"""The trial: a short signed pulse before the first motion, which shows whether command, drive and encoder agree.

A wire the wrong way round makes a loop run away, and a homing run to the wrong end; after 1 mm it can still be said in
words which wire it is. The drive's own position tells a wrong polarity from an encoder that counts the wrong way.
"""

from dataclasses import dataclass
from math import isnan, nan
from typing import Protocol

from dragrig.config import RigSettings

PULSE_MM = 1.0
PULSE_SPEED_MM_S = 5.0
PULSE_ACCELERATION_MM_S2 = 500.0
_MIN_DRIVEN_MM = 0.1
_MIN_COUNTS = 5
_MAX_RESOLUTION_ERROR = 0.1
_MAX_VOLTAGE_SCALE_ERROR = 0.3
"""Of the velocity output's scale: the drive has an offset and a lag as well."""


class PositionReader(Protocol):
    """A counter on the encoder, read on demand; both methods raise `DeviceError` when the card refuses."""

    def begin(self, position_mm: float, *, index: bool = False) -> None:
        """Start counting from the stage's present position."""

    def read(self) -> float:
        """Return the position now [mm]."""

    def close(self) -> None:
        """Release the counter. Safe to call twice."""


@dataclass(frozen=True, slots=True)
class Pulse:
    """What a pulse was to be, and what became of it; signed travels from standstill to standstill [mm]."""

    commanded_mm: float
    """NaN where the drive chose travel and direction."""
    driven_mm: float
    """By the drive's own position."""
    counted_mm: float
    """By the encoder at the card."""

    def problem(self, rig: RigSettings) -> str:
        """Say what is wired or set wrongly, without a full stop; empty when command, drive and encoder agree."""
        card, velocity = rig.hardware.card, rig.hardware.drive.velocity
        by_voltage = rig.hardware.drive.mode == "velocity"
        resolution_um, wires = rig.encoder.resolution_um, f"{card.encoder.a} and {card.encoder.b}"
        drive_moved = abs(self.driven_mm) >= _MIN_DRIVEN_MM
        counted = abs(self.counted_mm) >= _MIN_COUNTS * resolution_um / 1000.0
        ratio = self.counted_mm / self.driven_mm if drive_moved else nan
        scale = self.driven_mm / self.commanded_mm
        polarity = f"exchange the two wires of {velocity.channel}" if by_voltage else "turn round its direction"
        source = f"the wires of {velocity.channel}, " if by_voltage else ""
        findings = (
            (
                not (drive_moved or counted),
                "nothing moves",
                f"check {source}the motor's power, its brake, and whether the stage is blocked",
            ),
            (
                not counted,
                "the encoder does not count",
                f"check its supply, its line receiver, and A and B at {wires}",
            ),
            (
                not drive_moved,
                "the drive reports no motion",
                "check what hardware.drive.dialect makes of its position",
            ),
            (
                ratio < 0,
                "A and B of the encoder are swapped",
                f"exchange them at {wires}, or turn hardware.card.encoder.reversed round",
            ),
            (
                scale < 0,
                "the polarity is wrong",
                f"{polarity}, or reverse it in the drive",
            ),
            (
                abs(ratio - 1) > _MAX_RESOLUTION_ERROR,
                f"the encoder's resolution is wrong by a factor of {ratio:.2g}",
                f"encoder.resolution_um should be about {resolution_um / (ratio or nan):.2g} instead of "
                f"{resolution_um:g}",
            ),
            (
                by_voltage and abs(scale - 1) > _MAX_VOLTAGE_SCALE_ERROR,
                f"the velocity's scale is wrong by a factor of {scale:.2g}",
                f"hardware.drive.velocity.per_V should be about {velocity.per_V * scale:.2g} instead of "
                f"{velocity.per_V:g}",
            ),
        )
        return next((f"{what}: {self._seen()}; {remedy}" for is_so, what, remedy in findings if is_so), "")

    def _seen(self) -> str:
        told = "" if isnan(self.commanded_mm) else f"told to move by {self.commanded_mm:+.3f} mm, "
        return f"{told}the drive moved by {self.driven_mm:+.3f} mm and the encoder counted {self.counted_mm:+.3f} mm"
