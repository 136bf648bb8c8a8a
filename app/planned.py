"""What a plan would do, as plain values for a screen: curves, ranges, times, and what forbids it."""

from dataclasses import dataclass

import numpy as np

from dragrig.config.plan import Plan
from dragrig.engine_host.messages import RigTerms
from dragrig.measuring import check
from dragrig.pacing import pacing
from dragrig.rig.arrays import FloatArray
from dragrig.rig.preflight import Preview
from dragrig.rigs import resolve_rig

_POINTS_PER_PIECE = 24


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """One run before it is made; positions are absolute."""

    index: int
    summary: str
    capsule: str
    lowest_mm: float
    highest_mm: float
    speed_mm_s: float
    accel_mm_s2: float
    wait_s: float
    duration_s: float
    prompt: str
    preview: Preview

    def course(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return times [s], absolute positions [mm] and speeds [mm/s] that draw the run's motion, shape `(n,)` each."""
        run = self.preview.run
        profile = run.profile
        ends = np.append(profile.start_s, profile.duration_s)
        inside = np.linspace(0.0, 1.0, _POINTS_PER_PIECE, endpoint=False)
        time = np.append((ends[:-1, None] + np.diff(ends)[:, None] * inside).ravel(), profile.duration_s)
        return time, run.start_mm + profile.position(time), profile.velocity(time)


@dataclass(frozen=True, slots=True)
class PlannedSession:
    """All runs of a plan, what they take, and what forbids them."""

    runs: tuple[PlannedRun, ...]
    duration_s: float
    size_bytes: int
    free_bytes: int
    findings: tuple[str, ...]
    lowest_mm: float
    highest_mm: float


@dataclass(frozen=True, slots=True)
class RigInWords:
    """Which rig is meant, unmistakably: `title` in capital letters, and what that means."""

    name: str
    backend: str
    title: str
    meaning: str
    real: bool
    force_limit_mN: float
    data_root: str


def planned(plan: Plan | str, rig: RigTerms) -> PlannedSession:
    """Look at a plan without moving anything.

    Raises
    ------
    SettingsError, PlanError, OutputError
        For settings that cannot be used at all.
    """
    found = check(plan, **rig.choices())
    stage = resolve_rig(**rig.choices()).rig.stage
    return PlannedSession(
        runs=tuple(map(_planned_run, found.previews)),
        duration_s=found.duration_s,
        size_bytes=found.size_bytes,
        free_bytes=found.free_bytes,
        findings=found.findings,
        lowest_mm=stage.lowest_mm,
        highest_mm=stage.highest_mm,
    )


def rig_in_words(rig: RigTerms) -> RigInWords:
    """Say which rig is meant; raises `SettingsError`, also for a pace that this rig has not."""
    setup = resolve_rig(**rig.choices())
    pacing(rig.pace, double=setup.double)
    simulated = setup.backend == "simulated"
    if simulated:
        title, meaning = "SIMULATED", "nothing moves; the friction model stands in for rig and gut"
    elif setup.double:
        title, meaning = "DOUBLE", "nothing moves; doubles stand in for card and drive"
    else:
        title, meaning = "HARDWARE", "the real stage moves"
    return RigInWords(
        name=setup.rig.name,
        backend=setup.backend,
        title=title,
        meaning=meaning,
        real=not (simulated or setup.double),
        force_limit_mN=setup.rig.guard.force_limit_mN,
        data_root=str(setup.data_root),
    )


def _planned_run(one: Preview) -> PlannedRun:
    run = one.run
    return PlannedRun(
        index=run.index,
        summary=run.protocol.summary(),
        capsule=run.capsule.name,
        lowest_mm=one.lowest_mm,
        highest_mm=one.highest_mm,
        speed_mm_s=one.speed_mm_s,
        accel_mm_s2=one.accel_mm_s2,
        wait_s=run.wait_s,
        duration_s=run.duration_s,
        prompt=run.prompt,
        preview=one,
    )
