"""Coulomb and drag runs in memory: the friction model's force along a trapezoid, with a sensor's noise and zero."""

from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from uuid import uuid4

import numpy as np
from scipy.signal import lfilter

from dragrig.analysis.selection import RunSelection, select_loaded_runs
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Capsule, Fixture
from dragrig.rig.profile import AnyFloatArray, FloatArray, MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.rig.runfile.model import RecordedChannel, Run, RunHeader, RunInfo, RunStatus, Trace
from dragrig.sim_backend.friction import prepare
from friction_cases import SMOOTH, sliding

RATE_HZ = 500.0
PAPER = FrictionModelSettings()


def noise(rng: np.random.Generator, samples: int, white: float = 1.5, slow: float = 0.5) -> FloatArray:
    """White noise, and slow noise with a correlation time of 0.2 s."""
    phi = np.exp(-1 / (0.2 * RATE_HZ))
    drawn = rng.normal(size=samples) * slow * np.sqrt(1 - phi**2)
    drawn[0] = rng.normal() * slow
    return np.asarray(lfilter([1], [1, -phi], drawn) + white * rng.normal(size=samples))


def slid(
    kind: str,
    speed_mm_s: float,
    seed: int | None = None,
    model: FrictionModelSettings = PAPER,
    travel_mm: float = 40.0,
    fixture: Fixture | None = None,
    capsule: Capsule = SMOOTH,
    zero_mN: float = 3.0,
    repeat: int = 0,
) -> Run:
    """Return a run; without a seed it has no zero, no stiffness and friction of its own, and hardly any noise."""
    fixture = fixture or (Fixture.FOAM if kind == "drag" else Fixture.VACUUM)
    profile = MotionProfile.from_pieces(
        (stationary_piece(1.0, Phase.REST), *trapezoid(travel_mm, speed_mm_s, 400.0), stationary_piece(1.0, Phase.HOLD))
    )
    time = np.arange(profile.samples(RATE_HZ)) / RATE_HZ
    disturbed = 1e-3 * np.random.default_rng(0).normal(size=len(time))
    if seed is not None:
        rng = np.random.default_rng([seed, repeat, round(10 * speed_mm_s)])
        stiffer, rougher = 1 + np.array([0.02, 0.015]) * rng.standard_normal(2)
        model = model.model_copy(
            update={
                "stiffness_scale": model.stiffness_scale * stiffer,
                "friction_coefficient": model.friction_coefficient * rougher,
            }
        )
        disturbed = zero_mN + noise(rng, len(time))
    force = prepare(sliding(profile, capsule, fixture), model).force(time) + disturbed
    header = RunHeader(
        run_id=str(uuid4()), start_time=datetime(2026, 1, 1, tzinfo=UTC), order=0, backend="simulated", kind=kind,
        sample_rate_hz=RATE_HZ, channels=(RecordedChannel("force", "mN"), RecordedChannel("position", "mm")),
        entry={"insertion_dwell_s": 60.0},
        protocol={"speed_mm_s": speed_mm_s, "travel_mm": travel_mm},
        capsule={key: getattr(capsule, key) for key in ("diameter_mm", "length_mm", "mass_g", "contact_angle_deg")},
        specimen={"name": "test", "fixture": fixture.value, "wall_thickness_mm": 2.5},
    )  # fmt: skip
    info = RunInfo(Path(f"{kind}-{speed_mm_s:g}-{travel_mm:g}-{repeat}.h5"), 1, RunStatus.COMPLETE, header, len(time))
    position = np.round(profile.position(time), 3)
    channels: dict[str, AnyFloatArray] = {"force": force, "position": position}
    units = {"time": "s", "command": "mm", "force": "mN", "position": "mm"}
    return Run(info, Trace(RATE_HZ, "force", time, position, profile.phase_at(time), channels, units))


def with_force(run: Run, force: AnyFloatArray) -> Run:
    return replace(run, trace=replace(run.trace, channels={**run.trace.channels, "force": force}))


def without_rest(run: Run) -> Run:
    """Cut off what was recorded before the motion."""
    remaining = run.trace.phase != Phase.REST
    trace = run.trace
    channels = {name: values[remaining] for name, values in trace.channels.items()}
    cut = replace(
        trace,
        time=trace.time[remaining],
        command=trace.command[remaining],
        phase=trace.phase[remaining],
        channels=channels,
    )
    return replace(run, trace=cut)


def with_capsule(run: Run, **changes: float | None) -> Run:
    """Change what a run says of its capsule; None takes it away."""
    text = {**run.info.header.capsule, **changes}
    header = replace(run.info.header, capsule={key: value for key, value in text.items() if value is not None})
    return replace(run, info=replace(run.info, header=header))


def selected(runs: Iterable[Run]) -> RunSelection:
    return select_loaded_runs(runs)
