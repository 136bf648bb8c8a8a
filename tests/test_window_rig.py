"""The rig in the window: off a pressed limit switch, calibrated and set up, each with a real engine."""

from pathlib import Path

import add_ons
import pytest
from windows import WAIT_MS, Until, lab_in, opened, press, require_qt

require_qt()

from pytestqt.qtbot import QtBot

from dragrig.rig.operator import Answer
from dragrig.window.main_window import MainWindow

ON_A_SWITCH = (
    add_ons.CODE.replace("needs_hands = True", "needs_hands = False")
    + """
from dragrig.rig.devices import TravelEnd
from sim_faults import Faults, LimitSwitch

def hardware(request):
    made = Handed(request.rig, request.model, VirtualClock(request.origin), Faults(limit_switch=LimitSwitch(
        TravelEnd.HIGH, 100.0)))
    made.stage._axis.place(101.0)
    made.stage._homed = True
    return made
"""
)
"""A rig whose stage stands on its upper limit switch whenever it is opened."""


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return lab_in(tmp_path_factory.mktemp("lab"))


@pytest.fixture
def until(qtbot: QtBot) -> Until:
    return lambda done: qtbot.waitUntil(done, timeout=WAIT_MS)


def answer_all(window: MainWindow, until: Until, busy: str = "hand") -> list[str]:
    """Answer every prompt with done until the rig is at rest; return the prompts."""
    prompts: list[str] = []
    doer, notices = getattr(window.run, busy), window.notices
    while doer.busy:
        until(lambda: notices.prompt.isVisible() or not doer.busy)
        if notices.prompt.isVisible():
            prompts.append(notices.prompt_text.text())
            press(notices.answers[Answer.DONE])
    return prompts


def test_the_stage_is_driven_off_a_pressed_limit_switch(
    qtbot: QtBot, lab: Path, tmp_path: Path, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_ons.install(tmp_path / "site", monkeypatch, ON_A_SWITCH)
    window = opened(qtbot, lab, tmp_path / "window.ini", backend="handed")
    try:
        hand = window.run.hand
        press(window.reset)
        until(lambda: "high end is pressed" in window.notices.trip_text.text())
        assert not hand.jog.isEnabled()
        hand.speed.setValue(10.0)
        hand.override.setCurrentText("high")
        assert not hand.touch.isEnabled()
        assert hand.speed.value() == 2.0
        hand.distance.setValue(1.0)
        press(hand.jog)
        assert answer_all(window, until) == []
        assert "onto the high limit switch" in hand.state.text()
        for distance, end in ((-0.5, "the guard stays tripped"), (-4.0, "The high limit switch is free")):
            hand.override.setCurrentText("high")
            hand.distance.setValue(distance)
            press(hand.jog)
            (prompt,) = answer_all(window, until)
            assert "its high limit switch overridden" in prompt
            assert hand.state.text().startswith(f"The stage is at {101.0 + distance:.3f} mm")
            assert end in hand.state.text()
            # The override was for this motion alone, and the guard waits for a person.
            assert (hand.override.currentText(), hand.speed.value()) == ("none", 10.0)
            assert window.guard.text() == "guard: TRIPPED"
            assert not hand.jog.isEnabled()
        assert not window.notices.complaint.isVisible()  # what was refused before is no longer true
    finally:
        window.close_in_order("the test is over")
