"""The page that runs plans, used as a person uses it: every button, with a real engine on the simulated rig."""

import gc
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ending import kill
from property_tests import thorough
from windows import WAIT_MS, Until, dressed, opened, press, require_qt

require_qt()

from PySide6.QtCore import QPoint, QPointF, QSettings, QSize, Qt
from PySide6.QtGui import QWheelEvent
from PySide6.QtWidgets import QApplication, QComboBox, QSplitter, QWidget
from pytestqt.qtbot import QtBot

import dragrig
from dragrig.engine_host.messages import (
    GuardState,
    IdleReading,
    MirrorStatus,
    PromptShown,
    QueuedRun,
    RigIdle,
    RunFinished,
    RunStarted,
    SessionFinished,
    SessionJob,
    SessionStarted,
    StageHomes,
)
from dragrig.rig.operator import Answer
from dragrig.rig.runfile import read_campaign
from dragrig.rig.runfile.model import RunStatus
from dragrig.views import plan_form
from dragrig.window.live_view import RigReadings
from dragrig.window.main_window import MainWindow
from dragrig.window.plots import TimePlot
from dragrig.window.run_page import QueueView
from dragrig.window.session_queue import QueuedSession, QueueState, SessionQueue
from dragrig.window.widgets import Topic


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("settings") / "window.ini"


@pytest.fixture(scope="module")
def shared(request: pytest.FixtureRequest, qapp: QApplication, lab: Path, settings: Path) -> Iterator[MainWindow]:
    """One window for many tests: each engine takes seconds to start."""
    made = opened(QtBot(request), lab, settings)
    yield made
    made.close_in_order("the tests are over")


@pytest.fixture
def window(shared: MainWindow, until: Until) -> MainWindow:
    """A window with nothing in its queue, whose guard is reset."""
    assert not shared.run.session_running
    shared.run.queue.entries.clear()
    shared.notices.dismiss.click()
    shared.go_to(shared.run)
    if shared.guard.text() != "guard: armed":
        press(shared.reset)
        until(lambda: shared.guard.text() == "guard: armed")
    return shared


def fill(window: MainWindow, plan: str = "drag", **values: str) -> None:
    new = window.run.new
    new.plans.setCurrentIndex(new.plans.findData(plan))
    # Edits of a test before survive, as they do for a person.
    usual = {"speed_mm_s": "20", "travel_mm": "10", "rest_s": "0.2", "hold_s": "0.2", "wait_s": "0", "way_back": "stay",
             "prompt": "", "prompt_each": "no", "repeats": "1", "order": "listed",
             "fixture": "", "capsule": ""}  # fmt: skip
    for key, text in {**usual, **values}.items():
        new.editor.put(key, text)
    new.pace.setCurrentText("as fast as possible")
    new.update_preview()


def slow(window: MainWindow) -> None:
    """Fill in a run that lasts a minute at the real pace."""
    fill(window, speed_mm_s="0.2")
    window.run.new.pace.setCurrentText("as fast as the real rig")


def moving(window: MainWindow) -> bool:
    entry = window.run.queue.current
    return entry is not None and entry.current_run is not None and entry.elapsed_s > 0.2


def test_a_plan_is_edited_previewed_and_run(window: MainWindow, until: Until, lab: Path) -> None:
    fill(window, speed_mm_s="10, 20")
    assert window.run.preview.runs.rowCount() == 2
    assert "Plan OK, within limits" in window.run.preview.findings.text()
    window.run.new.operator.setText("A. Person")
    press(window.run.new.start)
    until(lambda: not window.run.session_running)
    entry = window.run.queue.entries[-1]
    assert entry.stage is QueueState.COMPLETE
    assert "A session is running" not in window.run.devices.status.text()
    made = read_campaign(Path(entry.folder))
    assert [run.status for run in made.runs] == [RunStatus.COMPLETE, RunStatus.COMPLETE]
    assert {run.header.entry["operator"] for run in made.runs} == {"A. Person"}
    live = window.run.live.run
    assert live is not None
    assert live.force.count == made.runs[-1].samples
    assert live.latest.phase == "hold"


def test_position_is_absolute_with_the_limits_and_what_came_while_another_tab_was_shown_is_drawn(
    window: MainWindow, until: Until
) -> None:
    fill(window, speed_mm_s="20", start_mm="60", travel_mm="8")
    run, preview, live = window.run, window.run.preview, window.run.live
    header = [preview.runs.horizontalHeaderItem(at).text() for at in range(preview.runs.columnCount())]
    assert preview.runs.item(0, header.index("Position (mm)")).text() == "60 to 68"
    press(run.new.start)
    run.tabs.setCurrentWidget(run.queue_view)
    until(lambda: not run.session_running)
    until(lambda: live.run is not None and live.run.latest.phase == "hold")
    assert live.speed.lines[0].drawn.getData()[1] is None or not len(live.speed.lines[0].drawn.getData()[1])
    run.tabs.setCurrentWidget(live)
    assert np.nanmax(live.speed.lines[0].drawn.getData()[1]) == pytest.approx(20.0, abs=1.0)
    for line, plot in ((preview.position.lines[0], preview.position), (live.position.lines[0], live.position)):
        shown = line.drawn.getData()[1]
        assert (np.nanmin(shown), np.nanmax(shown)) == (pytest.approx(60.0, abs=0.1), pytest.approx(68.0, abs=0.1))
        assert plot.levels == (0.0, 150.0)
    assert live.run.latest.position_mm == pytest.approx(68.0, abs=0.1)
    fill(window, start_mm="")


