"""The recorder: whatever the blocks, the file is the same; what flows in is on disk soon; a full disk is said."""

import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import psutil
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from disks import is_root, mounted
from dragrig.config.errors import OutputError, RecordingError, RunFileError
from dragrig.rig import FolderStore, recover
from dragrig.rig.engine import Store
from dragrig.rig.runfile import Recorder, finish, read_info, read_run, recorder, schema, verify
from dragrig.rig.runfile import store as store_module
from dragrig.rig.runfile.finisher import Finisher, finish_here
from dragrig.rig.runfile.model import Run, RunEnding, RunEvent, RunStatus
from dragrig.rig.runfile.recorder import (
    DiskSpace,
    FileSyncer,
    RecordingFile,
    SampleRing,
    create_recording,
    ending_annotation,
    entry_annotation,
    read_annotations,
    rebuild,
)
from places import SUPPORT
from property_tests import examples, thorough
from runfiles import START, arrays, blocks, header, record


def trace_of(run: Run) -> dict[str, np.ndarray]:
    trace = run.trace
    return {"time": trace.time, "command": trace.command, "phase": trace.phase, **trace.channels}


def same(run: Run, wanted: dict[str, np.ndarray]) -> None:
    columns = trace_of(run)
    assert columns.keys() == wanted.keys()
    for name, values in wanted.items():
        np.testing.assert_array_equal(columns[name], values, err_msg=name)


