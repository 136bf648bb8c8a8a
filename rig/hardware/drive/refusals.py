"""What a stage refuses before it moves, whatever drives it."""

from dataclasses import replace

from dragrig.config.errors import DeviceError
from dragrig.config.rig import StageSettings
from dragrig.rig.devices import LONGEST_BLOCK_S, Clock, Side, StageLimits
from dragrig.rig.hardware.coupling import Coupling
from dragrig.rig.profile import MotionProfile

POSITION_TOLERANCE_MM = 2e-3
"""A stage that stands a count or two off its limit is not beyond it."""
STANDSTILL_MM_S = 1e-6


def limits_of(settings: StageSettings) -> StageLimits:
    """Return what the settings allow the stage."""
    return StageLimits(
        lowest_mm=settings.lowest_mm,
        highest_mm=settings.highest_mm,
        speed_mm_s=settings.max_speed_mm_s,
        acceleration_mm_s2=settings.max_accel_mm_s2,
    )


def widened(limits: StageLimits, override: Side | None, origin_mm: float) -> StageLimits:
    """Return the limits of a move off an overridden limit switch: it begins outside the soft ones."""
    match override:
        case Side.LOW:
            return replace(limits, lowest_mm=min(limits.lowest_mm, origin_mm))
        case Side.HIGH:
            return replace(limits, highest_mm=max(limits.highest_mm, origin_mm))
        case None:
            return limits


def refuse_beyond(profile: MotionProfile, origin_mm: float, limits: StageLimits) -> None:
    """Refuse a profile from an absolute position that the stage must not follow.

    Raises
    ------
    DeviceError
        When it leaves the stage's travel, exceeds its speed or acceleration, or does not end at a standstill.
    """
    extremes = profile.extremes()
    lowest, highest = origin_mm + extremes.lowest_mm, origin_mm + extremes.highest_mm
    margin = POSITION_TOLERANCE_MM
    # Written so that a NaN is refused too.
    if not (lowest >= limits.lowest_mm - margin and highest <= limits.highest_mm + margin):
        raise DeviceError(
            f"the stage refuses a move from {origin_mm:g} mm that reaches {lowest:g} to {highest:g} mm: its travel is "
            f"{limits.lowest_mm:g} to {limits.highest_mm:g} mm (stage.lowest_mm and highest_mm of the rig file)."
        )
    for what, unit, value, most, key in (
        ("speed", "mm/s", extremes.speed_mm_s, limits.speed_mm_s, "max_speed_mm_s"),
        ("acceleration", "mm/s²", extremes.acceleration_mm_s2, limits.acceleration_mm_s2, "max_accel_mm_s2"),
    ):
        if not value <= most * (1 + 1e-9):
            raise DeviceError(
                f"the stage refuses a {what} of {value:g} {unit}: it goes up to {most:g} {unit} "
                f"(stage.{key} of the rig file)."
            )
    if not abs(float(profile.velocity(profile.duration_s))) <= STANDSTILL_MM_S:
        raise DeviceError("the stage refuses a profile that ends in motion: let it end at a standstill.")


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
