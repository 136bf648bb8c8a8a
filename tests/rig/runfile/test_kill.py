"""Processes killed while they record and finish: what was recorded is there afterwards."""

import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from dragrig.config.errors import OutputError
from dragrig.rig import left_recordings, recover
from dragrig.rig.runfile import Finisher, Recorder, read_info, read_run, verify
from dragrig.rig.runfile.finisher import RecoveryOutcome
from dragrig.rig.runfile.model import RunEnding, RunStatus
from dragrig.rig.runfile.schema import journal_path
from ending import kill
from killed import STEPS, loss_of, run_victim
from property_tests import thorough
from runfiles import arrays, blocks, header, record

BOUND_S = 0.25
CRUCIAL = ("flushing", "copying")
"""Steps of recording, finishing and cleaning up, one of each."""


@pytest.mark.parametrize("seed", [0, *map(thorough, (1, 2, 3))])
def test_a_kill_at_any_moment_loses_a_quarter_second_at_most(tmp_path: Path, seed: int) -> None:
    draw = random.Random(seed)
    path, rate_hz = tmp_path / "run.h5", draw.choice([1000.0, 50_000.0])
    offers, killed = run_victim(path, kill_after_s=draw.uniform(0.1, 0.7), in_a_flush=seed % 2 == 0, rate_hz=rate_hz)
    loss = loss_of(path, offers, killed, rate_hz)
    assert loss.kept > 0
    assert loss.lost_s <= BOUND_S + loss.stall_s, loss
    info = read_info(path)
    assert info.status is RunStatus.RECOVERED
    assert str(info.samples) in info.reason
    assert verify(path).holds


@pytest.mark.parametrize("step", [step if step in CRUCIAL else thorough(step) for step in STEPS])
def test_a_kill_in_the_middle_of_a_step_leaves_a_whole_run_or_none(tmp_path: Path, step: str) -> None:
    path, times = tmp_path / "run.h5", 3 if step in {"appending", "flushing", "noting"} else 1
    offers, killed = run_victim(path, seconds=0.45, die_at=step, times=times)
    if not offers:
        recover(tmp_path)
        assert not path.exists() or read_info(path).samples == 0
    else:
        loss = loss_of(path, offers, killed)
        assert loss.lost_s <= BOUND_S + loss.stall_s, loss
        ended = step in {"closing", "copying", "syncing", "placed"}
        assert read_info(path).status is (RunStatus.COMPLETE if ended else RunStatus.RECOVERED)
        assert verify(path).holds
        assert read_run(path).events[0].kind == "tick"
    left = path.read_bytes() if path.exists() else b""
    assert recover(tmp_path) == []
    assert [entry.name for entry in tmp_path.iterdir()] == (["run.h5"] if left else [])
    assert not left or path.read_bytes() == left