def test_a_plot_of_nothing_has_no_numbers(window: MainWindow) -> None:
    def numbers(plot: TimePlot) -> bool:
        return bool(plot.widget.getPlotItem().getAxis("left").style["showValues"])

    fill(window, speed_mm_s="20")
    preview, live = window.run.preview, window.run.live
    assert numbers(preview.position)
    assert numbers(preview.speed)
    fill(window, speed_mm_s="fast")
    assert not numbers(preview.position)
    assert not numbers(preview.speed)
    live.begin_session("another")
    assert not numbers(live.force)
    fill(window, speed_mm_s="20")
    assert numbers(preview.speed)
    assert preview.speed.widget.getPlotItem().getAxis("bottom").style["showValues"]
    assert not preview.position.widget.getPlotItem().getAxis("bottom").style["showValues"]


def test_a_plan_beyond_the_limits_cannot_be_started(window: MainWindow) -> None:
    fill(window, travel_mm="900")
    assert "NOT ALLOWED" in window.run.preview.findings.text()
    assert not window.run.new.start.isEnabled()
    assert not window.run.new.queue.isEnabled()
    fill(window, speed_mm_s="fast")
    assert "is not a number" in window.run.preview.findings.text()
    assert not window.run.new.start.isEnabled()


@pytest.mark.parametrize("how", ["escape", thorough("button"), thorough("abort")])
def test_a_run_is_stopped_from_every_page(how: str, window: MainWindow, until: Until, qtbot: QtBot) -> None:
    slow(window)
    press(window.run.new.queue)
    press(window.run.new.start)
    until(lambda: moving(window))
    window.go_to(window.pages.widget(window.pages.count() - 1))
    match how:
        case "button":
            press(window.stop_button)
        case "escape":
            qtbot.keyClick(window.pages.currentWidget(), Qt.Key.Key_Escape)
        case _:
            press(window.run.abort)
    until(lambda: not window.run.session_running)
    first, second = window.run.queue.entries
    assert first.stage is QueueState.ABORTED
    assert "by operator" in first.reason
    assert second.stage is QueueState.WAITING
    assert read_campaign(Path(first.folder)).runs[0].reason == first.reason


def test_a_covered_moved_or_minimised_window_loses_no_sample(window: MainWindow, until: Until) -> None:
    fill(window, speed_mm_s="8")
    window.run.new.pace.setCurrentText("as fast as the real rig")
    cover = QWidget()
    press(window.run.new.start)
    moves = 0

    def pushed_about() -> bool:
        nonlocal moves
        moves += 1
        match moves % 4:
            case 0:
                window.showMinimized()
            case 1:
                window.showNormal()
            case 2:
                cover.setGeometry(window.frameGeometry())
                cover.show()
                cover.raise_()
            case 3:
                cover.hide()
        window.move(40 + 7 * moves % 300, 30 + 11 * moves % 200)
        window.resize(1200 + 13 * moves % 400, 900 + 17 * moves % 200)
        return not window.run.session_running

    until(pushed_about)
    cover.close()
    window.showNormal()
    assert moves >= 4
    entry = window.run.queue.entries[-1]
    assert entry.stage is QueueState.COMPLETE, entry.reason
    (file,) = Path(entry.folder).glob("*.h5")
    run = dragrig.load(file)
    assert run.info.checks["lost_samples"] == 0
    assert not [event for event in run.events if event.kind == "gap"]
    planned = sum(run.duration_s for run in entry.runs)
    assert len(run.trace.time) == pytest.approx(planned * run.trace.sample_rate_hz, abs=2)


def test_a_prompt_is_answered_in_the_window(window: MainWindow, until: Until) -> None:
    fill(window, prompt="Put the capsule in", prompt_each="yes", repeats="2", way_back="driven")
    press(window.run.new.start)
    until(window.notices.prompt.isVisible)
    assert window.notices.prompt_text.text() == "Put the capsule in."
    assert not window.notices.answers[Answer.REDO].isVisible()
    press(window.notices.answers[Answer.DONE])
    until(window.notices.answers[Answer.REDO].isVisible)
    for answer in (Answer.REDO, Answer.DONE, Answer.SKIP):
        until(window.notices.prompt.isVisible)
        press(window.notices.answers[answer])
    until(lambda: not window.run.session_running)
    entry = window.run.queue.entries[-1]
    assert entry.stage is QueueState.COMPLETE
    made = read_campaign(Path(entry.folder))
    assert (len(made.runs), len(made.good)) == (4, 2)


@pytest.fixture(scope="module")
def careful_settings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("careful") / "window.ini"


@pytest.fixture(scope="module")
def careful(
    request: pytest.FixtureRequest, qapp: QApplication, lab: Path, careful_settings: Path
) -> Iterator[MainWindow]:
    """A window on a rig that no drag may move, whose motions by hand take the time that they say."""
    terms = {"assignments": ("rig.guard.force_limit_mN=20",), "pace": "real"}
    made = opened(QtBot(request), lab, careful_settings, **terms)
    yield made
    if made.isVisible():
        made.close_in_order("the tests are over")


def test_a_trip_is_shown_with_its_reason_and_keeps_the_queue_waiting_until_a_button_resets_the_guard(
    careful: MainWindow, until: Until
) -> None:
    window = careful
    until(window.notices.trip.isVisible)
    assert "path clear, hands out, e-stop in reach" in window.notices.trip_text.text()
    press(window.reset)
    until(lambda: not window.notices.trip.isVisible())
    assert window.guard.text() == "guard: armed"
    fill(window)
    press(window.run.new.queue)
    press(window.run.new.start)
    until(window.notices.trip.isVisible)
    assert "over the limit of 20 mN" in window.notices.trip_text.text()
    press(window.run.start_queue)
    assert "reset it" in window.notices.complaint_text.text()
    assert [entry.stage for entry in window.run.queue.entries] == [QueueState.TRIPPED, QueueState.WAITING]
    press(window.reset)
    until(lambda: window.guard.text() == "guard: armed")


