"""The page that diagnoses a campaign: verdict, ranking, where the gap is, before and after, what to run next."""

from PySide6.QtCore import QByteArray, Qt, QTimer, Signal
from PySide6.QtSvgWidgets import QSvgWidget
from PySide6.QtWidgets import QComboBox, QLineEdit, QProgressBar, QScrollArea, QTabWidget, QWidget

from dragrig.config.errors import DragrigError
from dragrig.present.palette import BLUE, GREY, PALE, VERMILLION
from dragrig.views.diagnosis_process import (
    DiagnosisFailed,
    DiagnosisProcess,
    DiagnosisProgress,
    DiagnosisTask,
    DiagnosisView,
    HypothesisRow,
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

_ROLE_TEXTS = ("", "cannot be told from it with these runs", "the verdict")


class DiagnosisResults(QWidget):
    """Shows one diagnosis."""

    next_wanted = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.told: DiagnosisView | None = None
        self.verdict = label("", "title", wrap=True)
        self.more = label("", wrap=True)
        self.next_words = label("", wrap=True)
        self.next = button("Put it in the &queue", self.next_wanted.emit, "main", "The plan is shown on the run page")
        self.ranking = BarChart()
        self.hypotheses = named(
            table(("Hypothesis", "Probability", "Takes away, held out", "")), "Ranking of hypotheses"
        )
        self.places = named(table(("Along", "Where", "By chance")), "Where the gap is")
        self.map = named(QSvgWidget(), "Map of where the gap is")
        self.where = label("", wrap=True)
        self.runs = named(QComboBox(), "Run to show before and after")
        self.runs.currentIndexChanged.connect(self._draw_run)
        self.above, self.below = TimePlot("Force", "mN"), TimePlot("Left", "mN")
        self.above.hide_times()
        self.above.follow(self.below)
        self.tabs = QTabWidget()
        self._lay_out()

    def show_told(self, told: DiagnosisView) -> None:
        """Show a diagnosis."""
        self.told = told
        first, *more = told.verdict
        self.verdict.setText(first)
        self.more.setText("\n".join((*more, *told.shrink, *told.honesty)))
        self.next_words.setText(told.next_words or "No further experiment is recommended.")
        self.next.setEnabled(told.next_plan is not None)
        fill_table(
            self.hypotheses, [(one.name, one.chance, one.held_out, _ROLE_TEXTS[_row_role(one)]) for one in told.ranking]
        )
        self.ranking.show_bars([(one.name, one.probability, one.chance, _bar_colour(one)) for one in told.ranking])
        fill_table(self.places, [(one.axis, one.where, f"{one.p:.2g}") for one in told.places])
        self.where.setText(told.where)
        self.map.load(QByteArray(told.where_svg))
        # What is loaded brings its own.
        self.map.renderer().setAspectRatioMode(Qt.AspectRatioMode.KeepAspectRatio)
        self.open_questions.setText("\n".join(told.cannot_answer) or "Nothing that was asked.")
        self.runs.clear()
        self.runs.addItems([f"{one.label}, {one.file} ({one.channel.replace('_', ' ')})" for one in told.views])
        self._draw_run(0)

    def _draw_run(self, at: int) -> None:
        told = self.told
        if told is None or not 0 <= at < len(told.views):
            return
        view = told.views[at]
        for panel in (self.above, self.below):
            panel.forget_lines()
            panel.forget_levels()
        self.above.rename(view.channel.replace("_", " ").capitalize(), view.unit)
        self.below.rename("Left", view.unit)
        words = [("measured", PALE), ("model before", VERMILLION), ("model after", BLUE)]
        self.above.line("", PALE, 5.0).points(view.time_s, view.measured)
        self.above.line("", VERMILLION, 2.0, dashed=True).points(view.time_s, view.before)
        self.below.line("", VERMILLION, 2.0, dashed=True).points(view.time_s, view.measured - view.before)
        if told.named:
            self.above.line("", BLUE, 2.0).points(view.time_s, view.after)
            self.below.line("", BLUE, 2.0).points(view.time_s, view.measured - view.after)
        self.above.title(*words[: 3 if told.named else 2])
        if told.floor_mN is not None and view.unit == "mN":
            for level in (-told.floor_mN, told.floor_mN):
                self.below.level(level, "noise and scatter of repeats" if level > 0 else "", aside=True)
        self.above.fit()
        self.below.fit()

    def _lay_out(self) -> None:
        self.open_questions = label("", wrap=True)
        which = QWidget()
        layout = column(self.ranking.widget, self.hypotheses, margin=8, stretch={0: 3, 1: 2})
        which.setLayout(layout)
        where = QWidget()
        beside = row(self.map, self.places, stretch={0: 2, 1: 1})
        layout = column(self.where, beside, margin=8, stretch={1: 1})
        where.setLayout(layout)
        runs = QWidget()
        layout = column(self.runs, self.above.widget, self.below.widget, margin=8, stretch={1: 3, 2: 2})
        runs.setLayout(layout)
        questions = QScrollArea()
        questions.setWidgetResizable(True)
        inside = QWidget()
        inside.setObjectName("bare")
        inside.setLayout(column(label("What these runs cannot answer", "title"), self.open_questions, 1, margin=10))
        questions.setWidget(inside)
        for widget, name in (
            (which, "&Which"), (where, "W&here"), (runs, "Before and a&fter"), (questions, "&Open questions"),
        ):  # fmt: skip
            self.tabs.addTab(widget, name)
        following = row(label("To run next", "title"), self.next_words, self.next, stretch={1: 1})
        whole = column(self.verdict, self.more, following, self.tabs, stretch={3: 1})
        self.setLayout(whole)


def _row_role(one: HypothesisRow) -> int:
    return 2 if one.verdict else 1 if one.confusable else 0


def _bar_colour(one: HypothesisRow) -> str:
    return (PALE, GREY, BLUE)[_row_role(one)]


_POLL_MS = 100


class DiagnosePage(QWidget):
    """Asks for a campaign, diagnoses it in a process of its own, and shows what was found."""

    complained = Signal(str)
    next_experiment = Signal(str, PlanForm)

    def __init__(self, remembered: StoredSettings) -> None:
        super().__init__()
        self.setObjectName("page")
        self._remembered = remembered
        self._work: DiagnosisProcess | None = None
        self.campaign = named(QLineEdit(remembered.text("campaign")), "Campaign to diagnose")
        self.campaign.setPlaceholderText("folder of run files")
        self.campaign.textChanged.connect(lambda _: self._show_state())
        self.choose = button("&Campaign …", self._choose, help_="The folder of a campaign")
        self.nominal = QComboBox()
        self.nominal.setEditable(True)
        self.nominal.addItems(["capsule", "drive"])
        self.nominal.setAccessibleName("What is expected")
        self.nominal.setToolTip("The friction model, the stage alone, or a file with a model of one's own")
        self.nominal.setMinimumWidth(160)
        self.start = button("Diag&nose", self.diagnose, "main", "Say where, why and how far the runs differ", "Ctrl+D")
        self.cancel = button("C&ancel", self.stop, help_="End the diagnosis; the runs stay as they are")
        self.progress = named(QProgressBar(), "Progress of the diagnosis")
        self.state = label("Choose a campaign; it need not be complete.", "faint", wrap=True)
        self.results = DiagnosisResults()
        self.results.next_wanted.connect(self._want_next)
        head = row(
            label("Campaign"),
            self.campaign,
            self.choose,
            label("expected"),
            self.nominal,
            self.start,
            self.cancel,
            stretch={1: 1},
        )
        whole = column(card(head, row(self.state, self.progress)), self.results, margin=8, stretch={1: 1})
        self.setLayout(whole)
        self.results.hide()
        self._timer = QTimer(self)
        self._timer.timeout.connect(self._look)
        self._show_state()

    @property
    def busy(self) -> bool:
        """Whether a diagnosis is under way."""
        return self._work is not None

    def offer(self, campaign: str) -> None:
        """Fill in a campaign that was chosen on another page."""
        if not self.busy:
            self.campaign.setText(campaign)

    def diagnose(self) -> None:
        """Begin."""
        self._work = DiagnosisProcess(DiagnosisTask(self.campaign.text().strip(), self.nominal.currentText().strip()))
        self.progress.setRange(0, 0)
        self.state.setText(f"Diagnosing {self.campaign.text()} …")
        self._timer.start(_POLL_MS)
        self._show_state()

    def stop(self) -> None:
        """End the diagnosis under way."""
        if self._work is not None:
            self._work.cancel()
            self._finish("Cancelled.")

    def keep(self) -> None:
        """Remember what is chosen, and end what is under way."""
        self._remembered.keep("campaign", self.campaign.text())
        self.stop()

    def _look(self) -> None:
        if self._work is None:
            return
        for news in self._work.news():
            match news:
                case DiagnosisProgress(done, of):
                    self.progress.setRange(0, max(of, 1))
                    self.progress.setValue(done)
                case DiagnosisView():
                    self.results.show_told(news)
                    self.results.show()
                    self._finish(f"Diagnosed: {self.campaign.text()}")
                case DiagnosisFailed(sentence):
                    self.complained.emit(sentence)
                    self._finish(sentence)

    def _finish(self, words: str) -> None:
        self._timer.stop()
        self._work = None
        self.state.setText(words)
        self._show_state()

    def _show_state(self) -> None:
        self.start.setEnabled(not self.busy and bool(self.campaign.text().strip()))
        self.cancel.setEnabled(self.busy)
        self.progress.setVisible(self.busy)
        self.campaign.setEnabled(not self.busy)

    def _want_next(self) -> None:
        told = self.results.told
        if told is None or told.next_plan is None:
            return
        try:
            self.next_experiment.emit("next experiment", form_from_plan(told.next_plan, "next experiment"))
        except DragrigError as error:
            self.complained.emit(str(error))

    def _choose(self) -> None:
        start = self.campaign.text() or self._remembered.text("look folder")
        choose_path(self, "Campaign to diagnose", start, self.campaign.setText)