def test_a_recording_whose_writer_lives_is_left_alone(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.h5", header(), reserve_bytes=0) as recorder:
        recorder.offer(0, arrays(0, 100))
        (recovered,) = recover(tmp_path)
        assert recovered.outcome is RecoveryOutcome.IN_USE
        elsewhere = subprocess.run(
            [sys.executable, "-c", "import sys; from pathlib import Path; from dragrig.rig import recover;"
             "print(recover(Path(sys.argv[1]))[0].outcome)", str(tmp_path)],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert elsewhere.stdout.strip() == "in use"
        with pytest.raises(OutputError, match="another process"):
            Recorder(tmp_path / "run.h5", header(), reserve_bytes=0)
        recorder.offer(100, arrays(100, 100))
        recorder.close(RunEnding(RunStatus.COMPLETE, "as planned"))
    (recovered,) = recover(tmp_path)
    assert (recovered.outcome, recovered.samples) == (RecoveryOutcome.FINISHED, 200)


def test_a_recording_that_cannot_be_read_stays_as_it_is(tmp_path: Path) -> None:
    left = record(tmp_path / "run.h5", 1000)
    for file in (left, journal_path(left)):
        file.write_bytes(file.read_bytes()[:3000])
    record(tmp_path / "whole.h5", 500)
    before = left.read_bytes()
    outcomes = {recovered.recording.name: recovered.outcome for recovered in recover(tmp_path)}
    assert outcomes == {"run.recording.h5": RecoveryOutcome.LEFT, "whole.recording.h5": RecoveryOutcome.FINISHED}
    assert left.read_bytes() == before
    assert left_recordings(tmp_path) == (left,)


def test_another_run_in_the_way_is_never_replaced(tmp_path: Path) -> None:
    left = record(tmp_path / "run.h5", 1000)
    aside = {file: file.rename(tmp_path / f"aside-{file.name}") for file in (left, journal_path(left))}
    recover(record(tmp_path / "run.h5", 500))
    for file, elsewhere in aside.items():
        elsewhere.rename(file)
    (recovered,) = recover(tmp_path)
    assert recovered.outcome is RecoveryOutcome.LEFT
    assert "another run" in recovered.message
    assert left.exists()
    assert read_info(tmp_path / "run.h5").samples == 500


def test_runs_are_finished_by_a_worker_out_of_the_terminals_reach(tmp_path: Path) -> None:
    with Finisher() as finisher:
        for order in range(2):
            finisher.submit(record(tmp_path / f"{order}.h5", 2000, order))
        first = finisher.wait()
        assert finisher.worker_pid is not None
        if sys.platform != "win32":  # where it has a console of its own
            os.kill(finisher.worker_pid, signal.SIGINT)
            assert os.getpgid(finisher.worker_pid) != os.getpgid(0)
        finisher.submit(record(tmp_path / "2.h5", 2000, 2))
        second = finisher.wait()
        assert psutil.Process(finisher.worker_pid).status() != psutil.STATUS_ZOMBIE
    assert [done.path for done in (*first, *second)] == [tmp_path / f"{order}.h5" for order in range(3)]
    assert finisher.pending == 0
    assert left_recordings(tmp_path) == ()
    assert all(verify(tmp_path / f"{order}.h5").holds for order in range(3))


def test_what_a_killed_worker_left_is_finished_here(tmp_path: Path) -> None:
    with Finisher() as finisher:
        finisher.submit(record(tmp_path / "0.h5", 100))
        finisher.wait()
        assert finisher.worker_pid is not None
        kill(finisher.worker_pid)
        for order in (1, 2):
            finisher.submit(record(tmp_path / f"{order}.h5", 1000, order))
        done = finisher.wait()
    assert sorted(result.path.name for result in done if result.path) == ["1.h5", "2.h5"]
    assert left_recordings(tmp_path) == ()


def test_a_worker_outlives_its_killed_parent_until_the_run_is_finished(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.h5", header(), reserve_bytes=0) as recorder:
        for first, block in blocks(400_000, 20_000):
            recorder.offer(first, block)
        left = recorder.close(RunEnding(RunStatus.COMPLETE, "as planned"))
    code = (
        "import sys, time; from pathlib import Path; from dragrig.rig.runfile import Finisher\n"
        "finisher = Finisher(); finisher.submit(Path(sys.argv[1])); finisher.wait(0.0)\n"
        "while finisher.worker_pid is None: time.sleep(0.001)\n"
        "print(finisher.worker_pid, flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(left)], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = psutil.Process(int(parent.stdout.readline()))
        parent.kill()
    worker.wait()
    recover(tmp_path)  # the kill may have come before the worker was told
    assert read_info(tmp_path / "run.h5").samples == 400_000
    assert verify(tmp_path / "run.h5").holds


def test_an_error_of_the_worker_comes_back_as_one_sentence(tmp_path: Path) -> None:
    with Finisher() as finisher:
        finisher.submit(tmp_path / "none.recording.h5")
        (done,) = finisher.wait()
    assert done.path is None
    assert done.error is not None
    assert "no such file" in str(done.error)
