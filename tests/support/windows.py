"""What the tests of the window share: a lab, a window on it, and what it takes to have one."""

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from dragrig.engine_host.messages import SilenceLimits

if TYPE_CHECKING:
    from PySide6.QtWidgets import QApplication
    from pytestqt.qtbot import QtBot

    from dragrig.window.main_window import MainWindow

PACKAGES = {
    "libEGL": "libegl1", "libGL": "libgl1", "libxkbcommon": "libxkbcommon0", "libdbus": "libdbus-1-3",
    "libfontconfig": "libfontconfig1", "libglib": "libglib2.0-0",
}  # fmt: skip
"""Debian's package for each library of the system that Qt needs, even off screen."""
WAIT_MS = 600_000
BUSY = SilenceLimits(600.0, 600.0)
"""A machine that tests may hold the window up for long."""


def lacking() -> str:
    """Say what keeps Qt from being loaded here; nothing when it can be."""
    try:
        import PySide6.QtTest
        import PySide6.QtWidgets  # noqa: F401
    except ImportError as error:
        package = next((name for part, name in PACKAGES.items() if part in str(error)), "")
        return f"the window needs {package or 'PySide6'} ({error}): apt-get install {package}"
    return ""


def require_qt() -> None:
    """Skip a test module where Qt cannot be loaded; fail where everything has to be there."""
    reason = lacking()
    if not reason:
        return
    if os.environ.get("CI") == "true":
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason, allow_module_level=True)


def press(widget: object) -> None:
    """Press a button as a person does: nothing happens where it cannot be pressed."""
    from PySide6.QtWidgets import QAbstractButton

    assert isinstance(widget, QAbstractButton)
    assert widget.isEnabled(), f"{widget.text()} cannot be pressed"
    widget.click()


Until = Callable[[Callable[[], bool]], None]


def lab_in(folder: Path) -> Path:
    """Make a lab folder."""
    from dragrig.setup import create_lab

    create_lab(folder)
    return folder


@cache
def dressed() -> "QApplication":
    """Return the application, looking as it does for people.

    Styled once a process: to style it again styles every window of the tests before again, for seconds.
    """
    from dragrig.window.main_window import qt_application

    return qt_application()


def opened(qtbot: "QtBot", lab: Path, settings: Path, silence: SilenceLimits = BUSY, **terms: object) -> "MainWindow":
    """Return a window on a lab whose engine is there, its guard not yet reset."""
    from PySide6.QtCore import QSettings

    from dragrig.engine_host.messages import RigSelection
    from dragrig.window.main_window import MainWindow
    from dragrig.window.widgets import StoredSettings

    dressed()
    rig = RigSelection(rig=lab / "rig.toml", **terms)  # type: ignore[arg-type]
    stored = StoredSettings(QSettings(str(settings), QSettings.Format.IniFormat))
    window = MainWindow(rig, lab, stored, silence)
    window.show()
    qtbot.waitUntil(lambda: window.guard.text() == "guard: NOT ARMED", timeout=WAIT_MS)
    return window
