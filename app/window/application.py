"""The program that shows the window."""

import signal
import sys
from pathlib import Path

from PySide6.QtWidgets import QApplication

from dragrig.engine_host.messages import RigTerms
from dragrig.window.main_window import MainWindow
from dragrig.window.theme import dress


def application() -> QApplication:
    """Return the one application of this process, dressed."""
    running = QApplication.instance()
    if isinstance(running, QApplication):
        dress(running)
        return running
    made = QApplication(sys.argv[:1])
    made.setApplicationName("dragrig")
    dress(made)
    return made


def show(rig: RigTerms, lab: Path | None) -> int:
    """Show the window until it is closed; return the exit code.

    Raises
    ------
    SettingsError
        When the rig's settings cannot be used.
    """
    made = application()
    window = MainWindow(rig, lab)
    window.show()
    # Python hears the signal when the engine's timer next runs some of it.
    signal.signal(signal.SIGINT, lambda *_: window.close_in_order("Ctrl-C"))
    return int(made.exec())
