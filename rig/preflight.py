"""What is checked before anything moves: limits, run time, file size, free disk, settings and calibrations.

Every run is checked against the stage's limits with its run-up and run-down; the settings of the rig are checked
against each other, and the calibrations for their age and their sensor.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from dragrig.config.errors import PlanError
from dragrig.config.rig import Calibration, RigSettings
from dragrig.rig.devices import MAX_BLOCK_S, RigCheck, StageLimits, limit_violations
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.runfile.filesystem import free_bytes

BYTES_PER_SAMPLE = 8 + 4 + 8 + 4 + 1
"""time, force, position, command and phase, before compression."""
BYTES_PER_EXTRA_CHANNEL = 4
BYTES_PER_FILE = 60_000


_SECONDS_PER_DAY = 86_400
_CALIBRATION_COMMANDS = {"force": "dragrig calibrate force", "encoder": "dragrig calibrate encoder"}


@dataclass(frozen=True, slots=True)
class RunPreview:
    """Extremes and size of a run, before it is made."""

    run: PlannedRun
    lowest_mm: float
    highest_mm: float
    speed_mm_s: float
    accel_mm_s2: float
    samples: int
    size_bytes: int


@dataclass(frozen=True, slots=True)
class Preflight:
    """Runs, duration and size of a session, before it is made, and every finding that forbids it."""

    previews: tuple[RunPreview, ...]
    duration_s: float
    size_bytes: int
    free_bytes: int
    findings: tuple[str, ...]

    def require(self) -> None:
        """Raise `PlanError` with the first finding and the number of others."""
        if self.findings:
            more = f" (and {len(self.findings) - 1} more)" if len(self.findings) > 1 else ""
            raise PlanError(self.findings[0] + more + ".")


def recording_bytes(samples: int, channels: int) -> int:
    """Return the size of a recording [bytes]; `channels` counts those besides force and position."""
    return samples * (BYTES_PER_SAMPLE + BYTES_PER_EXTRA_CHANNEL * channels) + BYTES_PER_FILE


def preflight(
    programme: Programme,
    rig: RigSettings,
    limits: StageLimits,
    folder: Path,
    source: str,
    extra_channels: int | None = None,
) -> Preflight:
    """Check every run of a programme without motion.

    Parameters
    ----------
    extra_channels
        Channels besides force and position; None for those of the simulated rig.
    """
    if extra_channels is None:
        extra_channels = 1 if rig.sampling.motor_force else 0
    previews: list[RunPreview] = []
    findings: list[str] = []
    for run in programme.runs:
        extremes, samples = run.profile.extremes(), run.profile.samples(rig.sampling.rate_hz)
        name = f"{source}: run {run.index} ({run.protocol.summary()})"
        findings += [f"{name} {violation}" for violation in limit_violations(extremes, run.start_mm, limits)]
        previews.append(
            RunPreview(
                run=run,
                lowest_mm=run.start_mm + extremes.lowest_mm,
                highest_mm=run.start_mm + extremes.highest_mm,
                speed_mm_s=extremes.speed_mm_s,
                accel_mm_s2=extremes.acceleration_mm_s2,
                samples=samples,
                size_bytes=recording_bytes(samples, extra_channels),
            )
        )
    free = free_bytes(folder)
    total = sum(preview.size_bytes for preview in previews)
    largest = max((preview.size_bytes for preview in previews), default=0)
    needed = total + largest + round(rig.recording.reserve_mb * 1e6)
    if needed > free:
        findings.append(
            f"{folder}: {free / 1e6:.0f} MB are free where the session needs up to {needed / 1e6:.0f} MB; "
            "make room or name another folder with --out"
        )
    return Preflight(tuple(previews), programme.duration_s, total, free, tuple(findings))


def check_limits(rig: RigSettings) -> RigCheck:
    """Check the limits of stage and guard: whether a stop from full speed fits into half of the travel."""
    stage = rig.stage
    travel_mm = stage.highest_mm - stage.lowest_mm
    delay_mm = stage.max_speed_mm_s * MAX_BLOCK_S
    stop_mm = delay_mm + stage.max_speed_mm_s**2 / (2 * stage.stop_accel_mm_s2)
    detail = (
        f"{stage.lowest_mm:g} to {stage.highest_mm:g} mm, up to {stage.max_speed_mm_s:g} mm/s, from which the guard's "
        f"stop takes {stop_mm:.1f} mm; force up to {rig.guard.force_limit_mN:g} mN"
    )
    if stop_mm < travel_mm / 2:
        return RigCheck("limits", True, detail)
    return RigCheck("limits", False, f"{detail}: lower stage.max_speed_mm_s, or widen the travel")


def check_wiring(rig: RigSettings, calibrations: Mapping[str, Calibration]) -> Iterator[RigCheck]:
    """Check whether the ranges of the real rig's converter and counter cover its limits."""
    force, encoder = rig.hardware.card.force, rig.hardware.card.encoder
    calibrated = calibrations.get("force")
    per_V = calibrated.gain if calibrated is not None else force.per_V
    range_mN = abs(per_V) * (min(force.overload_V, force.range_V) - abs(force.zero_V))
    yield RigCheck(
        "force limit",
        rig.guard.force_limit_mN <= range_mN,
        f"guard.force_limit_mN is {rig.guard.force_limit_mN:g} mN, the force input's range is {range_mN:.0f} mN",
    )
    if encoder.filter_ns:
        # A pulse of A or B lasts two counts.
        max_speed = 2e-3 * rig.encoder.resolution_um / (1e-9 * encoder.filter_ns)
        yield RigCheck(
            "encoder filter",
            rig.stage.max_speed_mm_s <= max_speed,
            f"the filter of {encoder.filter_ns} ns passes up to {max_speed:.0f} mm/s, and stage.max_speed_mm_s is "
            f"{rig.stage.max_speed_mm_s:g}",
        )


def check_calibration(quantity: str, entry: Calibration | None, rig: RigSettings, now: datetime) -> RigCheck:
    """Check the latest calibration of a quantity: whether there is one, its age, and its sensor."""
    name, max_days = f"calibration of {quantity}", rig.hardware.calibration_days
    if entry is None:
        return RigCheck(name, False, f"missing; make it with {_CALIBRATION_COMMANDS[quantity]}")
    age_days = (now - entry.made_at).total_seconds() / _SECONDS_PER_DAY
    detail = f"{entry.id}, {max(age_days, 0):.0f} days old"
    if age_days > max_days:
        return RigCheck(
            name, False, f"{detail}, more than {max_days:g}: repeat it with {_CALIBRATION_COMMANDS[quantity]}"
        )
    if quantity == "force" and rig.force_sensor.serial and entry.sensor_serial != rig.force_sensor.serial:
        sensor = entry.sensor_serial or "a sensor without a serial number"
        return RigCheck(name, False, f"{detail}, made with {sensor}, and the rig has {rig.force_sensor.serial}")
    return RigCheck(name, True, detail)
