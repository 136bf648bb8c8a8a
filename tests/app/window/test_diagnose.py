"""The page that diagnoses, carried to the end on a real campaign, and what its answer is good for on the run page."""

import multiprocessing
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diagnoses import ALL, RIPPLE_AND_AGEING, STRIBECK, TOGETHER, without_pictures
from places import CAMPAIGN, copied_runs
from windows import BUSY, WAIT_MS, Until, dressed, lab_in, press, require_qt

require_qt()

from PySide6.QtCore import QSettings
from PySide6.QtWidgets import QApplication, QLabel, QTableWidget
from pytestqt.qtbot import QtBot

from dragrig.analysis.gap.candidate_runs import plan_of_next_runs
from dragrig.analysis.gap.diagnosis import Diagnosis
from dragrig.engine_host.messages import RigSelection
from dragrig.present.diagnosis import diagnosis_document
from dragrig.present.diagnosis_sentences import verdict_sentences
from dragrig.present.gap_budget import budget_sentences
from dragrig.present.terminal import document_text
from dragrig.views import CompletedDiagnosis
from dragrig.window.diagnose_page import DiagnosisResults
from dragrig.window.main_window import MainWindow
from dragrig.window.session_queue import QueueState
from dragrig.window.widgets import DrawnFigure, MessageText, StoredSettings

LONG_MS = 600_000
"""A diagnosis on a busy machine."""