def test_queued_sessions_can_be_moved_removed_and_run(window: MainWindow, until: Until) -> None:
    view = window.run.queue_view
    for speed in ("10", "20", "40"):
        fill(window, speed_mm_s=speed)
        press(window.run.new.queue)
    entries = list(window.run.queue.entries)
    view.tree.setCurrentItem(view.tree.topLevelItem(2))
    press(view.up)
    assert window.run.queue.entries == [entries[0], entries[2], entries[1]]
    press(view.down)
    assert window.run.queue.entries == entries
    press(view.out)
    assert window.run.queue.entries == entries[:2]
    press(window.run.start_queue)
    until(lambda: not window.run.session_running)
    assert [(entry.stage, entry.reason) for entry in window.run.queue.entries] == [(QueueState.COMPLETE, "")] * 2
    assert window.run.queue.left_s == 0
    looked: list[str] = []
    window.run.look_at.connect(looked.append)
    view.tree.setCurrentItem(view.tree.topLevelItem(1))
    press(view.look)
    assert looked == [entries[1].folder]
    press(view.clear)
    assert window.run.queue.entries == []


def test_the_queue_follows_the_run_and_numbers_it_as_its_file(qapp: QApplication) -> None:
    dressed()
    queue, runs = SessionQueue(), tuple(QueuedRun(at, "drag 5 mm/s", 0.0, 5.0) for at in range(60))
    queue.add(QueuedSession(SessionJob(queue.next_number(), "drag"), "drag", 300.0, len(runs)))
    view = QueueView(queue)
    view.resize(600, 400)
    view.show()
    queue.entries[0].stage = QueueState.RUNNING
    queue.take(SessionStarted(1, runs, real_time=True))
    for order, at in enumerate([*range(40), 39, 40]):  # the fortieth is made again
        queue.take(RunStarted(replace(runs[at]), order))  # as it comes from the engine's process
        view.show_queue()
        if at < 40:
            queue.take(RunFinished(runs[at], order, RunStatus.COMPLETE, "", 5000, ()))
    session = view.tree.topLevelItem(0)
    assert session is not None
    running = session.child(40)
    assert running is not None
    assert (running.text(0), running.text(3)) == ("41  drag 5 mm/s", "running")
    assert running.font(0).bold()
    assert view.tree.viewport().rect().contains(view.tree.visualItemRect(running))
    assert [session.child(at).text(0).split()[0] for at in (38, 39, 41)] == ["38", "40", "42"]
    assert view.progress.format().startswith("drag: 40 of 60 runs over")
    view.close()


def test_the_stage_is_homed_jogged_and_touched_off_by_hand(window: MainWindow, until: Until, lab: Path) -> None:
    hand, notices, about = window.run.hand, window.notices, window.run.live.readings.about
    press(hand.home)
    until(notices.prompt.isVisible)
    until(lambda: about.text() == "live: prompt open")  # of a motion by hand, not of a session
    press(notices.answers[Answer.ABORT])
    until(lambda: not hand.busy)
    until(lambda: about.text() == "live: at rest")

    def done(action: QWidget) -> str:
        press(action)
        assert hand.busy
        assert not hand.jog.isEnabled()
        while hand.busy:
            until(lambda: notices.prompt.isVisible() or not hand.busy)
            if notices.prompt.isVisible():
                press(notices.answers[Answer.DONE])
        return hand.state.text()

    assert done(hand.home) == "The stage is at 0.000 mm."
    hand.distance.put(12.5)
    assert done(hand.jog) == "The stage is at 12.500 mm."
    hand.distance.put(-100.0)  # within the rig's travel, but not from here
    assert "outside its travel of 0 to 150 mm" in done(hand.jog)
    assert "outside its travel of 0 to 150 mm" in notices.complaint_text.text()
    hand.force.put(20.0)
    assert done(hand.touch).startswith("Contact at ")
    assert (lab / "contact.toml").is_file()
    (lab / "contact.toml").unlink()


def test_a_motion_by_hand_is_stopped_by_escape_and_refused_to_a_tripped_guard(
    window: MainWindow, until: Until, qtbot: QtBot
) -> None:
    hand = window.run.hand
    press(hand.home)
    until(window.notices.prompt.isVisible)
    qtbot.keyClick(window, Qt.Key.Key_Escape)
    until(lambda: not hand.busy)
    assert "Not done" in hand.state.text()
    assert not window.notices.prompt.isVisible()
    window.take(GuardState("for the test"))
    window.run.take(GuardState("for the test"))
    assert not hand.home.isEnabled()
    window.take(GuardState(""))
    window.run.take(GuardState(""))
    assert hand.home.isEnabled()


def test_escape_stops_a_jog_under_way(careful: MainWindow, qtbot: QtBot, until: Until) -> None:
    if careful.guard.text() != "guard: armed":
        press(careful.reset)
        until(lambda: careful.guard.text() == "guard: armed")
    hand, notices = careful.run.hand, careful.notices
    hand.distance.put(100.0)
    hand.speed.put(1.0)
    press(hand.jog)
    until(notices.prompt.isVisible)
    while "The stage moves by" not in notices.prompt_text.text():
        press(notices.answers[Answer.DONE])
        until(notices.prompt.isVisible)
    press(notices.answers[Answer.DONE])
    qtbot.keyClick(careful, Qt.Key.Key_Escape)
    until(lambda: not hand.busy)
    assert "stopped by operator (Esc)" in hand.state.text()


def test_an_edited_plan_is_saved_and_opened_again(window: MainWindow, tmp_path: Path) -> None:
    new = window.run.new
    fill(window, speed_mm_s="3, 7")
    assert new.save.isEnabled()
    new.save_as(str(tmp_path / "plans" / "slow.toml"))
    assert new.plans.currentText() == "slow"
    assert new.editor.values()[0]["speed_mm_s"] == "3, 7"
    again = plan_form(str(tmp_path / "plans" / "slow.toml"))
    assert (again.plan.name, again.values()[0]["travel_mm"]) == ("slow", "10")
    assert [line.protocol.summary() for line in (run.run for run in dragrig.check(again.plan).previews)] == [
        "drag 3 mm/s", "drag 7 mm/s"]  # fmt: skip
    new.save_as(str(tmp_path / "plans" / "of a winter evening.toml"))
    # The name of a plan becomes that of a folder, and has no blanks.
    assert new.plan().name == "of-a-winter-evening"
    assert new.plans.currentText() == new.plans.toolTip() == "of a winter evening"
    assert new.start.isEnabled()
    new.editor.put("speed_mm_s", "nonsense")
    new.save_as(str(tmp_path / "plans" / "wrong.toml"))
    assert not (tmp_path / "plans" / "wrong.toml").exists()
    assert "not a number" in new.problem.text() or "nonsense" in new.problem.text()
    new.editor.put("speed_mm_s", "3, 7")


