"""A window that does not respond cannot stop anything: whatever moves is stopped without it, at once."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from inspect import signature
from pathlib import Path

import psutil
import pytest

from engine_clients import PATIENCE_S, plan
from places import SUPPORT
from property_tests import thorough
from rig_faults import sentence
from windows import WAIT_MS, lab_in, opened, press, require_qt

require_qt()

from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QDialog
from pytestqt.qtbot import QtBot

from dragrig.config import RunFileError
from dragrig.engine_host.messages import SessionJob, SilenceLimits, StartSession
from dragrig.rig.profile import Phase
from dragrig.rig.runfile import read_campaign, read_run
from dragrig.rig.runfile.model import RunStatus
from dragrig.rig.runfile.reader import read_tail
from dragrig.window.main_window import MainWindow
from frozen_window import LIMITS

RATE_HZ = 1000.0
LATE_S = 15.0
"""Flush, poll, block and braking, on a machine that tests; the run takes 40 s."""


def moved_s(folder: Path) -> float:
    """Return how long the one run of a campaign has lasted, as far as its file says."""
    for path in folder.glob("*.h5"):
        try:
            return read_tail(path, 0.1).info.samples / RATE_HZ
        except RunFileError:
            break
    return 0.0


def until(done: Callable[[], bool]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end_s
        time.sleep(0.1)


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals on Windows")
@pytest.mark.parametrize("held", ["stopped", thorough("busy")])
def test_a_window_that_does_not_respond_has_the_stage_stopped(held: str, tmp_path: Path) -> None:
    folder = tmp_path / "c"
    command = [sys.executable, str(SUPPORT / "frozen_window.py"), str(lab_in(tmp_path / "lab")), str(folder)]
    surroundings = os.environ | {"QT_QPA_PLATFORM": "offscreen"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=surroundings) as window:
        try:
            assert window.stdout is not None
            host = psutil.Process(int(window.stdout.readline()))
            until(lambda: moved_s(folder) > 1.0)
            begun_s = moved_s(folder)
            # The other threads of a window whose Qt thread is busy live on.
            window.send_signal(signal.SIGSTOP if held == "stopped" else signal.SIGUSR1)
            until(lambda: bool(read_campaign(folder).runs))
            (info,) = read_campaign(folder).runs
            assert info.status is RunStatus.ABORTED
            assert "the window did not respond while the stage could move" in info.reason
            assert info.samples / RATE_HZ - begun_s < LIMITS.moving_s + LATE_S
            trace = read_run(info.path).trace
            assert trace.phase[-1] == Phase.HOLD
            window.send_signal(signal.SIGCONT)
            assert sentence("window does not respond").search(window.stdout.readline())
            assert host.is_running()
        finally:
            window.send_signal(signal.SIGCONT)
            window.terminate()
            window.communicate()


def test_a_window_has_a_second_to_respond_while_the_stage_moves() -> None:
    assert signature(MainWindow).parameters["silence"].default == SilenceLimits(moving_s=1.0, standing_s=20.0)


def test_a_dialog_that_waits_for_its_answer_stops_no_run(qtbot: QtBot, tmp_path: Path) -> None:
    window = opened(qtbot, lab_in(tmp_path / "lab"), tmp_path / "window.ini", SilenceLimits(3.0, 600.0))
    window.go_to(window.rig)  # to draw a run takes longer than to make it
    try:
        press(window.reset)
        qtbot.waitUntil(lambda: window.guard.text() == "guard: armed", timeout=WAIT_MS)
        window.engine.ask(StartSession(SessionJob(1, plan(0.5, 20.0), pace="real", out=tmp_path / "c")))
        qtbot.waitUntil(lambda: moved_s(tmp_path / "c") > 0.5, timeout=WAIT_MS)
        dialog = QDialog(window)
        QTimer.singleShot(6000, dialog.accept)
        dialog.exec()
        assert not read_campaign(tmp_path / "c").runs, "the run has ended"
    finally:
        window.close_in_order("the test is over")
