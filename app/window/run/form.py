"""The form of a plan: one step at a time, every key with its unit, range and help."""

from PySide6.QtCore import QSignalBlocker, Qt, Signal
from PySide6.QtWidgets import QCheckBox, QComboBox, QFormLayout, QLineEdit, QPlainTextEdit, QScrollArea, QWidget

from dragrig.plan_forms import FieldKind, FormField, PlanForm, StepForm
from dragrig.window.widgets import column, label

USUAL = "the usual"
Editor = QLineEdit | QPlainTextEdit | QComboBox | QCheckBox


class PlanEditor(QWidget):
    """Edits the steps of a plan; `changed` after every change."""

    changed = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.steps = QComboBox()
        self.steps.setAccessibleName("Step of the plan")
        self.steps.currentIndexChanged.connect(self._show_step)
        self.about = label("", "faint", wrap=True)
        self.editors: dict[str, Editor] = {}
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
        self._values = [_all_values(step) for step in form.steps]
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
                editor.setCurrentText(text or USUAL)
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
            name.setToolTip(_told(one))
            layout.addRow(name, self.editors[one.key])
        inner.setLayout(layout)
        self._scroll.setWidget(inner)

    def _keep(self) -> None:
        if self._shown >= 0:
            self._values[self._shown] = {key: _text_of(editor) for key, editor in self.editors.items()}

    def _editor(self, one: FormField, text: str) -> Editor:
        editor: Editor
        match one.kind:
            case FieldKind.CHOICE:
                editor = QComboBox()
                editor.addItems([*([] if one.default else [USUAL]), *one.choices])
                editor.setCurrentText(text or USUAL)
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
                editor.setPlaceholderText("needed" if one.required else USUAL)
                editor.textChanged.connect(lambda _: self.changed.emit())
        editor.setToolTip(_told(one))
        editor.setAccessibleName(one.name)
        editor.setAccessibleDescription(_told(one))
        return editor


def _all_values(step: StepForm) -> dict[str, str]:
    return {one.key: step.values.get(one.key, one.default) for one in step.fields}


def _text_of(editor: Editor) -> str:
    match editor:
        case QComboBox():
            return editor.currentText() if editor.currentText() != USUAL else ""
        case QCheckBox():
            return "yes" if editor.isChecked() else "no"
        case QPlainTextEdit():
            return editor.toPlainText()
        case _:
            return editor.text()


def _told(one: FormField) -> str:
    sweep = "Several values, separated by commas, make one run of each." if one.sweeps else ""
    limits = f"Allowed: {one.limits}." if one.limits else ""
    usual = f"Usually {one.default}." if one.default and one.kind is not FieldKind.LIST else ""
    return " ".join(part for part in (one.help, limits, usual, sweep) if part)
