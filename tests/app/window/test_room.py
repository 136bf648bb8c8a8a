"""The window where there is little room: what stops and resets is on the screen, whatever is written above it."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from places import SUPPORT
from property_tests import thorough
from windows import BUSY, WAIT_MS, dressed, lab_in, require_qt

require_qt()

from PySide6.QtCore import QPoint, QRect, QSettings, QSize, Qt
from PySide6.QtWidgets import QApplication, QLabel, QToolTip, QWidget
from pytestqt.qtbot import QtBot

from diagnoses import STRIBECK
from dragrig.engine_host.messages import GuardState, HostLost, PromptShown, RigSelection
from dragrig.present.diagnosis import diagnosis_document
from dragrig.views import CompletedDiagnosis
from dragrig.window.main_window import MainWindow
from dragrig.window.plots import TimePlot
from dragrig.window.widgets import StoredSettings, label

SMALL = QSize(1024, 650)
LARGE = '<svg xmlns="http://www.w3.org/2000/svg" width="1010pt" height="1400pt" viewBox="0 0 1010 1400"/>'
"""A drawing as large as the largest of a diagnosis."""
LONG = f"/runs/{'without-a-blank-' * 40}/a-run.h5 because {'of one thing and another ' * 30}"


@pytest.fixture(scope="module")
def window(
    request: pytest.FixtureRequest, qapp: QApplication, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[MainWindow]:
    dressed()
    lab = lab_in(tmp_path_factory.mktemp("lab"))
    settings = QSettings(str(lab / "window.ini"), QSettings.Format.IniFormat)
    made = MainWindow(RigSelection(rig=lab / "rig.toml"), lab, StoredSettings(settings), BUSY)
    made.resize(SMALL)
    made.show()
    QtBot(request).waitUntil(lambda: made.guard.text() == "guard: NOT ARMED", timeout=WAIT_MS)
    yield made
    made.close_in_order("the tests are over")


def say_everything(window: MainWindow) -> None:
    """Show every notice that there can be at once, each far too long."""
    window.take(GuardState(LONG))
    window.take(PromptShown(1, LONG, can_redo=True, can_skip=True, hands=True, can_measure=True))
    for number in range(5):
        window.notices.complain(f"{number} {LONG}")
    QApplication.processEvents()


def is_whole(widget: QWidget, window: MainWindow) -> bool:
    """Whether the whole of a widget can be seen."""
    place = QRect(widget.mapTo(window, QPoint(0, 0)), widget.size())
    return (
        widget.isVisible() and window.rect().contains(place) and widget.visibleRegion().boundingRect() == widget.rect()
    )


@pytest.mark.parametrize("size", [SMALL, thorough(QSize(1920, 1080))], ids=["1024 by 650", "full HD"])
def test_notices_never_change_the_windows_size(window: MainWindow, size: QSize) -> None:
    window.resize(size)
    window.take(GuardState(""))
    say_everything(window)
    for page in map(window.pages.widget, range(window.pages.count())):
        window.go_to(page)
        QApplication.processEvents()
        assert window.size() == size
        for always in (window.stop_button, window.reset, window.guard, *window.notices.answers.values()):
            assert is_whole(always, window), (page, always)
    window.take(HostLost(1))
    QApplication.processEvents()
    assert window.size() == size
    assert is_whole(window.notices.restart, window)
    window.notices.lost.hide()


def test_a_guard_that_nothing_tripped_is_no_alarm(window: MainWindow) -> None:
    """Red at every start would be red that nobody sees any more."""
    shown = []
    for state in (GuardState("not reset", tripped=False), GuardState("force: 9000 mN")):
        window.take(state)
        shown.append((window.guard.text(), window.notices.trip.property("role"), window.notices.trip_text.text()))
        assert window.reset.isEnabled()
    assert [text for text, _, _ in shown] == ["guard: NOT ARMED", "guard: TRIPPED"]
    assert [role for _, role, _ in shown] == ["calm", "trip"]
    assert shown[0][2].startswith("Nothing can move yet. Check: path clear")
    assert "force: 9000 mN" in shown[1][2]


def test_what_somebody_elses_file_says_is_text_and_no_html(window: MainWindow) -> None:
    note = "<b>bold</b><img src='http://x/y.png'>"
    QToolTip.showText(window.mapToGlobal(QPoint(9, 9)), note, window)
    tip = next(
        item for item in QApplication.topLevelWidgets() if isinstance(item, QLabel) and item.inherits("QTipLabel")
    )
    assert (tip.text(), tip.textFormat()) == (note, Qt.TextFormat.PlainText)
    QToolTip.hideText()
    plot = TimePlot(note, note)
    plot.set_x_quantity(note, note)
    for side in ("left", "bottom"):
        assert "<img" not in plot.widget.getPlotItem().getAxis(side).labelString()
    assert label(note).textFormat() == Qt.TextFormat.PlainText


def test_everything_fits_the_smallest_window(window: MainWindow) -> None:
    """A Full HD screen shows 960 by 540 at twice the size."""
    say_everything(window)
    assert window.minimumWidth() <= 940
    assert window.minimumHeight() <= 500
    for page in map(window.pages.widget, range(window.pages.count())):
        window.go_to(page)
        room = window.centralWidget().minimumSizeHint()
        assert room.width() <= window.minimumWidth()
        assert room.height() <= window.minimumHeight()


@pytest.mark.parametrize("page", [0, 1, 2, 3])
def test_a_page_needs_no_scrolling_at_1024_by_650(window: MainWindow, page: int) -> None:
    window.resize(SMALL)
    window.take(GuardState("short"))
    window.notices.hide_prompt()
    window.notices.dismiss.click()
    window.go_to(window.pages.widget(page))
    QApplication.processEvents()
    need, room = window.pages.currentWidget().minimumSizeHint(), window.pages.size()
    assert need.width() <= room.width()
    assert need.height() <= room.height()
    run = window.run
    for shown in (run.new.start, run.new.queue, run.abort, run.start_queue) if page == 0 else ():
        assert is_whole(shown, window)


@pytest.mark.parametrize("size", [SMALL, thorough(QSize(1500, 1000))], ids=["1024 by 650", "1500 by 1000"])
def test_a_diagnosis_fits_the_window_and_scrolls_within_its_tab(window: MainWindow, size: QSize) -> None:
    window.resize(size)
    window.take(GuardState(""))
    window.notices.dismiss.click()
    results = window.diagnose.results
    document = diagnosis_document(STRIBECK)
    drawings = {figure.name: LARGE for figure in document.figures()}
    results.show_diagnosis(CompletedDiagnosis(STRIBECK, document.with_drawings(drawings)))
    results.show()
    window.go_to(window.diagnose)
    for at in range(results.view.tabs.count()):
        results.view.tabs.setCurrentIndex(at)
        for _ in range(3):
            QApplication.processEvents()
        assert window.room.verticalScrollBar().maximum() == 0, results.view.tabs.tabText(at)
        assert is_whole(results.next_words, window)
    results.hide()


def test_a_prompt_leaves_start_and_abort_on_the_screen(window: MainWindow) -> None:
    """At 1024 by 650, whatever tab is shown: whoever is asked may also want to end the session."""
    window.resize(SMALL)
    window.take(GuardState(""))
    window.notices.dismiss.click()
    words = "The stage moves to the end of its travel to find its origin: take the capsule out of its path"
    window.take(PromptShown(1, words, can_redo=True, can_skip=True, hands=True, can_measure=True))
    run = window.run
    window.go_to(run)
    try:
        for tab in map(run.tabs.widget, range(run.tabs.count())):
            run.tabs.setCurrentWidget(tab)
            QApplication.processEvents()
            for shown in (run.new.start, run.new.queue, run.abort, run.start_queue, *window.notices.answers.values()):
                assert is_whole(shown, window), (tab, shown)
    finally:
        window.notices.hide_prompt()


def test_a_long_message_can_be_read_to_its_end(window: MainWindow) -> None:
    window.resize(SMALL)
    say_everything(window)
    for text in (window.notices.trip_text, window.notices.prompt_text, window.notices.complaint_text):
        bar = text.verticalScrollBar()
        assert text.text().count(LONG) >= 1
        assert bar.maximum() > 0
        bar.setValue(bar.maximum())
        end = text.cursorForPosition(text.viewport().rect().bottomRight())
        assert end.atEnd()


def test_a_short_message_takes_one_line(window: MainWindow) -> None:
    window.resize(SMALL)
    window.take(GuardState("force"))
    text = window.notices.trip_text
    assert text.height() < 2 * text.fontMetrics().lineSpacing()


@pytest.mark.thorough
def test_it_opens_on_a_small_screen_at_twice_the_size(tmp_path: Path) -> None:
    script = f"""