def test_garbage_is_collected_on_the_gui_thread_alone(window: MainWindow, until: Until) -> None:
    """On another thread it would take plots apart that are being drawn, and both would wait for ever."""
    collected_by: list[threading.Thread] = []

    class Knot:
        def __init__(self) -> None:
            self.me = self

        def __del__(self) -> None:
            collected_by.append(threading.current_thread())

    def litter() -> None:
        for _ in range(20_000):
            Knot()

    until(lambda: not gc.isenabled())
    reader = threading.Thread(target=litter)
    reader.start()
    reader.join()
    until(lambda: len(collected_by) == 20_000)
    assert set(collected_by) == {threading.main_thread()}


def test_a_dead_engine_is_reported_and_can_be_restarted(window: MainWindow, until: Until) -> None:
    pid = window.engine.pid
    assert pid is not None
    kill(pid)
    until(window.notices.lost.isVisible)
    fill(window)
    press(window.run.new.start)
    assert "the engine has ended" in window.notices.complaint_text.text()
    assert not window.run.session_running
    assert [entry.stage for entry in window.run.queue.entries] == [QueueState.WAITING]
    press(window.notices.restart)
    press(window.run.start_queue)  # before the new one is there
    assert [entry.stage for entry in window.run.queue.entries] == [QueueState.WAITING]
    until(lambda: window.guard.text() == "guard: NOT ARMED")
    assert window.engine.pid != pid
    assert not window.notices.lost.isVisible()


def test_the_view_can_be_limited_to_the_last_seconds(window: MainWindow, until: Until) -> None:
    fill(window, speed_mm_s="0.5")
    press(window.run.new.start)
    until(lambda: not window.run.session_running)
    whole = window.run.live.speed.shown()
    window.run.live.only_last.click()
    last = window.run.live.speed.shown()
    assert whole[1] - whole[0] > 15
    assert last[1] - last[0] < 12


def test_every_device_is_shown_and_the_backend_stays_what_the_banner_says(
    window: MainWindow, until: Until, lab: Path
) -> None:
    assert "SIMULATED" in window.windowTitle()
    assert window.description.title == "SIMULATED"
    devices, text = window.run.devices, (lab / "rig.toml").read_text("utf-8")
    until(lambda: devices.devices.rowCount() > 0)
    (lab / "rig.toml").write_text(text.replace('backend = "simulated"', 'backend = "hardware"'), "utf-8")
    devices.devices.setRowCount(0)
    press(devices.again)
    until(lambda: devices.devices.rowCount() > 0 or devices.verdict != "all ok")
    (lab / "rig.toml").write_text(text, "utf-8")
    assert devices.verdict == "all ok"  # there is no card here
    fill(window)
    assert window.run.new.start.isEnabled()


