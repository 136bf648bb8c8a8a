"""The rig in the window: off a pressed limit switch, calibrated and set up, each with a real engine."""

from collections.abc import Iterator
from pathlib import Path

import pytest

import add_ons
from windows import Until, opened, press, require_qt

require_qt()

from PySide6.QtWidgets import QApplication, QTableWidget
from pytestqt.qtbot import QtBot

from dragrig.engine_host.messages import RigSelection
from dragrig.rig.calibration import read_calibrations
from dragrig.rig.operator import Answer
from dragrig.rig.runfile import read_campaign
from dragrig.window.main_window import MainWindow
from dragrig.window.rig_page import SettingsView
from dragrig.window.session_queue import QueueState

ON_A_SWITCH = (
    add_ons.CODE.replace("needs_hands = True", "needs_hands = False")
    + """
from threading import Event
from dragrig.rig.devices import TravelEnd
from dragrig.rig.profile import MotionProfile, trapezoid
from sim_faults import Faults, LimitSwitch

def hardware(request):
    clock, way = VirtualClock(request.origin), MotionProfile.from_pieces(trapezoid(101.0, 50.0, 400.0))
    made = Handed(request.rig, request.model, clock, Faults(limit_switch=LimitSwitch(TravelEnd.HIGH, 100.0)))
    made.stage.enable()
    made.stage.home()
    made.stage.override_limit(TravelEnd.HIGH)
    made.stage.move(way)
    clock.sleep(way.duration_s + 1.0, Event())
    made.stage.disable()
    return made
"""
)
"""A rig whose stage stands on its upper limit switch whenever it is opened."""
PATIENT = ("rig.guard.stale_data_s=5", "rig.guard.following_error_mm=100", "rig.guard.encoder_silent_mm=100",
           "rig.hardware.card.buffer_s=20", "rig.hardware.hang_s=5", "rig.hardware.drive.reply_s=2",
           "rig.hardware.drive.silence_s=5", "rig.hardware.drive.homing_speed_mm_s=50")  # fmt: skip
"""A rig that waits as long as may be set, for a busy machine is no fault."""


