"""Runs that are added to an existing campaign in the window: chosen, previewed, refused in words, made."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from windows import WAIT_MS, Until, lab_in, opened, press, require_qt

require_qt()

from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

import dragrig
from dragrig.rig import read_campaign
from dragrig.window.main_window import MainWindow
from dragrig.window.new_session import NewSession
from dragrig.window.session_queue import QueueState
from dragrig.window.widgets import top_items

pytestmark = pytest.mark.usefixtures("finished_here")
QUICK = ("travel_mm=5", "hold_s=0.5", "rest_s=0.5")


@pytest.fixture(scope="module")
def window(
    request: pytest.FixtureRequest, qapp: QApplication, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[MainWindow]:
    lab = lab_in(tmp_path_factory.mktemp("lab"))
    bot = QtBot(request)
    made = opened(bot, lab, lab / "window.ini")
    made.run.new.pace.setCurrentText("as fast as possible")
    press(made.reset)
    bot.waitUntil(lambda: made.guard.text() == "guard: armed", timeout=WAIT_MS)
    yield made
    made.close_in_order("the tests are over")


@pytest.fixture(scope="module")
def first(window: MainWindow) -> Path:
    """A campaign of one drag and its way back, of a stated specimen, on the rig of the window."""
    data = Path(window.description.data_root)
    facts = ("specimen.id=P7", "specimen.wall_thickness_mm=2.0")
    return dragrig.run("drag", out=data / "first", assignments=(*QUICK, *facts), rig=data.parent / "rig.toml").folder


@pytest.fixture
def campaign(first: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(first, first.parent / tmp_path.name))


@pytest.fixture
def form(window: MainWindow) -> Iterator[NewSession]:
    """The form of a quick drag in a campaign of its own."""
    window.go_to(window.run)
    form = window.run.new
    for key, text in (("travel_mm", "5"), ("hold_s", "0.5"), ("rest_s", "0.5"), ("prompt", ""), ("wait_s", "0")):
        form.editor.put(key, text)
    yield form
    form.destination.adds.setChecked(False)
    form.destination.campaign.clear()
    form.specimen.put("id", "")
    form.specimen.put("wall_thickness_mm", "")


def choose(form: NewSession, campaign: Path, until: Until) -> None:
    """Have the runs added to a campaign."""
    form.destination.adds.setChecked(True)
    form.destination.campaign.setText(str(campaign))
    until(lambda: not form.destination.reading)
    form.update_preview()


def test_the_campaign_selected_in_the_list_is_suggested_and_its_runs_go_on(
    window: MainWindow, form: NewSession, campaign: Path, until: Until
) -> None:
    window.go_to(window.look)
    browser = window.look.browser
    browser.look_at(campaign)
    until(lambda: browser.campaign() == campaign and not browser.busy)
    window.go_to(window.run)
    folders = set(campaign.parent.iterdir())
    press(form.destination.adds)
    assert form.destination.path == campaign
    until(form.start.isEnabled)
    assert "2 runs, specimen P7" in form.destination.state.text()
    assert window.run.preview.conditions.text().startswith(f"Added to {campaign.name}; ")
    press(form.start)
    until(lambda: not window.run.session_running)
    entry = window.run.queue.entries[-1]
    assert (entry.stage, entry.title, entry.folder) == (
        QueueState.COMPLETE, f"drag, added to {campaign.name}", str(campaign)
    )  # fmt: skip
    runs = read_campaign(campaign).runs
    assert sorted(run.header.order for run in runs) == [0, 1, 2, 3]
    assert {(run.header.specimen["id"], run.header.specimen["wall_thickness_mm"]) for run in runs} == {("P7", 2.0)}
    assert set(campaign.parent.iterdir()) == folders
    until(lambda: "4 runs" in form.destination.state.text())


def test_a_chosen_campaign_stays_whatever_else_is_looked_at(
    window: MainWindow, form: NewSession, campaign: Path, first: Path, until: Until
) -> None:
    choose(form, campaign, until)
    browser = window.look.browser
    browser.look_at(first)
    until(lambda: browser.campaign() == first and not browser.busy)
    assert form.destination.path == campaign
    form.destination.adds.setChecked(False)
    browser.tree.clearSelection()
    browser.tree.setCurrentItem(top_items(browser.tree)[0])
    assert form.destination.campaign.text() != str(campaign)
    assert form.destination.path is None


def test_what_does_not_suit_the_campaign_is_said_in_the_form_before_anything_moves(
    window: MainWindow, form: NewSession, campaign: Path, until: Until
) -> None:
    dragrig.run(
        "drag", append=campaign, assignments=(*QUICK, "specimen.id=P8"), rig=campaign.parent.parent / "rig.toml"
    )
    before = sorted(campaign.glob("*.*"))
    choose(form, campaign, until)
    said = (
        "as runs of several specimens (P7, P8); say which one is on the rig with an id under Specimen, or a fresh id."
    )
    assert form.problem.text() == f"H{said}"
    assert window.run.preview.findings.text() == f"{campaign}: h{said}"
    assert not form.start.isEnabled()
    assert not form.queue.isEnabled()
    form.specimen.put("id", "P7")
    form.specimen.put("wall_thickness_mm", "3")
    form.update_preview()
    assert "a fresh piece needs an id of its own, as P8 under Specimen" in form.problem.text()
    assert not form.start.isEnabled()
    form.specimen.put("wall_thickness_mm", "2")
    form.update_preview()
    assert form.start.isEnabled()
    assert sorted(campaign.glob("*.*")) == before


def test_a_campaign_of_another_rig_or_a_folder_that_is_none_is_refused(
    window: MainWindow, form: NewSession, campaign: Path, until: Until, tmp_path: Path
) -> None:
    rig = campaign.parent.parent / "rig.toml"
    other = (*QUICK, "rig.force_sensor.range_mN=9000")
    foreign = dragrig.run("drag", out=tmp_path / "foreign", assignments=other, rig=rig).folder
    choose(form, foreign, until)
    assert "Its runs were made with another rig: force_sensor.range_mN is" in form.problem.text()
    assert not form.start.isEnabled()
    choose(form, tmp_path, until)
    assert "so it is no campaign that could go on" in form.problem.text()
    assert not form.start.isEnabled()
    form.destination.campaign.clear()
    until(lambda: not form.destination.reading)
    assert form.problem.text() == "Choose the campaign that the runs are added to."
    form.destination.adds.setChecked(False)
    assert form.start.isEnabled()
    assert not form.problem.isVisible()


def test_a_campaign_that_is_read_too_late_is_not_added_to(
    window: MainWindow, form: NewSession, campaign: Path, until: Until
) -> None:
    form.destination.campaign.setText(str(campaign))
    form.destination.adds.setChecked(True)
    assert form.destination.reading
    assert not form.start.isEnabled()
    form.destination.adds.setChecked(False)
    assert form.start.isEnabled()
    form.destination.files.finish()
    QApplication.processEvents()
    assert form.destination.read is None
    assert not window.run.preview.conditions.text().startswith("Added")


def test_a_session_that_the_campaign_refuses_when_its_turn_comes_says_so(
    window: MainWindow, form: NewSession, campaign: Path, until: Until
) -> None:
    choose(form, campaign, until)
    press(form.queue)
    shutil.rmtree(campaign)
    window.run.run_queue()
    until(lambda: not window.run.session_running)
    assert window.run.queue.entries[-1].stage is QueueState.REFUSED
    assert "is no campaign that could go on" in window.notices.complaint_text.text()
