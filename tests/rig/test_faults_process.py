"""Faults of program and computer: ended, killed, frozen, hung, met by another, disk full, time put back, no driver."""

import io
import json
import mmap
import shutil
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from ctypes.util import find_library
from datetime import datetime, timedelta
from pathlib import Path

import psutil
import pytest

from dragrig.cli import main
from dragrig.rig import recover
from dragrig.rig.hardware.dialects.base import Halt
from dragrig.rig.reading import Reading
from dragrig.rig.runfile import read_campaign, read_info, read_run
from dragrig.rig.runfile.model import RunStatus
from ending import press
from places import SUPPORT, TESTS
from remote_doubles import StageStatus
from rig_faults import (
    DOCS,
    FAR_MM,
    PATIENCE_S,
    SOON_HUNG,
    SOON_SILENT,
    Bench,
    Program,
    ServedDoubles,
    assert_goes_on,
    assert_kept,
    assert_reported,
    assert_stopped,
    begin,
    bench,
    only_run,
    sentence,
)


@pytest.fixture(scope="module")
def faulty_bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Doubles that outlive a program that is killed."""
    with bench(tmp_path_factory.mktemp("lab"), ServedDoubles) as entry:
        yield entry


@pytest.fixture
def near_rig(tmp_path: Path) -> Iterator[Bench]:
    """Doubles in this process."""
    with bench(tmp_path) as entry:
        yield entry


@pytest.fixture
def start(faulty_rig: Bench) -> Iterator[Callable[..., Program]]:
    """Return what starts `dragrig run`; whatever still runs in the end is killed."""
    started: list[Program] = []

    def begun(*words: object, **environment: str) -> Program:
        started.append(Program(faulty_rig, *map(str, words), **environment))
        return started[-1]

    yield begun
    for program in started:
        program.close()
    faulty_rig.until(lambda look: not look.moving)


Start = Callable[..., Program]
EVERY_SAMPLE = "rig.hardware.card.oversampling=1"
"""How the card's double has the least to do."""
ON_DISK = 250
"""Samples from which on a run has moved."""


def settings_words(*assignments: str) -> list[str]:
    """How a command line has settings changed."""
    return [word for assignment in assignments for word in ("--set", assignment)]


def recorded(folder: Path) -> int:
    """How many samples are on disk right now."""
    paths = list(folder.glob("*.recording.h5"))
    return read_info(paths[0]).samples if paths else 0


class ShiftedClock:
    """The time of day of a program that is started with `environment`, moved while it runs where that is possible."""

    def __init__(self, folder: Path) -> None:
        self.environment: dict[str, str] = {}
        library, file = folder / "shift.so", folder / "shift"
        file.write_bytes(bytes(8))
        with file.open("r+b") as opened:
            self._map = mmap.mmap(opened.fileno(), 8)
        if sys.platform == "linux" and shutil.which("cc"):
            words = ["cc", "-shared", "-fPIC", "-O1", "-o", library, SUPPORT / "wall_clock_shift.c", "-ldl"]
            if not subprocess.run(words, capture_output=True, check=False).returncode:
                self.environment = {"LD_PRELOAD": str(library), "CLOCK_SHIFT": str(file)}

    def put(self, shift: timedelta) -> None:
        self._map[:8] = struct.pack("q", round(shift.total_seconds()))


HOUR, HALF_AN_HOUR = timedelta(hours=1), timedelta(minutes=30)


def test_a_second_program_is_refused_and_sigkill_leaves_the_drive_to_stop_by_itself_and_the_data_on_disk(
    faulty_rig: Bench, start: Start, tmp_path: Path
) -> None:
    """Nor does it matter that the clock is put back by an hour while the first one runs."""
    clock, began = ShiftedClock(tmp_path), datetime.now().astimezone()
    clock.put(HOUR)
    words = ("plan.toml", *settings_words(*SOON_SILENT, EVERY_SAMPLE))
    program = start(*words, "--out", folder := faulty_rig.folder(), **clock.environment)
    faulty_rig.until(lambda look: look.enabled, lambda: program.alive or program.reported())
    second = begin(faulty_rig).end()
    assert second.exit_code == 5
    assert sentence("two programs on one rig").fullmatch(second.message), second.message
    assert str(program.process.pid) in second.message
    assert not second.folder.exists()
    struck = program.until_under_way()
    clock.put(timedelta())
    faulty_rig.until(lambda _: recorded(folder) > ON_DISK, lambda: program.alive)
    remaining = recorded(folder)
    program.process.kill()
    look = faulty_rig.until(lambda look: not look.moving)
    assert_stopped(struck, look, Halt.SILENCE, FAR_MM)
    # To this program it is an hour earlier than it was to the first one.
    assert_goes_on(faulty_rig, folder)
    lost, later = sorted(read_campaign(folder).runs, key=lambda info: info.header.order)
    assert lost.status is RunStatus.RECOVERED
    assert sentence("SIGKILL").fullmatch(lost.reason), lost.reason
    assert_kept(read_run(lost.path), remaining)
    if clock.environment:
        assert abs(lost.header.start_time - began - HOUR) < HALF_AN_HOUR
    assert later.header.start_time >= lost.header.start_time + timedelta(seconds=lost.samples / 1000)
    assert later.path.name > lost.path.name


