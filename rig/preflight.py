"""What is checked before anything moves: limits, run time, file size, free disk, settings and calibrations.

Every run is checked against the stage's limits with its run-up and run-down; the settings of the rig are checked
against each other, and the calibrations for their age and their sensor.
"""

import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from dragrig.config.errors import OutputError, PlanError
from dragrig.config.rig import Calibration, RigSettings
from dragrig.rig.devices import MAX_BLOCK_S, RigCheck, StageLimits
from dragrig.rig.programme import PlannedRun, Programme

BYTES_PER_SAMPLE = 8 + 4 + 8 + 4 + 1
"""time, force, position, command and phase, before compression."""
BYTES_PER_EXTRA_CHANNEL = 4
BYTES_PER_FILE = 60_000


@dataclass(frozen=True, slots=True)
class RunPreview:
    """What a run would do."""

    run: PlannedRun
    lowest_mm: float
    highest_mm: float
    speed_mm_s: float
    accel_mm_s2: float
    samples: int
    size_bytes: int


@dataclass(frozen=True, slots=True)
class Preflight:
    """What a session would do, and everything that forbids it."""

    previews: tuple[RunPreview, ...]
    duration_s: float
    size_bytes: int
    free_bytes: int
    findings: tuple[str, ...]

    def require(self) -> None:
        """Raise `PlanError` with the first finding, and how many more there are."""
        if self.findings:
            more = f" (and {len(self.findings) - 1} more)" if len(self.findings) > 1 else ""
            raise PlanError(self.findings[0] + more + ".")


def recording_bytes(samples: int, channels: int) -> int:
    """Return the size of a recording [bytes] of so many samples, `channels` besides force and position."""
    return samples * (BYTES_PER_SAMPLE + BYTES_PER_EXTRA_CHANNEL * channels) + BYTES_PER_FILE


def preflight(
    programme: Programme, rig: RigSettings, limits: StageLimits, folder: Path, source: str, further: int | None = None
) -> Preflight:
    """Look at every run of a programme without moving anything.

    Parameters
    ----------
    further
        Channels besides force and position; those of the simulated rig unless given.
    """
    if further is None:
        further = 1 if rig.sampling.motor_force else 0
    previews = tuple(_run_preview(run, rig.sampling.rate_hz, further) for run in programme.runs)
    free = free_bytes_near(folder)
    total = sum(one.size_bytes for one in previews)
    largest = max((one.size_bytes for one in previews), default=0)
    findings = [f"{source}: {text}" for one in previews for text in _limit_violations(one, limits)]
    needed = total + largest + round(rig.recording.reserve_mb * 1e6)
    if needed > free:
        findings.append(
            f"{folder}: {free / 1e6:.0f} MB are free where the session needs up to {needed / 1e6:.0f} MB; "
            "make room or name another folder with --out"
        )
    return Preflight(previews, programme.duration_s, total, free, tuple(findings))


def free_bytes_near(folder: Path) -> int:
    """Return the free space where `folder` is or will be; raises `OutputError` when nothing of its path exists."""
    for place in (folder.absolute(), *folder.absolute().parents):
        if place.is_dir():
            try:
                return shutil.disk_usage(place).free
            except OSError as error:
                raise OutputError(f"{place}: cannot be looked at ({error.strerror}).") from error
    raise OutputError(f"{folder}: nothing of this path exists; name another folder.")


def _run_preview(run: PlannedRun, rate_hz: float, further_channels: int) -> RunPreview:
    extremes = run.profile.extremes()
    samples = run.profile.samples(rate_hz)
    return RunPreview(
        run=run,
        lowest_mm=run.start_mm + extremes.lowest_mm,
        highest_mm=run.start_mm + extremes.highest_mm,
        speed_mm_s=extremes.speed_mm_s,
        accel_mm_s2=extremes.acceleration_mm_s2,
        samples=samples,
        size_bytes=recording_bytes(samples, further_channels),
    )


