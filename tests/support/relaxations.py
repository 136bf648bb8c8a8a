"""Relaxation runs of a known wall, made in memory: the exact force of model.md with a sensor's noise."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from dragrig.analysis.selection import RunSelection, select_loaded_runs
from dragrig.rig.profile import MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.rig.runfile.model import RecordedChannel, Run, RunHeader, RunInfo, RunStatus, Trace
from dragrig.sim_backend.devices.variability import SlowNoise
from dragrig.sim_backend.friction import ProfileMotion
from dragrig.sim_backend.friction.wall import MaxwellBranches

AREA_MM2 = np.pi * 12.9 * 15.2
COUNT_MM, STEP_MN = 1e-3, 20_000 / 65_536


def relaxation(
    elements: Sequence[float] = (3.0, 1.2, 1.1, 0.075, 0.5),
    strain: float = 1.0,
    *,
    third: tuple[float, float] | None = None,
    rate_hz: float = 500.0,
    rest_s: float = 1.0,
    hold_s: float = 20.0,
    ramp_mm_s: float = 20.0,
    slow_mN: float = 0.5,
    correlation_s: float = 0.2,
    zero_mN: float = 3.0,
    seed: int = 0,
) -> Run:
    """One run of E1, E2, E3, η1, η2, and of a third branch (modulus, time constant) if any."""
    E1, E2, E3, eta1, eta2 = elements
    branches = [(E1, eta1 / E1), (E2, eta2 / E2), *([third] if third else [])]
    moduli, times = np.array(branches).T
    ramp = trapezoid(2.5 * strain, ramp_mm_s, 2000.0)
    profile = MotionProfile.from_pieces(
        [stationary_piece(rest_s, Phase.REST), *ramp, stationary_piece(hold_s, Phase.HOLD)]
    )
    time = np.arange(profile.samples(rate_hz)) / rate_hz
    motion = ProfileMotion.of(profile)
    wall = MaxwellBranches.integrate(1 / times, motion.pieces(), 2.5)
    parts = np.array_split(time, 1 + time.size // 100_000)
    force = AREA_MM2 * np.concatenate(
        [E3 * wall.strain(part) + np.tensordot(moduli, wall.stress(part), 1) for part in parts]
    )
    random = np.random.default_rng(seed)
    force += zero_mN + 1.5 * random.standard_normal(time.size)
    force += SlowNoise(random, slow_mN, correlation_s, rate_hz).draw(time.size)
    position = np.round(motion.position(time) / COUNT_MM) * COUNT_MM
    channels = {"force": np.round(force / STEP_MN) * STEP_MN, "position": position}
    return _run(strain, seed, rate_hz, time, profile.phase_at(time).astype(np.uint8), channels)


def _run(strain, seed, rate_hz, time, phase, channels) -> Run:
    name = f"{100 * strain:03.0f}-{seed:03d}-relaxation.h5"
    header = RunHeader(
        run_id=name,
        start_time=datetime(2026, 5, 4, tzinfo=UTC),
        order=seed,
        backend="simulated",
        kind="relaxation",
        sample_rate_hz=rate_hz,
        channels=(RecordedChannel("force", "mN"), RecordedChannel("position", "mm")),
        protocol={"shear_strain": strain},
        capsule={"diameter_mm": 12.9, "length_mm": 15.2, "mass_g": 50.1, "contact_angle_deg": 60.0},
        specimen={"name": "made", "wall_thickness_mm": 2.5, "fixture": "vacuum"},
    )
    units = {"force": "mN", "position": "mm"}
    trace = Trace(rate_hz, "force", time, channels["position"], phase, channels, units)
    return Run(RunInfo(Path(name), 1, RunStatus.COMPLETE, header, len(time)), trace)


def selected(*runs: Run) -> RunSelection:
    return select_loaded_runs(runs)
