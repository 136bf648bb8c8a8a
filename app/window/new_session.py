"""The next session: its plan as a form, operator and pace, and a preview of what it will do."""

from pathlib import Path

from PySide6.QtCore import QSignalBlocker, Qt, QTimer, Signal
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QFileDialog,
    QFormLayout,
    QLineEdit,
    QPlainTextEdit,
    QScrollArea,
    QWidget,
)

from dragrig.config.errors import DragrigError
from dragrig.config.plan import Plan
from dragrig.engine_host.messages import RigSelection
from dragrig.present.numbers import duration_text, size_text
from dragrig.present.palette import BLUE, PURPLE
from dragrig.setup import Pace
from dragrig.views.plan_view import (
    FieldKind,
    FormField,
    PlanForm,
    RigDescription,
    SessionPreview,
    StepForm,
    known_plans,
    plan_form,
    preview_session,
)
from dragrig.window.plots import TimePlot
from dragrig.window.widgets import StoredSettings, button, card, column, fill_table, label, row, set_role, table

DEFAULT_TEXT = "the usual"
FieldEditor = QLineEdit | QPlainTextEdit | QComboBox | QCheckBox


class PlanEditor(QWidget):
    """Edits the steps of a plan; `changed` after every change."""

    changed = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.steps = QComboBox()
        self.steps.setAccessibleName("Step of the plan")
        self.steps.currentIndexChanged.connect(self._show_step)
        self.about = label("", "faint", wrap=True)
        self.editors: dict[str, FieldEditor] = {}
        self._form: PlanForm | None = None
        self._values: list[dict[str, str]] = []
        self._shown = -1
        self._scroll = QScrollArea()
        self._scroll.setWidgetResizable(True)
        self._scroll.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setLayout(column(self.steps, self.about, self._scroll))

    def edit(self, form: PlanForm) -> None:
        """Show a plan."""
        self._form, self._shown = form, -1
        self._values = [_step_values(step) for step in form.steps]
        with QSignalBlocker(self.steps):
            self.steps.clear()
            self.steps.addItems(
                [f"Step {at + 1} of {len(form.steps)}: {one.kind}" for at, one in enumerate(form.steps)]
            )
        self.steps.setVisible(len(form.steps) > 1)
        self._show_step(0)

    def values(self) -> list[dict[str, str]]:
        """Return the values of every step as text."""
        self._keep()
        return [dict(one) for one in self._values]

    def put(self, key: str, text: str) -> None:
        """Fill a field of the step that is shown."""
        editor = self.editors[key]
        match editor:
            case QComboBox():
                editor.setCurrentText(text or DEFAULT_TEXT)
            case QCheckBox():
                editor.setChecked(text == "yes")
            case QPlainTextEdit():
                editor.setPlainText(text)
            case _:
                editor.setText(text)

    def _show_step(self, at: int) -> None:
        if self._form is None or not 0 <= at < len(self._form.steps):
            return
        self._keep()
        step, self._shown = self._form.steps[at], at
        self.about.setText(step.about)
        self.editors = {one.key: self._editor(one, self._values[at][one.key]) for one in step.fields}
        inner, layout = QWidget(), QFormLayout()
        inner.setObjectName("bare")
        layout.setContentsMargins(0, 0, 8, 0)
        layout.setRowWrapPolicy(QFormLayout.RowWrapPolicy.DontWrapRows)
        for one in step.fields:
            name = label(f"{one.name.capitalize()}{f' ({one.unit})' if one.unit else ''}")
            name.setToolTip(_field_help(one))
            layout.addRow(name, self.editors[one.key])
        inner.setLayout(layout)
        self._scroll.setWidget(inner)

    def _keep(self) -> None:
        if self._shown >= 0:
            self._values[self._shown] = {key: _editor_text(editor) for key, editor in self.editors.items()}

    def _editor(self, one: FormField, text: str) -> FieldEditor:
        editor: FieldEditor
        match one.kind:
            case FieldKind.CHOICE:
                editor = QComboBox()
                editor.addItems([*([] if one.default else [DEFAULT_TEXT]), *one.choices])
                editor.setCurrentText(text or DEFAULT_TEXT)
                editor.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
                editor.setMinimumContentsLength(6)
                editor.currentTextChanged.connect(lambda _: self.changed.emit())
            case FieldKind.SWITCH:
                editor = QCheckBox("yes")
                editor.setChecked(text == "yes")
                editor.toggled.connect(lambda _: self.changed.emit())
            case FieldKind.LIST:
                editor = QPlainTextEdit(text)
                editor.setFixedHeight(110)
                editor.setTabChangesFocus(True)
                editor.textChanged.connect(self.changed.emit)
            case _:
                editor = QLineEdit(text)
                editor.setCursorPosition(0)
                editor.setPlaceholderText("needed" if one.required else DEFAULT_TEXT)
                editor.textChanged.connect(lambda _: self.changed.emit())
        editor.setToolTip(_field_help(one))
        editor.setAccessibleName(one.name)
        editor.setAccessibleDescription(_field_help(one))
        return editor


def _step_values(step: StepForm) -> dict[str, str]:
    return {one.key: step.values.get(one.key, one.default) for one in step.fields}


def _editor_text(editor: FieldEditor) -> str:
    match editor:
        case QComboBox():
            return editor.currentText() if editor.currentText() != DEFAULT_TEXT else ""
        case QCheckBox():
            return "yes" if editor.isChecked() else "no"
        case QPlainTextEdit():
            return editor.toPlainText()
        case _:
            return editor.text()