@pytest.fixture(scope="module")
def shared(
    request: pytest.FixtureRequest, qapp: QApplication, lab: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[MainWindow]:
    """A window on the doubles, whose sensor bears weights."""
    settings = tmp_path_factory.mktemp("settings") / "window.ini"
    made = opened(QtBot(request), lab, settings, backend="hardware", double=True, pace=5.0, assignments=PATIENT)
    yield made
    made.close_in_order("the tests are over")


@pytest.fixture
def window(shared: MainWindow, until: Until) -> MainWindow:
    """A window with nothing in its queue, whose guard is reset."""
    assert not shared.run.rig_busy
    shared.run.queue.entries.clear()
    arm(shared, until)
    return shared


def arm(window: MainWindow, until: Until) -> None:
    if window.guard.text() != "guard: armed":
        until(window.reset.isEnabled)
        press(window.reset)
        until(window.notices.prompt.isVisible)
        press(window.notices.answers[Answer.DONE])
        until(lambda: window.guard.text() == "guard: armed")


def answer_all(window: MainWindow, until: Until) -> list[str]:
    """Answer every prompt with done until the rig is at rest; return the prompts."""
    prompts: list[str] = []
    run, notices = window.run, window.notices
    while run.rig_busy:
        until(lambda: notices.prompt.isVisible() or not run.rig_busy)
        if notices.prompt.isVisible():
            prompts.append(notices.prompt_text.text())
            press(notices.answers[Answer.DONE])
    return prompts


def test_a_reset_after_a_stop_asks_its_prompt(shared: MainWindow, until: Until) -> None:
    """On a rig that needs hands; its double asks as it does."""
    assert shared.run.new.chosen_pace == 5.0
    press(shared.stop_button)
    until(shared.reset.isEnabled)
    press(shared.reset)
    until(shared.notices.prompt.isVisible)
    press(shared.notices.answers[Answer.ABORT])
    until(lambda: shared.notices.complaint.isVisible() and shared.reset.isEnabled())
    arm(shared, until)
    press(shared.notices.dismiss)


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
        hand.speed.put(10.0)
        hand.override.setCurrentText("high")
        assert not hand.touch.isEnabled()
        assert hand.speed.value() == 2.0
        hand.distance.put(1.0)
        press(hand.jog)
        assert answer_all(window, until) == []
        assert "onto the upper limit switch" in hand.state.text()
        for distance, end in ((-0.5, "the guard stays tripped"), (-4.0, "The upper limit switch is free")):
            hand.override.setCurrentText("high")
            hand.distance.put(distance)
            press(hand.jog)
            (prompt,) = answer_all(window, until)
            assert "its upper limit switch overridden" in prompt
            assert hand.state.text().startswith(f"The stage is at {101.0 + distance:.3f} mm")
            assert end in hand.state.text()
            # The override was for this motion alone, and the guard waits for a person.
            assert (hand.override.currentText(), hand.speed.value()) == ("none", 10.0)
            assert window.guard.text() == "guard: TRIPPED"
            assert not hand.jog.isEnabled()
        assert not window.notices.complaint.isVisible()  # what was refused before is no longer true
    finally:
        window.close_in_order("the test is over")


def test_the_force_sensor_is_calibrated_and_the_record_seen_before_it_is_stored(
    window: MainWindow, until: Until, lab: Path
) -> None:
    calibrate = window.rig.calibrate
    window.go_to(window.rig)
    window.rig.tabs.setCurrentWidget(calibrate)
    window.run.new.operator.setText("A. Person")
    told = calibrate.editor.problems["weights"]
    for weights, problem in (
        ("0, 20, heavy", "'heavy' is not a number"),
        ("0, 20,5, 50", "is 0, 20.5, 50 or 0, 20, 5, 50?"),
    ):
        calibrate.editor.put("weights", weights)
        assert problem in told.text()
        assert told.isVisible()
        assert not calibrate.start.isEnabled()
    calibrate.editor.put("weights", "0, 20")
    press(calibrate.start)
    until(lambda: not window.run.rig_busy)
    assert "at least 3 distinct" in told.text()
    assert told.isVisible()
    calibrate.editor.put("weights", "0, 20, 50, 100")
    assert not calibrate.editor.problems["weights"].isVisible()

    press(calibrate.start)
    until(window.notices.prompt.isVisible)
    assert "Take every weight off the sensor" in window.notices.prompt_text.text()
    assert not window.run.hand.jog.isEnabled()
    assert not window.close()
    press(calibrate.cancel)
    until(lambda: not calibrate.busy)
    assert "cancelled by operator" in calibrate.state.text()
    assert not window.notices.prompt.isVisible()
    until(lambda: window.run.live.readings.about.text() == "live: at rest")  # no prompt is open any more
    assert calibrate.record.isHidden()

    before = read_calibrations(lab)
    press(calibrate.start)
    assert not window.notices.complaint.isVisible()  # of the attempt before
    assert len(answer_all(window, until)) == 4
    assert "mN/V" in calibrate.record.answer.text()
    assert "stored" not in calibrate.record.answer.text()
    assert "then store it or discard it" in calibrate.state.text()
    (points,) = calibrate.record.findChildren(QTableWidget)
    assert [points.item(row, 0).text() for row in range(4)] == ["0", "20", "50", "100"]
    assert read_calibrations(lab) == before
    press(calibrate.store)
    until(lambda: "Stored as" in calibrate.state.text())
    (entry,) = read_calibrations(lab)[len(before) :]
    assert entry.id in calibrate.state.text()
    assert (entry.quantity, entry.operator, entry.made_on) == ("force", "A. Person", "hardware double")
    assert not calibrate.store.isVisible()
    assert f"Calibration stored: {entry.id}" in window.run.log.toPlainText()

    press(calibrate.start)
    answer_all(window, until)
    press(calibrate.discard)
    assert calibrate.record.isHidden()
    assert read_calibrations(lab)[-1] == entry


def test_the_encoder_is_calibrated_over_a_known_travel(window: MainWindow, until: Until, lab: Path) -> None:
    calibrate = window.rig.calibrate
    window.go_to(window.rig)
    window.rig.tabs.setCurrentWidget(calibrate)
    calibrate.sensor.setCurrentText("Encoder")
    calibrate.editor.put("repeats", "1")
    calibrate.editor.put("travel_mm", "900")
    press(calibrate.start)
    until(lambda: not calibrate.busy)
    assert "longer than the stage's range" in calibrate.editor.problems["travel_mm"].text()
    calibrate.editor.put("travel_mm", "10")
    press(calibrate.start)
    prompts = answer_all(window, until)
    assert [prompt for prompt in prompts if "The stage moves by" in prompt] == prompts[-2:]
    assert calibrate.record.answer.text().startswith("A count is 1")
    press(calibrate.store)
    until(lambda: "Stored as" in calibrate.state.text())
    assert read_calibrations(lab)[-1].quantity == "encoder"


def test_settings_are_saved_and_the_engine_starts_again_once_nothing_runs(
    window: MainWindow, until: Until, lab: Path
) -> None:
    settings, run, pid = window.rig.settings, window.run, window.engine.pid
    window.go_to(window.rig)
    window.rig.tabs.setCurrentWidget(settings)
    settings.groups.setCurrentRow(1)
    settings.editor.put("highest_mm", "10")
    assert not settings.save.isEnabled()
    assert "between lowest and highest" in settings.editor.problems["start_mm"].text()
    settings.groups.setCurrentRow(3)
    assert settings.problem.isVisible()  # also where the field is not
    assert settings.problem.text().startswith("Stage: Start: ")
    press(settings.undo)
    settings.groups.setCurrentRow(1)
    settings.editor.put("highest_mm", "120")
    assert settings.changes.text() == "Changed: Stage: Highest 120 (was 150)."

    swift = {"speed_mm_s": "20", "travel_mm": "10", "rest_s": "0.2", "hold_s": "0.2", "wait_s": "0"}
    for key, text in {**swift, "way_back": "stay", "prompt": "Mount it"}.items():
        run.new.editor.put(key, text)
    run.new.update_preview()
    press(run.new.queue)
    press(run.new.start)
    until(window.notices.prompt.isVisible)
    press(settings.save)
    assert "as soon as nothing runs" in settings.state.text()
    assert "highest_mm = 120.0" in (lab / "rig.toml").read_text("utf-8")
    assert window.engine.pid == pid
    answer_all(window, until)
    assert window.engine.pid != pid
    assert [entry.stage for entry in run.queue.entries] == [QueueState.COMPLETE, QueueState.WAITING], run.queue.entries[
        0
    ].reason
    assert window.guard.text() == "guard: NOT ARMED"  # not what the engine before said
    assert "reset the guard" in settings.state.text()
    assert run.live.readings.limits.text() == "0 to 120 mm"
    arm(window, until)
    run.new.editor.put("travel_mm", "100")
    run.new.update_preview()
    assert "outside the stage's travel" in run.new.problem.text()
    run.new.editor.put("travel_mm", "10")
    settings.editor.put("highest_mm", "150")
    press(settings.save)
    assert run.live.readings.limits.text() == "0 to 150 mm"


def test_settings_outside_of_a_lab_are_shown_and_cannot_be_changed(qtbot: QtBot) -> None:
    view = SettingsView(RigSelection(assignments=("rig.stage.start_mm=30",)))
    qtbot.addWidget(view)
    assert "dragrig init" in view.state.text()
    assert not view.editor.isEnabled()
    assert not view.save.isEnabled()
    view.groups.setCurrentRow(1)
    assert view.heading.text() == "Stage"


def test_a_specimen_is_stated_in_the_form_and_recorded(window: MainWindow, until: Until) -> None:
    run, new = window.run, window.run.new
    window.go_to(run)
    new.plans.setCurrentIndex(new.plans.findData("blank"))
    for key, text in {"speed_mm_s": "20", "travel_mm": "10", "rest_s": "0.2", "hold_s": "0.2", "wait_s": "0"}.items():
        new.editor.put(key, text)
    new.specimen.put("excised_at", "this morning")
    new.update_preview()
    assert new.specimen.problems["excised_at"].isVisibleTo(window)
    assert not new.start.isEnabled()
    new.specimen.put("excised_at", "2026-05-04T09:15")
    new.specimen.put("id", "P7")
    new.update_preview()
    assert "is not described: wall thickness taken as" in run.preview.conditions.text()
    press(new.queue)
    press(new.queue)
    kept = run.queue.as_text()
    run.queue.entries.pop()
    run.queue.restore(kept)
    assert [entry.job.specimen for entry in run.queue.entries] == 3 * [run.queue.entries[0].job.specimen]
    del run.queue.entries[1:]
    press(run.start_queue)
    while run.session_running:
        until(lambda: window.notices.prompt.isVisible() or not run.session_running)
        if window.notices.prompt.isVisible():
            press(window.notices.answers[Answer.DONE])
    assert not window.notices.complaint.isVisible()  # the preview said it
    assert "recorded as unknown" in run.log.toPlainText()
    assert run.queue.entries[0].stage is QueueState.COMPLETE, run.queue.entries[0].reason
    (made, *_) = read_campaign(Path(run.queue.entries[0].folder)).runs
    assert (made.header.specimen["id"], made.header.specimen["animal"]) == ("P7", "unknown")
    assert str(made.header.specimen["excised_at"]).startswith("2026-05-04T09:15")


def test_operator_and_specimen_are_seen_first_at_the_least_size(window: MainWindow) -> None:
    new, size = window.run.new, window.size()
    window.go_to(window.run)
    window.resize(940, 500)
    for field in (new.operator, new.specimen_told, new.state_specimen):
        assert field.visibleRegion().boundingRect() == field.rect()
    new.state_specimen.setChecked(True)
    press(new.state_specimen)
    assert not new.specimen.isVisible()
    press(new.state_specimen)
    new.specimen.put("excised_at", "")
    new.specimen.put("id", "P7")
    new.update_preview()
    assert new.specimen_told.text() == "P7"
    assert new.specimen.captions["temperature_degC"].text() == "Temperature (°C)"
    new.specimen.put("id", "")
    window.resize(size)
