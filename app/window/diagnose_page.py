"""The page of campaigns: diagnosis (verdict, where the gap is, before and after, next runs), identification, report."""

import time
from collections.abc import Callable
from pathlib import Path

from PySide6.QtCore import QTimer, QUrl, Signal
from PySide6.QtGui import QDesktopServices
from PySide6.QtWidgets import QComboBox, QLineEdit, QProgressBar, QSizePolicy, QWidget

from dragrig.analysis.gap import Diagnosis, RunTraces, plan_of_next_runs
from dragrig.config import DragrigError, NumberRange
from dragrig.present import BLUE, PALE, VERMILLION, TimeLeft, next_text
from dragrig.views import (
    CampaignWork,
    CompletedDiagnosis,
    CompletedIdentification,
    CompletedReport,
    CompletedSettleStep,
    DiagnosisFailed,
    DiagnosisProcess,
    DiagnosisProgress,
    DiagnosisTask,
    FurtherRuns,
    PlanForm,
    form_from_plan,
)
from dragrig.window.forms import NumberField
from dragrig.window.plots import TimePlot
from dragrig.window.session_queue import QueuedSession, QueueState
from dragrig.window.widgets import (
    DocumentView,
    ElidedLabel,
    MessageText,
    StoredSettings,
    button,
    card,
    choose_path,
    column,
    label,
    named,
    row,
    scrolling,
)


class DiagnosisResults(QWidget):
    """Shows one diagnosis: its document, and any run before and after."""

    next_wanted = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.diagnosis: Diagnosis | None = None
        self.view = DocumentView()
        self.next_words = MessageText(most_lines=2)
        self.next = button("Add to &queue", self.next_wanted.emit, "main", "Append the plan and show its preview")
        self.runs = named(QComboBox(), "Run to show")
        self.runs.currentIndexChanged.connect(self._draw_run)
        self.above, self.below = TimePlot("Force", "mN"), TimePlot("Residual", "mN")
        self.above.hide_times()
        self.above.follow(self.below)
        self.before_after = scrolling(
            column(self.runs, self.above.widget, self.below.widget, margin=8, stretch={1: 3, 2: 2})
        )
        recommended = row(label("Next experiment", "title"), self.next_words, self.next, stretch={1: 1})
        self.setLayout(column(self.view, recommended, stretch={0: 1}))

    def show_diagnosis(self, completed: CompletedDiagnosis) -> None:
        """Show a diagnosis."""
        diagnosis = self.diagnosis = completed.diagnosis
        self.view.show_document(completed.document, {"Before and a&fter": self.before_after})
        self.next_words.setText(next_text(diagnosis) or "No run was looked for.")
        self.next.setVisible(diagnosis.next_experiment is not None)
        self.runs.clear()
        for traces in diagnosis.traces:
            self.runs.addItem(f"{traces.label}, {traces.file} ({traces.channel.replace('_', ' ')})")
        self._draw_run(0)

    def _draw_run(self, index: int) -> None:
        diagnosis = self.diagnosis
        if diagnosis is None or not 0 <= index < len(diagnosis.traces):
            return
        view: RunTraces = diagnosis.traces[index]
        for plot in (self.above, self.below):
            plot.remove_lines()
            plot.remove_levels()
        self.above.set_quantity(view.channel.replace("_", " ").capitalize(), view.unit)
        self.below.set_quantity("Residual", view.unit)
        legend = [("measured", PALE), ("model before", VERMILLION)]
        self.above.line("", PALE, 5.0).points(view.time_s, view.measured)
        self.above.line("", VERMILLION, 2.0, dashed=True).points(view.time_s, view.before)
        self.below.line("", VERMILLION, 2.0, dashed=True).points(view.time_s, view.measured - view.before)
        if diagnosis.effects:
            legend.append(("model after", BLUE))
            self.above.line("", BLUE, 2.0).points(view.time_s, view.after)
            self.below.line("", BLUE, 2.0).points(view.time_s, view.measured - view.after)
        self.above.title(*legend)
        if diagnosis.shrink is not None and view.unit == "mN":
            floor_mN = diagnosis.shrink.noise_floor_mN
            self.below.level(-floor_mN, "")
            self.below.level(floor_mN, "noise and scatter of repeats", at=0.85, above=True)
        self.above.fit()
        self.below.fit()


_POLL_MS = 100
_LEAST_DOCUMENT_PX, _PROGRESS_PX = 200, 250
_DOING = {
    CampaignWork.DIAGNOSE: "Diagnosing",
    CampaignWork.IDENTIFY: "Identifying",
    CampaignWork.REPORT: "Reporting on",
    CampaignWork.SETTLE: "Settling",
}
_USUAL_MIN, _MINUTES = 20.0, NumberRange("min", 1.0, 999.0)


