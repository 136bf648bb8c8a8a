"""Campaigns as run files."""

from concurrent.futures import ProcessPoolExecutor
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from uuid import UUID, uuid5

import h5py
import numpy as np

from dragrig.sim_backend.blind.gut import MASS_G, RADIUS_MM
from dragrig.sim_backend.blind.programme import RATE_HZ, WALL_MM, Listed, RunPlan
from dragrig.sim_backend.blind.record import Trace, recorded
from dragrig.sim_backend.blind.secret import Secret, another_session

START = datetime(2026, 5, 4, 9, 0, tzinfo=UTC)
_NAMES = UUID("6d1e2f60-2f7b-4c0e-9d0e-1f2b9a7c5e11")
_FIXTURES = {"drag": "foam", "coulomb": "vacuum", "relaxation": "vacuum", "blank": "none"}
_UNITS = {"time": "s", "force": "mN", "position": "mm", "command": "mm"}
_PACKED = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
PHASES = ("rest", "accelerate", "steady", "decelerate", "hold")


def make(secret: Secret, folder: str | Path, workers: int = 1, *, runs: str | Listed | None = None) -> None:
    """Write a campaign's run files, NNN-KIND.h5, with the required part of the run format and nothing hidden in it.

    Parameters
    ----------
    workers
        Processes that share the runs; more than one only pays on an idle machine.
    runs
        Programme to be written in place of the one that was drawn, `fresh` for one, or a list of runs.

    Raises
    ------
    OSError
        When a file cannot be written.
    """
    if runs is not None:
        secret = another_session(secret, runs)
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    one = partial(_write_one, secret, place)
    if workers > 1:
        with ProcessPoolExecutor(workers) as pool:
            list(pool.map(one, range(len(secret.runs)), chunksize=4))
    else:
        for index in range(len(secret.runs)):
            one(index)


def _write_one(secret: Secret, folder: Path, index: int) -> None:
    trace = recorded(secret, index)
    run = trace.run
    with h5py.File(folder / f"{run.order:03d}-{run.kind}.h5", "w") as file:
        _describe(file, secret, run)
        _fill(file.create_group("entry/trace"), trace)


def _describe(file: h5py.File, secret: Secret, run: RunPlan) -> None:
    file.attrs.update({"NX_class": "NXroot", "default": "entry", "format": "dragrig-run", "format_version": 1})
    session = START + (timedelta(days=1) if secret.programme == "fresh" else timedelta())
    entry = file.create_group("entry")
    entry.attrs.update(
        {
            "NX_class": "NXentry",
            "default": "trace",
            "backend": "external",
            "run_id": str(uuid5(_NAMES, f"{secret.seed} {secret.programme} {run.order}")),
            "start_time": (session + timedelta(seconds=run.start_s)).isoformat(),
            "order": run.order,
            "status": "complete",
            "insertion_dwell_s": run.dwell_s,
        }
    )
    entry.create_group("protocol").attrs.update(_protocol(run))
    mass = 0.0 if run.kind == "blank" else MASS_G
    entry.create_group("capsule").attrs.update(
        {"diameter_mm": 2 * RADIUS_MM, "length_mm": 15.2, "mass_g": mass, "contact_angle_deg": 60.0}
    )
    entry.create_group("specimen").attrs.update(
        {"name": "jejunum", "wall_thickness_mm": WALL_MM, "fixture": _FIXTURES[run.kind]}
    )


def _protocol(run: RunPlan) -> dict[str, str | float]:
    both: dict[str, str | float] = {"kind": run.kind, "rest_s": run.rest_s, "hold_s": run.hold_s}
    if run.strain is not None:
        ramp = {"ramp_speed_mm_s": run.speed_mm_s, "ramp_accel_mm_s2": run.accel_mm_s2}
        return {**both, "shear_strain": run.strain, **ramp}
    return {**both, "speed_mm_s": run.speed_mm_s, "travel_mm": run.travel_mm, "accel_mm_s2": run.accel_mm_s2}


def _fill(group: h5py.Group, trace: Trace) -> None:
    group.attrs.update({"NX_class": "NXdata", "signal": "force", "axes": "time", "sample_rate_hz": RATE_HZ})
    columns = {"force": trace.force, "position": trace.position, "command": trace.command}
    group.create_dataset("time", data=trace.time, **_PACKED)
    for name, values in columns.items():
        group.create_dataset(name, data=values.astype(np.float32), **_PACKED)
    for name, unit in _UNITS.items():
        group[name].attrs["units"] = unit
    phase = group.create_dataset("phase", data=trace.phase, **_PACKED)
    phase.attrs.create("names", PHASES, dtype=h5py.string_dtype())
