"""The trial: a short signed pulse before the first motion, which shows whether command, drive and encoder agree.

A wire the wrong way round makes a loop run away, and a homing run to the wrong end; after 1 mm it can still be said in
words which wire it is. The drive's own position tells a wrong polarity from an encoder that counts the wrong way.
"""

from dataclasses import dataclass
from math import nan

from dragrig.config import RigSettings
from dragrig.rig import TravelEnd

PULSE_MM = 1.0
PULSE_SPEED_MM_S = 5.0
PULSE_ACCELERATION_MM_S2 = 500.0
_MIN_DRIVEN_MM = 0.1
_MIN_COUNTS = 5
_MAX_RESOLUTION_ERROR = 0.1
_MAX_VOLTAGE_SCALE_ERROR = 0.3
"""Of the velocity output's scale: the drive has an offset and a lag as well."""


@dataclass(frozen=True, slots=True)
class Pulse:
    """A pulse as planned and as made; signed travels from standstill to standstill [mm]."""

    commanded_mm: float | None
    """None where the drive homed by itself, and chose the travel."""
    driven_mm: float
    """By the drive's own position."""
    counted_mm: float
    """By the encoder at the card."""
    homes_astray: bool = False
    """Whether a drive that was to home by itself went the wrong way."""

    def problem(self, rig: RigSettings) -> str:
        """Say which wire or setting is wrong, without a full stop; empty when command, drive and encoder agree."""
        card, velocity = rig.hardware.card, rig.hardware.drive.velocity
        by_voltage = rig.hardware.drive.mode == "velocity"
        resolution_um, wires = rig.encoder.resolution_um, f"{card.encoder.a} and {card.encoder.b}"
        drive_moved = abs(self.driven_mm) >= _MIN_DRIVEN_MM
        counted = abs(self.counted_mm) >= _MIN_COUNTS * resolution_um / 1000.0
        ratio = self.counted_mm / self.driven_mm if drive_moved else nan
        scale = self.driven_mm / self.commanded_mm if self.commanded_mm is not None else 1.0
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
                self.homes_astray,
                "the drive homes the wrong way",
                homing_remedy(rig),
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
        told = "" if self.commanded_mm is None else f"told to move by {self.commanded_mm:+.3f} mm, "
        return f"{told}the drive moved by {self.driven_mm:+.3f} mm and the encoder counted {self.counted_mm:+.3f} mm"


def homing_remedy(rig: RigSettings) -> str:
    """Return the remedy for a drive that homes the wrong way."""
    return (
        f"hardware.drive.homing_direction is '{rig.hardware.drive.homing_direction}': set homing method and sense of "
        "motion in the drive to it, or the setting to the drive"
    )


class HomingWay:
    """Follows a drive that homes by itself: it goes towards its switch first, and away only from there.

    Which way it goes is up to its own settings, for not every dialect can tell it the side.

    Parameters
    ----------
    side
        The switch that homing is to find first.
    begin_mm
        Where it begins, by the drive's own position.
    on_switch
        Whether it begins on that switch, from which it may go away at once.
    """

    def __init__(self, side: TravelEnd, begin_mm: float, *, on_switch: bool) -> None:
        self._begin_mm, self._sense = begin_mm, 1.0 if side is TravelEnd.LOW else -1.0
        self._is_right, self._away_mm = on_switch, 0.0

    def add(self, position_mm: float, *, on_switch: bool) -> None:
        """Take where it is now, and whether it is on that switch."""
        away_mm = self._sense * (position_mm - self._begin_mm)
        self._is_right = self._is_right or on_switch or away_mm <= -_MIN_DRIVEN_MM
        self._away_mm = 0.0 if self._is_right else away_mm

    def is_wrong(self, bound_mm: float = _MIN_DRIVEN_MM) -> bool:
        """Whether it went further the other way than `bound_mm`."""
        return not self._away_mm <= bound_mm
