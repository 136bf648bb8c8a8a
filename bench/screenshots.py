"""Pictures of every page of the window, made off screen: `python bench/screenshots.py [FOLDER]`; else docs/images.

A lab folder is made for it, with one campaign on the simulated rig; the pages are used as a person would.
"""

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

from PySide6.QtCore import QSettings
from PySide6.QtWidgets import QLabel, QLineEdit, QWidget

import dragrig
from dragrig.engine_host.messages import ResetGuard, RigSelection, SilenceLimits
from dragrig.rig.operator import Answer
from dragrig.setup import create_lab
from dragrig.window.main_window import MainWindow, qt_application
from dragrig.window.widgets import MessageText, StoredSettings

PATIENCE_S = 600.0


class Photographer:
    """Uses a window and takes its picture."""

    def __init__(self, folder: Path, lab: Path, rig: RigSelection) -> None:
        self.application = qt_application()
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.place = folder, lab.parent
        settings = QSettings(str(lab / "window.ini"), QSettings.Format.IniFormat)
        self.window = MainWindow(rig, lab, StoredSettings(settings), SilenceLimits(PATIENCE_S, PATIENCE_S))
        self.window.resize(1500, 1000)
        self.window.show()

    def until(self, done: Callable[[], bool]) -> None:
        """Let the window live until something is so."""
        end = time.monotonic() + PATIENCE_S
        while not done():
            if time.monotonic() > end:
                self.window.grab().save(str(self.folder / "window-stuck.png"))
                raise TimeoutError("the window does not get there")
            self.application.processEvents()
            time.sleep(0.01)

    def live_for(self, duration_s: float) -> None:
        """Let the window live for a while."""
        end = time.monotonic() + duration_s
        self.until(lambda: time.monotonic() > end)

    def take(self, name: str, widget: QWidget | None = None) -> None:
        """Take a picture."""
        self.window.notices.dismiss.click()
        self.live_for(0.2)
        self.window.resize(1500, 1000)
        self.live_for(0.4)
        path = self.folder / f"window-{name}.png"
        with self.nobodys_folder():
            (widget or self.window).grab().save(str(path))
        print(path)

    @contextmanager
    def nobodys_folder(self) -> Iterator[None]:
        """Show folders as if the lab were at home; where the pictures are made is nobody's business."""
        widgets: list[QLineEdit | QLabel | MessageText] = [
            entry for kind in (QLineEdit, QLabel, MessageText) for entry in self.window.findChildren(kind)
        ]
        answer = [(button, button.text()) for button in widgets]
        answer = [(entry, text) for entry, text in answer if str(self.place) in text]
        for button, text in answer:
            button.blockSignals(True)
            button.setText(text.replace(str(self.place), "/home/person"))
        yield
        for button, text in answer:
            button.setText(text)
            button.blockSignals(False)


def run_page(camera: Photographer) -> None:
    """Show a plan filled in, and its run under way."""
    window = camera.window
    new = window.run.new
    new.plans.setCurrentIndex(new.plans.findData("drag"))
    new.operator.setText("A. Person")
    camera.until(lambda: bool(window.guard.text().startswith("guard: NOT ARMED")))
    camera.take("tripped")
    window.engine.ask(ResetGuard())
    camera.until(lambda: window.guard.text() == "guard: armed")
    camera.until(lambda: window.run.devices.devices.rowCount() > 0)
    for key, text in {"speed_mm_s": "5, 10, 20", "wait_s": "0", "repeats": "2"}.items():
        new.editor.put(key, text)
    new.update_preview()
    camera.take("plan")
    new.queue.click()
    new.start.click()
    camera.until(window.notices.prompt.isVisible)
    camera.take("question")
    window.notices.answers[Answer.DONE].click()
    camera.until(lambda: window.run.live.run is not None and window.run.live.run.latest.time_s > 6)
    camera.take("run")
    window.stop_button.click()
    camera.until(lambda: not window.run.session_running)


def look_page(camera: Photographer, campaign: Path) -> None:
    """Show runs over each other, with cursors, and their steady forces."""
    window = camera.window
    window.run.look_at.emit(str(campaign))
    browser = window.look.browser
    camera.until(lambda: not browser.busy and bool(browser.selected()))
    items = [item.child(at) for item in browser.tree.selectedItems() for at in range(item.childCount())]
    drags = [item for item in items if any(item.text(0).endswith(f"drag {speed} mm/s") for speed in (5, 10, 20, 40))]
    browser.tree.clearSelection()
    for item in drags[:4]:
        item.setSelected(True)
    camera.until(lambda: len(window.look.overlay.traces) == len(drags[:4]))
    window.look.overlay.cursors.click()
    window.look.overlay.place_cursors(1.3, 2.8)
    camera.take("look")
    window.look.tabs.setCurrentIndex(1)
    camera.until(lambda: bool(window.look.steady.rows))
    camera.take("steady")


def diagnose_page(camera: Photographer, campaign: Path) -> None:
    """Diagnose a campaign and show each of its tabs."""
    window = camera.window
    page = window.diagnose
    window.go_to(page)
    page.offer(str(campaign))
    page.start.click()
    camera.until(lambda: not page.busy)
    for at, name in enumerate(("budget", "speed", "confidence", "where", "which", "how-much", "runs", "before-after")):
        page.results.view.tabs.setCurrentIndex(at)
        camera.take(f"diagnose-{name}")


def rig_page(camera: Photographer) -> None:
    """Show settings, one of them changed, and a calibration that is not stored yet."""
    window = camera.window
    window.go_to(window.rig)
    settings = window.rig.settings
    camera.until(lambda: window.guard.text().startswith("guard: NOT ARMED"))
    settings.groups.setCurrentRow(5)
    settings.editor.put("force_limit_mN", "6000")
    camera.take("settings")
    settings.undo.click()
    window.rig.tabs.setCurrentWidget(window.rig.calibrate)
    window.rig.calibrate.start.click()
    while window.run.rig_busy:
        camera.until(lambda: window.notices.prompt.isVisible() or not window.run.rig_busy)
        if window.notices.prompt.isVisible():
            window.notices.answers[Answer.DONE].click()
    camera.take("calibrate")


def main(folder: Path) -> None:
    """Take all pictures."""
    with tempfile.TemporaryDirectory() as place:
        lab = Path(place) / "lab"
        create_lab(lab)
        campaign = lab / "runs" / "stribeck"
        # Less rest than a specimen would want: nobody looks at it.
        dragrig.simulate(
            "drag-sweep",
            out=campaign,
            rig=lab / "rig.toml",
            effects=["stribeck:ratio=0.6"],
            assignments=["speed_mm_s=[1,2,5,10,20,40]", "repeats=2"],
        )
        simulated = RigSelection(rig=lab / "rig.toml")
        double = replace(simulated, backend="hardware", double=True, pace=10.0)
        for rig, pages in (
            (simulated, (run_page, lambda camera: look_page(camera, campaign),
                         lambda camera: diagnose_page(camera, campaign))),
            (double, (rig_page,)),
        ):  # fmt: skip
            camera = Photographer(folder, lab, rig)
            try:
                for show in pages:
                    show(camera)
            finally:
                camera.window.close_in_order("the pictures are taken")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1] / "docs" / "images")
