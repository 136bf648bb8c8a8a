"""The window without a mouse: letters that belong to one control each, and a way to every control."""

from collections import Counter
from collections.abc import Iterator
from itertools import pairwise

import pytest

from windows import BUSY, WAIT_MS, dressed, lab_in, require_qt

require_qt()

from PySide6.QtCore import QSettings, Qt
from PySide6.QtGui import QKeySequence
from PySide6.QtWidgets import (
    QAbstractButton,
    QAbstractItemView,
    QAbstractSpinBox,
    QApplication,
    QComboBox,
    QLineEdit,
    QPlainTextEdit,
    QScrollBar,
    QTabBar,
    QTabWidget,
    QWidget,
)
from pytestqt.qtbot import QtBot

from diagnoses import STRIBECK, without_pictures
from dragrig.engine_host.messages import PromptShown, RigSelection
from dragrig.present.diagnosis import diagnosis_document
from dragrig.views import CompletedDiagnosis
from dragrig.window.main_window import MainWindow
from dragrig.window.widgets import MessageText, StoredSettings

CONTROLS = (QAbstractButton, QAbstractItemView, QAbstractSpinBox, QComboBox, QLineEdit, QPlainTextEdit, QTabBar)


@pytest.fixture(scope="module")
def window(
    request: pytest.FixtureRequest, qapp: QApplication, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[MainWindow]:
    """A window in which everything that can be seen at once is seen."""
    dressed()
    lab = lab_in(tmp_path_factory.mktemp("lab"))
    settings = QSettings(str(lab / "window.ini"), QSettings.Format.IniFormat)
    made = MainWindow(RigSelection(rig=lab / "rig.toml"), lab, StoredSettings(settings), BUSY)
    made.resize(1500, 1000)
    made.show()
    QtBot(request).waitUntil(lambda: made.guard.text() == "guard: NOT ARMED", timeout=WAIT_MS)
    made.notices.ask(PromptShown(1, "Lay a fresh specimen on the foam", hands=True, can_redo=True, can_skip=True))
    made.notices.complain("something went wrong")
    made.run.new.destination.adds.setChecked(True)
    document = without_pictures(diagnosis_document(STRIBECK).without("before-after"))
    made.diagnose.results.show_diagnosis(CompletedDiagnosis(STRIBECK, document))
    made.diagnose.results.show()
    yield made
    made.close_in_order("the tests are over")


def every_view(window: MainWindow) -> Iterator[str]:
    """Go to every page, and every tab of it."""
    for at in range(window.pages.count()):
        page = window.pages.widget(at)
        window.go_to(page)
        for tabs in page.findChildren(QTabWidget):
            for place in range(tabs.count()):
                tabs.setCurrentIndex(place)
                yield f"page {at + 1}, {tabs.tabText(place)}"


def letters(window: MainWindow) -> list[tuple[str, str]]:
    result = [(button.text(), button) for button in window.findChildren(QAbstractButton)]
    for bar in window.findChildren(QTabBar):
        result += [(bar.tabText(at), bar) for at in range(bar.count())]
    keys = ((QKeySequence.mnemonic(text).toString(), text) for text, widget in result if widget.isVisibleTo(window))
    return [(key, text) for key, text in keys if key]


def test_no_two_controls_share_a_letter(window: MainWindow) -> None:
    window.notices.lost.show()
    clashes = {}
    for view in every_view(window):
        result = letters(window)
        assert len(result) > 10
        twice = {key for key, count in Counter(key for key, _ in result).items() if count > 1}
        clashes |= {f"{view}: {key}": [text for entry, text in result if entry == key] for key in sorted(twice)}
    window.notices.lost.hide()
    assert clashes == {}


def test_a_button_with_a_shortcut_keeps_its_letter(window: MainWindow, qtbot: QtBot) -> None:
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow, timeout=WAIT_MS)
    for number, page in (
        (Qt.Key.Key_2, window.look), (Qt.Key.Key_3, window.diagnose), (Qt.Key.Key_4, window.rig),
        (Qt.Key.Key_1, window.run),
    ):  # fmt: skip
        qtbot.keyClick(window, number, Qt.KeyboardModifier.AltModifier)
        qtbot.waitUntil(lambda page=page: window.pages.currentWidget() is page, timeout=WAIT_MS)
        window.go_to(window.run)
        qtbot.keyClick(window, number, Qt.KeyboardModifier.ControlModifier)
        assert window.pages.currentWidget() is page


def reached(window: MainWindow, qtbot: QtBot) -> set[QWidget]:
    """Press Tab until the focus has come round."""
    seen: list[QWidget] = []
    while (focus := QApplication.focusWidget()) is not None and seen.count(focus) < 2 and len(seen) < 500:
        seen.append(focus)
        qtbot.keyClick(focus, Qt.Key.Key_Tab)
    assert len(seen) < 500, [type(entry).__name__ for entry, _ in zip(seen, range(20), strict=False)]
    assert all(entry is not second for entry, second in pairwise(seen)), "the focus does not leave a control"
    return set(seen)


def test_tab_reaches_every_control(window: MainWindow, qtbot: QtBot) -> None:
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow, timeout=WAIT_MS)
    missed = []
    for view in every_view(window):
        window.pages.currentWidget().setFocus()
        qtbot.keyClick(window, Qt.Key.Key_Tab)
        seen = reached(window, qtbot)
        for path in window.findChildren(QWidget):
            wanted = isinstance(path, CONTROLS) and not isinstance(path, QScrollBar)
            inside = isinstance(path.parent(), (QAbstractSpinBox, QComboBox, QAbstractItemView, QTabBar))
            # Those have keys of their own on every page: Escape, Ctrl+1 to Ctrl+4.
            own = path is window.stop_button or path.property("role") == "page"
            wanted = wanted and not (isinstance(path, MessageText) and path.focusPolicy() is Qt.FocusPolicy.NoFocus)
            if wanted and not inside and not own and path.isVisibleTo(window) and path.isEnabled() and path not in seen:
                missed.append(f"{view}: {type(path).__name__} {path.accessibleName() or path.objectName()}")
    assert missed == []


def test_keys_zoom_plots_and_move_cursors(window: MainWindow, qtbot: QtBot) -> None:
    window.go_to(window.look)
    window.look.tabs.setCurrentIndex(0)
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow, timeout=WAIT_MS)
    overlay = window.look.overlay
    overlay.speed_plot.show_times(0.0, 10.0)
    control, alt = Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.AltModifier
    before = overlay.speed_plot.shown()
    overlay.cursors.setFocus()
    qtbot.keyClick(overlay.cursors, Qt.Key.Key_Plus, control)
    low, high = overlay.speed_plot.shown()
    assert high - low == pytest.approx(0.5 * (before[1] - before[0]))
    qtbot.keyClick(overlay.cursors, Qt.Key.Key_Right, control)
    assert overlay.speed_plot.shown()[0] > low
    qtbot.keyClick(overlay.cursors, Qt.Key.Key_C, alt)
    qtbot.waitUntil(overlay.cursors.isChecked, timeout=WAIT_MS)
    first, second = (cursor.time_s for cursor in overlay.cursor_lines)
    qtbot.keyClick(overlay.cursors, Qt.Key.Key_Right, alt)
    qtbot.keyClick(overlay.cursors, Qt.Key.Key_Left, alt | Qt.KeyboardModifier.ShiftModifier)
    assert overlay.cursor_lines[0].time_s > first
    assert overlay.cursor_lines[1].time_s < second
    overlay.cursors.setChecked(False)
