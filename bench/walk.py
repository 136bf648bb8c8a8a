"""A day at the window by keyboard and mouse, off screen: `python bench/walk.py [FOLDER] [--size NAME]`.

The window is opened on the simulated rig, and at the end on the doubles of the hardware, at 1024 by 650, at 1920 by
1080, and on a Full HD screen at twice the size. Each step saves a picture to FOLDER (`walk-pictures`) and is checked:
the window has the size that was asked for; STOP, Reset, Start and the buttons of an open prompt are wholly seen; no
text is cut off unless its tooltip has it; no reading is called live that is not. Exits with 1 if anything is wrong.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

import pyqtgraph
from PySide6.QtCore import QPoint, QPointF, QRect, QSettings, Qt, QTimer
from PySide6.QtGui import QImage, QPainter, QWheelEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractButton,
    QApplication,
    QComboBox,
    QFileDialog,
    QLabel,
    QLineEdit,
    QProgressBar,
    QScrollArea,
    QTableWidget,
    QTabWidget,
    QTreeWidget,
    QTreeWidgetItem,
    QWidget,
)

import dragrig
from dragrig.engine_host import GuardState, RigSelection, SilenceLimits
from dragrig.rig.operator import Answer
from dragrig.setup import create_lab
from dragrig.window.live_view import STALE_S
from dragrig.window.main_window import MainWindow, qt_application
from dragrig.window.widgets import ElidedLabel, StoredSettings

PATIENCE_S = 300.0
SETTLE_S = 0.4
SIZES = {"1024x650": (1024, 650, 1), "1920x1080": (1920, 1080, 1), "960x540@2": (960, 540, 2)}
"""Width and height in the window's pixels, and how many of the screen's each of these has."""
CONTROL, SHIFT = Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.ShiftModifier
PLAIN = Qt.KeyboardModifier.NoModifier
LONG_PROMPT = "Lay a fresh specimen on the foam, fix one side and the mesentery, wet it with Tyrode's solution; " * 4
LONG_FOLDER = "/no-such-disk/" + "measurements-of-the-winter-term/" * 8 + "mirror"
LONG_REASON = f"{LONG_FOLDER}, which is not there, and " + "a force beyond the limit of the sensor; " * 12
LOW_LIMIT = "rig.guard.force_limit_mN=148"
"""So low that the fastest drag trips the guard."""
PATIENT = ("rig.guard.stale_data_s=5", "rig.hardware.hang_s=5", "rig.hardware.drive.reply_s=2",
           "rig.hardware.drive.silence_s=5")  # fmt: skip
"""Doubles that wait as long as may be set, for a busy machine is no fault."""


# --- What must hold at every step -----------------------------------------------------------------------------------


def faults(person: "Person") -> Iterator[str]:
    """Say what is wrong in the window as it is now."""
    window, notices = person.window, person.window.notices
    if (window.width(), window.height()) != (person.width, person.height):
        yield f"the window is {window.width()} by {window.height()}"
    always: list[QWidget] = [window.stop_button, window.reset, window.guard]
    if window.pages.currentWidget() is window.run:
        always += [window.run.new.start, window.run.abort, window.run.start_queue]
    always += [button for button in (*notices.answers.values(), notices.restart) if button.isVisible()]
    yield from (f"not wholly seen: {told(widget)}" for widget in always if not seen_whole(widget))
    for widget in window.findChildren(QWidget):
        if widget.isVisible() and not widget.visibleRegion().isEmpty():
            yield from (f"cut off: {text!r}" for text in cut_texts(widget))
    for dialog in open_dialogs():
        if not window.screen().geometry().contains(dialog.frameGeometry()):
            yield f"the dialog {dialog.windowTitle()!r} is larger than the screen"
    about, shown = window.run.live.readings.about.text(), window.run.live.readings.readings
    if about.startswith("live") and time.monotonic() - person.read_at_s > STALE_S + 1.0:
        yield f"called live and {time.monotonic() - person.read_at_s:.1f} s old: {about}"
    if shown["Speed"].text() != "–" and not (window.run.rig_busy and about.startswith("live")):
        yield f"speed {shown['Speed'].text()} while nothing runs"


def seen_whole(widget: QWidget) -> bool:
    """Whether all of a widget is inside its window, and nothing lies over it."""
    window = widget.window()
    place = QRect(widget.mapTo(window, QPoint(0, 0)), widget.size())
    hits = (window.childAt(point) for point in (place.center(), place.topLeft() + QPoint(4, 4)))
    on_top = all(hit is widget or (hit is not None and widget.isAncestorOf(hit)) for hit in hits)
    return window.rect().contains(place) and widget.visibleRegion().boundingRect() == widget.rect() and on_top


def cut_texts(widget: QWidget) -> Iterator[str]:  # noqa: C901, PLR0912  # a case for each kind of widget
    """Return the texts of a widget that do not fit and are in no tooltip."""

    def too_wide(text: str, room: int) -> bool:
        return widget.fontMetrics().horizontalAdvance(text) > room

    match widget:
        case ElidedLabel() if too_wide(widget.text(), widget.contentsRect().width()):
            if widget.toolTip() != widget.text():
                yield widget.text()
        case QLabel() if widget.text() and not isinstance(widget, ElidedLabel):
            need = widget.heightForWidth(widget.width()) if widget.wordWrap() else widget.sizeHint().height()
            if need > widget.height() + 1 or (not widget.wordWrap() and widget.sizeHint().width() > widget.width() + 1):
                yield widget.text()
        case QAbstractButton() if widget.text():
            if widget.sizeHint().width() > widget.width() or widget.sizeHint().height() > widget.height():
                yield widget.text()
        case QTabWidget():
            bar = widget.tabBar()
            hidden = (at for at in range(bar.count()) if not bar.rect().contains(bar.tabRect(at)))
            if bar.isVisible():
                yield from (bar.tabText(at) for at in hidden if bar.tabText(at))
        case QComboBox() if too_wide(widget.currentText(), widget.width() - 30):
            if widget.currentText() not in widget.toolTip():
                yield widget.currentText()
        case QLineEdit() if not widget.text() and too_wide(widget.placeholderText(), widget.width() - 18):
            yield widget.placeholderText()
        case QProgressBar() if too_wide(widget.text(), widget.width()) and widget.text() not in widget.toolTip():
            yield widget.text()
        case QTableWidget():
            heads = ((at, widget.horizontalHeaderItem(at).text()) for at in range(widget.columnCount()))
            yield from (text for at, text in heads if too_wide(text, widget.columnWidth(at) - 12))
            cells = (widget.item(at, to) for at in range(widget.rowCount()) for to in range(widget.columnCount()))
            for cell in cells:
                if cell is not None and cell.toolTip() != cell.text():
                    yield cell.text()
        case QTreeWidget():
            for item in shown_items(widget):
                for at in range(widget.columnCount()):
                    room = widget.visualRect(widget.indexFromItem(item, at)).width()
                    if too_wide(item.text(at), room) and item.text(at) not in item.toolTip(at):
                        yield item.text(at)
        case pyqtgraph.PlotWidget():
            inside = widget.viewport().rect().adjusted(-3, -3, 3, 3)
            for item in widget.scene().items():
                text = item.toPlainText() if hasattr(item, "toPlainText") and item.isVisible() else ""
                if text.strip() and not inside.contains(
                    widget.mapFromScene(item.sceneBoundingRect()).boundingRect().adjusted(3, 3, -3, -3)
                ):
                    yield f"{text} (of a plot)"
        case QScrollArea() if widget.horizontalScrollBarPolicy() is Qt.ScrollBarPolicy.ScrollBarAlwaysOff:
            if widget.widget().width() > widget.viewport().width():
                yield f"a form {widget.widget().width() - widget.viewport().width()} px wider than its room"


def shown_items(tree: QTreeWidget) -> Iterator[QTreeWidgetItem]:
    """Return the entries of a tree that can be seen."""
    item = tree.itemAt(QPoint(2, 2))
    while item is not None and tree.visualItemRect(item).top() < tree.viewport().height():
        yield item
        item = tree.itemBelow(item)


def told(widget: QWidget) -> str:
    """Name a widget."""
    text = getattr(widget, "text", str)()
    return f"{type(widget).__name__} {text or widget.accessibleName()!r}"


def open_dialogs() -> list[QFileDialog]:
    """Return the dialogs that are open."""
    return [top for top in QApplication.topLevelWidgets() if isinstance(top, QFileDialog) and top.isVisible()]


# --- The person -----------------------------------------------------------------------------------------------------


class Person:
    """Uses a window by key and mouse, takes its picture, and checks what must hold."""

    def __init__(self, folder: Path, lab: Path, size: str) -> None:
        self.application = qt_application()
        self.folder, self.lab = folder, lab
        self.width, self.height, _ = SIZES[size]
        self.count, self.wrong = 0, 0
        self.unmet: list[str] = []
        self.window: MainWindow | None = None
        folder.mkdir(parents=True, exist_ok=True)

    def open(self, rig: RigSelection) -> MainWindow:
        """Open the window on the lab, as after its last end."""
        if self.window is not None:
            self.window.close_in_order("another window is opened")
        stored = StoredSettings(QSettings(str(self.lab / "window.ini"), QSettings.Format.IniFormat))
        window = self.window = MainWindow(rig, self.lab, stored, SilenceLimits(PATIENCE_S, PATIENCE_S))
        window.resize(self.width, self.height)
        window.move(0, 0)
        window.show()
        window.activateWindow()
        self.read_at_s = float("-inf")
        window.engine.event_received.connect(self._note_reading)
        window.engine.sampled.connect(lambda _: self._note_reading(None))
        self.until(lambda: window.guard.text() == "guard: NOT ARMED" and window.run.devices.devices.rowCount() > 0)
        return window

    def _note_reading(self, event: object) -> None:
        if event is None or getattr(getattr(event, "reading", None), "force_mN", None) is not None:
            self.read_at_s = time.monotonic()

    def until(self, done: Callable[[], bool], patience_s: float = PATIENCE_S) -> None:
        """Let the window live until something is so."""
        end = time.monotonic() + patience_s
        while not done():
            if time.monotonic() > end:
                raise TimeoutError("the window does not get there")
            self.application.processEvents()
            time.sleep(0.005)

    def live_for(self, duration_s: float) -> None:
        """Let the window live for a while."""
        end = time.monotonic() + duration_s
        self.until(lambda: time.monotonic() > end)

    def expect(self, holds: bool, sentence: str) -> None:
        """Count what a step should have done and did not as wrong."""
        if not holds:
            self.unmet.append(sentence)

    def step(self, name: str, *, settle: bool = True) -> None:
        """Take the picture of a step, and check what must hold."""
        if settle:
            self.live_for(SETTLE_S)
        self.count += 1
        found = [*self.unmet, *dict.fromkeys(faults(self))]
        self.picture().save(str(self.folder / f"{self.count:02d}-{name.replace(' ', '-')}.png"))
        self.unmet = []
        self.wrong += len(found)
        print(f"  {self.count:02d} {name:36} {'; '.join(found) or 'ok'}", flush=True)

    def picture(self) -> QImage:
        """Return what the screen shows: the window, and menus and dialogs over it."""
        image = self.window.grab().toImage()
        painter = QPainter(image)
        for top in QApplication.topLevelWidgets():
            if top is not self.window and top.isVisible() and top.isWindow():
                painter.drawPixmap(top.mapToGlobal(QPoint(0, 0)) - self.window.mapToGlobal(QPoint(0, 0)), top.grab())
        painter.end()
        return image

    def bring_into_view(self, widget: QWidget) -> None:
        """Scroll until a widget is seen: what lies outermost first, so that what is in it can be."""
        assert widget.isVisible(), f"{told(widget)} is not shown"
        areas = [above for above in ancestors(widget) if isinstance(above, QScrollArea)]
        for _ in range(20):  # what a field changes may move it
            for area, inner in pairwise([*reversed(areas), widget]):
                area.ensureWidgetVisible(inner, 0, 4)
            self.live_for(0.05)
            if widget.visibleRegion().boundingRect() == widget.rect():
                return

    def click(self, widget: QWidget) -> None:
        """Click on a widget, which has to be there to be clicked on."""
        self.bring_into_view(widget)
        assert widget.isEnabled(), f"{told(widget)} cannot be pressed"
        self.click_at(widget, QPoint(12, min(widget.height() // 2, 20)))

    def click_at(self, widget: QWidget, at: QPoint, modifiers: Qt.KeyboardModifier = PLAIN) -> None:
        """Click on a point of a widget, as the screen has it."""
        top = widget.window()
        point = widget.mapTo(top, at)
        hit = top.childAt(point)
        assert hit is widget or (hit is not None and widget.isAncestorOf(hit)), f"{told(widget)} is not in reach"
        QTest.mouseClick(top.windowHandle(), Qt.MouseButton.LeftButton, modifiers, point)
        self.live_for(0.05)

    def wheel(self, widget: QWidget, notches: int) -> None:
        """Turn the wheel over a widget; what is under the pointer gets it first."""
        at = widget.rect().center()
        event = QWheelEvent(
            QPointF(widget.mapTo(self.window, at)), QPointF(widget.mapToGlobal(at)), QPoint(0, 0),
            QPoint(0, 120 * notches), Qt.MouseButton.NoButton, PLAIN, Qt.ScrollPhase.NoScrollPhase, False,
        )  # fmt: skip
        QApplication.sendEvent(self.window.windowHandle(), event)
        self.live_for(0.02)

    def key(self, key: Qt.Key, modifiers: Qt.KeyboardModifier = PLAIN) -> None:
        """Press a key, wherever the focus is."""
        QTest.keyClick(QApplication.focusWidget() or self.window, key, modifiers)
        self.live_for(0.05)

    def type_in(self, field: QWidget, text: str) -> None:
        """Replace what is in a field."""
        self.click(field)
        self.key(Qt.Key.Key_A, CONTROL)
        if text:
            QTest.keyClicks(QApplication.focusWidget(), text)
        else:
            self.key(Qt.Key.Key_Delete)
        self.live_for(0.3)

    def choose(self, box: QComboBox, text: str) -> None:
        """Choose an entry of a list, with its keys."""
        self.click(box)
        view = box.view()
        self.until(view.isVisible, 10.0)
        for key in (Qt.Key.Key_Home, *box.findText(text) * (Qt.Key.Key_Down,), Qt.Key.Key_Return):
            QTest.keyClick(view, key)
        self.until(lambda: not view.isVisible(), 10.0)
        self.live_for(0.3)
        assert box.currentText() == text, f"{box.accessibleName()} is {box.currentText()}, not {text}"

    def tab(self, tabs: QTabWidget, page: QWidget | int) -> None:
        """Click on a tab."""
        bar, at = tabs.tabBar(), page if isinstance(page, int) else tabs.indexOf(page)
        self.click_at(bar, bar.tabRect(at).center())
        self.live_for(0.1)
        assert tabs.currentIndex() == at, f"the tab {tabs.tabText(at)} cannot be clicked"

    def page(self, number: int) -> None:
        """Go to a page by its key."""
        self.key((Qt.Key.Key_1, Qt.Key.Key_2, Qt.Key.Key_3, Qt.Key.Key_4)[number - 1], CONTROL)

    def select(self, tree: QTreeWidget, item: QTreeWidgetItem, modifiers: Qt.KeyboardModifier = PLAIN) -> None:
        """Click on an entry of a tree."""
        tree.scrollToItem(item)
        self.click_at(tree.viewport(), QPoint(60, tree.visualItemRect(item).center().y()), modifiers)

    def answer(self, answer: Answer = Answer.DONE) -> None:
        """Wait for a prompt, and answer it."""
        self.until(self.window.notices.prompt.isVisible)
        self.live_for(0.1)
        self.click(self.window.notices.answers[answer])

    def answer_until(self, done: Callable[[], bool]) -> None:
        """Answer every prompt until something is so."""
        while not done():
            self.until(lambda: done() or self.window.notices.prompt.isVisible())
            if not done():
                self.answer()

    def asked(self, words: str) -> None:
        """Answer prompts until one has these words."""
        notices = self.window.notices
        self.answer_until(lambda: notices.prompt.isVisible() and words in notices.prompt_text.text())

    def arm(self) -> None:
        """Reset the guard by key; look at the rig where that is asked."""
        self.until(self.window.reset.isEnabled)
        self.key(Qt.Key.Key_R, CONTROL)
        self.answer_until(lambda: self.window.guard.text() == "guard: armed")


def ancestors(widget: QWidget) -> Iterator[QWidget]:
    """Return what a widget lies in, from the inside."""
    above = widget.parentWidget()
    while above is not None:
        yield above
        above = above.parentWidget()


def top_items(tree: QTreeWidget) -> list[QTreeWidgetItem]:
    """Return the top entries of a tree."""
    return [tree.topLevelItem(at) for at in range(tree.topLevelItemCount())]


# --- The day --------------------------------------------------------------------------------------------------------


def plan_a_session(person: Person) -> None:
    """Choose a plan, edit it, err on each tab, and come back."""
    run, new = person.window.run, person.window.run.new
    person.step("opened")
    person.choose(new.plans, "relaxation")
    person.step("another plan")
    person.choose(new.plans, "paper")
    person.step("a plan of many steps")
    person.choose(new.plans, "drag")
    for key, text in {"speed_mm_s": "5, 10, 20", "travel_mm": "20", "rest_s": "0.5", "hold_s": "0.5"}.items():
        person.type_in(new.editor.editors[key], text)
    person.type_in(new.editor.editors["wait_s"], "0")
    person.type_in(new.operator, "A. Person")
    person.expect(run.preview.runs.rowCount() == 6, f"{run.preview.runs.rowCount()} runs for 3 speeds and ways back")
    person.step("fields changed")
    person.click(new.note)
    before = new.editor.values()
    for field in list(new.editor.editors.values()):
        person.bring_into_view(field)
        person.wheel(field, -1)
    person.expect(new.editor.values() == before, "the wheel changed the form in passing")
    person.step("wheel over the form")
    person.type_in(new.editor.editors["speed_mm_s"], "fast")
    for at in range(run.tabs.count()):
        person.tab(run.tabs, at)
        person.expect(seen_whole(new.problem) and "fast" in new.problem.text(), "it is not said what is invalid")
        person.step(f"invalid on tab {at + 1}")
    person.tab(run.tabs, run.preview)
    person.type_in(new.editor.editors["speed_mm_s"], "5, 10, 20")
    person.step("valid again")
    person.type_in(new.editor.editors["travel_mm"], "900")
    person.step("not allowed")
    person.key(Qt.Key.Key_Z, CONTROL)
    person.live_for(0.5)
    person.expect(new.editor.values()[0]["travel_mm"] == "20", "undo does not bring 20 mm back")
    person.step("undone")


def work_on_the_queue(person: Person) -> None:
    """Add, reorder, remove, put back; save the plan."""
    run, new, view = person.window.run, person.window.run.new, person.window.run.queue_view

    def waiting() -> list[QTreeWidgetItem]:
        return [item for item in top_items(view.tree) if item.text(3) == "waiting"]

    for speed in ("5", "10", "20"):
        person.type_in(new.editor.editors["speed_mm_s"], speed)
        person.click(new.queue)
    person.tab(run.tabs, view)
    person.expect(len(waiting()) == 3, f"{len(waiting())} sessions wait")
    person.step("three waiting")
    person.select(view.tree, waiting()[-1])
    person.key(Qt.Key.Key_Up, CONTROL)
    person.click(view.out)
    person.expect(len(waiting()) == 2, "nothing was removed")
    person.step("removed")
    person.key(Qt.Key.Key_Z, CONTROL | SHIFT)
    person.expect(len(waiting()) == 3, "what was removed is not back")
    person.step("put back")
    person.key(Qt.Key.Key_S, CONTROL)
    person.until(lambda: bool(open_dialogs()), 10.0)
    person.live_for(0.2)
    entry = next(field for field in open_dialogs()[0].findChildren(QLineEdit) if field.objectName() == "fileNameEdit")
    QTest.keyClick(entry, Qt.Key.Key_A, CONTROL)
    QTest.keyClicks(entry, str(person.lab / "plans" / "of a winter evening.toml"))
    person.step("save dialog")
    QTest.keyClick(entry, Qt.Key.Key_Return)
    person.until(lambda: not open_dialogs(), 10.0)
    # As the desktop does once a dialog is closed.
    person.window.activateWindow()
    person.expect(new.plans.currentText() == "of a winter evening", "the saved plan is not shown")
    person.step("plan saved")
    while waiting():
        person.select(view.tree, waiting()[0])
        person.click(view.out)
    for tab, name in ((run.log, "log"), (run.devices, "devices"), (run.hand, "by hand, tripped")):
        person.tab(run.tabs, tab)
        person.step(name)


def move_by_hand(person: Person) -> None:
    """Home, jog, touch off."""
    window, hand = person.window, person.window.run.hand
    person.arm()
    person.step("guard reset")
    person.click(hand.home)
    person.until(window.notices.prompt.isVisible)
    person.step("home asked")
    person.answer_until(lambda: not hand.busy)
    person.type_in(hand.distance, "8")
    person.click(hand.jog)
    person.until(window.notices.prompt.isVisible)
    person.step("jog asked")
    person.answer_until(lambda: not hand.busy)
    person.step("jogged")
    person.type_in(hand.approach, "5")
    person.click(hand.touch)
    person.answer_until(lambda: not hand.busy)
    person.step("touched off")


def run_sessions(person: Person) -> None:
    """Start, answer, watch, pause, stop."""
    window, run = person.window, person.window.run
    person.type_in(run.new.editor.editors["speed_mm_s"], "5, 2, 20")
    person.click(run.new.note)
    person.key(Qt.Key.Key_Return, CONTROL)
    person.asked("Lay a fresh specimen")
    person.live_for(1.5)
    force = run.live.readings.readings["Force"].text()
    person.expect(force.endswith("mN"), f"no force at the prompt: {force}")
    person.step("prompt with force")
    person.answer()
    person.until(lambda: run.live.run is not None and run.live.run.latest.speed_mm_s > 3)
    person.step("run under way", settle=False)
    person.key(Qt.Key.Key_P, CONTROL)
    person.tab(run.tabs, run.queue_view)
    person.step("pause wanted")
    person.until(lambda: window.notices.prompt.isVisible() and "Paused" in window.notices.prompt_text.text())
    person.live_for(1.2)
    person.step("paused")
    person.tab(run.tabs, run.live)
    person.step("paused, live tab")
    person.answer()
    person.until(lambda: "Run 2" in run.live.title.text() and run.live.run.latest.speed_mm_s > 1)
    person.key(Qt.Key.Key_Escape)
    person.until(lambda: not run.session_running)
    person.live_for(1.5)
    person.expect("Esc" in window.notices.complaint_text.text(), "the stop is not told")
    person.step("stopped by Esc")


def trip_the_guard(person: Person) -> None:
    """Drag faster than the guard's force limit allows; then the longest reason that there may be."""
    window, run = person.window, person.window.run
    if window.guard.text() != "guard: armed":
        person.arm()
    person.type_in(run.new.editor.editors["travel_mm"], "60")
    person.type_in(run.new.editor.editors["speed_mm_s"], "90")
    person.click(run.new.start)
    person.answer_until(lambda: not run.session_running)
    person.live_for(1.5)
    person.expect(window.notices.trip.isVisible(), "the guard did not trip")
    person.step("tripped")
    reason = run._trip_reason  # noqa: SLF001  # put back afterwards
    window.take(GuardState(LONG_REASON))
    window.notices.complain(LONG_REASON)
    for number in (1, 2, 3, 4):
        person.page(number)
        person.step(f"a very long reason, page {number}")
    person.page(1)
    person.click(window.notices.dismiss)
    window.take(GuardState(reason))
    person.arm()
    person.step("reset after the trip")