@settings(max_examples=examples(15), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(sizes=st.lists(st.integers(1, 9000), min_size=1, max_size=12), timed=st.booleans())
def test_the_arrays_do_not_depend_on_the_blocks(tmp_path: Path, sizes: list[int], timed: bool) -> None:
    path = tmp_path / "run.h5"
    path.unlink(missing_ok=True)
    with Recorder(path, header(), reserve_bytes=0) as recorder:
        first = 0
        for size in sizes:
            block = arrays(first, size)
            if not timed:
                del block["time"]
            recorder.offer(first, block)
            first += size
        left = recorder.close(RunEnding(RunStatus.COMPLETE, "as planned"))
    same(read_run(finish(left)), arrays(0, sum(sizes)))


@settings(max_examples=examples(60), deadline=None)
@given(capacity=st.integers(4, 40), sizes=st.lists(st.integers(0, 90), max_size=12))
def test_the_ring_hands_over_every_sample_in_order(capacity: int, sizes: list[int]) -> None:
    ring = SampleRing({"time": np.dtype("f8")}, capacity)
    taken: list[float] = []

    def take() -> None:
        closed = False
        while not closed:
            closed = ring.wait(0.001)
            for columns in ring.take():
                taken.extend(columns["time"].tolist())  # type: ignore[arg-type]

    taker = threading.Thread(target=take)
    taker.start()
    first = 0
    for size in sizes:
        assert ring.put({"time": np.arange(first, first + size, dtype=float)})
        first += size
    ring.close()
    taker.join()
    assert taken == list(range(first))
    assert not ring.put({"time": np.zeros(1)})


def test_lost_samples_leave_a_jump_in_time_and_an_event(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.h5", header(), reserve_bytes=0) as recorder:
        for first in (0, 100, 250, 350, 1000):
            block = arrays(first, 100)
            del block["time"]
            recorder.offer(first, block)
        left = recorder.close(RunEnding(RunStatus.COMPLETE, "as planned"))
    run = read_run(finish(left))
    index = np.concatenate([np.arange(first, first + 100) for first in (0, 100, 250, 350, 1000)])
    np.testing.assert_array_equal(run.trace.time, index / 1000.0)
    assert [(event.time_s, event.kind) for event in run.events] == [(0.2, "gap"), (0.45, "gap")]
    assert [event.message.partition(" samples")[0] for event in run.events] == ["50", "550"]


def test_all_that_is_known_of_a_run_is_in_its_file(tmp_path: Path) -> None:
    long = "µ" * 200
    with Recorder(tmp_path / "run.h5", header(order=4), reserve_bytes=0) as recorder:
        recorder.event(RunEvent(0.0, "start", "drag"))
        recorder.offer(0, arrays(0, 10))
        recorder.annotate({"command_t0_uncertainty_s": 2e-5, "origin_mm": 13.0, "note": "ü\n"})
        recorder.event(RunEvent(0.01, "trip", long))
        checks = {"rest_offset_mN": 0.1, "clipped": True}
        left = recorder.close(RunEnding(RunStatus.TRIPPED, "force: 500 mN", START, checks))
    run = read_run(finish(left))
    assert run.info.header.entry == {
        "operator": "Åsa", "origin_mm": 13.0, "command_t0_uncertainty_s": 2e-5, "note": "ü\n",
    }  # fmt: skip
    assert (run.info.status, run.info.reason, run.info.end_time) == (RunStatus.TRIPPED, "force: 500 mN", START)
    assert run.info.checks == {"rest_offset_mN": 0.1, "clipped": True}
    assert run.info.header.settings_toml == 'title = "drag"\n'
    assert run.events[0] == RunEvent(0.0, "start", "drag")
    assert run.events[1].message == "µ" * 78 + "…"
    assert verify(run.info.path).holds
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.h5"]


def test_a_finished_file_is_plain_hdf5_for_old_readers(tmp_path: Path) -> None:
    path = finish(record(tmp_path / "run.h5", 1000))
    assert path.read_bytes()[8] == 0  # the version of the superblock
    with h5py.File(path) as file:
        force = file["entry/trace/force"]
        assert (force.compression, force.shuffle) == ("gzip", True)


def snapshots(recording: Path, copy: Path) -> Iterator[Run]:
    """What is on disk, again and again, seen through a copy of the bytes."""
    while True:
        shutil.copy(recording, copy)
        yield read_run(copy)


def test_what_came_last_is_on_disk_soon_though_nothing_follows(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.h5", header(), reserve_bytes=0) as recorder:
        recorder.offer(0, arrays(0, 321))
        recorder.event(RunEvent(0.3, "phase", "steady"))
        copy = tmp_path / "copy.recording.h5"
        seen = next(run for run in snapshots(recorder.path, copy) if run.info.samples == 321 and run.events)
        same(seen, arrays(0, 321))
        assert seen.info.status is RunStatus.RECORDING
        assert seen.events == (RunEvent(0.3, "phase", "steady"),)
        recorder.close(RunEnding(RunStatus.COMPLETE, "as planned"))


def test_any_viewer_follows_a_recording(tmp_path: Path) -> None:
    viewer = (
        "import sys, h5py\n"
        "file = h5py.File(sys.argv[1], 'r', swmr=True)\n"
        "force = file['entry/trace/force']\n"
        "print(len(force), flush=True)\n"
        "while len(force) < 3000: force.refresh()\n"
        "print(force[2999], flush=True)\n"
    )
    with Recorder(tmp_path / "run.h5", header(), reserve_bytes=0) as recorder:
        recorder.offer(0, arrays(0, 1000))
        with subprocess.Popen(
            [sys.executable, "-c", viewer, str(recorder.path)], stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            try:
                assert int(process.stdout.readline()) <= 1000
                recorder.offer(1000, arrays(1000, 2000))
                assert float(process.stdout.readline()) == 2999
                assert process.wait() == 0
            finally:
                process.kill()
        recorder.close(RunEnding(RunStatus.COMPLETE, "as planned"))


@pytest.mark.parametrize(
    ("first", "change", "message"),
    [
        (50, lambda block: block, "100 comes next"),
        (100, lambda block: {**block, "extra": block["force"]}, "extra"),
        (100, lambda block: {**block, "force": block["force"][:5]}, "force has shape"),
        (100, lambda block: {**block, "force": block["force"] * 1j}, "complex"),
        (100, lambda block: {name: block[name] for name in block if name != "position"}, "position"),
    ],
)
def test_samples_that_do_not_fit_are_refused_and_the_run_goes_on(
    tmp_path: Path, first: int, change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]], message: str
) -> None:
    with Recorder(tmp_path / "run.h5", header(), reserve_bytes=0) as recorder:
        recorder.offer(0, arrays(0, 100))
        with pytest.raises(ValueError, match=message):
            recorder.offer(first, change(arrays(first, 10)))
        recorder.offer(100, arrays(100, 100))
        left = recorder.close(RunEnding(RunStatus.COMPLETE, "as planned"))
    same(read_run(finish(left)), arrays(0, 200))


def test_a_run_is_never_recorded_over_another(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    left = record(path, 100)
    with pytest.raises(OutputError, match="already"):
        Recorder(path, header())
    finish(left)
    with pytest.raises(OutputError, match="already"):
        Recorder(path, header())
    with pytest.raises(OutputError, match="choose another folder"):
        Recorder(tmp_path / "none" / "run.h5", header())
    with pytest.raises(RunFileError, match="diameter_mm"):
        Recorder(tmp_path / "other.h5", replace(header(), capsule={}))
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.h5"]


@pytest.mark.parametrize(
    ("fault", "status"),
    [(KeyboardInterrupt(), RunStatus.ABORTED), (RuntimeError("the stage is gone"), RunStatus.FAILED)],
)
def test_a_recorder_left_by_an_error_says_so_in_its_file(
    tmp_path: Path, fault: BaseException, status: RunStatus
) -> None:
    def fail() -> None:
        with Recorder(tmp_path / "run.h5", header(), reserve_bytes=0) as recorder:
            recorder.offer(0, arrays(0, 100))
            raise fault

    with pytest.raises(type(fault)):
        fail()
    (recovered,) = recover(tmp_path)
    assert recovered.path is not None
    info = read_info(recovered.path)
    assert (info.status, info.samples) == (status, 100)
    assert str(fault) in info.reason


def test_a_disk_with_too_little_room_is_refused_before_anything_moves(tmp_path: Path) -> None:
    free = shutil.disk_usage(tmp_path).free
    with pytest.raises(RecordingError, match="make room"):
        Recorder(tmp_path / "run.h5", header(), expected_samples=free // 20)
    assert list(tmp_path.iterdir()) == []


def test_a_session_records_into_a_folder_of_run_files(tmp_path: Path) -> None:
    from dragrig.rig.runfile import read_campaign

    with FolderStore(tmp_path / "data" / "campaign", reserve_mb=0) as folder:
        store: Store = folder
        for order in range(2):
            sink = store.open(header(order=order), 1000)
            for first, block in blocks(1000, 50):
                sink.offer(first, block)
            path = sink.close(RunEnding(RunStatus.COMPLETE, "as planned", START))
        store.mark_bad(0, "spilled")
        store.settle()
    recovered = read_campaign(tmp_path / "data" / "campaign")
    assert [run.path.name for run in recovered.runs] == ["20260504-093000-drag-000.h5", "20260504-093000-drag-001.h5"]
    assert [run.header.order for run in recovered.good] == [1]
    same(read_run(path), arrays(0, 1000))


FILLER = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from runfiles import arrays, header
from dragrig.config.errors import RecordingError
from dragrig.rig.runfile import Recorder, recorder as module
from dragrig.rig.runfile.model import RunEnding, RunStatus
folder = Path(sys.argv[1])
if sys.argv[3] == "blind":  # the disk is filled by others, faster than anybody can watch
    module.free_bytes = lambda _: 1 << 60
# Offered as fast as the computer can, and not as a rig does: what is not written yet needs a reserve of its own.
recorder = Recorder(folder / "run.h5", header(rate_hz=250e3), reserve_bytes=20 << 20, flush_s=0.005)
first = 0
try:
    while True:
        recorder.offer(first, arrays(first, 5000, 250e3))
        first += 5000
except RecordingError as error:
    print(error)
try:
    recorder.close(RunEnding(RunStatus.FAILED, "no room"))
except RecordingError as error:
    print(error)
print("done", first)
"""


@pytest.mark.parametrize("watch", [thorough("watched"), "blind"])
def test_a_full_disk_is_reported_and_what_was_recorded_is_kept(small_disk: Path, tmp_path: Path, watch: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FILLER, str(small_disk), str(SUPPORT), watch],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert "make room" in lines[0]
    assert lines[-1].startswith("done")
    offered = int(lines[-1].split()[1])
    if watch == "blind":
        assert "No space left on device" in lines[0]
        (recovered,) = recover(small_disk)
        assert "make room" in recovered.message
        shutil.copy(recovered.recording, tmp_path)
        (recovered,) = recover(tmp_path / recovered.recording.name)
        assert recovered.samples > 0
    else:
        (recovered,) = recover(small_disk)
        # The samples whose offer told of the shortage are kept too.
        assert recovered.samples == offered + 5000
    assert recovered.path is not None
    same(read_run(recovered.path), arrays(0, recovered.samples, 250e3))
    assert read_info(recovered.path).status is (RunStatus.RECOVERED if watch == "blind" else RunStatus.FAILED)


def test_a_folder_whose_path_leaves_no_room_for_names_is_refused_before_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    longest = 4095  # PATH_MAX without its end
    if sys.platform == "win32":
        # As a Windows whose long paths are not switched on, which a test cannot do to the computer.
        longest, touch = 259, Path.touch

        def known(path: Path) -> None:
            return touch(path) if len(str(path)) <= longest else touch(path / "not there" / "file")

        monkeypatch.setattr(Path, "touch", known)
    deep = tmp_path
    while len(str(deep)) < longest - 250:
        deep /= "d" * 200
    deep /= "d" * (longest - 41 - len(str(deep)))
    with pytest.raises(OutputError, match=rf"path of {longest - 41} characters leaves no room"):
        FolderStore(deep)


def test_a_session_ends_though_the_disk_makes_no_progress_and_says_what_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finishers: list[Finisher] = []

    def finisher(*arguments: Any) -> Finisher:
        finishers.append(Finisher(*arguments))
        return finishers[-1]

    monkeypatch.setattr(store_module, "Finisher", finisher)

    def run(store: FolderStore, order: int) -> None:
        sink = store.open(header(order=order), 1000)
        for first, block in blocks(1000, 50):
            sink.offer(first, block)
        sink.close(RunEnding(RunStatus.COMPLETE, "as planned", START))

    with FolderStore(tmp_path, reserve_mb=0, max_stall_s=0.3) as store:
        run(store, 0)
        finishers[0].wait()
        worker = psutil.Process(finishers[0].worker_pid)
        worker.suspend()
        try:
            run(store, 1)
            with pytest.raises(RecordingError, match=r"no progress for 0\.3 s; still recordings"):
                store.settle()
        finally:
            worker.resume()
    finishers[0].wait()
    recover(tmp_path)
    assert read_info(tmp_path / "20260504-093000-drag-001.h5").samples == 1000


@pytest.mark.skipif(not is_root(), reason="only root may keep a file from being removed")
def test_a_disk_that_refuses_to_remove_a_recording_is_said_in_a_sentence(tmp_path: Path) -> None:
    recording = record(tmp_path / "run.h5", 1000)
    copy = tmp_path / "copy"
    copy.write_bytes(recording.read_bytes())
    # A file with something mounted on it cannot be removed.
    if not mounted("--bind", str(copy), str(recording)):
        pytest.skip("nothing can be mounted here")
    try:
        result = finish_here(recording)
    finally:
        subprocess.run(["umount", str(recording)], check=True)
    assert result.error is not None
    assert "is whole and in place, but the disk refuses to remove the recording" in str(result.error)
    assert verify(tmp_path / "run.h5").holds
    assert finish_here(recording).path == tmp_path / "run.h5"


# The parts of the recorder, each by itself


def test_a_ring_hands_over_views_at_its_end_and_at_its_begin() -> None:
    ring = SampleRing({"time": np.dtype("f8"), "phase": np.dtype("u1")}, 8)
    given = {"time": np.arange(6.0), "phase": np.arange(6, dtype="u1")}
    assert ring.put(given)
    assert [columns["time"].tolist() for columns in ring.take()] == [[0, 1, 2, 3, 4, 5]]
    assert ring.put({"time": np.arange(6.0, 11.0), "phase": np.arange(6, 11, dtype="u1")})
    pieces = [(columns["time"].tolist(), columns["phase"].tolist()) for columns in ring.take()]
    assert pieces == [([6, 7], [6, 7]), ([8, 9, 10], [8, 9, 10])]
    assert list(ring.take()) == []


def test_a_ring_wakes_its_consumer_at_a_quarter_and_says_when_it_is_closed() -> None:
    ring = SampleRing({"time": np.dtype("f8")}, 8)
    woken = threading.Thread(target=ring.wait, args=(600.0,))
    woken.start()
    ring.put({"time": np.zeros(1)})
    woken.join(0.05)
    assert woken.is_alive()
    ring.put({"time": np.zeros(1)})
    woken.join(60.0)
    assert not woken.is_alive()
    assert ring.wait(600.0) is False
    ring.close()
    assert ring.wait(600.0) is True
    assert ring.put({"time": np.zeros(1)}) is False


def test_a_ring_without_room_lets_its_producer_wait() -> None:
    ring = SampleRing({"time": np.dtype("f8")}, 4)
    put: list[bool] = []
    producer = threading.Thread(target=lambda: put.append(ring.put({"time": np.arange(6.0)})))
    producer.start()
    taken: list[float] = []
    while len(taken) < 6:
        ring.wait(60.0) if len(taken) < 4 else None
        for columns in ring.take():
            taken.extend(columns["time"].tolist())  # type: ignore[arg-type]
    producer.join(60.0)
    assert (put, taken) == ([True], [0, 1, 2, 3, 4, 5])
    full = threading.Thread(target=lambda: put.append(ring.put({"time": np.arange(9.0)})))
    full.start()
    full.join(0.05)
    assert full.is_alive()
    ring.close()
    full.join(60.0)
    assert put == [True, False]


@pytest.mark.parametrize(
    ("run_bytes", "written", "needed"),
    [(1000, 0, 3000), (1000, 400, 2200), (1000, 1000, 1000), (1000, 5000, 5000), (0, 0, 0)],
)
def test_a_run_needs_room_for_what_is_to_come_twice_and_for_its_copy(
    tmp_path: Path, run_bytes: int, written: int, needed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    space = DiskSpace(tmp_path, 70_000_000, run_bytes * 1_000_000)
    monkeypatch.setattr(recorder, "free_bytes", lambda folder: 70_000_000 + needed * 1_000_000)
    assert space.shortage(written * 1_000_000) is None
    monkeypatch.setattr(recorder, "free_bytes", lambda folder: 70_000_000 + needed * 1_000_000 - 1_000_000)
    assert space.shortage(written * 1_000_000) == (
        f"{tmp_path}: {needed + 69:.1f} MB are free and {needed + 70:.1f} MB needed; make room"
    )


def offered_until_refused(recording: Recorder, first: int, step: int) -> tuple[int, str]:
    """Return the first sample after those that were offered last, and what was said of these."""
    while True:
        try:
            recording.offer(first, arrays(first, step))
        except RecordingError as error:
            return first + step, str(error)
        first += step


class FullDisk:
    """A disk whose free room a test says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.free = 1 << 60
        monkeypatch.setattr(recorder, "free_bytes", lambda folder: self.free)


def test_a_disk_that_fills_up_is_said_once_and_what_is_still_sampled_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = FullDisk(monkeypatch)
    path = tmp_path / "run.h5"
    with Recorder(path, header(), flush_s=0.001, reserve_bytes=1_000_000) as recording:
        recording.offer(0, arrays(0, 100))
        assert recording.failure is None
        disk.free = 0
        first, said = offered_until_refused(recording, 100, 10)
        assert re.fullmatch(rf"{re.escape(str(tmp_path))}: 0\.0 MB are free and 1\.\d MB needed; make room", said)
        assert str(recording.failure) == said
        recording.offer(first, arrays(first, 10))
        left = recording.close(RunEnding(RunStatus.FAILED, "no room"))
    run = read_run(finish(left))
    assert run.info.samples == first + 10
    assert (run.info.status, run.info.reason) == (RunStatus.FAILED, "no room")


def test_a_disk_that_refuses_is_said_with_the_file_and_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.h5"

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    recording = Recorder(path, header(), flush_s=0.001, reserve_bytes=0)
    recording.offer(0, arrays(0, 100))
    recording.event(RunEvent(0.0, "start", "drag"))
    monkeypatch.setattr(recorder.RecordingFile, "append", refuse)
    _, said = offered_until_refused(recording, 100, 10_000)
    sentence = (
        f"{tmp_path / 'run.recording.h5'}: the disk refused data (No space left on device); make room, then "
        "`dragrig recover` finishes what was recorded"
    )
    assert said == sentence
    assert str(recording.failure) == sentence
    for _ in range(2):
        with pytest.raises(RecordingError, match="the disk refused data"):
            recording.close(RunEnding(RunStatus.FAILED))
    monkeypatch.undo()
    (recovered,) = recover(tmp_path)
    assert recovered.path is not None


def test_a_sync_that_fails_is_raised_by_the_next_request(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> None:
        raise OSError(5, "Input/output error")

    target = tmp_path / "journal"
    target.write_bytes(b"x")
    monkeypatch.setattr(recorder, "sync_file", refuse)
    syncer = FileSyncer(target)
    syncer.request()
    syncer.close()
    with pytest.raises(OSError, match="Input/output error"):
        syncer.request()


def threads_of(name: str) -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == name]


def test_every_request_is_synced_before_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(recorder, "sync_file", synced.append)
    target = tmp_path / "journal"
    syncer = FileSyncer(target)
    threads = threads_of("sync of journal")
    assert {thread.daemon for thread in threads} == {True}
    syncer.close()
    assert synced == []
    syncer = FileSyncer(target)
    syncer.request()
    syncer.close()
    assert synced == [target]
    assert threads_of("sync of journal") == []


ENDING = RunEnding(RunStatus.TRIPPED, "force", START, {"lost_samples": 3})


def test_what_became_known_during_a_run_is_read_in_its_order(tmp_path: Path) -> None:
    left = record(tmp_path / "run.h5", 10)
    with h5py.File(left) as file:
        entry, ending = read_annotations(file, schema.LAYOUT)
    assert entry == {}
    assert ending == RunEnding(RunStatus.COMPLETE, "as planned", START, {"rest_offset_mN": 1.5, "clipped": False})
    lines = [
        entry_annotation({"a": 1, "b": "µ"}), ending_annotation(ENDING), entry_annotation({"a": 2.5}),
        ending_annotation(replace(ENDING, end_time=None, status=RunStatus.FAILED)),
    ]  # fmt: skip
    recording = create_recording(tmp_path / "other.recording.h5", header())
    file = RecordingFile(tmp_path / "other.recording.h5", recording)
    file.append_annotations(lines[:2])
    file.flush()
    file.append_annotations(lines[2:3])
    with h5py.File(tmp_path / "other.recording.h5", swmr=True, locking=False) as early:
        assert read_annotations(early, schema.LAYOUT) == ({"a": 1, "b": "µ"}, ENDING)
    file.append_annotations(lines[3:])
    file.flush()
    file.close()
    with h5py.File(tmp_path / "other.recording.h5") as whole:
        assert read_annotations(whole, schema.LAYOUT) == (
            {"a": 2.5, "b": "µ"}, RunEnding(RunStatus.FAILED, "force", None, {"lost_samples": 3}),
        )  # fmt: skip
        del whole
    with h5py.File(tmp_path / "bare.h5", "w") as bare:
        assert read_annotations(bare, schema.LAYOUT) == ({}, None)


def test_a_recording_is_made_anew_from_its_journal(tmp_path: Path) -> None:
    path = tmp_path / "run.recording.h5"
    journal = create_recording(path, header())
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["run.recording.h5", "run.recording.journal"]
    file = RecordingFile(path, journal)
    assert file.written_bytes == 0
    file.append(arrays(0, 100))
    file.append_events([RunEvent(0.0, "start", "drag")])
    file.append(arrays(100, 50))
    file.append_annotations([entry_annotation({"note": "x"}), ending_annotation(ENDING)])
    assert file.samples == 150
    assert file.written_bytes == 150 * (8 + 4 * 4 + 1)
    file.flush()
    file.close()
    path.write_bytes(b"destroyed")
    rebuild(path)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["run.recording.h5", "run.recording.journal"]
    run = read_run(finish(path))
    same(run, arrays(0, 150))
    assert [event.kind for event in run.events] == ["start"]
    assert (run.info.status, run.info.reason) == (RunStatus.TRIPPED, "force")
    assert run.info.header.entry["note"] == "x"


def test_a_journal_of_nothing_leaves_the_recording_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "run.recording.h5"
    path.write_bytes(b"as it was")
    (tmp_path / "run.recording.journal").write_bytes(b"no frame")
    rebuild(path)
    assert path.read_bytes() == b"as it was"
    assert len(list(tmp_path.iterdir())) == 2


def test_a_recording_that_cannot_be_named_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(13, "Permission denied")

    for step in ("rename_into_place", "sync_folder", "sync_file", "write_header"):
        with monkeypatch.context() as patch:
            patch.setattr(recorder, step, refuse)
            with pytest.raises(OutputError) as caught:
                Recorder(tmp_path / "run.h5", header(), reserve_bytes=0)
        assert str(caught.value) == (
            f"{tmp_path / 'run.recording.h5'}: could not be made (Permission denied); choose another folder"
        )
        assert not (tmp_path / "run.recording.journal").exists()
        assert not list(tmp_path.glob("*.part"))
        (tmp_path / "run.recording.h5").unlink(missing_ok=True)


def test_what_stands_in_the_way_of_a_run_is_named(tmp_path: Path) -> None:
    for name in ("run.h5", "run.recording.h5", "run.recording.journal"):
        taken = tmp_path / name
        taken.write_bytes(b"")
        with pytest.raises(OutputError) as caught:
            Recorder(tmp_path / "run.h5", header(), reserve_bytes=0)
        assert str(caught.value) == f"{taken}: there is a run file already; choose another name"
        taken.unlink()
    with pytest.raises(RunFileError) as refused:
        Recorder(tmp_path / "run.h5", replace(header(), capsule={}))
    assert str(refused.value) == (
        f"{tmp_path / 'run.h5'}: cannot be recorded because /entry/capsule lacks the attribute diameter_mm; correct "
        "the settings"
    )


NAMES = "command, force, motor_force, phase, position, time"


@pytest.mark.parametrize(
    ("first", "change", "sentence"),
    [
        (50, lambda block: block, "samples from 50 on are not expected, 100 comes next"),
        (100, lambda block: {**block, "extra": block["force"]},
         f"got command, extra, force, motor_force, phase, position, time instead of {NAMES}"),
        (100, lambda block: {"time": block["time"]}, f"got time instead of {NAMES}"),
        (100, lambda block: {**block, "force": block["force"][:5]}, "force has shape (5,) instead of (10,)"),
        (100, lambda block: {**block, "time": block["time"][:, None]}, "time has shape (10, 1) instead of (10,)"),
        (100, lambda block: {**block, "force": block["force"] * 1j},
         "force is complex64, which float32 cannot hold"),
        (100, lambda block: {**block, "phase": block["phase"].astype("f4")},
         "phase is float32, which uint8 cannot hold"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_said(
    tmp_path: Path, first: int, change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]], sentence: str
) -> None:
    with Recorder(tmp_path / "run.h5", header(), reserve_bytes=0) as recording:
        recording.offer(0, arrays(0, 100))
        with pytest.raises(ValueError, match=re.escape(sentence)) as caught:
            recording.offer(first, change(arrays(first, 10)))
        assert str(caught.value) == sentence
        recording.close(RunEnding(RunStatus.COMPLETE))
        with pytest.raises(ValueError, match="samples from 100 on are not expected, 100 comes next"):
            recording.offer(100, arrays(100, 1))


def test_wider_numbers_than_the_files_are_taken(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.h5", header(), reserve_bytes=0) as recording:
        recording.offer(0, {name: column.astype("f8") if column.dtype == "f4" else column
                            for name, column in arrays(0, 10).items()})  # fmt: skip
        left = recording.close(RunEnding(RunStatus.COMPLETE))
    same(read_run(finish(left)), arrays(0, 10))


def test_a_recorder_that_is_left_open_says_so(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.h5", header(), reserve_bytes=0) as recording:
        assert recording.path == tmp_path / "run.recording.h5"
        recording.offer(0, arrays(0, 100))
    info = read_info(finish(recording.path))
    assert (info.status, info.reason) == (RunStatus.FAILED, "the recorder was left before the run was closed")


def test_a_disk_that_does_not_answer_is_not_waited_for_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = threading.Event()
    flush = recorder.RecordingFile.flush

    def late(file: RecordingFile) -> None:
        answers.wait(600.0)
        flush(file)

    monkeypatch.setattr(recorder.RecordingFile, "flush", late)
    monkeypatch.setattr(recorder, "MAX_CLOSE_S", 0.05)
    recording = Recorder(tmp_path / "run.h5", header(), reserve_bytes=0)
    recording.offer(0, arrays(0, 10))
    with pytest.raises(RecordingError) as caught:
        recording.close(RunEnding(RunStatus.COMPLETE))
    assert str(caught.value) == (
        f"{tmp_path / 'run.recording.h5'}: the disk has not taken the last samples for 0.05 s; what it has taken is "
        "kept: check the disk, then `dragrig recover`"
    )
    (thread,) = threads_of("recorder of run.recording.h5")
    assert thread.daemon
    answers.set()
    thread.join(600.0)
    assert not thread.is_alive()
