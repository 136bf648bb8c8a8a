"""What the tests of the run file share: headers, samples and folders of runs."""

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from uuid import uuid4

import h5py
import numpy as np
import numpy.typing as npt

from dragrig.rig.runfile.model import RecordedChannel, RunEnding, RunHeader, RunStatus
from dragrig.rig.runfile.recorder import Recorder

Arrays = dict[str, npt.NDArray[np.generic]]

CHANNELS = (RecordedChannel("force", "mN"), RecordedChannel("position", "mm"), RecordedChannel("motor_force", "mN"))
START = datetime(2026, 5, 4, 9, 30, tzinfo=UTC)


def header(order: int = 0, rate_hz: float = 1000.0, kind: str = "drag", specimen: str = "jejunum") -> RunHeader:
    return RunHeader(
        run_id=str(uuid4()),
        start_time=START,
        order=order,
        backend="simulated",
        kind=kind,
        sample_rate_hz=rate_hz,
        channels=CHANNELS,
        entry={"operator": "Åsa", "origin_mm": 12.5},
        protocol={"speed_mm_s": 1, "travel_mm": 40.0, "accel_mm_s2": 400.0, "rest_s": 1.0, "hold_s": 3.0},
        capsule={"diameter_mm": 12.9, "length_mm": 15.2, "mass_g": 50.1, "contact_angle_deg": 60.0},
        specimen={"name": specimen, "wall_thickness_mm": 2.5, "fixture": "foam"},
        settings_toml='title = "drag"\n',
    )


def arrays(first: int, count: int, rate_hz: float = 1000.0) -> Arrays:
    """Samples whose values follow from their index, so that any piece of a file can be told right or wrong."""
    index = np.arange(first, first + count)
    return {
        "time": index / rate_hz,
        "force": (index % 8191).astype(np.float32),
        "position": (index % 4093 / 1e3).astype(np.float32),
        "motor_force": (index % 127).astype(np.float32),
        "command": (index % 4093 / 1e3).astype(np.float32),
        "phase": (index // 100 % 5).astype(np.uint8),
    }


def blocks(total: int, size: int) -> Iterator[tuple[int, Arrays]]:
    for first in range(0, total, size):
        yield first, arrays(first, min(size, total - first))


def as_version_1(path: Path) -> Path:
    """Lay a run file, finished or still a recording, out as the first version of the format did."""
    with h5py.File(path, "r+") as file:
        entry, run = file["entry"], file["entry/run"]
        for name, value in run.attrs.items():
            if name != "NX_class":
                holder = file if name.startswith("format") else entry
                holder.attrs[name] = 1 if name == "format_version" else value
        for name in run:
            file.move(f"entry/run/{name}", f"entry/{name}")
        del file["entry/run"]
    return path


def record(path: Path, samples: int, order: int = 0, status: RunStatus = RunStatus.COMPLETE) -> Path:
    """Record a run to its end and return the recording."""
    with Recorder(path, replace(header(order)), reserve_bytes=0) as recorder:
        for first, block in blocks(samples, 500):
            recorder.offer(first, block)
        return recorder.close(RunEnding(status, "as planned", START, {"rest_offset_mN": 1.5, "clipped": False}))