def test_a_plan_from_a_file_is_opened(window: MainWindow, tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text('name = "own"\n[[steps]]\nkind = "blank"\nspeed_mm_s = [5, 10]\n', "utf-8")
    window.run.new.open_file(str(file))
    assert window.run.preview.runs.rowCount() == 4


def test_plans_that_are_put_into_the_lab_meanwhile_are_listed_with_what_they_are_for(
    window: MainWindow, until: Until, lab: Path
) -> None:
    plans = window.run.new.plans
    chosen = plans.currentData()
    folder = lab / "plans"
    folder.mkdir(exist_ok=True)
    file = folder / "evening.toml"
    file.write_text('name = "evening"\ndescription = "Short, for the evening"\n[[steps]]\nkind = "blank"\n', "utf-8")
    until(lambda: plans.findData(str(file)) >= 0)
    assert plans.model().index(plans.findData(str(file)), 1).data() == "Short, for the evening"
    assert plans.model().index(plans.findData("first"), 1).data().startswith("Eight runs to begin with")
    assert plans.currentData() == chosen
    file.unlink()
    until(lambda: plans.findData(str(file)) < 0)
    assert plans.currentData() == chosen


def test_every_file_is_copied_to_the_chosen_mirror(window: MainWindow, until: Until, tmp_path: Path) -> None:
    fill(window, speed_mm_s="20")
    window.run.new.mirror.setText(str(tmp_path))
    press(window.run.new.start)
    until(lambda: not window.run.session_running)
    window.run.new.mirror.clear()
    entry = window.run.queue.entries[-1]
    made = sorted(file.name for file in Path(entry.folder).iterdir() if file.suffix in {".h5", ".toml"})
    assert sorted(file.name for file in (tmp_path / Path(entry.folder).name).iterdir()) == made
    item = window.run.queue_view.tree.topLevelItem(0)
    assert item.text(3) == f"complete; all {len(made)} files in the mirror {tmp_path / Path(entry.folder).name}"
    assert not window.notices.complaint.isVisible()


def test_a_mirror_that_cannot_be_reached_is_refused(window: MainWindow, until: Until, tmp_path: Path) -> None:
    fill(window, speed_mm_s="20")
    window.run.new.mirror.setText(str(tmp_path / "unplugged"))
    press(window.run.new.start)
    until(lambda: not window.run.session_running)
    window.run.new.mirror.clear()
    entry = window.run.queue.entries[-1]
    assert entry.stage is QueueState.REFUSED
    assert "unplugged" in entry.reason
    assert "unplugged" in window.notices.complaint_text.text()


def test_files_missing_in_the_mirror_are_shown(window: MainWindow, until: Until, tmp_path: Path) -> None:
    fill(window, speed_mm_s="20")
    press(window.run.new.queue)
    entry = window.run.queue.entries[-1]
    entry.stage = QueueState.RUNNING
    mirror = MirrorStatus(tmp_path, 1, (("0000-drag.h5", "there is no such folder"),))
    window.take(SessionFinished(entry.job.number, RunStatus.COMPLETE, "", tmp_path, mirror))
    window.run.take(SessionFinished(entry.job.number, RunStatus.COMPLETE, "", tmp_path, mirror))
    item = window.run.queue_view.tree.topLevelItem(0)
    below = {item.child(at).text(0): item.child(at).text(3) for at in range(item.childCount())}
    assert "there is no such folder" in below["0000-drag.h5"]
    assert "0000-drag.h5" in window.notices.complaint_text.text()
    assert "NOT IN THE MIRROR" in item.text(3)


def test_an_offered_plan_can_be_selected_again(window: MainWindow) -> None:
    plans = window.run.new.plans
    window.run.offer_and_queue("next experiment", plan_form("coulomb"))
    offered = plans.currentIndex()
    plans.setCurrentIndex(plans.findData("drag"))
    plans.setCurrentIndex(offered)
    assert window.run.new.plan().name == "coulomb"
    assert window.run.preview.summary.text() != "This plan cannot be used yet"


def test_a_reading_is_live_or_gone_and_abort_at_a_prompt_ends_the_session(window: MainWindow, until: Until) -> None:
    shown = window.run.live.readings
    force, position, speed = shown.readings.values()
    slow(window)
    window.run.new.editor.put("prompt", "Mount the specimen")
    window.run.new.update_preview()
    press(window.run.new.start)
    until(window.notices.prompt.isVisible)
    until(lambda: shown.about.text() == "live: prompt open")
    assert (position.text(), speed.text()) == ("40.00 mm", "–")
    press(window.notices.answers[Answer.DONE])
    until(lambda: moving(window) and speed.text() == "0.2 mm/s")
    assert 40.0 < float(position.text().split()[0]) < 50.0  # absolute, as the limits beside it
    assert shown.limits.text() == "0 to 150 mm"
    assert shown.about.text().startswith("live: steady")
    press(window.stop_button)
    until(lambda: not window.run.session_running)
    assert speed.text() == "–"
    until(lambda: shown.about.text() == "live: at rest")
    assert 40.0 < float(position.text().split()[0]) < 50.0  # where it was stopped
    assert 20.0 < float(force.text().split()[0]) < 60.0  # the capsule is in the gut
    assert "Session ended" in window.notices.complaint_text.text()
    press(window.run.new.start)
    assert not window.notices.complaint.isVisible()  # another session: no longer true
    assert window.run.live.run is None  # nor are the curves of the one before
    until(window.notices.prompt.isVisible)
    assert speed.text() == "–"
    press(window.notices.answers[Answer.ABORT])
    until(lambda: not window.run.session_running)
    assert window.run.queue.entries[-1].stage is QueueState.ABORTED
    assert not window.notices.prompt.isVisible()
    assert "Session ended: ended at a prompt" in window.notices.complaint_text.text()
    assert window.notices.passing.isActive()
    window.notices.passing.timeout.emit()  # half a minute later
    assert not window.notices.complaint.isVisible()
    window.run.devices.watch.setChecked(False)
    assert (force.text(), shown.about.text()) == ("–", "not read between sessions")
    window.run.devices.watch.setChecked(True)
    until(lambda: shown.about.text() == "live: at rest")


def test_a_reading_that_nothing_follows_is_grey_with_its_age(qtbot: QtBot, until: Until) -> None:
    shown = RigReadings()
    qtbot.addWidget(shown)
    force, position, speed = shown.readings.values()
    shown.show_values(12.0, 3.0, 4.0, "steady")
    assert force.property("role") == "reading"
    until(lambda: shown.about.text().endswith("s ago; steady"))
    assert (force.text(), speed.text()) == ("12 mN", "–")
    assert force.property("role") == "old reading"
    assert float(shown.about.text().split()[0]) > 0.0
    shown.show_values(-0.2, -0.001, None, "idle")  # of nothing, without a sign
    assert (force.text(), position.text()) == ("0 mN", "0.00 mm")


def test_a_complaint_goes_away_once_it_is_no_longer_true(window: MainWindow) -> None:
    notices = window.notices
    notices.complain("the guard is tripped", Topic.GUARD)
    notices.complain("dismiss me")
    window.take(GuardState(""))
    assert "guard is tripped" not in notices.complaint_text.text()
    assert "dismiss me" in notices.complaint_text.text()
    press(notices.dismiss)
    window.diagnose.complained.emit("no such campaign")
    assert notices.complaint.isVisible()
    window.diagnose.begun.emit()
    assert not notices.complaint.isVisible()


def wheel_over(widget: QWidget) -> None:
    middle = QPointF(widget.rect().center())
    event = QWheelEvent(middle, widget.mapToGlobal(middle), QPoint(0, 0), QPoint(0, -120), Qt.MouseButton.NoButton,
                        Qt.KeyboardModifier.NoModifier, Qt.ScrollPhase.NoScrollPhase, False)  # fmt: skip
    QApplication.sendEvent(widget, event)


def test_the_wheel_changes_only_the_field_with_the_focus(window: MainWindow, qtbot: QtBot) -> None:
    fill(window)
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow, timeout=WAIT_MS)
    editor = window.run.new.editor
    window.run.new.operator.setFocus()
    before = editor.values()
    for field in (*editor.editors.values(), window.run.new.plans, window.run.new.pace):
        wheel_over(field)
        if isinstance(field, QComboBox):  # a wheel of a real mouse would give it the focus, and then turn it
            assert field.focusPolicy() is Qt.FocusPolicy.StrongFocus
    assert editor.values() == before
    window.go_to(window.look)
    spin = window.look.overlay.order
    order = spin.value()
    wheel_over(spin)
    assert spin.value() == order
    spin.setFocus()
    wheel_over(spin)
    assert spin.value() != order
    spin.put(order)


