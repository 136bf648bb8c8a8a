"""The page that diagnoses a campaign."""

from pathlib import Path

from PySide6.QtCore import QTimer, Signal
from PySide6.QtWidgets import QComboBox, QFileDialog, QLineEdit, QProgressBar, QWidget

from dragrig.config.errors import DragrigError
from dragrig.diagnosing_apart import DiagnosisProcess, Failed, Far, Told, Wanted
from dragrig.plan_forms import PlanForm, form_of_plan
from dragrig.window.diagnose.results import Results
from dragrig.window.remembered import Remembered
from dragrig.window.widgets import button, card, column, label, row

_LOOK_MS = 100


class DiagnosePage(QWidget):
    """Asks for a campaign, diagnoses it in a process of its own, and shows what was found."""

    complained = Signal(str)
    next_experiment = Signal(str, PlanForm)

    def __init__(self, remembered: Remembered) -> None:
        super().__init__()
        self.setObjectName("page")
        self._remembered = remembered
        self._work: DiagnosisProcess | None = None
        self.campaign = QLineEdit(remembered.text("campaign"))
        self.campaign.setAccessibleName("Campaign to diagnose")
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
        self.progress = QProgressBar()
        self.progress.setAccessibleName("Progress of the diagnosis")
        self.state = label("Choose a campaign; it need not be complete.", "faint", wrap=True)
        self.results = Results()
        self.results.next_wanted.connect(self._want_next)
        head = row(
            label("Campaign"), self.campaign, self.choose, label("expected"), self.nominal, self.start, self.cancel
        )
        head.setStretch(1, 1)
        whole = column(card(head, row(self.state, self.progress)), self.results, margin=8)
        whole.setStretch(1, 1)
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
        self._work = DiagnosisProcess(Wanted(self.campaign.text().strip(), self.nominal.currentText().strip()))
        self.progress.setRange(0, 0)
        self.state.setText(f"Diagnosing {self.campaign.text()} …")
        self._timer.start(_LOOK_MS)
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
                case Far(done, of):
                    self.progress.setRange(0, max(of, 1))
                    self.progress.setValue(done)
                case Told():
                    self.results.show_told(news)
                    self.results.show()
                    self._finish(f"Diagnosed: {self.campaign.text()}")
                case Failed(sentence):
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
            self.next_experiment.emit("next experiment", form_of_plan(told.next_plan, "next experiment"))
        except DragrigError as error:
            self.complained.emit(str(error))

    def _choose(self) -> None:
        dialog = QFileDialog(self, "Campaign to diagnose", self.campaign.text() or self._remembered.text("look folder"))
        dialog.setOption(QFileDialog.Option.DontUseNativeDialog)
        dialog.setFileMode(QFileDialog.FileMode.Directory)
        dialog.fileSelected.connect(lambda path: self.campaign.setText(str(Path(path))))
        dialog.open()
