"""Settling in the window: runs that are chosen, made and diagnosed with their reason on the screen, until it ends."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from windows import WAIT_MS, Until, opened, press, require_qt

require_qt()

from PySide6.QtWidgets import QApplication, QLabel
from pytestqt.qtbot import QtBot

import dragrig
from dragrig.analysis.gap import Ending
from dragrig.analysis.gap.settling import SETTLE_FILE
from dragrig.api import read_settle_record, take_up_settling
from dragrig.config import Plan
from dragrig.engine_host import Answer, SessionJob
from dragrig.present.settle import ending_sentence
from dragrig.rig import read_campaign
from dragrig.setup import resolve
from dragrig.window.main_window import MainWindow
from dragrig.window.session_queue import QueuedSession, QueueState, SessionQueue
from settled import EFFECT, FIRST, begun_loop, little_lab

pytestmark = pytest.mark.usefixtures("finished_here")
REASON = "A drag at 5 mm/s best shows which causes act."


@pytest.fixture(scope="module")
def window(
    request: pytest.FixtureRequest, qapp: QApplication, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[MainWindow]:
    lab = little_lab(tmp_path_factory.mktemp("lab"))
    bot = QtBot(request)
    made = opened(bot, lab, lab / "window.ini")
    press(made.reset)
    bot.waitUntil(lambda: made.guard.text() == "guard: armed", timeout=WAIT_MS)
    yield made
    made.close_in_order("the tests are over")


@pytest.fixture(scope="module")
def few(window: MainWindow) -> Path:
    """A campaign of four runs on the rig of the window."""
    data = Path(window.description.data_root)
    return dragrig.run(FIRST, out=data / "few", effects=[EFFECT], rig=data.parent / "rig.toml").folder


def settle(window: MainWindow, campaign: Path, pace: str) -> None:
    """Choose a campaign and have it settled within the shortest time."""
    window.run.new.pace.setCurrentText(pace)
    window.go_to(window.diagnose)
    window.diagnose.offer(str(campaign))
    window.diagnose.minutes.put(1)
    press(window.diagnose.settle)


def with_answers(window: MainWindow, done: Callable[[], bool]) -> Callable[[], bool]:
    """Return a condition that answers every prompt meanwhile: what is asked for is mounted."""

    def is_done() -> bool:
        if window.notices.prompt.isVisible():
            press(window.notices.answers[Answer.DONE])
        return done()

    return is_done


@pytest.mark.thorough
def test_further_runs_are_made_and_diagnosed_with_their_reason_on_the_screen(
    window: MainWindow, few: Path, until: Until, tmp_path: Path
) -> None:
    campaign = Path(shutil.copytree(few, few.parent / "settled"))
    page, seen = window.diagnose, list[tuple[str, bool]]()
    window.run.new.mirror.setText(str(tmp_path))
    window.run.running_changed.connect(
        lambda running: seen.append((window.run.why.text(), window.run.why.isVisible())) if running else None
    )
    settle(window, campaign, "as fast as possible")
    until(with_answers(window, lambda: "Time is up" in page.state.text()))
    record = read_settle_record(campaign)
    so_far, batch = record.batches
    assert record.ending is Ending.TIME
    assert so_far.minutes == pytest.approx(resolve(FIRST).programme().duration_s / 60)
    assert batch.minutes <= 1.0
    assert set(seen) == {(f"Settle settled: {batch.reason}", True)}
    assert not window.run.why.isVisible()
    further = [run for run in read_campaign(campaign).runs if run.header.entry["plan"] == batch.plan.name]
    assert batch.reason in {run.header.entry["note"] for run in further}
    assert ending_sentence(record) in page.state.text()
    assert ending_sentence(record) in [text.text() for text in page.results.view.findChildren(QLabel)]
    assert page.results.isVisibleTo(page)
    assert read_settle_record(tmp_path / campaign.name) == record
    window.run.new.mirror.clear()


def test_a_stopped_session_pauses_it_and_the_same_runs_go_on(
    window: MainWindow, shared_folder: Path, until: Until
) -> None:
    campaign = Path(shutil.copytree(begun_loop(shared_folder), Path(window.description.data_root) / "paused"))
    page, run = window.diagnose, window.run
    settle(window, campaign, "as fast as the real rig")
    until(lambda: run.queue.current is not None and bool(run.queue.current.runs))
    press(window.stop_button)
    until(lambda: not run.session_running)
    assert page.state.text() == "Settling paused: stopped by operator (stop button); press Settle to go on."
    decided = read_settle_record(campaign)
    assert not page.busy
    assert len(decided.batches) > len(decided.steps)
    settle(window, campaign, "as fast as possible")
    until(lambda: run.session_running)
    resumed = run.queue.entries[-1]
    assert resumed.job.resume == campaign
    assert resumed.why == decided.batches[-1].reason
    until(with_answers(window, lambda: resumed.stage is not QueueState.RUNNING))
    assert resumed.stage is QueueState.COMPLETE, resumed.reason
    assert page.busy
    press(page.cancel)
    assert read_settle_record(campaign).batches == decided.batches


def test_a_queued_session_of_a_campaign_waits_again_at_the_next_start() -> None:
    queue, again = SessionQueue(), SessionQueue()
    plan = Plan.model_validate({"name": "few-then-1", "steps": [{"kind": "drag", "speed_mm_s": 5.0}]})
    job = SessionJob(1, plan, note=REASON, append=Path("runs/few"))
    queue.add(QueuedSession(job, "Settle few", 60.0, 1))
    again.restore(queue.as_text())
    (entry,) = again.entries
    assert (entry.job.append, entry.why, entry.title) == (Path("runs/few"), REASON, "Settle few")
    assert again.of_campaign(Path("runs/few"), plan) is entry
    assert again.of_campaign(Path("runs/few"), plan.model_copy(update={"name": "few-then-2"})) is None


def test_more_time_for_a_settled_campaign_is_counted_from_what_was_spent(shared_folder: Path, tmp_path: Path) -> None:
    campaign = Path(shutil.copytree(begun_loop(shared_folder), tmp_path / "c"))
    (campaign / SETTLE_FILE).unlink()
    record = take_up_settling(campaign, 20.0)
    assert record.minutes == pytest.approx(20.0 + resolve(FIRST).programme().duration_s / 60)
    assert record.left_min == pytest.approx(20.0)
