"""The window on desktops whose decimals have a comma or a point: what is typed is what moves."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from windows import WAIT_MS, lab_in, opened, press, require_qt

require_qt()

from PySide6.QtCore import QLocale, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QLineEdit
from pytestqt.qtbot import QtBot

from dragrig.config import NumberRange
from dragrig.rig.operator import Answer
from dragrig.window.forms import NumberField
from dragrig.window.main_window import MainWindow
from dragrig.window.widgets import column
from property_tests import thorough
from typed_in_locale import LOCALES, typed_in

PER_LOCALE = 360


@pytest.mark.thorough
@pytest.mark.parametrize("locale", LOCALES)
def test_numbers_typed_under_a_locale_are_those_that_are_sent(locale: str) -> None:
    outcome = typed_in(locale, PER_LOCALE)
    assert (outcome.locale, outcome.decimal_mark) == (locale, "." if locale == "en_US" else ",")
    assert outcome.typed >= PER_LOCALE
    assert outcome.refused >= PER_LOCALE // 10
    assert outcome.differing == []
    assert outcome.sent == []


@pytest.fixture(params=[name if name == "de_DE" else thorough(name) for name in LOCALES])
def window(request: pytest.FixtureRequest, qtbot: QtBot, tmp_path: Path) -> Iterator[MainWindow]:
    before = QLocale()
    QLocale.setDefault(QLocale(str(request.param)))
    try:
        shown = opened(qtbot, lab_in(tmp_path / "lab"), tmp_path / "window.ini")
        assert shown.run.hand.distance.locale().decimalPoint() == QLocale(str(request.param)).decimalPoint()
        yield shown
        shown.close_in_order("the test is over")
    finally:
        QLocale.setDefault(before)


def type_in(line: QLineEdit, text: str) -> None:
    line.setFocus()
    line.selectAll()
    QTest.keyClicks(line, text)
    QTest.keyClick(line, Qt.Key.Key_Return)


def test_a_jog_is_announced_with_the_number_typed_and_goes_so_far(window: MainWindow, qtbot: QtBot) -> None:
    hand, notices = window.run.hand, window.notices
    window.go_to(window.run)
    window.run.tabs.setCurrentWidget(hand)
    press(window.reset)
    qtbot.waitUntil(lambda: window.guard.text() == "guard: armed", timeout=WAIT_MS)
    for text, sentence, end in (
        ("1.5", "by +1.5 mm at 0.5 mm/s", "1.500"),
        ("2,0625", "by +2.0625 mm at 0.5 mm/s", "3.56"),  # the simulated rig stays where it is
    ):
        type_in(hand.distance.lineEdit(), text)
        type_in(hand.speed.lineEdit(), "0,5")
        press(hand.jog)
        asked: list[str] = []
        while hand.busy:
            qtbot.waitUntil(lambda: notices.prompt.isVisible() or not hand.busy, timeout=WAIT_MS)
            if notices.prompt.isVisible():
                asked.append(notices.prompt_text.text())
                press(notices.answers[Answer.DONE])
        assert sentence in asked[-1]
        assert hand.state.text().startswith(f"The stage is at {end}")
    type_in(hand.distance.lineEdit(), "1.234,5")
    assert not hand.jog.isEnabled()
    assert hand.distance.problem.isVisible()
    assert hand.distance.problem.text() == "Distance of the jog: '1.234,5' has a mark of thousands; write 1234.5."
    assert hand.touch.isEnabled()  # it has numbers of its own
    type_in(hand.distance.lineEdit(), "1")
    type_in(hand.speed.lineEdit(), "100,5")
    assert "above 100 mm/s, the rig's limit" in hand.speed.problem.text()
    assert not hand.jog.isEnabled()
    type_in(hand.speed.lineEdit(), "100")
    assert hand.jog.isEnabled()
    assert not hand.speed.problem.isVisible()

    new = window.run.new
    speed = new.editor.editors["speed_mm_s"]
    assert isinstance(speed, QLineEdit)
    for text, said in (("5,5", "is 5.5 or 5, 5?"), ("100.5", "above 100 mm/s, the rig's limit")):
        type_in(speed, text)
        new.update_preview()
        assert said in new.editor.problems["speed_mm_s"].text()
        assert new.editor.problems["speed_mm_s"].isVisible()
        assert not new.start.isEnabled()
    type_in(speed, "5.5")
    new.update_preview()
    assert new.start.isEnabled()
    assert {preview.run.protocol.summary() for preview in new.session.preflight.previews} >= {"drag 5.5 mm/s"}


@pytest.fixture
def field(qtbot: QtBot) -> Iterator[NumberField]:
    from PySide6.QtWidgets import QWidget

    made = NumberField("Travel", NumberRange("mm", 0.0, 10.0), 5.0, step=0.1)
    outer = QWidget()
    outer.setLayout(column(made, made.problem))
    outer.show()
    yield made
    outer.close()


def test_steps_are_those_that_are_shown_and_end_at_the_limit(field: NumberField) -> None:
    entered: list[float] = []
    field.entered.connect(entered.append)
    for _ in range(3):
        QTest.keyClick(field, Qt.Key.Key_Up)
    assert (field.text(), field.value()) == ("5.3", 5.3)
    assert entered == [5.1, 5.2, 5.3]
    type_in(field.lineEdit(), "9.95")
    QTest.keyClick(field, Qt.Key.Key_Up)
    assert field.value() == 9.95
    type_in(field.lineEdit(), "far")
    QTest.keyClick(field, Qt.Key.Key_Up)
    assert (field.text(), field.value()) == ("far", None)
    assert field.entered_value == 9.95


def test_no_digit_that_is_typed_is_lost_or_shown_and_not_sent(field: NumberField) -> None:
    type_in(field.lineEdit(), "0,1234567890123")
    assert (field.text(), field.value()) == ("0.1234567890123", 0.1234567890123)
    type_in(field.lineEdit(), "11")
    assert (field.text(), field.value()) == ("11", None)
    assert field.problem.text() == "Travel: '11' is above 10 mm, the most allowed."
    field.set_range(NumberRange("mm", 0.0, 20.0))
    assert field.value() == 11.0
    assert not field.problem.isVisible()
    field.clear()
    assert "is empty" in field.problem.text()
