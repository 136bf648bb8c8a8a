"""The next session: its plan as a form, operator and pace, and a preview of what it will do."""

from pathlib import Path

from PySide6.QtCore import QSignalBlocker, Qt, QTimer, Signal
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QFormLayout,
    QLineEdit,
    QPlainTextEdit,
    QWidget,
)

from dragrig.config import DragrigError, Plan
from dragrig.engine_host import Pace, RigSelection
from dragrig.present import BLUE, PURPLE, duration_text, size_text
from dragrig.views import (
    FieldKind,
    FormField,
    PlanForm,
    RigDescription,
    SessionPreview,
    known_plans,
    motion_curves,
    plan_form,
    preview_session,
)
from dragrig.window.plots import TimePlot
from dragrig.window.widgets import (
    ElidedLabel,
    MessageText,
    StoredSettings,
    bare_widget,
    button,
    card,
    choose_path,
    column,
    fill_table,
    label,
    named,
    row,
    scrolling,
    set_role,
    table,
)

DEFAULT_TEXT = "default"
FieldEditor = QLineEdit | QPlainTextEdit | QComboBox | QCheckBox


class PlanEditor(QWidget):
    """Edits the steps of a plan; `changed` after every change."""

    changed = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.steps = named(QComboBox(), "Step of the plan")
        self.steps.currentIndexChanged.connect(self._show_step)
        self.about = label("", "faint", wrap=True)
        self.editors: dict[str, FieldEditor] = {}
        self._form: PlanForm | None = None
        self._values: list[dict[str, str]] = []
        self._shown = -1
        self._fields = bare_widget(column())
        self._rows = column(self.steps, self.about, self._fields)
        self.setLayout(self._rows)

    def edit(self, form: PlanForm) -> None:
        """Show a plan."""
        self._form, self._shown = form, -1
        self._values = [
            {field.key: step.values.get(field.key, field.default) for field in step.fields} for step in form.steps
        ]
        with QSignalBlocker(self.steps):
            self.steps.clear()
            self.steps.addItems(
                [f"Step {number} of {len(form.steps)}: {step.kind}" for number, step in enumerate(form.steps, 1)]
            )
        self.steps.setVisible(len(form.steps) > 1)
        self._show_step(0)

    def values(self) -> list[dict[str, str]]:
        """Return the values of every step as text."""
        self._keep()
        return [dict(values) for values in self._values]

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

    def _show_step(self, index: int) -> None:
        if self._form is None or not 0 <= index < len(self._form.steps):
            return
        self._keep()
        step, self._shown = self._form.steps[index], index
        self.about.setText(step.about)
        self.editors = {field.key: self._editor(field, self._values[index][field.key]) for field in step.fields}
        inner, layout = QWidget(), QFormLayout()
        inner.setObjectName("bare")
        layout.setContentsMargins(0, 0, 8, 0)
        layout.setRowWrapPolicy(QFormLayout.RowWrapPolicy.WrapLongRows)
        for field in step.fields:
            name = label(f"{field.name.capitalize()}{f' ({field.unit})' if field.unit else ''}")
            name.setToolTip(_field_help(field))
            layout.addRow(name, self.editors[field.key])
        inner.setLayout(layout)
        self._rows.replaceWidget(self._fields, inner)
        self._fields.deleteLater()
        self._fields = inner

    def _keep(self) -> None:
        if self._shown >= 0:
            self._values[self._shown] = {key: _editor_text(editor) for key, editor in self.editors.items()}

    def _editor(self, field: FormField, text: str) -> FieldEditor:
        editor: FieldEditor
        match field.kind:
            case FieldKind.CHOICE:
                editor = QComboBox()
                editor.addItems([*([] if field.default else [DEFAULT_TEXT]), *field.choices])
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
                editor.setPlaceholderText("required" if field.required else DEFAULT_TEXT)
                editor.textChanged.connect(lambda _: self.changed.emit())
        editor.setToolTip(_field_help(field))
        editor.setAccessibleName(field.name)
        editor.setAccessibleDescription(_field_help(field))
        return editor


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


def _field_help(field: FormField) -> str:
    sweep = "Several values, separated by commas, make a run for each value." if field.sweeps else ""
    limits = f"Allowed: {field.limits}." if field.limits else ""
    default = f"Default: {field.default}." if field.default and field.kind is not FieldKind.LIST else ""
    return " ".join(part for part in (field.help, limits, default, sweep) if part)


_PREVIEW_HEADER = (
    "Run",
    "Protocol",
    "Capsule",
    "Position (mm)",
    "Speed (mm/s)",
    "Wait before",
    "Duration",
    "Prompt before",
)