def long_texts(person: Person) -> None:
    """Plan a prompt of several lines, and a mirror folder that is long and not there."""
    window, run, new = person.window, person.window.run, person.window.run.new
    person.tab(run.tabs, run.preview)
    person.type_in(new.editor.editors["speed_mm_s"], "20")
    person.type_in(new.editor.editors["travel_mm"], "20")
    person.type_in(new.editor.editors["prompt"], LONG_PROMPT.strip(" ;"))
    person.step("long prompt planned")
    person.type_in(new.mirror, LONG_FOLDER)
    person.click(new.start)
    person.answer_until(lambda: not run.session_running)
    person.step("mirror not there")
    person.type_in(new.mirror, "")
    person.click(new.start)
    person.asked("Tyrode")
    for number in (1, 2, 3, 4):
        person.page(number)
        person.step(f"long prompt asked, page {number}")
    person.page(1)
    person.answer_until(lambda: not run.session_running)
    person.live_for(1.2)
    person.expect(not window.notices.complaint.isVisible(), f"still said: {window.notices.complaint_text.text()}")
    person.step("session complete")


def view_runs(person: Person) -> None:
    """Select, overlay, zoom, measure, mark, note, export."""
    look = person.window.look
    browser, overlay = look.browser, look.overlay
    person.page(2)
    person.until(lambda: not browser.busy)
    person.expect(len(top_items(browser.tree)) > 2, "the list has not refreshed itself after the sessions")
    person.step("runs listed")
    top = next(item for item in top_items(browser.tree) if item.text(0) == "stribeck")
    person.select(browser.tree, top)
    person.key(Qt.Key.Key_Right)
    person.until(lambda: not browser.busy and top.childCount() > 0 and bool(overlay.traces))
    person.step("a campaign selected")
    person.select(browser.tree, top.child(0))
    for at in (4, 8, 12):
        person.select(browser.tree, top.child(at), CONTROL)
    person.until(lambda: len(overlay.traces) == 4)
    person.step("four runs")
    person.choose(overlay.axis, "position")
    person.click(overlay.cursors)
    person.step("against position, cursors")
    person.choose(overlay.axis, "speed")
    person.step("against speed")
    person.choose(overlay.axis, "time")
    person.click(overlay.cursors)
    for _ in range(4):
        person.wheel(overlay.channel_plot.widget, 1)
    person.key(Qt.Key.Key_Right, CONTROL)
    person.step("zoomed and panned")
    person.key(Qt.Key.Key_0, CONTROL)
    person.tab(look.tabs, look.steady)
    person.step("steady forces")
    person.tab(look.tabs, overlay)
    person.select(browser.tree, top.child(2))
    person.type_in(browser.words, "an air bubble under the capsule, seen only after the run had ended")
    person.click(browser.bad)
    person.until(lambda: "BAD" in top.child(2).text(2))
    person.step("marked bad")
    person.type_in(browser.words, "specimen turned over")
    person.click(browser.note)
    person.until(lambda: "turned over" in top.child(2).text(2))
    person.step("noted")
    person.click(browser.good)
    person.until(lambda: "BAD" not in top.child(2).text(2))

    def at_the_menu() -> None:
        person.step("export menu", settle=False)
        QTest.keyClick(look.menu, Qt.Key.Key_Escape)

    # The menu takes the click for itself until it is left.
    QTimer.singleShot(600, at_the_menu)
    person.click(look.export)
    person.window.activateWindow()


