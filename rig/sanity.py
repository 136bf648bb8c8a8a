"""Whether what is set for a rig makes sense together, and whether its calibrations are good still."""

from collections.abc import Iterator, Mapping
from datetime import datetime

from dragrig.config.lab import Calibration
from dragrig.config.rig import RigSettings
from dragrig.rig.backend import Finding
from dragrig.rig.devices import LONGEST_BLOCK_S

_SECONDS_PER_DAY = 86_400
_COMMANDS = {"force": "dragrig calibrate force", "encoder": "dragrig calibrate encoder"}


def limits(rig: RigSettings) -> Finding:
    """Look at the limits of the stage and of the guard: travel, and what a stop from full speed takes of it."""
    stage = rig.stage
    travel_mm = stage.highest_mm - stage.lowest_mm
    seen_mm = stage.max_speed_mm_s * LONGEST_BLOCK_S
    stop_mm = seen_mm + stage.max_speed_mm_s**2 / (2 * stage.stop_accel_mm_s2)
    detail = (
        f"{stage.lowest_mm:g} to {stage.highest_mm:g} mm, up to {stage.max_speed_mm_s:g} mm/s, from which the guard's "
        f"stop takes {stop_mm:.1f} mm; force up to {rig.guard.force_limit_mN:g} mN"
    )
    if stop_mm < travel_mm / 2:
        return Finding("limits", True, detail)
    return Finding("limits", False, f"{detail}: lower stage.max_speed_mm_s, or widen the travel")


def wiring(rig: RigSettings, calibrations: Mapping[str, Calibration]) -> Iterator[Finding]:
    """Look at whether the real rig's converter and counter reach as far as its limits."""
    force, encoder = rig.hardware.card.force, rig.hardware.card.encoder
    calibrated = calibrations.get("force")
    per_V = calibrated.gain if calibrated is not None else force.per_V
    reach_mN = abs(per_V) * (min(force.overload_V, force.range_V) - abs(force.zero_V))
    yield Finding(
        "force limit",
        rig.guard.force_limit_mN <= reach_mN,
        f"guard.force_limit_mN is {rig.guard.force_limit_mN:g} mN, and the force input tells up to {reach_mN:.0f} mN",
    )
    if encoder.filter_ns:
        # A pulse of A or B lasts two counts.
        fastest = 2e-3 * rig.encoder.resolution_um / (1e-9 * encoder.filter_ns)
        yield Finding(
            "encoder filter",
            rig.stage.max_speed_mm_s <= fastest,
            f"the filter of {encoder.filter_ns} ns passes counts up to {fastest:.0f} mm/s, and stage.max_speed_mm_s is "
            f"{rig.stage.max_speed_mm_s:g}",
        )


def calibration(quantity: str, entry: Calibration | None, rig: RigSettings, now: datetime) -> Finding:
    """Look at the calibration of a quantity that holds now: whether there is one, its age, and its sensor."""
    what, most_days = f"calibration of {quantity}", rig.hardware.calibration_days
    if entry is None:
        return Finding(what, False, f"there is none: {_COMMANDS[quantity]}")
    age_days = (now - entry.made_at).total_seconds() / _SECONDS_PER_DAY
    detail = f"{entry.id}, {max(age_days, 0):.0f} days old"
    if age_days > most_days:
        return Finding(what, False, f"{detail}, where {most_days:g} are allowed: {_COMMANDS[quantity]}")
    if quantity == "force" and rig.force_sensor.serial and entry.sensor_serial != rig.force_sensor.serial:
        other = entry.sensor_serial or "a sensor without a serial number"
        return Finding(what, False, f"{detail}, made with {other}, and the rig has {rig.force_sensor.serial}")
    return Finding(what, True, detail)
