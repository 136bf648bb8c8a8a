"""Campaigns of the plant written as run files."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from uuid import UUID, uuid5

import h5py
import numpy as np

from dragrig.sim_backend.blind.blind_campaign import BlindCampaign, parallel_session
from dragrig.sim_backend.blind.plant import CAPSULE_MASS_G, CAPSULE_RADIUS_MM, PlantRecord, recorded_run
from dragrig.sim_backend.blind.programme import PLANT_WALL_MM, RATE_HZ, RunList, RunPlan

SESSION_START = datetime(2026, 5, 4, 9, 0, tzinfo=UTC)
_RUN_ID_NAMESPACE = UUID("6d1e2f60-2f7b-4c0e-9d0e-1f2b9a7c5e11")
_FIXTURES = {"drag": "foam", "coulomb": "vacuum", "relaxation": "vacuum", "blank": "none"}
_UNITS = {"time": "s", "force": "mN", "position": "mm", "command": "mm"}
_COMPRESSION = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
PHASES = ("rest", "accelerate", "steady", "decelerate", "hold")


def write_campaign(campaign: BlindCampaign, folder: str | Path, *, runs: str | RunList | None = None) -> None:
    """Write a campaign's run files, NNN-KIND.h5: the required part of the run format, without anything hidden.

    Parameters
    ----------
    runs
        Programme in place of the drawn one: `fresh`, or a list of runs.

    Raises
    ------
    OSError
        When a file cannot be written.
    """
    if runs is not None:
        campaign = parallel_session(campaign, runs)
    Path(folder).mkdir(parents=True, exist_ok=True)
    for index, run in enumerate(campaign.runs):
        with h5py.File(Path(folder) / f"{run.order:03d}-{run.kind}.h5", "w") as file:
            _write_metadata(file, campaign, run)
            _write_trace(file.create_group("entry/trace"), recorded_run(campaign, index))


def _write_metadata(file: h5py.File, campaign: BlindCampaign, run: RunPlan) -> None:
    file.attrs.update({"NX_class": "NXroot", "default": "entry", "format": "dragrig-run", "format_version": 1})
    session = SESSION_START + (timedelta(days=1) if campaign.programme == "fresh" else timedelta())
    entry = file.create_group("entry")
    entry.attrs.update(
        {
            "NX_class": "NXentry",
            "default": "trace",
            "backend": "external",
            "run_id": str(uuid5(_RUN_ID_NAMESPACE, f"{campaign.seed} {campaign.programme} {run.order}")),
            "start_time": (session + timedelta(seconds=run.start_s)).isoformat(),
            "order": run.order,
            "status": "complete",
            "insertion_dwell_s": run.dwell_s,
        }
    )
    entry.create_group("protocol").attrs.update(_protocol_attributes(run))
    mass = 0.0 if run.kind == "blank" else CAPSULE_MASS_G
    entry.create_group("capsule").attrs.update(
        {"diameter_mm": 2 * CAPSULE_RADIUS_MM, "length_mm": 15.2, "mass_g": mass, "contact_angle_deg": 60.0}
    )
    entry.create_group("specimen").attrs.update(
        {"name": "jejunum", "wall_thickness_mm": PLANT_WALL_MM, "fixture": _FIXTURES[run.kind]}
    )


def _protocol_attributes(run: RunPlan) -> dict[str, str | float]:
    shared: dict[str, str | float] = {"kind": run.kind, "rest_s": run.rest_s, "hold_s": run.hold_s}
    if run.strain is not None:
        ramp = {"ramp_speed_mm_s": run.speed_mm_s, "ramp_accel_mm_s2": run.accel_mm_s2}
        return {**shared, "shear_strain": run.strain, **ramp}
    return {**shared, "speed_mm_s": run.speed_mm_s, "travel_mm": run.travel_mm, "accel_mm_s2": run.accel_mm_s2}


def _write_trace(group: h5py.Group, record: PlantRecord) -> None:
    group.attrs.update({"NX_class": "NXdata", "signal": "force", "axes": "time", "sample_rate_hz": RATE_HZ})
    columns = {"force": record.force, "position": record.position, "command": record.command}
    group.create_dataset("time", data=record.time, **_COMPRESSION)
    for name, values in columns.items():
        group.create_dataset(name, data=values.astype(np.float32), **_COMPRESSION)
    for name, unit in _UNITS.items():
        group[name].attrs["units"] = unit
    phase = group.create_dataset("phase", data=record.phase, **_COMPRESSION)
    phase.attrs.create("names", PHASES, dtype=h5py.string_dtype())
