"""`dragrig gui` where it cannot show a window, and the queue's arithmetic, which needs none."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dragrig.cli import main
from dragrig.engine_host.messages import QueuedRun, RunFinished, RunStarted, SessionFinished, SessionJob, SessionStarted
from dragrig.rig.runfile.model import RunStatus
from property_tests import thorough
from windows import require_qt


@pytest.mark.parametrize("missing", ["PySide6", thorough("pyqtgraph")])
def test_without_qt_the_error_says_what_to_install(missing: str, tmp_path: Path) -> None:
    script = f"import sys; sys.modules[{missing!r}] = None; from dragrig.cli import main; sys.exit(main(['gui']))"
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "pip install 'dragrig[gui]'" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_folder_without_a_lab_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    require_qt()
    assert main(["gui", str(tmp_path)]) == 2
    assert "is no lab folder" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="a screen is named by the environment on Linux alone")
def test_without_a_screen_the_error_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM"):
        monkeypatch.delenv(name, raising=False)
    assert main(["gui"]) == 2
    assert "there is no screen here" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="the system brings Qt's libraries on Linux alone")
def test_libraries_that_qt_lacks_are_named_with_the_command_before_it_aborts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    require_qt()
    # Where it is not refused, nothing aborts here: it would take the other tests with it.
    monkeypatch.setattr("dragrig.window.main_window.show_window", lambda *_: 0)
    monkeypatch.chdir(tmp_path)
    finder = tmp_path / "ldd"  # what it says where they lack
    lines = (
        "libxcb.so.1 => /lib/libxcb.so.1 (0x7f)\\nlibxcb-cursor.so.0 => not found\\nlibxkbcommon-x11.so.0 => not found"
    )
    finder.write_text(f'#!/bin/sh\nprintf "{lines}\\n"\n', "utf-8")
    finder.chmod(0o755)
    for name in ("WAYLAND_DISPLAY", "QT_QPA_PLATFORM"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DISPLAY", ":4711")
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    assert main(["gui"]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "not here (libxcb-cursor.so.0, libxkbcommon-x11.so.0)" in told
    assert "apt-get install libxcb-cursor0 libxkbcommon-x11-0 (" in told


def test_an_unsupported_pace_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    require_qt()
    monkeypatch.chdir(tmp_path)
    assert main(["gui", "--backend", "simulated", "--pace", "20"]) == 2
    assert "choose fast or real here" in capsys.readouterr().err


def test_a_queue_knows_its_progress_and_the_time_left() -> None:
    require_qt()
    from dragrig.window.session_queue import QueuedSession, QueueState, SessionQueue

    queue = SessionQueue()
    runs = (QueuedRun(0, "drag", 10.0, 5.0), QueuedRun(1, "drag", 10.0, 5.0))
    queue.add(QueuedSession(SessionJob(queue.next_number(), "drag"), "drag", 30.0, 2))
    queue.add(QueuedSession(SessionJob(queue.next_number(), "blank"), "blank", 8.0, 1))
    assert queue.left_s == 38.0
    first = queue.entries[0]
    first.stage = QueueState.RUNNING
    queue.take(SessionStarted(1, runs, real_time=True))
    assert (first.left_s, first.progress) == (30.0, 0.0)
    queue.take(RunStarted(runs[0], 0))
    first.elapsed_s = 2.0
    assert first.left_s == 18.0
    queue.take(RunFinished(runs[0], 0, RunStatus.COMPLETE, "", 5000, ()))
    assert (first.left_s, first.progress, first.over_count) == (15.0, 0.5, 1)
    queue.take(RunStarted(runs[0], 1))
    assert (first.left_s, first.over_count) == (20.0, 0)  # made again
    queue.take(RunStarted(runs[1], 2))
    assert (first.left_s, first.over_count) == (5.0, 1)  # whatever became of the one before
    first.elapsed_s = 5.0
    queue.take(SessionFinished(1, RunStatus.TRIPPED, "force: too much"))
    assert (first.stage, first.reason, queue.left_s) == (QueueState.TRIPPED, "force: too much", 8.0)
    assert queue.next is queue.entries[1]