def diagnose(person: Person) -> None:
    """Diagnose the small campaign, identify it, report on it, queue what is recommended."""
    run, page = person.window.run, person.window.diagnose
    person.page(3)
    person.step("diagnose page")
    person.type_in(page.campaign, str(person.lab / "runs" / "no such campaign"))
    person.key(Qt.Key.Key_D, CONTROL)
    person.until(lambda: not page.busy)
    person.step("no such campaign")
    person.type_in(page.campaign, str(person.lab / "runs" / "stribeck"))
    person.click(page.start)
    person.live_for(3.0)
    person.step("diagnosing")
    person.until(lambda: not page.busy)
    tabs = page.results.view.tabs
    for at in range(tabs.count()):
        person.tab(tabs, at)
        person.step(f"diagnosis, {tabs.tabText(at).replace('&', '').lower()}")
    waiting = len(run.queue.entries)
    if page.results.next.isEnabled():
        person.click(page.results.next)
        person.expect(len(run.queue.entries) == waiting + 1, "the experiment is not in the queue")
        person.step("next experiment queued")
    person.page(3)
    person.click(page.identify)
    person.until(lambda: not page.busy)
    tabs = page.identification.tabs
    for at in range(tabs.count()):
        person.tab(tabs, at)
        person.step(f"identified, {tabs.tabText(at).replace('&', '').lower()}")
    person.click(page.report)
    person.until(lambda: not page.busy)
    person.step("report written")