@pytest.fixture(scope="module")
def window(
    request: pytest.FixtureRequest, qapp: QApplication, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[MainWindow]:
    dressed()
    lab = lab_in(tmp_path_factory.mktemp("lab"))
    settings = QSettings(str(lab / "window.ini"), QSettings.Format.IniFormat)
    made = MainWindow(RigSelection(rig=lab / "rig.toml"), lab, StoredSettings(settings), BUSY)
    made.show()
    QtBot(request).waitUntil(lambda: made.guard.text() == "guard: NOT ARMED", timeout=WAIT_MS)
    made.go_to(made.diagnose)
    yield made
    made.close_in_order("the tests are over")


@pytest.fixture
def until(qtbot: QtBot) -> Until:
    return lambda done: qtbot.waitUntil(done, timeout=LONG_MS)


@pytest.fixture
def diagnosed(window: MainWindow, until: Until) -> Diagnosis:
    """The diagnosis of the practice campaign, made once."""
    page = window.diagnose
    if page.results.diagnosis is None:
        page.offer(str(CAMPAIGN))
        press(page.start)
        assert not page.start.isEnabled()
        assert page.progress.isVisible()
        said: list[str] = []
        until(lambda: said.append(page.progress.text()) or not page.busy)
        assert any(re.fullmatch(r"\d+ %, .* left", text) for text in said)
    assert page.results.diagnosis is not None, window.notices.complaint_text.text()
    return page.results.diagnosis


def test_a_running_diagnosis_can_be_cancelled(window: MainWindow, until: Until) -> None:
    page = window.diagnose
    page.offer(str(CAMPAIGN))
    press(page.start)
    (work,) = (child for child in multiprocessing.active_children() if child.name == "dragrig-diagnosis")
    until(lambda: page.progress.maximum() > 0)
    press(page.cancel)
    assert page.state.text() == "Cancelled."
    assert not work.is_alive()
    assert page.start.isEnabled()
    assert page.results.diagnosis is None


def test_a_campaign_is_diagnosed_completely(window: MainWindow, diagnosed: Diagnosis) -> None:
    results = window.diagnose.results
    assert window.diagnose.state.text() == f"Diagnosed: {CAMPAIGN}"
    assert results.isVisible()
    answer, *_ = (*budget_sentences(diagnosed.budget), *verdict_sentences(diagnosed))
    assert results.view.answer.text() == answer
    ranking = next(shown for shown in results.findChildren(QTableWidget) if shown.accessibleName() == "ranking")
    ranked = sorted(diagnosed.ranking, key=lambda hypothesis: -hypothesis.probability)[: ranking.rowCount()]
    names = [ranking.item(place, 1).text() for place in range(ranking.rowCount())]
    assert names == [hypothesis.hypothesis for hypothesis in ranked]
    assert 0.9 < sum(hypothesis.probability for hypothesis in ranked) <= 1.001
    figures = list(diagnosis_document(diagnosed).without("before-after").figures())
    assert len([shown for shown in results.findChildren(DrawnFigure) if shown.renderer().isValid()]) == len(figures)


def test_a_diagnosis_shows_the_fitted_parameters_that_the_terminal_prints(qtbot: QtBot) -> None:
    results = DiagnosisResults()
    qtbot.addWidget(results)
    document = without_pictures(diagnosis_document(STRIBECK).without("before-after"))
    results.show_diagnosis(CompletedDiagnosis(STRIBECK, document))
    shown = next(table for table in results.findChildren(QTableWidget) if "Refitted" in table.accessibleName())
    printed = document_text(diagnosis_document(STRIBECK))
    rows = [[shown.item(row, at).text() for at in range(3)] for row in range(shown.rowCount())]
    assert rows == [["ratio", "0.410", "0.312 to 0.508"], ["speed_mm_s", "2.90", "1.72 to 4.08"]]
    assert all(text in printed for row in rows for text in row)


@pytest.mark.parametrize("diagnosis", ALL.values(), ids=ALL)
def test_a_diagnosis_shows_everything_that_the_terminal_prints(qtbot: QtBot, diagnosis: Diagnosis) -> None:
    document = diagnosis_document(diagnosis, source="runs/first")
    without_runs = document.without("before-after")
    results = DiagnosisResults()
    qtbot.addWidget(results)
    results.show_diagnosis(CompletedDiagnosis(diagnosis, without_pictures(without_runs)))
    shown = [label.text() for label in results.findChildren(QLabel)]
    shown += [message.toPlainText() for message in results.findChildren(MessageText)]
    for table in results.findChildren(QTableWidget):
        shown += [table.horizontalHeaderItem(at).text() for at in range(table.columnCount())]
        shown += [table.item(row, at).text() for row in range(table.rowCount()) for at in range(table.columnCount())]
    shown += [results.view.tabs.tabText(at) for at in range(results.view.tabs.count())]
    window = " ".join(" ".join(shown).split())
    printed = [part.lstrip("! ") for line in document_text(document).splitlines() for part in re.split(r"\s{2,}", line)]
    assert len(printed) > 30
    assert [part for part in printed if part not in window] == []


def test_a_specimen_is_identified_and_reported_on(window: MainWindow, until: Until, tmp_path: Path) -> None:
    page = window.diagnose
    campaign = copied_runs(tmp_path / "practice", "008-coulomb.h5")
    page.offer(str(campaign))
    press(page.identify)
    assert not page.report.isEnabled()
    until(lambda: not page.busy)
    assert page.state.text() == f"Identified: {campaign}", page.state.text()
    assert page.identification.isVisible()
    assert not page.results.isVisible()
    names = {cell.text() for table in page.identification.findChildren(QTableWidget) for row in range(table.rowCount())
             if (cell := table.item(row, 0)) is not None}  # fmt: skip
    assert "μ" in names
    assert (campaign / "identified" / "model.toml").is_file()
    assert [figure.renderer().isValid() for figure in page.identification.findChildren(DrawnFigure)] == [True]
    assert not page.open_report.isVisible()
    press(page.report)
    until(lambda: not page.busy)
    assert page.report_path == campaign / "practice.html"
    assert page.open_report.isVisible()
    assert page.report_path.stat().st_size > 10_000


def test_the_budget_is_the_first_page_of_a_diagnosis(qtbot: QtBot) -> None:
    diagnosis = replace(TOGETHER, traces=(), budget=RIPPLE_AND_AGEING)
    results = DiagnosisResults()
    qtbot.addWidget(results)
    results.show_diagnosis(CompletedDiagnosis(diagnosis, without_pictures(diagnosis_document(diagnosis), but="budget")))
    assert results.view.answer.text() == budget_sentences(RIPPLE_AND_AGEING)[0]
    assert results.view.tabs.tabText(0) == "The budget"
    page = results.view.tabs.widget(0)
    assert page is not None
    picture, *others = page.findChildren(DrawnFigure)
    assert picture.renderer().isValid()
    assert picture.accessibleName().startswith("A bar of the gap")
    assert not others
    (table,) = page.findChildren(QTableWidget)
    assert [table.item(row, 0).text() for row in range(table.rowCount())] == [
        "Velocity ripple",
        "Tissue ageing or preconditioning",
        "Unexplained",
    ]
    assert [table.item(row, 1).text() for row in range(table.rowCount())] == ["55 %", "20 %", "25 %"]


def test_every_run_is_shown_before_and_after(window: MainWindow, diagnosed: Diagnosis) -> None:
    results = window.diagnose.results
    forces = [trace for trace in diagnosed.traces if trace.channel == "force"]
    assert {force.file for force in forces} == {file.name for file in CAMPAIGN.glob("*.h5")}
    for at, view in enumerate(diagnosed.traces):
        results.runs.setCurrentIndex(at)
        measured, before = (line.drawn.getData()[1] for line in results.above.lines[:2])
        np.testing.assert_array_equal(measured, view.measured)
        np.testing.assert_array_equal(before, view.before)
        left = results.below.lines[0].drawn.getData()[1]
        np.testing.assert_allclose(left, view.measured - view.before)


def test_a_button_queues_the_next_experiment(window: MainWindow, diagnosed: Diagnosis) -> None:
    assert diagnosed.next_experiment is not None
    plan = plan_of_next_runs(diagnosed.next_experiment)
    assert not window.run.queue.entries
    press(window.diagnose.results.next)
    assert window.pages.currentWidget() is window.run
    (entry,) = window.run.queue.entries
    assert entry.stage is QueueState.WAITING
    assert [step.kind for step in entry.job.plan.steps] == [step.kind for step in plan.steps]
    for queued, wanted in zip(entry.job.plan.steps, plan.steps, strict=True):
        # The form adds what is usual to what is recommended.
        assert wanted.parameters.items() <= queued.parameters.items()
    assert window.run.preview.runs.rowCount() == entry.run_count > 0
    assert not window.run.session_running


def test_an_invalid_campaign_is_reported_and_the_page_stays_usable(
    window: MainWindow, until: Until, tmp_path: Path
) -> None:
    page = window.diagnose
    window.go_to(page)
    page.offer(str(tmp_path))
    press(page.start)
    until(lambda: not page.busy)
    assert str(tmp_path) in window.notices.complaint_text.text()
    assert page.start.isEnabled()
