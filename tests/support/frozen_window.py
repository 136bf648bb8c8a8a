"""A window whose Qt thread can be held, in a process of its own.

`python frozen_window.py LAB FOLDER` has one, not shown, with a slow run under way into FOLDER: it says on standard
output what happens, a line each, and its Qt thread sleeps for `HELD_S` when it gets SIGUSR1.
"""

import signal
import sys
import time
from pathlib import Path

from engine_clients import plan
from windows import require_qt

require_qt()

from PySide6.QtCore import QSettings, QTimer

from dragrig.engine_host.messages import RigSelection, SessionFinished, SessionJob, SilenceLimits
from dragrig.window.main_window import MainWindow, qt_application
from dragrig.window.widgets import StoredSettings

LIMITS = SilenceLimits(3.0, 600.0)
"""A busy machine may hold the window up too, and for longer than the usual second."""
HELD_S = 20.0


def main(lab: Path, folder: Path) -> None:
    """Be the window that is held."""
    application = qt_application()
    stored = StoredSettings(QSettings(str(lab / "window.ini"), QSettings.Format.IniFormat))
    window = MainWindow(RigSelection(rig=lab / "rig.toml", backend="simulated"), lab, stored, LIMITS)

    def take(event: object) -> None:
        if isinstance(event, SessionFinished):
            print(window.notices.complaint_text.text().replace("\n", " "), flush=True)

    def begin() -> None:
        if window.guard.text() == "guard: NOT ARMED" and window.reset.isEnabled():
            window.reset.click()
        if window.guard.text() == "guard: armed":
            beginning.stop()
            window.engine.ask(SessionJob(1, plan(0.5, 20.0), pace="real", out=folder))
            print(window.engine.pid, flush=True)

    beginning = QTimer()
    beginning.timeout.connect(begin)
    beginning.start(100)
    window.engine.event_received.connect(take)
    signal.signal(signal.SIGUSR1, lambda *_: time.sleep(HELD_S))

    def end() -> None:
        window.close_in_order("the test is over")
        application.quit()

    signal.signal(signal.SIGTERM, lambda *_: end())
    application.exec()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
