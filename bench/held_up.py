"""How long the window's thread gives no sign of life while the stage moves and a person does something else.

`python bench/held_up.py [POINTS]`: two runs of POINTS samples (10 million) and a campaign are looked at, exported,
diagnosed and planned from, off screen, during a slow run on the simulated rig. Printed for each step: the longest time
between two turns of the event loop, and the processor time of its thread within; the engine stops the stage after
1 s without a sign of life. Exits with 1 where a step takes more than 0.3 s of the processor.
"""

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from PySide6.QtCore import QSettings, QTimer

import dragrig
from dragrig.engine_host import RigSelection, SessionJob
from dragrig.rig.runfile import finish
from dragrig.setup import create_lab
from dragrig.views import FORMATS
from dragrig.window.main_window import MainWindow, qt_application
from dragrig.window.widgets import StoredSettings, choose_path, top_items
from engine_clients import PATIENT, plan
from runfiles import record

POINTS = 10_000_000
MOST_S = 0.3
TURN_MS = 5
MOST_WAIT_S = 300.0


class Watch:
    """Measures the turns of the event loop."""

    def __init__(self) -> None:
        self._application = qt_application()
        self._turned = (time.monotonic(), time.thread_time())
        self._longest = (0.0, 0.0)
        self._timer = QTimer()
        self._timer.timeout.connect(self._turn)
        self._timer.start(TURN_MS)
        self.late = 0

    def _turn(self) -> None:
        now = (time.monotonic(), time.thread_time())
        self._longest = max(self._longest, (now[0] - self._turned[0], now[1] - self._turned[1]))
        self._turned = now

    def until(self, done: Callable[[], bool]) -> None:
        """Turn the event loop until something is so."""
        end_s = time.monotonic() + MOST_WAIT_S
        while not done() and time.monotonic() < end_s:
            self._application.processEvents()
            time.sleep(0.002)

    def step(self, name: str, act: Callable[[], object], done: Callable[[], bool] | None = None) -> None:
        """Do something, wait until it is done and shown, and print how long the thread was held up."""
        self._turn()
        self._longest = (0.0, 0.0)
        act()
        if done is not None:
            self.until(done)
        shown_s = time.monotonic() + 1.0
        self.until(lambda: time.monotonic() > shown_s)
        wall_s, processor_s = self._longest
        self.late += processor_s > MOST_S
        print(f"{name:36s} {1000 * wall_s:6.0f} ms, of the processor {1000 * processor_s:6.0f} ms", flush=True)


def look(watch: Watch, window: MainWindow, lab: Path) -> None:
    """Look at runs."""
    page = window.look
    browser, overlay = page.browser, page.overlay

    def choose(folder: str) -> None:
        (item,) = (top for top in top_items(browser.tree) if top.text(0) == folder)
        browser.tree.clearSelection()
        for at in range(item.childCount()):
            item.child(at).setSelected(True)

    def shown() -> bool:
        workers = (page._traces, page._table, page._exporting)  # noqa: SLF001  # nothing else tells
        return not (browser.busy or overlay.prepared.busy or any(worker.busy for worker in workers))

    watch.step("page of runs", lambda: window.go_to(page), shown)
    for folder in ("long", "stribeck"):
        watch.step(f"look at {folder}", lambda folder=folder: page.look_at(lab / "runs" / folder), shown)
        watch.step(f"its runs overlaid, {folder}", lambda folder=folder: choose(folder), shown)
        watch.step("cursors", lambda: overlay.cursors.setChecked(True), shown)
        for axis in ("position", "speed", "time"):
            watch.step(f"against {axis}", lambda axis=axis: overlay.axis.setCurrentText(axis), shown)
        watch.step("another filter", lambda: overlay.window_ms.setValue(overlay.window_ms.value() + 20), shown)
        watch.step("another channel", lambda: overlay.channel.setCurrentText("position"), shown)
        for name in FORMATS:
            watch.step(f"export, {name}", lambda name=name: page.export_to(lab / "exported", name), shown)


def conclude(watch: Watch, window: MainWindow, lab: Path) -> None:
    """Diagnose, identify, report."""
    page = window.diagnose
    watch.step("page of diagnoses", lambda: window.go_to(page))
    page.campaign.setText(str(lab / "runs" / "stribeck"))
    for name, start in (("diagnose", page.start), ("identify", page.identify), ("report", page.report)):
        watch.step(name, start.click, lambda: not page.busy)
    tabs = page.results.view.tabs
    for at in range(tabs.count()):
        watch.step(f"diagnosis, tab {at + 1}", lambda at=at: tabs.setCurrentIndex(at))


def plan_more(watch: Watch, window: MainWindow, lab: Path) -> None:
    """Set the rig, plan, queue."""
    groups, new, tabs = window.rig.settings.groups, window.run.new, window.run.tabs
    watch.step("page of the rig", lambda: window.go_to(window.rig))
    watch.step("its largest table", lambda: groups.setCurrentRow(9))
    watch.step("page of plans", lambda: window.go_to(window.run))
    for at in range(new.plans.count()):
        watch.step(f"plan {new.plans.itemText(at)}", lambda at=at: new.plans.setCurrentIndex(at))
    new.plans.setCurrentIndex(new.plans.findData("drag"))
    watch.step("300 runs", lambda: new.editor.put("repeats", "300"))
    watch.step("queued", new.queue.click)
    for at in range(tabs.count()):
        watch.step(f"tab {at + 1}", lambda at=at: tabs.setCurrentIndex(at))
    watch.step("a dialog", lambda: choose_path(window, "Folder", str(lab), lambda _: None))


def main() -> int:
    """Make the lab, start a run, and do what one does meanwhile."""
    points = int(sys.argv[1]) if len(sys.argv) > 1 else POINTS
    with tempfile.TemporaryDirectory() as place:
        lab = Path(place) / "lab"
        create_lab(lab)
        (lab / "runs" / "long").mkdir(parents=True)
        for number in range(2):
            finish(record(lab / "runs" / "long" / f"20260504-093000-drag-{number:03d}.h5", points))
        dragrig.simulate(
            "drag-sweep", out=lab / "runs" / "stribeck", rig=lab / "rig.toml",
            effects=["stribeck:ratio=0.6"], assignments=["speed_mm_s=[1,2,5,10,20,40]", "repeats=2"],
        )  # fmt: skip
        watch = Watch()
        stored = StoredSettings(QSettings(str(Path(place) / "window.ini"), QSettings.Format.IniFormat))
        window = MainWindow(RigSelection(rig=lab / "rig.toml", backend="simulated"), lab, stored, PATIENT)
        window.show()
        watch.until(lambda: window.guard.text() == "guard: NOT ARMED")
        window.reset.click()
        watch.until(lambda: window.guard.text() == "guard: armed")
        # Slow enough to last until the end.
        window.engine.ask(SessionJob(1, plan(0.05, 60.0), pace="real", out=Path(place) / "moving"))
        watch.until(lambda: window.run.live.run is not None)
        for part in (look, conclude, plan_more):
            part(watch, window, lab)
        window.close_in_order("the bench is over")
    return min(watch.late, 1)


if __name__ == "__main__":
    sys.exit(main())
