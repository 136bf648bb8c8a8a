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
from rig_faults import sentence
from windows import WAIT_MS, lab_in, opened, press, require_qt

require_qt()

from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QDialog
from pytestqt.qtbot import QtBot

from dragrig.config import RunFileError
from dragrig.engine_host.messages import SessionJob, SilenceLimits
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


def ended(folder: Path) -> bool:
    return bool(read_campaign(folder).runs)


def until(done: Callable[[], bool]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end_s
        time.sleep(0.1)


def require_stopped(folder: Path, begun_s: float) -> None:
    """Wait until the one run of a campaign is stopped, which was as long before the window was held."""
    until(lambda: ended(folder))
    (info,) = read_campaign(folder).runs
    assert info.status is RunStatus.ABORTED
    assert "the window did not respond while the stage could move" in info.reason
    assert info.samples / RATE_HZ - begun_s < LIMITS.moving_s + LATE_S
    assert read_run(info.path).trace.phase[-1] == Phase.HOLD


def test_a_window_that_does_not_respond_has_the_stage_stopped_and_a_dialog_that_waits_has_not(
    qtbot: QtBot, tmp_path: Path
) -> None:
    window, folder = opened(qtbot, lab_in(tmp_path / "lab"), tmp_path / "window.ini", LIMITS), tmp_path / "c"
    window.go_to(window.rig)  # to draw a run takes longer than to make it
    try:
        press(window.reset)
        qtbot.waitUntil(lambda: window.guard.text() == "guard: armed", timeout=WAIT_MS)
        window.engine.ask(SessionJob(1, plan(0.5, 20.0), pace="real", out=folder))
        qtbot.waitUntil(lambda: moved_s(folder) > 0.3, timeout=WAIT_MS)
        dialog, shown_s = QDialog(window), moved_s(folder)
        waited = QTimer(dialog, interval=200)
        waited.timeout.connect(
            lambda: dialog.accept() if moved_s(folder) > shown_s + LIMITS.moving_s + 0.5 or ended(folder) else None
        )
        waited.start()
        dialog.exec()
        waited.stop()
        assert not ended(folder), "the run has ended"
        require_stopped(folder, moved_s(folder))  # no event of the window is handled meanwhile
        qtbot.waitUntil(
            lambda: bool(sentence("window does not respond").search(window.notices.complaint_text.text())),
            timeout=WAIT_MS,
        )
        assert window.guard.text() != "guard: no engine"
    finally:
        window.close_in_order("the test is over")


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform == "win32", reason="no such signals on Windows")
@pytest.mark.parametrize("held", ["stopped", "busy"])
def test_a_window_that_is_held_from_outside_has_the_stage_stopped(held: str, tmp_path: Path) -> None:
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
            require_stopped(folder, begun_s)
            window.send_signal(signal.SIGCONT)
            assert sentence("window does not respond").search(window.stdout.readline())
            assert host.is_running()
        finally:
            window.send_signal(signal.SIGCONT)
            window.terminate()
            window.communicate()


def test_a_window_has_a_second_to_respond_while_the_stage_moves() -> None:
    assert signature(MainWindow).parameters["silence"].default == SilenceLimits(moving_s=1.0, standing_s=20.0)