def test_the_preview_names_capsule_fixture_and_order_and_goes_with_its_plan(window: MainWindow) -> None:
    fill(window, fixture="vacuum", order="reversed")
    preview = window.run.preview
    assert preview.conditions.text() == "capsule drag, fixture vacuum, order reversed."
    header = [preview.runs.horizontalHeaderItem(at).text() for at in range(preview.runs.columnCount())]
    assert preview.runs.item(0, header.index("Fixture")).text() == "vacuum"
    assert preview.runs.item(0, header.index("Capsule")).text() == "drag"
    assert len(preview.position.lines[0].drawn.getData()[0]) > 2
    window.run.new.editor.put("speed_mm_s", "fast")
    window.run.new.update_preview()
    assert preview.runs.rowCount() == 0
    assert preview.position.lines[0].drawn.getData()[0] is None or not len(preview.position.lines[0].drawn.getData()[0])
    assert preview.conditions.text() == ""
    fill(window)


def test_what_differs_from_the_last_session_is_marked(window: MainWindow) -> None:
    fill(window, plan="blank", speed_mm_s="10")
    new = window.run.new
    press(new.queue)
    assert not new.changes.isVisible()
    assert new.editor.captions["order"].text() == "Order"
    new.editor.put("order", "reversed")
    new.update_preview()
    assert new.editor.captions["order"].text() == "Order ●"
    assert new.changes.text() == "Differs from the last session: Order reversed (was listed)."
    assert "was listed" in new.editor.captions["order"].toolTip()
    new.editor.put("order", "listed")
    new.update_preview()
    assert not new.changes.isVisible()


def test_an_invalid_field_says_so_below_itself_and_on_every_tab(window: MainWindow) -> None:
    fill(window)
    run, new = window.run, window.run.new
    for key, text, said in (
        ("speed_mm_s", "fast", "'fast' is not a number"),
        ("repeats", "0", "below 1, the least allowed"),
        ("travel_mm", "900", "outside the stage's travel"),
        ("capsule", "no-such-capsule", "no-such-capsule"),
    ):
        fill(window, **{key: text})
        for tab in range(run.tabs.count()):
            run.tabs.setCurrentIndex(tab)
            assert new.editor.problems[key].isVisible(), key
            assert said in new.editor.problems[key].text(), key
            name = next(field.name for field in plan_form("drag").groups[0].fields if field.key == key)
            assert new.problem.isVisible()
            assert new.problem.text().startswith(f"{name.capitalize()}: "), new.problem.text()
        others = [label for other, label in new.editor.problems.items() if other != key]
        assert not any(label.isVisible() for label in others)
        fill(window, **{key: {"repeats": "1", "speed_mm_s": "20", "travel_mm": "10"}.get(key, "")})
    fill(window, speed_mm_s="20", travel_mm="10", capsule="")
    assert not new.problem.isVisible()


def test_an_invalid_field_of_a_step_that_is_not_shown_is_named(window: MainWindow) -> None:
    new = window.run.new
    new.plans.setCurrentIndex(new.plans.findData("diagnose"))
    new.editor.steps.setCurrentIndex(1)
    new.editor.put("repeats", "0")
    new.editor.steps.setCurrentIndex(0)
    new.update_preview()
    assert new.problem.text().startswith("Step 2, Repeats: ")
    assert not any(label.isVisible() for label in new.editor.problems.values())
    assert not new.start.isEnabled()
    new.editor.steps.setCurrentIndex(1)
    assert "below 1, the least allowed" in new.editor.problems["repeats"].text()
    new.editor.put("repeats", "1")
    new.update_preview()
    fill(window)


def test_edits_survive_another_plan_and_can_be_taken_back(window: MainWindow, qtbot: QtBot) -> None:
    fill(window, speed_mm_s="11", order="listed")
    new = window.run.new
    new.editor.put("speed_mm_s", "12")
    new.update_preview()
    new.editor.put("order", "random")
    new.plans.setCurrentIndex(new.plans.findData("coulomb"))  # before the preview was due
    new.plans.setCurrentIndex(new.plans.findData("drag"))
    values = new.editor.values()[0]
    assert (values["speed_mm_s"], values["order"]) == ("12", "random")
    press(new.undo)
    assert new.editor.values()[0]["order"] == "listed"
    window.activateWindow()
    qtbot.waitUntil(window.isActiveWindow, timeout=WAIT_MS)
    field = new.editor.editors["speed_mm_s"]
    field.setFocus()
    qtbot.keyClick(field, Qt.Key.Key_Z, Qt.KeyboardModifier.ControlModifier)
    qtbot.waitUntil(lambda: new.editor.values()[0]["speed_mm_s"] == "11", timeout=WAIT_MS)


def test_what_was_removed_from_the_queue_can_be_put_back(window: MainWindow) -> None:
    view = window.run.queue_view
    while view.back.isEnabled():  # of the tests before
        press(view.back)
    window.run.queue.entries.clear()
    for speed in ("10", "20", "40"):
        fill(window, speed_mm_s=speed)
        press(window.run.new.queue)
    entries = list(window.run.queue.entries)
    window.run.tabs.setCurrentWidget(view)
    view.tree.setCurrentItem(view.tree.topLevelItem(1))
    press(view.out)
    assert window.run.queue.entries == [entries[0], entries[2]]
    entries[0].stage = QueueState.ABORTED
    press(view.clear)
    assert window.run.queue.entries == [entries[2]]
    press(view.back)
    press(view.back)
    assert window.run.queue.entries == entries
    assert not view.back.isEnabled()
    assert window.run.start_queue.isEnabled()


