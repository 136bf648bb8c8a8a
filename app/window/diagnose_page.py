"""The page that diagnoses a campaign: verdict, ranking, where the gap is, before and after, what to run next."""

from PySide6.QtCore import QByteArray, Qt, QTimer, Signal
from PySide6.QtSvgWidgets import QSvgWidget
from PySide6.QtWidgets import QComboBox, QLayout, QLineEdit, QProgressBar, QScrollArea, QTabWidget, QWidget

from dragrig.analysis.gap.candidate_runs import plan_of_next_runs
from dragrig.analysis.gap.diagnosis import Diagnosis, RunTraces, Verdict
from dragrig.analysis.gap.diagnosis_text import (
    as_sentence,
    axis_texts,
    calibration_sentence,
    detection_limit_sentence,
    display_name,
    domain_sentence,
    effect_description,
    is_stated_verdict,
    percent_text,
    probability_text,
    shrink_sentences,
    verdict_sentences,
)
from dragrig.config.errors import DragrigError
from dragrig.present.palette import BLUE, GREY, PALE, VERMILLION
from dragrig.views.diagnosis_process import (
    CompletedDiagnosis,
    DiagnosisFailed,
    DiagnosisProcess,
    DiagnosisProgress,
    DiagnosisTask,
)
from dragrig.views.plan_view import PlanForm, form_from_plan
from dragrig.window.plots import BarChart, TimePlot
from dragrig.window.widgets import (
    StoredSettings,
    button,
    card,
    choose_path,
    column,
    fill_table,
    label,
    named,
    row,
    table,
)

_MAX_RANKED = 8


class DiagnosisResults(QWidget):
    """Shows one diagnosis."""

    next_wanted = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.diagnosis: Diagnosis | None = None
        self.verdict = label("", "title", wrap=True)
        self.more = label("", wrap=True)
        self.next_words = label("", wrap=True)
        self.next = button("Put it in the &queue", self.next_wanted.emit, "main", "The plan is shown on the run page")
        self.ranking = BarChart()
        header = ("Hypothesis", "Probability", "Gap explained on held-out runs", "")
        self.hypotheses = named(table(header), "Ranking of hypotheses")
        self.places = named(table(("Coordinate", "Where", "p-value")), "Where the gap is")
        self.map = named(QSvgWidget(), "Map of where the gap is")
        self.where = label("", wrap=True)
        self.runs = named(QComboBox(), "Run to show before and after")
        self.runs.currentIndexChanged.connect(self._draw_run)
        self.above, self.below = TimePlot("Force", "mN"), TimePlot("Residual", "mN")
        self.above.hide_times()
        self.above.follow(self.below)
        self.open_questions = label("", wrap=True)
        self.tabs = QTabWidget()
        self._lay_out()

    def show_diagnosis(self, completed: CompletedDiagnosis) -> None:
        """Show a diagnosis."""
        diagnosis = self.diagnosis = completed.diagnosis
        first, *more = (*verdict_sentences(diagnosis), *map(effect_description, diagnosis.effects))
        self.verdict.setText(first)
        if diagnosis.shrink is not None:
            more += shrink_sentences(diagnosis.shrink, named=bool(diagnosis.effects))
        more.append(calibration_sentence(diagnosis))
        if diagnosis.verdict is not Verdict.NO_GAP:
            more.append(detection_limit_sentence(diagnosis))
        self.more.setText("\n".join(more))
        experiment = diagnosis.next_experiment
        self.next_words.setText("No further experiment is recommended." if experiment is None else experiment.reason)
        self.next.setEnabled(experiment is not None)
        self._show_ranking(diagnosis)
        fill_table(self.places, [(place.axis, place.where, f"{place.p:.2g}") for place in axis_texts(diagnosis.where)])
        self.where.setText(domain_sentence(diagnosis.where))
        self.map.load(QByteArray(completed.location_svg))
        # A loaded file resets the renderer's mode.
        self.map.renderer().setAspectRatioMode(Qt.AspectRatioMode.KeepAspectRatio)
        questions = "\n".join(map(as_sentence, diagnosis.limitations))
        self.open_questions.setText(questions or "None.")
        self.runs.clear()
        for view in diagnosis.traces:
            self.runs.addItem(f"{view.label}, {view.file} ({view.channel.replace('_', ' ')})")
        self._draw_run(0)

    def _show_ranking(self, diagnosis: Diagnosis) -> None:
        rows, bars = [], []
        for ranked in sorted(diagnosis.ranking, key=lambda ranked: -ranked.probability)[:_MAX_RANKED]:
            name, probability = display_name(ranked.hypothesis), probability_text(ranked.probability)
            improvement = ranked.held_out_improvement
            if is_stated_verdict(ranked, diagnosis):
                remark, colour = "verdict", BLUE
            elif set(ranked.hypothesis.split("+")) & set(diagnosis.confusable_with):
                remark, colour = "confusable with the verdict on these runs", GREY
            else:
                remark, colour = "", PALE
            rows.append((name, probability, "" if improvement is None else percent_text(improvement), remark))
            bars.append((name, ranked.probability, probability, colour))
        fill_table(self.hypotheses, rows)
        self.ranking.show_bars(bars)

    def _draw_run(self, index: int) -> None:
        diagnosis = self.diagnosis
        if diagnosis is None or not 0 <= index < len(diagnosis.traces):
            return
        view: RunTraces = diagnosis.traces[index]
        for plot in (self.above, self.below):
            plot.forget_lines()
            plot.forget_levels()
        self.above.rename(view.channel.replace("_", " ").capitalize(), view.unit)
        self.below.rename("Residual", view.unit)
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
            self.below.level(-floor_mN, "", aside=True)
            self.below.level(floor_mN, "noise and run-to-run scatter", aside=True)
        self.above.fit()
        self.below.fit()

    def _lay_out(self) -> None:
        inside = QWidget()
        inside.setObjectName("bare")
        inside.setLayout(column(label("What these runs cannot answer", "title"), self.open_questions, 1, margin=10))
        questions = QScrollArea()
        questions.setWidgetResizable(True)
        questions.setWidget(inside)
        where = row(self.map, self.places, stretch={0: 2, 1: 1})
        pages: dict[str, QLayout] = {
            "&Which": column(self.ranking.widget, self.hypotheses, margin=8, stretch={0: 3, 1: 2}),
            "W&here": column(self.where, where, margin=8, stretch={1: 1}),
            "Before and a&fter": column(
                self.runs, self.above.widget, self.below.widget, margin=8, stretch={1: 3, 2: 2}
            ),
        }
        for name, layout in pages.items():
            page = QWidget()
            page.setLayout(layout)
            self.tabs.addTab(page, name)
        self.tabs.addTab(questions, "&Open questions")
        recommended = row(label("Next experiment", "title"), self.next_words, self.next, stretch={1: 1})
        self.setLayout(column(self.verdict, self.more, recommended, self.tabs, stretch={3: 1}))