class PlanPreview(QWidget):
    """Preview of a planned session, with the motion of the selected run."""

    def __init__(self) -> None:
        super().__init__()
        self.summary = ElidedLabel("", "title")
        self.findings = MessageText()
        self.runs = named(table(_PREVIEW_HEADER), "Runs of the plan")
        self.runs.currentCellChanged.connect(lambda index, *_: self._draw(index))
        self.position = TimePlot("Position", "mm")
        self.speed = TimePlot("Speed", "mm/s")
        self.position.hide_times()
        self.position.follow(self.speed)
        self._position_line = self.position.line("", BLUE, 2.5)
        self._speed_line = self.speed.line("", PURPLE, 2.5)
        self._session: SessionPreview | None = None
        layout = column(
            self.summary,
            self.findings,
            self.position.widget,
            self.speed.widget,
            self.runs,
            margin=8,
            stretch={2: 3, 3: 2, 4: 3},
        )
        self.setLayout(layout)

    def show_session(self, session: SessionPreview) -> None:
        """Show the preview of a session."""
        preflight = session.preflight
        self._session = session
        count = len(preflight.previews)
        self.summary.setText(
            f"{count} run{'' if count == 1 else 's'}, {duration_text(preflight.duration_s)}, "
            f"{size_text(preflight.size_bytes)} on disk, {size_text(preflight.free_bytes)} free"
        )
        if preflight.findings:
            self.findings.setText("\n".join(f"NOT ALLOWED: {finding}." for finding in preflight.findings))
        else:
            limits = f"stage limits {session.lowest_mm:g} to {session.highest_mm:g} mm"
            self.findings.setText(f"Plan OK, within limits; {limits}.")
        set_role(self.findings, "wrong" if preflight.findings else "fine")
        rows = [
            (
                str(preview.run.index),
                preview.run.protocol.summary(),
                preview.run.capsule.name,
                f"{preview.lowest_mm:g} to {preview.highest_mm:g}",
                f"{preview.speed_mm_s:g}",
                duration_text(preview.run.wait_s) if preview.run.wait_s else "none",
                duration_text(preview.run.duration_s),
                preview.run.prompt,
            )
            for preview in preflight.previews
        ]
        fill_table(self.runs, rows)
        self.position.remove_levels()
        for level, name in ((session.lowest_mm, "lower limit"), (session.highest_mm, "upper limit")):
            self.position.level(level, name)
        if count:
            self.runs.setCurrentCell(0, 0)
            self._draw(0)

    def refuse(self, sentence: str) -> None:
        """Show why the plan cannot be used."""
        self.summary.setText("This plan cannot be used yet")
        self.findings.setText(sentence)
        set_role(self.findings, "wrong")

    def _draw(self, index: int) -> None:
        previews = () if self._session is None else self._session.preflight.previews
        if 0 <= index < len(previews):
            time, position, speed = motion_curves(previews[index])
            self._position_line.points(time, position)
            self._speed_line.points(time, speed)
            self.position.fit()
            self.speed.fit()


_EDIT_DELAY_MS = 250
_SIMULATED_PACES: dict[str, Pace] = {"as fast as the real rig": "real", "as fast as possible": "fast"}
_DOUBLE_PACES: dict[str, Pace] = {"as fast as the real rig": "real", "5 times faster": 5.0, "20 times faster": 20.0}


