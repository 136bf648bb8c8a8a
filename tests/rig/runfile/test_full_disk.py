"""A truly full disk under a running session: the stage is stopped, the error said, the data kept."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dragrig.rig.runfile import read_campaign, read_run
from dragrig.rig.runfile.model import RunStatus


def fill(disk: Path) -> None:
    with (disk / "filler").open("wb", buffering=0) as file:
        try:
            while True:
                file.write(b"\0" * 65536)
        except OSError:
            pass


def recorded_samples(folder: Path) -> int:
    recordings = list(folder.glob("*.recording.h5"))
    return read_run(recordings[0]).info.samples if recordings else 0


@pytest.mark.thorough
def test_a_full_disk_stops_the_stage_and_costs_nothing_recorded(small_disk: Path, tmp_path: Path) -> None:
    folder = small_disk / "campaign"
    command = [sys.executable, "-m", "dragrig", "run", "drag", "--pace", "real", "--yes", "--out", str(folder)]
    changes = ["wait_s=0", "speed_mm_s=2", "hold_s=0.5", "rig.recording.reserve_mb=1"]
    for change in changes:
        command += ["--set", change]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as session:
        try:
            while recorded_samples(folder) < 1500:
                assert session.poll() is None, session.communicate()
                time.sleep(0.05)
            recorded = recorded_samples(folder)
            fill(small_disk)
            _, errors = session.communicate()
        finally:
            session.kill()
    assert session.returncode == 5, errors
    assert "Traceback" not in errors
    assert "disk" in errors or "free" in errors
    (small_disk / "filler").unlink()
    recovered = subprocess.run(
        [sys.executable, "-m", "dragrig", "recover", str(folder)], capture_output=True, text=True, check=False
    )
    assert recovered.returncode == 0, recovered.stderr
    (info,) = read_campaign(folder).runs
    assert info.status in {RunStatus.FAILED, RunStatus.RECOVERED}
    run = read_run(info.path)
    assert run.info.samples >= recorded
    np.testing.assert_allclose(np.diff(run.trace.time), 1e-3, atol=1e-9)
    np.testing.assert_allclose(run.trace.position, run.trace.command, atol=0.01)