def test_sigterm_ends_a_run_in_good_order(
    near_rig: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, struck = near_rig.folder(), list[StageStatus]()
    monkeypatch.chdir(near_rig.lab)
    monkeypatch.setattr(sys, "stdin", io.StringIO("done\n" * 20))

    def strike() -> None:
        near_rig.until_under_way()
        struck.append(near_rig.until(lambda _: recorded(folder) > ON_DISK))
        press(signal.SIGTERM)

    # A run that has ended before must not take the tests with it.
    earlier = signal.signal(signal.SIGTERM, lambda *_: None)
    striking = threading.Thread(target=strike)
    striking.start()
    try:
        code = main(["run", "plan.toml", "--json", "--out", str(folder), *settings_words("speed_mm_s=3", EVERY_SAMPLE)])
    finally:
        striking.join()
        signal.signal(signal.SIGTERM, earlier)
    told = capsys.readouterr()
    printed, answer = json.loads(told.out), told.err.splitlines()[-1].removeprefix("dragrig: ")
    run = only_run(folder)
    assert (code, printed["status"], run.info.status) == (3, "aborted", RunStatus.ABORTED)
    assert sentence("SIGTERM").fullmatch(answer), answer
    assert printed["reason"] == run.info.reason == "ended by SIGTERM"
    assert run.info.checks["lost_samples"] == 0
    look = near_rig.look()
    assert_stopped(struck[0], look, Halt.STOP)
    assert not look.enabled
    assert_kept(run, ON_DISK)


@pytest.mark.thorough
def test_a_program_that_is_frozen_lets_the_drive_stop_by_itself(faulty_rig: Bench, start: Start) -> None:
    program = start("plan.toml", *settings_words(*SOON_SILENT), "--out", folder := faulty_rig.folder())
    struck = program.until_under_way()
    remaining = recorded(folder)
    psutil.Process(program.process.pid).suspend()
    look = faulty_rig.until(lambda look: not look.moving)
    assert_stopped(struck, look, Halt.SILENCE, FAR_MM)
    psutil.Process(program.process.pid).resume()
    code, printed, answer = program.end()
    run = only_run(folder)
    assert (code, printed["status"], run.info.status) == (4, "tripped", RunStatus.TRIPPED)
    assert sentence("program frozen").fullmatch(answer), answer
    assert printed["reason"] == run.info.reason
    assert not faulty_rig.look().enabled
    assert_kept(run, remaining)


def test_a_program_that_no_longer_looks_at_its_data_is_stopped_by_its_watchdog(near_rig: Bench) -> None:
    running = begin(near_rig, assignments=[*SOON_HUNG, EVERY_SAMPLE])
    held, let_go = threading.Event(), threading.Event()

    def hang(reading: Reading) -> None:
        if reading.channels["position"][-1] > 0.5:
            held.set()
            let_go.wait(PATIENCE_S)

    running.person.reads = hang  # type: ignore[method-assign]
    assert held.wait(PATIENCE_S)
    struck = near_rig.look()
    near_rig.until(lambda look: not look.moving)
    let_go.set()
    ended = running.end()
    run = only_run(ended.folder)
    assert (ended.status, ended.exit_code) == (RunStatus.TRIPPED, 4), ended.message
    assert_stopped(struck, ended.stage, Halt.STOP, FAR_MM)
    assert_reported("program hangs", ended, run)
    assert_kept(run, 1)


def fill(disk: Path) -> Path:
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(b"\0" * 65536)
        except OSError:
            return filler


FULL_DISK = ("disk full", "disk full to the last byte", "disk refuses data")


def test_a_full_disk_stops_the_stage_and_costs_nothing_recorded(near_rig: Bench, small_disk: Path) -> None:
    folder = small_disk / "campaign"
    running = begin(near_rig, out=folder, assignments=["rig.recording.reserve_mb=1", "speed_mm_s=3", EVERY_SAMPLE])
    running.until_under_way()
    struck = near_rig.until(lambda _: recorded(folder) > ON_DISK, lambda: running.alive)
    remaining = recorded(folder)
    filler = fill(small_disk)
    ended = running.end()
    assert ended.exit_code == 5
    assert any(sentence(fault).fullmatch(ended.message) for fault in FULL_DISK), ended.message
    assert_stopped(struck, ended.stage, Halt.STOP)
    assert not ended.stage.enabled
    filler.unlink()
    recover(folder)
    (lost,) = read_campaign(folder).runs
    assert_kept(read_run(lost.path), remaining)
    assert lost.status is RunStatus.RECOVERED or "MB are free" in lost.reason


@pytest.mark.skipif(find_library("nidaqmx") is not None, reason="this computer has NI's driver")
def test_without_ni_driver_nothing_moves_and_one_sentence_says_what_to_install(faulty_rig: Bench) -> None:
    before = faulty_rig.look()
    ended = begin(faulty_rig, assignments=["rig.hardware.card.server=''"]).end()
    assert ended.exit_code == 5
    assert sentence("driver missing").fullmatch(ended.message), ended.message
    assert faulty_rig.look() == before
    assert not ended.folder.exists()


def test_the_page_on_faults_shows_what_the_tests_hear() -> None:
    rows = [line.split("|")[1:3] for line in DOCS.read_text("utf-8").splitlines() if line.startswith("| ")]
    shown = {fault.strip() for fault, line in rows if line.strip().startswith("`")}
    elsewhere = ("window/test_frozen.py", "test_end_of_windows.py")
    heard = (*TESTS.rglob("test_faults_*.py"), *(TESTS / "app" / name for name in elsewhere))
    answer = "".join(path.read_text("utf-8") for path in heard)
    assert len(shown) > 20
    assert [fault for fault in sorted(shown) if f'"{fault}"' not in answer] == []
