"""Windows ends a program whose rig moves: a closed console, a logoff, a shutdown. Real processes, on Windows alone."""

import subprocess
import sys
from pathlib import Path

import pytest

from dragrig.rig.runfile.model import RunStatus
from dragrig.rig.runfile.reader import read_info
from dragrig.session_state import STATE_FILE

FAULT = "Windows ends the program: its console is closed, its user logged off, the computer shut down"
"""As docs/faults.md has it."""
pytestmark = pytest.mark.skipif(sys.platform != "win32", reason="only Windows ends a program by calling it")

SESSION = """
import ctypes, os, pathlib, sys, threading
from ctypes import wintypes
from dragrig.cli import main

def close_console(user32):
    ctypes.WinDLL("kernelbase").CtrlRoutine(ctypes.c_void_p(2))  # CTRL_CLOSE_EVENT, on a thread as Windows takes one

def end_session(user32, how):
    @ctypes.WINFUNCTYPE(wintypes.BOOL, wintypes.HWND, wintypes.LPARAM)
    def each(window, _):
        owner = wintypes.DWORD()
        user32.GetWindowThreadProcessId(wintypes.HWND(window), ctypes.byref(owner))
        if owner.value == os.getpid():
            if user32.SendMessageW(wintypes.HWND(window), 0x11, None, ctypes.c_ssize_t(how)):  # WM_QUERYENDSESSION
                user32.SendMessageW(wintypes.HWND(window), 0x16, ctypes.c_void_p(1), ctypes.c_ssize_t(how))
        return True
    user32.EnumWindows(each, 0)

def windows():
    while not list(pathlib.Path("c").glob("*.recording.h5")):
        threading.Event().wait(0.1)
    user32 = ctypes.WinDLL("user32")
    {"console": lambda: close_console(user32), "logoff": lambda: end_session(user32, -(1 << 31)),
     "shutdown": lambda: end_session(user32, 0)}[sys.argv[1]]()
    os._exit(9)  # as Windows does once the program has answered

threading.Thread(target=windows, daemon=True).start()
main("run drag --yes --out c --pace real --set wait_s=0 --set travel_mm=60 --set speed_mm_s=2".split())
threading.Event().wait()
"""


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("console", "the console was closed"),
        ("logoff", "the user was logged off"),
        ("shutdown", "the computer was shut down"),
    ],
)
def test_a_session_that_windows_ends_stops_and_its_run_is_finished_before_the_process_ends(
    how: str, reason: str, tmp_path: Path
) -> None:
    ended = subprocess.run([sys.executable, "-c", SESSION, how], cwd=tmp_path, stdin=subprocess.DEVNULL, check=False)
    assert ended.returncode == 9
    (run,) = (tmp_path / "c").glob("*.h5")
    assert read_info(run).status is RunStatus.ABORTED
    assert f'"reason": "{reason}"' in (tmp_path / "c" / STATE_FILE).read_text("utf-8")
    assert not list((tmp_path / "c").glob("*.lock"))