def test_a_session_pauses_after_the_run(window: MainWindow, until: Until) -> None:
    run = window.run
    fill(window, prompt="Put the capsule in", repeats="3", way_back="driven")
    press(run.new.start)
    until(window.notices.prompt.isVisible)
    press(run.pause)
    press(window.notices.answers[Answer.DONE])
    until(lambda: window.notices.prompt.isVisible() and window.notices.prompt_text.text().startswith("Paused"))
    assert window.notices.answers[Answer.DONE].text().startswith("Continue")
    assert not run.pause.isChecked()
    assert len(run.queue.current.ended) == 2  # the run and its return stroke
    press(window.notices.answers[Answer.REDO])
    until(window.notices.prompt.isVisible)
    press(window.notices.answers[Answer.DONE])
    until(lambda: not run.session_running)
    entry = run.queue.entries[-1]
    assert entry.stage is QueueState.COMPLETE
    made = read_campaign(Path(entry.folder))
    assert (len(made.runs), len(made.good)) == (8, 6)
    assert not run.pause.isEnabled()
    log = run.log.toPlainText()
    assert "Prompt: Paused. Next is drag" in log
    assert f"Session complete: {entry.folder}" in log


def test_settings_and_waiting_sessions_survive_closing_the_window(
    careful: MainWindow, careful_settings: Path, qtbot: QtBot, lab: Path, tmp_path: Path
) -> None:
    first = careful
    first.run.queue.entries.clear()
    fill(first, speed_mm_s="10, 20")
    first.run.new.operator.setText("C. Person")
    press(first.run.new.queue)
    press(first.run.new.queue)
    first.run.queue.entries[0].stage = QueueState.ABORTED
    file = tmp_path / "own.toml"
    file.write_text('name = "own"\n[[steps]]\nkind = "blank"\n', "utf-8")
    first.run.new.open_file(str(file))
    first.run.new.operator.setText("B. Person")
    first.run.new.mirror.setText("/second disk")
    first.run.new.pace.setCurrentText("as fast as possible")
    first.resize(940, 640)
    for page, left_px in ((first.run, 380), (first.look, 430)):
        first.go_to(page)
        (border,) = page.findChildren(QSplitter)
        border.moveSplitter(left_px, 1)
    first.close_in_order("closed")
    second = opened(qtbot, lab, careful_settings)
    try:
        assert second.size() == QSize(940, 640)
        assert second.pages.currentWidget() is second.look
        for page, left_px in ((second.run, 380), (second.look, 430)):
            second.go_to(page)
            QApplication.processEvents()
            assert page.findChildren(QSplitter)[0].sizes()[0] == pytest.approx(left_px, abs=5)
        (entry,) = second.run.queue.entries
        assert entry.stage is QueueState.WAITING
        assert (entry.job.plan, entry.job.operator) == (first.run.queue.entries[1].job.plan, "C. Person")
        assert entry.run_count == 2
        assert entry.job.pace == "fast"
        assert not second.run.session_running  # nothing starts by itself
        assert second.run.start_queue.isEnabled()
        assert second.run.new.plans.currentData() == str(file)
        assert second.run.new.chosen_pace == "fast"
        assert second.run.new.operator.text() == "B. Person"
        assert second.run.new.chosen_mirror == Path("/second disk")
        second.run.queue.restore("[{}")
        second.run.queue.restore('[{"plan": 3}]')
        assert len(second.run.queue.entries) == 1
    finally:
        second.close_in_order("the test is over")


def test_the_queue_is_on_disk_at_each_change_and_a_session_that_was_cut_off_can_be_gone_on_with(
    window: MainWindow, settings: Path, lab: Path, tmp_path: Path, qtbot: QtBot, until: Until
) -> None:
    fill(window, speed_mm_s="40")
    press(window.run.new.queue)
    fill(window, speed_mm_s="0.5, 20")
    window.run.new.pace.setCurrentText("as fast as the real rig")
    press(window.run.new.start)
    until(lambda: moving(window))
    copy = tmp_path / "died.ini"  # as a window that dies now leaves it
    copy.write_bytes(settings.read_bytes())
    press(window.stop_button)
    until(lambda: not window.run.session_running)
    again = opened(qtbot, lab, copy)
    notices, queue = again.notices, again.run.queue
    assert notices.cut_off.isVisible()
    assert notices.cut_off_text.text().startswith("Session drag was cut off at 20")
    assert "at run 0, drag 0.5 mm/s, 1 of 2 in all." in notices.cut_off_text.text()
    assert [entry.stage for entry in queue.entries] == [QueueState.CUT_OFF, QueueState.WAITING]
    press(again.reset)
    until(lambda: again.guard.text() == "guard: armed")
    folder = Path(queue.entries[0].folder)
    press(notices.go_on)
    assert not notices.cut_off.isVisible()
    assert again.run.queue.current is queue.entries[1]
    until(lambda: moving(again))
    press(again.stop_button)
    until(lambda: not again.run.session_running)
    assert [run.header.order for run in read_campaign(folder).runs] == [0, 1]
    assert [entry.stage for entry in queue.entries] == [QueueState.ABORTED, QueueState.ABORTED, QueueState.WAITING]
    assert not opened_queue(copy).cut_off
    again.close()


def opened_queue(settings: Path) -> SessionQueue:
    """Return the queue that the next window would have."""
    stored, queue = QSettings(str(settings), QSettings.Format.IniFormat), SessionQueue()
    (key,) = (key for key in stored.allKeys() if key.startswith("queue"))
    queue.restore(str(stored.value(key)))
    return queue


def test_start_starts_the_form_before_those_that_wait_and_the_window_does_not_close_meanwhile(
    window: MainWindow, until: Until
) -> None:
    fill(window, speed_mm_s="40")
    press(window.run.new.queue)
    fill(window, speed_mm_s="0.2")
    window.run.new.pace.setCurrentText("as fast as the real rig")
    press(window.run.new.start)
    until(lambda: moving(window))
    assert [entry.stage for entry in window.run.queue.entries] == [QueueState.RUNNING, QueueState.WAITING]
    assert [run.summary for run in window.run.queue.entries[0].runs if "0.2" in run.summary]
    assert not window.close()
    assert "A session is running" in window.notices.complaint_text.text()
    press(window.run.abort)
    until(lambda: not window.run.session_running)


