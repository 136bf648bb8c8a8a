"""What any stage refuses before it moves."""

from dataclasses import replace

from dragrig.config.errors import DeviceError
from dragrig.config.rig import StageSettings
from dragrig.rig.devices import Side, StageLimits
from dragrig.rig.profile import MotionProfile

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


def refuse_beyond(profile: MotionProfile, origin_mm: float, limits: StageLimits, tolerance_mm: float) -> None:
    """Refuse a profile from an absolute position that the stage must not follow.

    Parameters
    ----------
    tolerance_mm
        So far beyond its travel counts as at its end: a count or two of an encoder.

    Raises
    ------
    DeviceError
        When it leaves the stage's travel, exceeds its speed or acceleration, or does not end at a standstill.
    """
    extremes = profile.extremes()
    lowest, highest = origin_mm + extremes.lowest_mm, origin_mm + extremes.highest_mm
    # Written so that a NaN is refused too.
    if not (lowest >= limits.lowest_mm - tolerance_mm and highest <= limits.highest_mm + tolerance_mm):
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