class DiagnosePage(QWidget):
    """Selects a campaign, diagnoses it in its own process, and shows the result.

    Parameters
    ----------
    mirror
        Returns the folder for a second copy of what settling decides.
    """

    complained = Signal(str)
    begun = Signal()
    """A diagnosis has begun: errors of the one before are no longer true."""
    next_experiment = Signal(str, PlanForm)
    further_runs = Signal(FurtherRuns)
    """Runs that settle the gap, to be made now."""

    def __init__(self, stored: StoredSettings, mirror: Callable[[], Path | None] = lambda: None) -> None:
        super().__init__()
        self.setObjectName("page")
        self._stored, self._mirror = stored, mirror
        self._process: DiagnosisProcess | None = None
        self._left, self._begun_s = TimeLeft(), 0.0
        self.campaign = named(QLineEdit(stored.text("campaign")), "Campaign to diagnose")
        self.campaign.setPlaceholderText("folder of run files")
        self.campaign.textChanged.connect(lambda _: self._show_state())
        self.choose = button("&Campaign …", self._choose, help_="Choose the folder of a campaign")
        self.nominal = named(QComboBox(), "Nominal model")
        self.nominal.setEditable(True)
        self.nominal.addItems(["capsule", "drive"])
        self.nominal.setToolTip("capsule: friction model; drive: stage alone; or a Python file with another model")
        self.nominal.setMinimumWidth(160)
        self.start = button(
            "Diag&nose", self.diagnose, "main", "Diagnose where, why and how far runs and model differ", "Ctrl+D"
        )
        self.identify = button(
            "Identif&y",
            lambda: self._begin(CampaignWork.IDENTIFY),
            help_="Identify the specimen's parameters from its runs; model and pictures are written into the campaign",
        )
        self.report = button(
            "Rep&ort",
            lambda: self._begin(CampaignWork.REPORT),
            help_="Write a report on the campaign into it, one HTML file",
        )
        self.open_report = button("&View the report", self._open_report, help_="Open it in the browser")
        self.settle = button(
            "Sett&le",
            self._settle,
            help_="Make the runs that tell most, diagnose again, and so on until causes and verdict are sure; "
            "goes on where it was paused",
        )
        usual_min = stored.number("settle minutes", _USUAL_MIN)
        self.minutes = NumberField("Rig time of the further runs, without hands", _MINUTES, usual_min)
        self.minutes.edited.connect(self._show_state)
        self._awaited: Path | None = None
        """Campaign whose further runs are being made."""
        self._due: Path | None = None
        """Campaign whose further runs are made, to be diagnosed as soon as nothing else is done."""
        self.report_path: Path | None = None
        self.cancel = button("C&ancel", self.stop, help_="End the work; the runs are not changed")
        self.progress = named(QProgressBar(), "Progress of the diagnosis")
        self.progress.setMinimumWidth(_PROGRESS_PX)
        self.state = ElidedLabel("Choose a campaign; it need not be complete.", "faint")
        self.results = DiagnosisResults()
        self.results.next_wanted.connect(self._want_next)
        head = row(
            label("Campaign"),
            self.campaign,
            self.choose,
            label("Nominal model"),
            self.nominal,
            self.settle,
            self.minutes,
            self.minutes.unit,
            stretch={1: 1},
        )
        self.identification = DocumentView()
        # Its own tabs scroll, and not the page.
        self.identification.setMinimumHeight(_LEAST_DOCUMENT_PX)
        doing = row(self.start, self.identify, self.report, self.cancel, self.state, self.progress, self.open_report,
                    stretch={4: 1})  # fmt: skip
        choice = card(head, self.minutes.problem, doing, margin=4)
        choice.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Maximum)
        self.setLayout(column(choice, self.results, self.identification, 0, margin=8, stretch={1: 1, 2: 1}))
        self.results.hide()
        self.identification.hide()
        self.open_report.hide()
        self._timer = QTimer(self)
        self._timer.timeout.connect(self._poll)
        self._show_state()

    @property
    def busy(self) -> bool:
        """Whether a diagnosis is running."""
        return self._process is not None

    def offer(self, campaign: str) -> None:
        """Fill in a campaign chosen on another page."""
        if not self.busy:
            self.campaign.setText(campaign)

    def diagnose(self) -> None:
        """Start the diagnosis."""
        self._begin(CampaignWork.DIAGNOSE)

    def _settle(self) -> None:
        if (minutes := self.minutes.value()) is not None:
            self._awaited = None
            self._begin(CampaignWork.SETTLE, minutes=minutes)

    def session_over(self, session: QueuedSession) -> None:
        """Go on with settling once the runs that it waits for are made, or say that it is paused."""
        if self._awaited is None or session.job.campaign != self._awaited:
            return
        folder, self._awaited = self._awaited, None
        if session.stage is QueueState.COMPLETE:
            self._due = folder
            self._go_on()
        else:
            self.state.setText(f"Settling paused: {session.reason.rstrip('.')}; press Settle to go on.")
        self._show_state()

    def _go_on(self) -> None:
        if self._due is not None and not self.busy:
            folder, self._due = self._due, None
            self._begin(CampaignWork.SETTLE, str(folder))

    def _begin(self, work: CampaignWork, campaign: str = "", minutes: float | None = None) -> None:
        self.begun.emit()
        campaign = campaign or self.campaign.text().strip()
        nominal = self.nominal.currentText().strip()
        self._process = DiagnosisProcess(DiagnosisTask(campaign, nominal, work, minutes, self._mirror()))
        self._left, self._begun_s = TimeLeft(), time.monotonic()
        self.progress.setRange(0, 0)
        self.state.setText(f"{_DOING[work]} {campaign} …")
        self._timer.start(_POLL_MS)
        self._show_state()

    def stop(self) -> None:
        """End the running diagnosis, and settling after the runs that are queued."""
        settling, self._awaited, self._due = self._awaited is not None, None, None
        if self._process is not None:
            self._process.cancel()
            self._finish("Cancelled.")
        elif settling:
            self._finish("Settling ends here; what is queued stays. Press Settle to go on.")

    def keep(self) -> None:
        """Store the choice, and end a running diagnosis."""
        self._stored.keep("campaign", self.campaign.text())
        self._stored.keep("settle minutes", self.minutes.entered_value)
        self.stop()

    def _poll(self) -> None:
        if self._process is None:
            return
        drawing = "drawing" if 0 < self.progress.maximum() == self.progress.value() else ""
        left = self._left.text(time.monotonic() - self._begun_s) or drawing
        self.progress.setFormat(f"%p %, {left}" if left else "%p %")
        for event in self._process.events():
            match event:
                case DiagnosisProgress(done, total):
                    self.progress.setRange(0, max(total, 1))
                    self.progress.setValue(done)
                    self._left.at(done / max(total, 1), time.monotonic() - self._begun_s)
                case CompletedDiagnosis():
                    self.results.show_diagnosis(event)
                    self.results.show()
                    self._finish(f"Diagnosed: {self.campaign.text()}")
                    self.identification.hide()
                case CompletedIdentification(document, _):
                    self.identification.show_document(document)
                    self.results.hide()
                    self.identification.show()
                    self._finish(f"Identified: {self.campaign.text()}")
                case CompletedReport(path):
                    self.report_path = path
                    self._finish(f"Report: {path}")
                case CompletedSettleStep():
                    self._take_step(event)
                case DiagnosisFailed(sentence):
                    self.complained.emit(sentence)
                    self._finish(sentence)

    def _take_step(self, step: CompletedSettleStep) -> None:
        """Show what was decided, and have the next runs made."""
        for problem in step.problems:
            self.complained.emit(problem)
        if step.completed is not None:
            self.results.show_diagnosis(step.completed)
            self.results.show()
            self.identification.hide()
        if step.runs is not None:
            self._awaited = step.runs.folder
        self._finish(step.sentence)
        if step.runs is not None:
            self.further_runs.emit(step.runs)

    def _finish(self, text: str) -> None:
        self._timer.stop()
        self._process = None
        self.state.setText(text)
        self._show_state()
        self._go_on()

    def _show_state(self) -> None:
        for work in (self.start, self.identify, self.report, self.settle):
            work.setEnabled(not self.busy and bool(self.campaign.text().strip()))
        if self.minutes.value() is None:
            self.settle.setEnabled(False)
        self.open_report.setVisible(self.report_path is not None and not self.busy)
        self.cancel.setEnabled(self.busy or self._awaited is not None)
        self.progress.setVisible(self.busy)
        self.campaign.setEnabled(not self.busy)

    def _open_report(self) -> None:
        QDesktopServices.openUrl(QUrl.fromLocalFile(str(self.report_path)))

    def _want_next(self) -> None:
        diagnosis = self.results.diagnosis
        if diagnosis is None or diagnosis.next_experiment is None:
            return
        plan = plan_of_next_runs(diagnosis.next_experiment)
        try:
            self.next_experiment.emit("next experiment", form_from_plan(plan, "next experiment"))
        except DragrigError as error:
            self.complained.emit(str(error))

    def _choose(self) -> None:
        start = self.campaign.text() or self._stored.text("look folder")
        choose_path(self, "Campaign to diagnose", start, self.campaign.setText)