def _field_help(one: FormField) -> str:
    sweep = "Several values, separated by commas, make one run of each." if one.sweeps else ""
    limits = f"Allowed: {one.limits}." if one.limits else ""
    usual = f"Usually {one.default}." if one.default and one.kind is not FieldKind.LIST else ""
    return " ".join(part for part in (one.help, limits, usual, sweep) if part)


_PREVIEW_HEADER = (
    "Run",
    "What",
    "Capsule",
    "Lowest (mm)",
    "Highest (mm)",
    "Speed (mm/s)",
    "Rest",
    "Takes",
    "Asks before",
)


class PlanPreview(QWidget):
    """Shows a planned session; the run that is chosen in the list is drawn."""

    def __init__(self) -> None:
        super().__init__()
        self.summary = label("", "title", wrap=True)
        self.findings = label("", wrap=True)
        self.runs = table(_PREVIEW_HEADER)
        self.runs.setAccessibleName("Runs of the plan")
        self.runs.currentCellChanged.connect(lambda at, *_: self._draw(at))
        self.position = TimePlot("Position", "mm")
        self.speed = TimePlot("Speed", "mm/s")
        self.position.hide_times()
        self.position.follow(self.speed)
        self._way = self.position.line("", BLUE, 2.5)
        self._pace = self.speed.line("", PURPLE, 2.5)
        self._session: SessionPreview | None = None
        layout = column(self.summary, self.findings, self.position.widget, self.speed.widget, self.runs, margin=8)
        for place, share in ((2, 3), (3, 2), (4, 3)):
            layout.setStretch(place, share)
        self.setLayout(layout)

    def show_session(self, session: SessionPreview) -> None:
        """Show what a plan would do."""
        self._session = session
        count = len(session.runs)
        self.summary.setText(
            f"{count} run{'' if count == 1 else 's'}, {duration_text(session.duration_s)}, "
            f"{size_text(session.size_bytes)} of {size_text(session.free_bytes)} free"
        )
        fine = not session.findings
        limits = f"stage limits {session.lowest_mm:g} to {session.highest_mm:g} mm"
        self.findings.setText(
            f"Nothing forbids it; {limits}." if fine else "\n".join(f"NOT ALLOWED: {one}." for one in session.findings)
        )
        set_role(self.findings, "fine" if fine else "wrong")
        fill_table(
            self.runs,
            [
                (
                    str(one.index),
                    one.summary,
                    one.capsule,
                    f"{one.lowest_mm:g}",
                    f"{one.highest_mm:g}",
                    f"{one.speed_mm_s:g}",
                    duration_text(one.wait_s) if one.wait_s else "none",
                    duration_text(one.duration_s),
                    one.prompt,
                )
                for one in session.runs
            ],
        )
        self.position.forget_levels()
        for level, words in ((session.lowest_mm, "lower limit"), (session.highest_mm, "upper limit")):
            self.position.level(level, words)
        if count:
            self.runs.setCurrentCell(0, 0)
            self._draw(0)

    def refuse(self, sentence: str) -> None:
        """Say why there is nothing to show."""
        self.summary.setText("This plan cannot be used yet")
        self.findings.setText(sentence)
        set_role(self.findings, "wrong")

    def _draw(self, at: int) -> None:
        if self._session is None or not 0 <= at < len(self._session.runs):
            return
        time, position, speed = self._session.runs[at].course()
        self._way.points(time, position)
        self._pace.points(time, speed)
        self.position.fit()
        self.speed.fit()


_EDIT_DELAY_MS = 250
_SIMULATED_PACES: dict[str, Pace] = {"as fast as the real rig": "real", "as fast as it can": "fast"}
_DOUBLE_PACES: dict[str, Pace] = {"as fast as the real rig": "real", "5 times faster": 5.0, "20 times faster": 20.0}


class NewSession(QWidget):
    """Edits a session; `preview_session` and `refused` tell what it would do, a moment after every change."""

    planned = Signal(object)
    refused = Signal(str)
    wanted = Signal(bool)
    """It is to be put into the queue; true when it is to be started as well."""

    def __init__(self, rig: RigSelection, words: RigDescription, lab: Path | None, remembered: StoredSettings) -> None:
        super().__init__()
        self._rig, self._words, self._remembered = rig, words, remembered
        self._form: PlanForm | None = None
        self._offered: dict[str, PlanForm] = {}
        self.session: SessionPreview | None = None
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
        self._paces = _allowed_paces(rig, words)
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
        self.editor.changed.connect(lambda: self._settle.start(_EDIT_DELAY_MS))
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
            return plan_form(str(self.plans.currentData())).plan
        return self._form.filled(self.editor.values())

    def look(self) -> None:
        """Look at what the session would do."""
        self._settle.stop()
        self.session = None
        try:
            self.session = preview_session(self.plan(), self._rig)
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
            form = self._offered.get(name) or plan_form(name)
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


def _allowed_paces(rig: RigSelection, words: RigDescription) -> dict[str, Pace]:
    """Return the paces that this rig may have, by their names; the one asked for among them."""
    if words.real:
        return {}
    known = _DOUBLE_PACES if words.title == "DOUBLE" else _SIMULATED_PACES
    asked = rig.pace
    return {**known, f"{asked:g} times faster": asked} if isinstance(asked, int | float) else known