class NewSession(QWidget):
    """Form of the next session; every change emits `planned` with its preview, or `refused` with the reason."""

    planned = Signal(object)
    refused = Signal(str)
    submitted = Signal(bool)
    """Append the session to the queue; True to start it."""

    def __init__(
        self, rig: RigSelection, description: RigDescription, lab: Path | None, stored: StoredSettings
    ) -> None:
        super().__init__()
        self._rig, self._description, self._stored = rig, description, stored
        self._form: PlanForm | None = None
        self._offered: dict[str, PlanForm] = {}
        self.session: SessionPreview | None = None
        self.plans = named(QComboBox(), "Plan")
        for name in known_plans(None if lab is None else lab.absolute()):
            self.plans.addItem(Path(name).stem if name.endswith(".toml") else name, name)
        self.open = button("&Open …", self._choose_file, help_="Open a plan file")
        self.editor = PlanEditor()
        self.operator = QLineEdit(stored.text("operator"))
        self.note = QLineEdit()
        self.mirror = QLineEdit(stored.text("mirror"))
        self.mirror.setPlaceholderText("no mirror")
        self.mirror.setToolTip("A folder on another disk; each finished file is copied to it and verified")
        self.choose_mirror = button("&Folder …", self._choose_mirror, help_="Choose the mirror folder")
        self.pace = QComboBox()
        self._paces = _allowed_paces(rig, description)
        self.pace.addItems(list(self._paces))
        self._choose_pace(rig.pace)
        self.queue = button("Add to &queue", lambda: self.submitted.emit(False), help_="Append to the queue")
        self.start = button(
            "&Start", lambda: self.submitted.emit(True), "main", "Append to the queue and start", "Ctrl+Return"
        )
        self._lay_out()
        self._edit_timer = QTimer(self)
        self._edit_timer.setSingleShot(True)
        self._edit_timer.timeout.connect(self.update_preview)
        self.editor.changed.connect(lambda: self._edit_timer.start(_EDIT_DELAY_MS))
        self.plans.currentIndexChanged.connect(lambda _: self._load(str(self.plans.currentData())))

    @property
    def chosen_pace(self) -> Pace | None:
        """Pace of a simulated rig or a double."""
        return self._paces.get(self.pace.currentText())

    @property
    def chosen_mirror(self) -> Path | None:
        """Folder that finished files are copied to."""
        text = self.mirror.text().strip()
        return Path(text).expanduser() if text else None

    def begin(self) -> None:
        """Show the plan used last, or the first."""
        last = self._stored.text("plan", "drag")
        with QSignalBlocker(self.plans):
            if self.plans.findData(last) < 0 and Path(last).is_file():
                self.plans.addItem(Path(last).stem, last)
            self.plans.setCurrentIndex(max(self.plans.findData(last), 0))
        self._load(str(self.plans.currentData()))

    def offer(self, name: str, plan: PlanForm) -> None:
        """Show a plan from another page; it stays selectable as long as the window is open."""
        self._offered[name] = plan
        with QSignalBlocker(self.plans):
            if self.plans.findData(name) < 0:
                self.plans.addItem(plan.plan.name, name)
            self.plans.setCurrentIndex(self.plans.findData(name))
        self._edit(plan)

    def plan(self) -> Plan:
        """Return the plan in the form; raises `DragrigError`."""
        if self._form is None:
            return plan_form(str(self.plans.currentData())).plan
        return self._form.filled(self.editor.values())

    def update_preview(self) -> None:
        """Preview the session."""
        self._edit_timer.stop()
        self.session = None
        try:
            self.session = preview_session(self.plan(), self._rig)
        except DragrigError as error:
            self.refused.emit(str(error))
        else:
            self.planned.emit(self.session)
        allowed = self.session is not None and not self.session.preflight.findings
        self.start.setEnabled(allowed)
        self.queue.setEnabled(allowed)

    def keep(self) -> None:
        """Store the choices for the next start."""
        if (plan := str(self.plans.currentData())) not in self._offered:
            self._stored.keep("plan", plan)
        self._stored.keep("operator", self.operator.text())
        self._stored.keep("mirror", self.mirror.text().strip())
        if self._paces:
            self._stored.keep(f"pace, {self._description.title}", self.pace.currentText())

    def _lay_out(self) -> None:
        form = QFormLayout()
        form.setRowWrapPolicy(QFormLayout.RowWrapPolicy.WrapLongRows)
        form.addRow("Operator", named(self.operator, "Operator"))
        form.addRow("Note", named(self.note, "Note"))
        if self._paces:
            form.addRow("Pace", named(self.pace, "Pace"))
        mirror = named(self.mirror, "Mirror folder")
        form.addRow("Mirror folder", row(mirror, self.choose_mirror, stretch={0: 1}))
        self.plans.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
        self.plans.setMinimumContentsLength(8)
        header = row(label("Plan"), self.plans, self.open, stretch={1: 1})
        inside = bare_widget(column(self.editor, form, 1))
        inside.setObjectName("bare")
        fields = scrolling(inside)
        fields.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        buttons = row(1, self.queue, self.start)
        self.setLayout(column(card(column(header, fields, buttons, stretch={1: 1}))))
        self.setMinimumWidth(330)

    def _choose_pace(self, pace: Pace | None) -> None:
        """Select the pace of the command line, else that used last."""
        name = next((text for text, known in self._paces.items() if known == pace), "")
        index = self.pace.findText(name or self._stored.text(f"pace, {self._description.title}"))
        self.pace.setCurrentIndex(max(index, 0))

    def _choose_file(self) -> None:
        start = self._stored.text("plan folder")
        choose_path(self, "Open a plan", start, self.open_file, filter_="Plans (*.toml)", folder=False)

    def _choose_mirror(self) -> None:
        choose_path(self, "Mirror folder", self.mirror.text(), self.mirror.setText)

    def open_file(self, path: str) -> None:
        """Choose a plan by its file."""
        self._stored.keep("plan folder", str(Path(path).parent))
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
        self.update_preview()


def _allowed_paces(rig: RigSelection, description: RigDescription) -> dict[str, Pace]:
    """Return the paces of this rig by name, including that of the command line."""
    if description.real:
        return {}
    known = _DOUBLE_PACES if description.title == "DOUBLE" else _SIMULATED_PACES
    pace = rig.pace
    return {**known, f"{pace:g} times faster": pace} if isinstance(pace, int | float) else known