def test_a_waiting_session_is_opened_duplicated_changed_and_its_missing_runs_are_made(
    window: MainWindow, until: Until
) -> None:
    view, new, queue = window.run.queue_view, window.run.new, window.run.queue
    fill(window, speed_mm_s="0.5, 20")
    new.note.setText("as it was")
    press(new.queue)
    waiting = view.tree.topLevelItem(0)
    assert [waiting.child(at).text(0) for at in range(waiting.childCount())] == ["0  drag 0.5 mm/s", "1  drag 20 mm/s"]
    view.tree.setCurrentItem(waiting)
    assert not view.missing.isEnabled()
    press(view.copy)
    assert len(queue.entries) == 2
    new.note.clear()
    fill(window, "blank", speed_mm_s="5")
    view.tree.setCurrentItem(view.tree.topLevelItem(1))
    press(view.edit)
    assert len(queue.entries) == 1
    assert (new.plan().name, new.note.text()) == ("drag", "as it was")
    assert new.editor.values()[0]["speed_mm_s"] == "0.5, 20"
    new.note.clear()
    queue.entries[0].job = replace(queue.entries[0].job, pace="real")
    press(window.run.start_queue)
    until(lambda: moving(window))
    press(window.stop_button)
    until(lambda: not window.run.session_running)
    view.tree.setCurrentItem(view.tree.topLevelItem(0))
    queue.entries[0].job = replace(queue.entries[0].job, pace="fast")
    press(view.missing)
    until(lambda: not window.run.session_running)
    assert [entry.stage for entry in queue.entries] == [QueueState.ABORTED, QueueState.COMPLETE]
    made = read_campaign(Path(queue.entries[1].folder))
    assert [(run.header.order, run.status) for run in made.runs] == [
        (0, RunStatus.ABORTED), (1, RunStatus.COMPLETE), (2, RunStatus.COMPLETE)]  # fmt: skip


def test_a_rest_counts_down_with_live_readings_and_a_pause_is_seen_and_taken_back(
    window: MainWindow, until: Until
) -> None:
    run, live, entries = window.run, window.run.live, window.run.queue.entries
    fill(window, speed_mm_s="20", wait_s="30", way_back="driven")
    window.run.new.pace.setCurrentText("as fast as the real rig")
    press(run.new.start)
    until(lambda: 0.0 < live.rest_left_s < 28.5)
    left_s = entries[-1].left_s
    assert live.title.text().startswith("Rest before drag 20 mm/s: 2")
    assert live.readings.about.text() == f"live: rest, {live.title.text().split(': ')[1]}"
    assert live.force.lines[1].drawn.getData()[1].size > 10
    until(lambda: entries[-1].left_s < left_s - 1.0)
    assert 0 < run.queue_view.progress.value() < 200
    press(run.pause)
    assert run.pause.text() == "Pauses after run 1 (undo)"  # with its way back
    assert run.pause.property("role") == "main"
    press(run.pause)
    assert run.pause.text() == "Pause after this run"
    press(window.stop_button)
    until(lambda: not run.session_running)
    assert entries[-1].reason == "stopped by operator (stop button)"


def test_homing_is_called_homing_and_no_prompt_open_where_none_is(window: MainWindow) -> None:
    notices, about = window.notices, window.run.live.readings.about
    for shown in (window, window.run):
        shown.take(StageHomes("HOMING: the stage moves"))
    assert notices.homing.isVisible()
    assert notices.homing_text.text() == "HOMING: the stage moves. STOP (Esc) stops it."
    assert "homing" in about.text().lower()
    for shown in (window, window.run):
        shown.take(StageHomes(""))
    assert not notices.homing.isVisible()
    prompt = PromptShown(4711, "Put it in", can_redo=False, can_skip=False, hands=True)
    for event in (prompt, RigIdle(IdleReading(3.0, None), 4711)):
        window.take(event)
        window.run.take(event)
    assert about.text() == "live: prompt open"
    press(notices.answers[Answer.DONE])
    window.run.take(RigIdle(IdleReading(3.0, None), 4711))  # it was on its way
    assert about.text() == "live: preparing"


def test_the_simulated_rig_remembers_home_position_and_the_capsule_in_the_gut(
    window: MainWindow, until: Until, lab: Path
) -> None:
    hand, notices, shown = window.run.hand, window.notices, window.run.live.readings
    force, position, _ = shown.readings.values()

    def done(action: QWidget) -> None:
        press(action)
        while hand.busy:
            until(lambda: notices.prompt.isVisible() or not hand.busy)
            if notices.prompt.isVisible():
                press(notices.answers[Answer.DONE])
        until(lambda: shown.about.text() == "live: at rest")

    done(hand.home)
    assert position.text() == "0.00 mm"
    hand.distance.put(5.0)
    done(hand.jog)
    assert (position.text(), hand.state.text()) == ("5.00 mm", "The stage is at 5.000 mm.")
    fill(window, speed_mm_s="20", start_mm="30", prompt="Put it in", prompt_each="yes", repeats="2")
    press(window.run.new.start)
    until(notices.prompt.isVisible)
    until(lambda: shown.about.text() == "live: prompt open")
    assert (position.text(), abs(float(force.text().split()[0].replace("−", "-"))) < 5.0) == ("30.00 mm", True)
    press(notices.answers[Answer.DONE])
    until(notices.answers[Answer.REDO].isVisible)  # before the second run
    until(lambda: shown.about.text() == "live: prompt open")
    assert 25.0 < float(force.text().split()[0]) < 60.0
    press(notices.answers[Answer.ABORT])
    until(lambda: not window.run.session_running and shown.about.text() == "live: at rest")
    assert position.text() == "40.00 mm"
    assert 25.0 < float(force.text().split()[0]) < 60.0
    fill(window, start_mm="")
