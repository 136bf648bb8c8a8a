"""What is checked before anything moves: limits with run-up and run-down, duration, file size, free disk."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from dragrig.config.errors import OutputError, PlanError
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import StageLimits
from dragrig.rig.programme import PlannedRun, Programme

BYTES_PER_SAMPLE = 8 + 4 + 8 + 4 + 1
"""time, force, position, command and phase, before compression."""
BYTES_PER_FURTHER_CHANNEL = 4
BYTES_PER_FILE = 60_000


@dataclass(frozen=True, slots=True)
class Preview:
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

    previews: tuple[Preview, ...]
    duration_s: float
    size_bytes: int
    free_bytes: int
    findings: tuple[str, ...]

    def require(self) -> None:
        """Raise `PlanError` with the first finding, and how many more there are."""
        if self.findings:
            more = f" (and {len(self.findings) - 1} more)" if len(self.findings) > 1 else ""
            raise PlanError(self.findings[0] + more + ".")


def size_of(samples: int, channels: int) -> int:
    """Return the size of a recording [bytes] of so many samples, `channels` besides force and position."""
    return samples * (BYTES_PER_SAMPLE + BYTES_PER_FURTHER_CHANNEL * channels) + BYTES_PER_FILE


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
    previews = tuple(_preview(run, rig.sampling.rate_hz, further) for run in programme.runs)
    free = free_bytes(folder)
    total = sum(one.size_bytes for one in previews)
    largest = max((one.size_bytes for one in previews), default=0)
    findings = [f"{source}: {text}" for one in previews for text in _over_limits(one, limits)]
    needed = total + largest + round(rig.recording.reserve_mb * 1e6)
    if needed > free:
        findings.append(
            f"{folder}: {free / 1e6:.0f} MB are free where the session needs up to {needed / 1e6:.0f} MB; "
            "make room or name another folder with --out"
        )
    return Preflight(previews, programme.duration_s, total, free, tuple(findings))


def free_bytes(folder: Path) -> int:
    """Return the free space where `folder` is or will be; raises `OutputError` when nothing of its path exists."""
    for place in (folder.absolute(), *folder.absolute().parents):
        if place.is_dir():
            try:
                return shutil.disk_usage(place).free
            except OSError as error:
                raise OutputError(f"{place}: cannot be looked at ({error.strerror}).") from error
    raise OutputError(f"{folder}: nothing of this path exists; name another folder.")


def _preview(run: PlannedRun, rate_hz: float, further_channels: int) -> Preview:
    extremes = run.profile.extremes()
    samples = run.profile.samples(rate_hz)
    return Preview(
        run=run,
        lowest_mm=run.start_mm + extremes.lowest_mm,
        highest_mm=run.start_mm + extremes.highest_mm,
        speed_mm_s=extremes.speed_mm_s,
        accel_mm_s2=extremes.acceleration_mm_s2,
        samples=samples,
        size_bytes=size_of(samples, further_channels),
    )


def _over_limits(preview: Preview, limits: StageLimits) -> list[str]:
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