def _limit_violations(preview: RunPreview, limits: StageLimits) -> list[str]:
    run = preview.run
    name = f"run {run.index} ({run.protocol.summary()})"
    found = []
    if preview.lowest_mm < limits.lowest_mm - 1e-9 or preview.highest_mm > limits.highest_mm + 1e-9:
        found.append(
            f"{name} would go from {preview.lowest_mm:g} to {preview.highest_mm:g} mm, where the stage may go from "
            f"{limits.lowest_mm:g} to {limits.highest_mm:g} mm; change travel_mm or start_mm"
        )
    if preview.speed_mm_s > limits.speed_mm_s * (1 + 1e-9):
        found.append(
            f"{name} would reach {preview.speed_mm_s:g} mm/s, where the stage may do {limits.speed_mm_s:g} mm/s"
        )
    if preview.accel_mm_s2 > limits.acceleration_mm_s2 * (1 + 1e-9):
        found.append(
            f"{name} would accelerate with {preview.accel_mm_s2:g} mm/s², where the stage may do "
            f"{limits.acceleration_mm_s2:g} mm/s²"
        )
    return found


_SECONDS_PER_DAY = 86_400
_CALIBRATION_COMMANDS = {"force": "dragrig calibrate force", "encoder": "dragrig calibrate encoder"}


def check_limits(rig: RigSettings) -> RigCheck:
    """Look at the limits of the stage and of the guard: travel, and what a stop from full speed takes of it."""
    stage = rig.stage
    travel_mm = stage.highest_mm - stage.lowest_mm
    seen_mm = stage.max_speed_mm_s * MAX_BLOCK_S
    stop_mm = seen_mm + stage.max_speed_mm_s**2 / (2 * stage.stop_accel_mm_s2)
    detail = (
        f"{stage.lowest_mm:g} to {stage.highest_mm:g} mm, up to {stage.max_speed_mm_s:g} mm/s, from which the guard's "
        f"stop takes {stop_mm:.1f} mm; force up to {rig.guard.force_limit_mN:g} mN"
    )
    if stop_mm < travel_mm / 2:
        return RigCheck("limits", True, detail)
    return RigCheck("limits", False, f"{detail}: lower stage.max_speed_mm_s, or widen the travel")


def check_wiring(rig: RigSettings, calibrations: Mapping[str, Calibration]) -> Iterator[RigCheck]:
    """Look at whether the real rig's converter and counter reach as far as its limits."""
    force, encoder = rig.hardware.card.force, rig.hardware.card.encoder
    calibrated = calibrations.get("force")
    per_V = calibrated.gain if calibrated is not None else force.per_V
    reach_mN = abs(per_V) * (min(force.overload_V, force.range_V) - abs(force.zero_V))
    yield RigCheck(
        "force limit",
        rig.guard.force_limit_mN <= reach_mN,
        f"guard.force_limit_mN is {rig.guard.force_limit_mN:g} mN, and the force input tells up to {reach_mN:.0f} mN",
    )
    if encoder.filter_ns:
        # A pulse of A or B lasts two counts.
        fastest = 2e-3 * rig.encoder.resolution_um / (1e-9 * encoder.filter_ns)
        yield RigCheck(
            "encoder filter",
            rig.stage.max_speed_mm_s <= fastest,
            f"the filter of {encoder.filter_ns} ns passes counts up to {fastest:.0f} mm/s, and stage.max_speed_mm_s is "
            f"{rig.stage.max_speed_mm_s:g}",
        )


def check_calibration(quantity: str, entry: Calibration | None, rig: RigSettings, now: datetime) -> RigCheck:
    """Look at the calibration of a quantity that holds now: whether there is one, its age, and its sensor."""
    what, most_days = f"calibration of {quantity}", rig.hardware.calibration_days
    if entry is None:
        return RigCheck(what, False, f"there is none: {_CALIBRATION_COMMANDS[quantity]}")
    age_days = (now - entry.made_at).total_seconds() / _SECONDS_PER_DAY
    detail = f"{entry.id}, {max(age_days, 0):.0f} days old"
    if age_days > most_days:
        return RigCheck(what, False, f"{detail}, where {most_days:g} are allowed: {_CALIBRATION_COMMANDS[quantity]}")
    if quantity == "force" and rig.force_sensor.serial and entry.sensor_serial != rig.force_sensor.serial:
        other = entry.sensor_serial or "a sensor without a serial number"
        return RigCheck(what, False, f"{detail}, made with {other}, and the rig has {rig.force_sensor.serial}")
    return RigCheck(what, True, detail)
