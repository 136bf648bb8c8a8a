"""What the real stage refuses besides, before it moves."""

from dragrig.config.errors import DeviceError
from dragrig.rig.devices import LONGEST_BLOCK_S, Clock, Side
from dragrig.rig.hardware.coupling import Coupling
from dragrig.rig.profile import MotionProfile

POSITION_TOLERANCE_MM = 2e-3
"""A stage that stands a count or two off its limit is not beyond it."""


def refuse_towards(profile: MotionProfile, side: Side, most_mm_s: float) -> None:
    """Refuse whatever goes towards an overridden limit switch, or leaves it fast.

    Raises
    ------
    DeviceError
        When the profile goes further that way, or exceeds `most_mm_s`.
    """
    extremes = profile.extremes()
    further_mm = -extremes.lowest_mm if side is Side.LOW else extremes.highest_mm
    if not further_mm <= POSITION_TOLERANCE_MM:
        raise DeviceError(f"the {side} limit switch is overridden for a move away from it only: turn the travel round.")
    if not extremes.speed_mm_s <= most_mm_s * (1 + 1e-9):
        raise DeviceError(
            f"off an overridden limit switch the stage moves at {most_mm_s:g} mm/s at most, not at "
            f"{extremes.speed_mm_s:g} (hardware.drive.homing_speed_mm_s of the rig file)."
        )


def refuse_late(start_s: float, coupling: Coupling, clock: Clock) -> None:
    """Refuse a motion that should have begun more than a block ago, `start_s` after the first sample.

    Raises
    ------
    DeviceError
        When its start is too long past.
    """
    first = coupling.first_sample
    if first is not None and clock.monotonic() > first.at_s + start_s + LONGEST_BLOCK_S:
        raise DeviceError("the stage was told to move too long after the first sample: start it before.")


def sets_out_s(profile: MotionProfile) -> float:
    """Return when a profile's first motion begins; its end when it has none."""
    moving = profile.start_s[profile.acceleration_mm_s2 != 0]
    return float(moving[0]) if moving.size else profile.duration_s
