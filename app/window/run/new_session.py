"""What the next session is to be: a plan, filled in, who is there, and how fast a rig that is no rig lives."""

from pathlib import Path

from PySide6.QtCore import QSignalBlocker, QTimer, Signal
from PySide6.QtWidgets import QComboBox, QFileDialog, QFormLayout, QLineEdit, QWidget

from dragrig.config.errors import DragrigError
from dragrig.config.plan import Plan
from dragrig.engine_host.messages import Pace, RigTerms
from dragrig.plan_forms import PlanForm, form_of, known_plans
from dragrig.planned import PlannedSession, RigInWords, planned
from dragrig.window.remembered import Remembered
from dragrig.window.run.form import PlanEditor
from dragrig.window.widgets import button, card, column, label, row

_SETTLE_MS = 250
_PACES: dict[str, Pace] = {"as fast as the real rig": "real", "as fast as it can": "fast"}
_DOUBLE_PACES: dict[str, Pace] = {"as fast as the real rig": "real", "5 times faster": 5.0, "20 times faster": 20.0}


class NewSession(QWidget):
    """Edits a session; `planned` and `refused` tell what it would do, a moment after every change."""

    planned = Signal(object)
    refused = Signal(str)
    wanted = Signal(bool)
    """It is to be put into the queue; true when it is to be started as well."""

    def __init__(self, rig: RigTerms, words: RigInWords, lab: Path | None, remembered: Remembered) -> None:
        super().__init__()
        self._rig, self._words, self._remembered = rig, words, remembered
        self._form: PlanForm | None = None
        self._offered: dict[str, PlanForm] = {}
        self.session: PlannedSession | None = None
        self.plans = QComboBox()
        self.plans.setAccessibleName("Plan")
        for name in known_plans(None if lab is None else lab.absolute()):
            self.plans.addItem(Path(name).stem if name.endswith(".toml") else name, name)
        self.open = button("&Open …", self._choose_file, help_="A plan from a file")
        self.editor = PlanEditor()
        self.operator = QLineEdit(remembered.text("operator"))
        self.note = QLineEdit()
        self.mirror = QLineEdit(remembered.text("mirror"))
        self.mirror.setPlaceholderText("no second copy")
        self.mirror.setToolTip("A folder on another disk: each finished file is copied into it and read back")
        self.choose_mirror = button(
            "&Folder …", self._choose_mirror, help_="A folder on another disk for second copies"
        )
        self.pace = QComboBox()
        self._paces = _paces(rig, words)
        self.pace.addItems(list(self._paces))
        self._choose_pace(rig.pace)
        self.queue = button("Add to &queue", lambda: self.wanted.emit(False), help_="Put it at the end of the queue")
        self.start = button(
            "&Start", lambda: self.wanted.emit(True), "main", "Put it into the queue and start", "Ctrl+Return"
        )
        self._lay_out()
        self._settle = QTimer(self)
        self._settle.setSingleShot(True)
        self._settle.timeout.connect(self.look)
        self.editor.changed.connect(lambda: self._settle.start(_SETTLE_MS))
        self.plans.currentIndexChanged.connect(lambda _: self._load(str(self.plans.currentData())))

    @property
    def chosen_pace(self) -> Pace | None:
        """How fast a rig that is no rig is to live."""
        return self._paces.get(self.pace.currentText())

    @property
    def chosen_mirror(self) -> Path | None:
        """Where second copies go."""
        text = self.mirror.text().strip()
        return Path(text).expanduser() if text else None

    def begin(self) -> None:
        """Show the plan of the last time, or the first."""
        last = self._remembered.text("plan", "drag")
        with QSignalBlocker(self.plans):
            if self.plans.findData(last) < 0 and Path(last).is_file():
                self.plans.addItem(Path(last).stem, last)
            self.plans.setCurrentIndex(max(self.plans.findData(last), 0))
        self._load(str(self.plans.currentData()))

    def offer(self, name: str, plan: PlanForm) -> None:
        """Show a plan that comes from elsewhere; it can be chosen again for as long as the window is open."""
        self._offered[name] = plan
        with QSignalBlocker(self.plans):
            if self.plans.findData(name) < 0:
                self.plans.addItem(plan.plan.name, name)
            self.plans.setCurrentIndex(self.plans.findData(name))
        self._edit(plan)

    def plan(self) -> Plan:
        """Return the plan as it is filled in; raises `DragrigError`."""
        if self._form is None:
            return form_of(str(self.plans.currentData())).plan
        return self._form.filled(self.editor.values())

    def look(self) -> None:
        """Look at what the session would do."""
        self._settle.stop()
        self.session = None
        try:
            self.session = planned(self.plan(), self._rig)
        except DragrigError as error:
            self.refused.emit(str(error))
        else:
            self.planned.emit(self.session)
        allowed = self.session is not None and not self.session.findings
        self.start.setEnabled(allowed)
        self.queue.setEnabled(allowed)

    def keep(self) -> None:
        """Remember what is chosen."""
        if (plan := str(self.plans.currentData())) not in self._offered:
            self._remembered.keep("plan", plan)
        self._remembered.keep("operator", self.operator.text())
        self._remembered.keep("mirror", self.mirror.text().strip())
        if self._paces:
            self._remembered.keep(f"pace, {self._words.title}", self.pace.currentText())

    def _lay_out(self) -> None:
        form = QFormLayout()
        form.addRow("Operator", self.operator)
        form.addRow("Note", self.note)
        if self._paces:
            form.addRow("Pace", self.pace)
        copies = row(self.mirror, self.choose_mirror)
        copies.setStretch(0, 1)
        form.addRow("Second copy", copies)
        for edit, name in (
            (self.operator, "Operator"),
            (self.note, "Note"),
            (self.pace, "Pace"),
            (self.mirror, "Folder for second copies"),
        ):
            edit.setAccessibleName(name)
        self.plans.setMinimumWidth(180)
        head = row(self.plans, self.open)
        head.setStretch(0, 1)
        inside = column(label("New session", "title"), head, self.editor, form, row(1, self.queue, self.start))
        inside.setStretch(2, 1)
        self.setLayout(column(card(inside)))

    def _choose_pace(self, asked: Pace | None) -> None:
        """Choose the pace that was asked for with the rig, or else that of the last time."""
        wanted = next((name for name, pace in self._paces.items() if pace == asked), "")
        place = self.pace.findText(wanted or self._remembered.text(f"pace, {self._words.title}"))
        self.pace.setCurrentIndex(max(place, 0))

    def _choose_file(self) -> None:
        dialog = QFileDialog(self, "Open a plan", self._remembered.text("plan folder"), "Plans (*.toml)")
        # Not the system's own, which would keep Escape from the stop.
        dialog.setOption(QFileDialog.Option.DontUseNativeDialog)
        dialog.setFileMode(QFileDialog.FileMode.ExistingFile)
        dialog.fileSelected.connect(self.open_file)
        dialog.open()

    def _choose_mirror(self) -> None:
        dialog = QFileDialog(self, "Folder for second copies", self.mirror.text())
        dialog.setOption(QFileDialog.Option.DontUseNativeDialog)
        dialog.setFileMode(QFileDialog.FileMode.Directory)
        dialog.fileSelected.connect(self.mirror.setText)
        dialog.open()

    def open_file(self, path: str) -> None:
        """Choose a plan by its file."""
        self._remembered.keep("plan folder", str(Path(path).parent))
        if self.plans.findData(path) < 0:
            with QSignalBlocker(self.plans):
                self.plans.addItem(Path(path).stem, path)
        self.plans.setCurrentIndex(self.plans.findData(path))

    def _load(self, name: str) -> None:
        try:
            form = self._offered.get(name) or form_of(name)
        except DragrigError as error:
            self._form = None
            self.start.setEnabled(False)
            self.queue.setEnabled(False)
            self.refused.emit(str(error))
            return
        self._edit(form)

    def _edit(self, form: PlanForm) -> None:
        self._form = form
        self.editor.edit(form)
        self.look()


def _paces(rig: RigTerms, words: RigInWords) -> dict[str, Pace]:
    """Return the paces that this rig may have, by their names; the one asked for among them."""
    if words.real:
        return {}
    known = _DOUBLE_PACES if words.title == "DOUBLE" else _PACES
    asked = rig.pace
    return {**known, f"{asked:g} times faster": asked} if isinstance(asked, int | float) else known