import sys
sys.path.insert(0, {str(SUPPORT)!r})
from pathlib import Path
from windows import BUSY, lab_in
from PySide6.QtCore import QSettings
from dragrig.engine_host.messages import GuardState, RigSelection
from dragrig.window.main_window import MainWindow, qt_application
from dragrig.window.plots import TimePlot
from dragrig.window.widgets import StoredSettings, label

if __name__ == "__main__":
    application = qt_application()
    lab = lab_in(Path({str(tmp_path / "lab")!r}))
    settings = StoredSettings(QSettings(str(lab / "w.ini"), QSettings.Format.IniFormat))
    window = MainWindow(RigSelection(rig=lab / "rig.toml"), lab, settings, BUSY)
    window.show()
    window.take(GuardState("x" * 2000))
    application.processEvents()
    room = window.screen().availableGeometry().size()
    stop = window.stop_button
    print(window.devicePixelRatio(), window.width() <= room.width(), window.height() <= room.height(),
          stop.mapTo(window, stop.rect().bottomRight()).x() < window.width(), window.isMaximized())
    window.close_in_order("done")
"""
    file = tmp_path / "opened.py"
    file.write_text(script, "utf-8")
    screen = tmp_path / "screen.json"
    screen.write_text(
        '{"screens": [{"name": "one", "x": 0, "y": 0, "width": 1920, "height": 1080, "dpr": 1}]}', "utf-8"
    )
    surroundings = {**os.environ, "QT_SCALE_FACTOR": "2", "QT_QPA_PLATFORM": f"offscreen:configfile={screen}"}
    done = subprocess.run([sys.executable, str(file)], env=surroundings, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["2.0", "True", "True", "True", "True"], done.stdout
