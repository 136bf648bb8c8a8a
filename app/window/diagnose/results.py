"""What a diagnosis found, on the screen: verdict, where, ranking, before and after, what next."""

from PySide6.QtCore import QByteArray, Qt, Signal
from PySide6.QtSvgWidgets import QSvgWidget
from PySide6.QtWidgets import QComboBox, QScrollArea, QTabWidget, QWidget

from dragrig.diagnosing_apart import Hypothesis, Told
from dragrig.figures.palette import BLUE, GREY, PALE, VERMILLION
from dragrig.window.diagnose.bars import Bars
from dragrig.window.plots.panel import Panel
from dragrig.window.widgets import button, column, fill, label, row, table

_WORDS = ("", "cannot be told from it with these runs", "the verdict")


class Results(QWidget):
    """Shows one diagnosis."""

    next_wanted = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.told: Told | None = None
        self.verdict = label("", "title", wrap=True)
        self.more = label("", wrap=True)
        self.next_words = label("", wrap=True)
        self.next = button("Put it in the &queue", self.next_wanted.emit, "main", "The plan is shown on the run page")
        self.ranking = Bars()
        self.hypotheses = table(("Hypothesis", "Probability", "Takes away, held out", ""))
        self.hypotheses.setAccessibleName("Ranking of hypotheses")
        self.places = table(("Along", "Where", "By chance"))
        self.places.setAccessibleName("Where the gap is")
        self.map = QSvgWidget()
        self.map.setAccessibleName("Map of where the gap is")
        self.where = label("", wrap=True)
        self.runs = QComboBox()
        self.runs.setAccessibleName("Run to show before and after")
        self.runs.currentIndexChanged.connect(self._draw_run)
        self.above, self.below = Panel("Force", "mN"), Panel("Left", "mN")
        self.above.hide_times()
        self.above.follow(self.below)
        self.tabs = QTabWidget()
        self._lay_out()

    def show_told(self, told: Told) -> None:
        """Show a diagnosis."""
        self.told = told
        first, *more = told.verdict
        self.verdict.setText(first)
        self.more.setText("\n".join((*more, *told.shrink, *told.honesty)))
        self.next_words.setText(told.next_words or "No further experiment is recommended.")
        self.next.setEnabled(told.next_plan is not None)
        fill(self.hypotheses, [(one.name, one.chance, one.held_out, _WORDS[_rank(one)]) for one in told.ranking])
        self.ranking.show_bars([(one.name, one.probability, one.chance, _colour(one)) for one in told.ranking])
        fill(self.places, [(one.axis, one.where, f"{one.p:.2g}") for one in told.places])
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
        layout = column(self.ranking.widget, self.hypotheses, margin=8)
        layout.setStretch(0, 3)
        layout.setStretch(1, 2)
        which.setLayout(layout)
        where = QWidget()
        beside = row(self.map, self.places)
        beside.setStretch(0, 2)
        beside.setStretch(1, 1)
        layout = column(self.where, beside, margin=8)
        layout.setStretch(1, 1)
        where.setLayout(layout)
        runs = QWidget()
        layout = column(self.runs, self.above.widget, self.below.widget, margin=8)
        layout.setStretch(1, 3)
        layout.setStretch(2, 2)
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
        following = row(label("To run next", "title"), self.next_words, self.next)
        following.setStretch(1, 1)
        whole = column(self.verdict, self.more, following, self.tabs)
        whole.setStretch(3, 1)
        self.setLayout(whole)


def _rank(one: Hypothesis) -> int:
    return 2 if one.verdict else 1 if one.confusable else 0


def _colour(one: Hypothesis) -> str:
    return (PALE, GREY, BLUE)[_rank(one)]