def lose_the_engine(person: Person) -> None:
    """Kill the engine during a run, start another, recover what it left."""
    window, run, browser = person.window, person.window.run, person.window.look.browser
    person.page(1)
    person.choose(run.new.plans, "of a winter evening")
    person.type_in(run.new.editor.editors["speed_mm_s"], "2")
    person.type_in(run.new.editor.editors["prompt"], "")
    for entry in [entry for entry in run.queue.entries if entry.stage == "waiting"]:
        run.queue.remove(entry)
    person.click(run.new.start)
    person.answer_until(lambda: "mm/s" in run.live.readings.readings["Speed"].text() and run.live.run is not None)
    person.live_for(1.5)
    assert window.engine.pid is not None
    os.kill(window.engine.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
    person.until(window.notices.lost.isVisible)
    person.live_for(1.5)
    person.step("engine lost")
    person.click(window.notices.restart)
    person.until(lambda: window.guard.text() == "guard: NOT ARMED" and window.reset.isEnabled())
    person.live_for(2.0)
    person.step("engine started again")
    person.page(2)
    person.key(Qt.Key.Key_F5)
    person.until(lambda: not browser.busy)
    newest = max((item for item in top_items(browser.tree) if item.text(0) != "stribeck"), key=lambda i: i.text(0))
    person.select(browser.tree, newest)
    person.key(Qt.Key.Key_Right)
    person.until(browser.recover.isEnabled, 20.0)
    person.step("a recording left")
    person.click(browser.recover)
    person.until(lambda: not browser.recover.isEnabled())
    person.step("recovered")


def close_and_open(person: Person) -> None:
    """Close with waiting sessions, and open again."""
    run = person.window.run
    person.page(1)
    person.tab(run.tabs, run.queue_view)
    person.click(run.new.queue)
    person.click(run.new.queue)
    waiting = sum(item.text(3) == "waiting" for item in top_items(run.queue_view.tree))
    person.step("before closing")
    person.window.close()
    run = person.open(simulated(person.lab)).run
    again = sum(item.text(3) == "waiting" for item in top_items(run.queue_view.tree))
    person.expect(again == waiting, f"{again} of {waiting} sessions wait again")
    person.tab(run.tabs, run.queue_view)
    person.step("opened again")


def on_the_doubles(person: Person) -> None:
    """Do what the simulated rig does not ask for: look at it, calibrate, state the specimen, set the rig."""
    window = person.open(
        replace(simulated(person.lab), backend="hardware", double=True, assignments=PATIENT, pace=10.0)
    )
    run, rig = window.run, window.rig
    person.step("doubles opened")
    person.key(Qt.Key.Key_R, CONTROL)
    person.until(window.notices.prompt.isVisible)
    person.step("reset asks to look")
    person.answer_until(lambda: window.guard.text() == "guard: armed")
    person.page(1)
    person.type_in(run.new.editor.editors["speed_mm_s"], "10")
    person.click(run.new.start)
    person.until(window.notices.prompt.isVisible)
    person.live_for(1.0)
    person.step("doubles ask")
    person.answer_until(lambda: not run.session_running)
    person.live_for(1.5)
    person.step("doubles complete")
    person.page(4)
    person.tab(rig.tabs, rig.settings)
    for at in range(rig.settings.groups.count()):
        rig.settings.groups.setCurrentRow(at)
        person.step(f"settings, {rig.settings.groups.item(at).text().strip().lower()}")
    rig.settings.groups.setCurrentRow(5)
    person.type_in(rig.settings.editor.editors["force_limit_mN"], "much")
    person.expect(not rig.settings.save.isEnabled(), "an invalid setting can be saved")
    person.step("an invalid setting")
    person.type_in(rig.settings.editor.editors["force_limit_mN"], "6000")
    person.step("a setting changed")
    person.click(rig.settings.save)
    person.until(lambda: window.guard.text() == "guard: NOT ARMED" and window.reset.isEnabled())
    person.step("settings saved")
    person.arm()
    person.tab(rig.tabs, rig.calibrate)
    person.step("calibrate")
    person.click(rig.calibrate.start)
    person.until(window.notices.prompt.isVisible)
    person.step("a weight asked for")
    person.answer_until(lambda: not run.rig_busy)
    person.step("force calibrated")
    person.click(rig.calibrate.store)
    person.live_for(1.0)
    person.step("calibration stored")
    person.choose(rig.calibrate.sensor, "Encoder")
    person.step("calibrate the encoder")
    person.click(rig.calibrate.start)
    person.until(window.notices.prompt.isVisible)
    person.key(Qt.Key.Key_Escape)
    person.until(lambda: not run.rig_busy)
    person.step("calibration cancelled")


DAY = (plan_a_session, work_on_the_queue, move_by_hand, run_sessions, trip_the_guard, long_texts, view_runs, diagnose,
       lose_the_engine, close_and_open, on_the_doubles)  # fmt: skip


def simulated(lab: Path) -> RigSelection:
    """Return the simulated rig, whose guard trips early."""
    return RigSelection(rig=lab / "rig.toml", assignments=(LOW_LIMIT,), pace="real")


def walk(folder: Path, lab: Path, size: str) -> int:
    """Work through the day in this process, and count what was wrong."""
    person = Person(folder, lab, size)
    try:
        person.open(simulated(lab))
        for part in DAY:
            part(person)
    except (AssertionError, TimeoutError) as error:
        person.expect(False, f"{error} (line {error.__traceback__.tb_next.tb_lineno})")
        person.step("cannot go on")
    finally:
        person.window.close_in_order("the walk is over")
    return person.wrong


def walk_in_a_process(folder: Path, place: Path, size: str) -> int:
    """Walk in a process whose screen is as large as the window; return how much was wrong."""
    own = place / size
    shutil.copytree(place / "lab", own)
    shutil.rmtree(folder, ignore_errors=True)
    width, height, scale = SIZES[size]
    screen = {"name": "screen", "x": 0, "y": 0, "width": width * scale, "height": height * scale, "dpr": 1}
    file = place / f"{size}.json"
    file.write_text(json.dumps({"screens": [screen]}), "utf-8")
    surroundings = {**os.environ, "QT_SCALE_FACTOR": str(scale), "QT_QPA_PLATFORM": f"offscreen:configfile={file}"}
    call = [sys.executable, __file__, str(folder), "--lab", str(own), "--size", size]
    return subprocess.run(call, env=surroundings, check=False).returncode


def main() -> int:
    """Walk at every size, each in a process of its own."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("folder", nargs="?", type=Path, default=Path("walk-pictures"))
    options.add_argument("--size", choices=SIZES, action="append")
    options.add_argument("--lab", type=Path, help=argparse.SUPPRESS)
    chosen = options.parse_args()
    if chosen.lab is not None:
        return min(walk(chosen.folder, chosen.lab, chosen.size[0]), 1)
    wrong = 0
    with tempfile.TemporaryDirectory() as place:
        create_lab(Path(place) / "lab")
        # Less rest than a specimen would want: nobody looks at it.
        dragrig.simulate(
            "drag-sweep", out=Path(place) / "lab" / "runs" / "stribeck", rig=Path(place) / "lab" / "rig.toml",
            effects=["stribeck:ratio=0.6"], assignments=["speed_mm_s=[1,2,5,10,20,40]", "repeats=2"],
        )  # fmt: skip
        for size in chosen.size or SIZES:
            print(size, flush=True)
            wrong += walk_in_a_process(chosen.folder / size, Path(place), size) != 0
    print(f"{'something is wrong' if wrong else 'nothing is wrong'}; pictures in {chosen.folder}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