_POLL_MS = 100


class DiagnosePage(QWidget):
    """Selects a campaign, diagnoses it in its own process, and shows the result."""

    complained = Signal(str)
    next_experiment = Signal(str, PlanForm)

    def __init__(self, remembered: StoredSettings) -> None:
        super().__init__()
        self.setObjectName("page")
        self._remembered = remembered
        self._process: DiagnosisProcess | None = None
        self.campaign = named(QLineEdit(remembered.text("campaign")), "Campaign to diagnose")
        self.campaign.setPlaceholderText("folder of run files")
        self.campaign.textChanged.connect(lambda _: self._show_state())
        self.choose = button("&Campaign …", self._choose, help_="The folder of a campaign")
        self.nominal = named(QComboBox(), "Nominal model")
        self.nominal.setEditable(True)
        self.nominal.addItems(["capsule", "drive"])
        self.nominal.setToolTip("The friction model, the stage alone, or a file with a model of your own")
        self.nominal.setMinimumWidth(160)
        self.start = button(
            "Diag&nose", self.diagnose, "main", "Diagnose where, why and how far runs and model differ", "Ctrl+D"
        )
        self.cancel = button("C&ancel", self.stop, help_="End the diagnosis; the runs are not changed")
        self.progress = named(QProgressBar(), "Progress of the diagnosis")
        self.state = label("Choose a campaign; it need not be complete.", "faint", wrap=True)
        self.results = DiagnosisResults()
        self.results.next_wanted.connect(self._want_next)
        head = row(
            label("Campaign"),
            self.campaign,
            self.choose,
            label("Nominal model"),
            self.nominal,
            self.start,
            self.cancel,
            stretch={1: 1},
        )
        whole = column(card(head, row(self.state, self.progress)), self.results, margin=8, stretch={1: 1})
        self.setLayout(whole)
        self.results.hide()
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
        self._process = DiagnosisProcess(
            DiagnosisTask(self.campaign.text().strip(), self.nominal.currentText().strip())
        )
        self.progress.setRange(0, 0)
        self.state.setText(f"Diagnosing {self.campaign.text()} …")
        self._timer.start(_POLL_MS)
        self._show_state()

    def stop(self) -> None:
        """End the running diagnosis."""
        if self._process is not None:
            self._process.cancel()
            self._finish("Cancelled.")

    def keep(self) -> None:
        """Store the choice, and end a running diagnosis."""
        self._remembered.keep("campaign", self.campaign.text())
        self.stop()

    def _poll(self) -> None:
        if self._process is None:
            return
        for event in self._process.events():
            match event:
                case DiagnosisProgress(done, of):
                    self.progress.setRange(0, max(of, 1))
                    self.progress.setValue(done)
                case CompletedDiagnosis():
                    self.results.show_diagnosis(event)
                    self.results.show()
                    self._finish(f"Diagnosed: {self.campaign.text()}")
                case DiagnosisFailed(sentence):
                    self.complained.emit(sentence)
                    self._finish(sentence)

    def _finish(self, text: str) -> None:
        self._timer.stop()
        self._process = None
        self.state.setText(text)
        self._show_state()

    def _show_state(self) -> None:
        self.start.setEnabled(not self.busy and bool(self.campaign.text().strip()))
        self.cancel.setEnabled(self.busy)
        self.progress.setVisible(self.busy)
        self.campaign.setEnabled(not self.busy)

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
        start = self.campaign.text() or self._remembered.text("look folder")
        choose_path(self, "Campaign to diagnose", start, self.campaign.setText)
