"""Forms in the window: an editor for every field of a schema, what is wrong below it, what was changed beside it.

The number in a field of its own is, whatever the desktop's language, the text that the field shows.
"""

from collections.abc import Mapping, Sequence
from decimal import Decimal

from PySide6.QtCore import QSize, Qt, Signal
from PySide6.QtGui import QShowEvent
from PySide6.QtWidgets import (
    QAbstractSpinBox,
    QCheckBox,
    QComboBox,
    QFormLayout,
    QLabel,
    QLineEdit,
    QPlainTextEdit,
    QWidget,
)

from dragrig.config import NumberRange, SettingsError, number_text, read_number
from dragrig.views import FieldKind, FieldPlace, Form, FormField
from dragrig.window.widgets import bare_widget, column, label, named, row, set_role

DEFAULT_TEXT = "default"
CHANGED_MARK = " ●"
"""Beside the name of a field that was changed."""
_MIN_TEXT_PX = 240
_SENTENCES = frozenset({"prompt", "note"})
"""Keys of texts that are longer than a line."""
FieldEditor = QLineEdit | QPlainTextEdit | QComboBox | QCheckBox


class FormEditor(QWidget):
    """Edits a form, one group of fields at a time; `changed` after every change by a person.

    What `mark` is told of a field is shown beside its name and below it.

    Parameters
    ----------
    explains
        Whether the meaning of each field stands beside it; otherwise only its tooltip has it.
    """

    changed = Signal()

    def __init__(self, *, explains: bool = False) -> None:
        super().__init__()
        self._explains = explains
        self.about = label("", "faint", wrap=True)
        self.editors: dict[str, FieldEditor] = {}
        self.captions: dict[str, QLabel] = {}
        self.problems: dict[str, QLabel] = {}
        self._form: Form | None = None
        self._values: list[dict[str, str]] = []
        self.shown = -1
        """Number of the group that is shown; −1 for none."""
        self._invalid: dict[FieldPlace, str] = {}
        self._changes: dict[FieldPlace, str] = {}
        self._fields = bare_widget(column())
        self._rows = column(self.about, self._fields)
        self.setLayout(self._rows)

    def edit(self, form: Form, values: Sequence[Mapping[str, str]] | None = None, group: int = 0) -> None:
        """Show a group of a form, with these values or its own."""
        self._form, self.shown = form, -1
        self._values = [dict(texts) for texts in (form.values() if values is None else values)]
        self._invalid, self._changes = {}, {}
        self.show_group(group)

    def values(self) -> list[dict[str, str]]:
        """Return the values of every group as text."""
        self._keep()
        return [dict(values) for values in self._values]

    def put(self, key: str, text: str) -> None:
        """Fill a field of the group that is shown."""
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

    def mark(self, invalid: Mapping[FieldPlace, str], changes: Mapping[FieldPlace, str]) -> None:
        """Say below a field what is wrong with it, and beside its name that it was changed, with what it was."""
        self._invalid, self._changes = dict(invalid), dict(changes)
        if self._form is None or self.shown < 0:
            return
        for field in self._form.groups[self.shown].fields:
            place = self.shown, field.key
            problem, change = self._invalid.get(place, ""), self._changes.get(place)
            self.problems[field.key].setText(problem)
            self.problems[field.key].setVisible(bool(problem))
            caption = self.captions[field.key]
            caption.setText(f"{field_label(field)}{'' if change is None else CHANGED_MARK}")
            caption.setToolTip(_field_help(field) if change is None else f"Changed: {change}. {_field_help(field)}")
            set_role(caption, "wrong" if problem else "changed" if change is not None else "")

    def show_group(self, index: int) -> None:
        """Show another group; what was typed in the one before is kept."""
        if self._form is None or not 0 <= index < len(self._form.groups):
            return
        self._keep()
        group, self.shown = self._form.groups[index], index
        self.about.setText(group.about)
        self.editors = {field.key: self._editor(field, self._values[index][field.key]) for field in group.fields}
        self.captions = {field.key: label(field_label(field)) for field in group.fields}
        self.problems = {field.key: label("", "wrong", wrap=True) for field in group.fields}
        inner, layout = QWidget(), QFormLayout()
        inner.setObjectName("bare")
        layout.setContentsMargins(0, 0, 8, 0)
        layout.setRowWrapPolicy(QFormLayout.RowWrapPolicy.WrapLongRows)
        for field in group.fields:
            about = [label(_field_help(field), "faint", wrap=True)] if self._explains else []
            beside = row(self.editors[field.key], *about, stretch={0: 2, 1: 3})
            beside.setAlignment(self.editors[field.key], Qt.AlignmentFlag.AlignTop)
            layout.addRow(self.captions[field.key], beside)
            layout.addRow(self.problems[field.key])
        inner.setLayout(layout)
        self._rows.replaceWidget(self._fields, inner)
        self._fields.hide()
        self._fields.deleteLater()
        self._fields = inner
        inner.show()
        self.mark(self._invalid, self._changes)

    def _keep(self) -> None:
        if self.shown >= 0:
            self._values[self.shown] = {key: _editor_text(editor) for key, editor in self.editors.items()}

    def _editor(self, field: FormField, text: str) -> FieldEditor:
        editor: FieldEditor
        match field.kind:
            case FieldKind.CHOICE:
                editor = QComboBox()
                editor.addItems([*([] if field.default else [DEFAULT_TEXT]), *map(str, field.choices)])
                editor.setCurrentText(text or DEFAULT_TEXT)
                editor.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
                editor.setMinimumContentsLength(6)
                editor.currentTextChanged.connect(lambda _: self.changed.emit())
            case FieldKind.SWITCH:
                editor = QCheckBox("yes")
                editor.setChecked(text == "yes")
                editor.toggled.connect(lambda _: self.changed.emit())
            case _ if field.kind is FieldKind.LIST or field.key in _SENTENCES:
                editor = QPlainTextEdit(text)
                editor.setPlaceholderText(field.empty)
                editor.setFixedHeight(110 if field.kind is FieldKind.LIST else 84)
                editor.setTabChangesFocus(True)
                editor.textChanged.connect(self.changed.emit)
            case _:
                editor = QLineEdit(text)
                editor.setCursorPosition(0)
                editor.setPlaceholderText("required" if field.required else field.empty)
                if field.kind is FieldKind.TEXT:
                    # Below its name rather than too short to read in a narrow form.
                    editor.setMinimumWidth(_MIN_TEXT_PX)
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


def field_label(field: FormField) -> str:
    """Return the name of a field as the form has it, with its unit."""
    return f"{field.name.capitalize()}{f' ({field.unit})' if field.unit else ''}"


def _field_help(field: FormField) -> str:
    sweep = "Several values, as 1, 5.5, 20, make a run for each value." if field.sweeps else ""
    limits = f"Allowed: {field.limits}." if field.limits else ""
    default = f"Default: {field.default}." if field.default and field.kind is not FieldKind.LIST else ""
    return " ".join(" ".join((field.help, limits, default, sweep)).split())


_USUAL_CHARACTERS = "-1000.000 "
_BUTTONS_PX = 34
StepFlag = QAbstractSpinBox.StepEnabledFlag


class NumberField(QAbstractSpinBox):
    """A number, typed or stepped; Qt's own spin boxes read a text as the desktop's language writes it.

    A text that is no allowed number stays, gives None, and is refused in `problem`, a label for a place beside the
    field. The unit may be typed too; `unit` is the label for it, behind the field.
    """

    edited = Signal()
    """After every change of the text."""
    entered = Signal(float)
    """Another number than before was typed to its end, stepped to or put."""

    def __init__(self, name: str, allowed: NumberRange, value: float, step: float = 1.0) -> None:
        super().__init__()
        named(self, name)
        self._name, self._step = name, step
        self._allowed = allowed
        self.entered_value = value
        """The last number that was allowed, for what is shown with it and moves nothing."""
        self.unit: QLabel = label(allowed.unit)
        self.problem: QLabel = label("", "wrong", wrap=True)
        self.problem.hide()
        self.lineEdit().textChanged.connect(lambda _: self._check())
        self.editingFinished.connect(self._enter)
        self.put(value)
        self.set_range(allowed)

    def value(self) -> float | None:
        """Return the number that is on the screen; None where it is none that is allowed."""
        try:
            return read_number(self.text(), self._allowed)
        except SettingsError:
            return None

    def put(self, value: float) -> None:
        """Show a number."""
        self.lineEdit().setText(number_text(value))
        self._enter()

    def set_range(self, allowed: NumberRange) -> None:
        """Allow other numbers; the text stays, and is refused where it is none of them."""
        self._allowed = allowed
        self.setToolTip(". ".join(filter(None, (self._name, f"Allowed: {allowed}" if str(allowed) else ""))))
        self._check()

    def stepBy(self, steps: int) -> None:
        """Add steps to the number, as the arrow keys and the wheel do, unless there is none or that is not allowed."""
        if (value := self._stepped(steps)) is not None:
            self.put(value)
            self.selectAll()

    def stepEnabled(self) -> StepFlag:
        """Return the directions in which a step leads to a number that is allowed."""
        up = StepFlag.StepUpEnabled if self._stepped(1) is not None else StepFlag.StepNone
        return up | (StepFlag.StepDownEnabled if self._stepped(-1) is not None else StepFlag.StepNone)

    def showEvent(self, event: QShowEvent) -> None:
        """Show what is refused from the start, as a limit that was stored and is none any more."""
        super().showEvent(event)
        self._check()

    def sizeHint(self) -> QSize:
        """Room for a usual number."""
        width = self.fontMetrics().horizontalAdvance(_USUAL_CHARACTERS) + _BUTTONS_PX
        return QSize(width, super().sizeHint().height())

    def minimumSizeHint(self) -> QSize:
        """As much as it asks for: a number that is cut off is another number."""
        return self.sizeHint()

    def _stepped(self, steps: int) -> float | None:
        value = self.value()
        if value is None:
            return None
        # In decimals: 0.1 and 0.2 are 0.3.
        reached = float(Decimal(repr(value)) + steps * Decimal(repr(self._step)))
        return None if self._allowed.why_not(reached) else reached

    def _check(self) -> None:
        problem = ""
        try:
            read_number(self.text(), self._allowed)
        except SettingsError as error:
            problem = f"{self._name}: {error}"
        if problem != self.problem.text():
            self.problem.setText(problem)
            self.setAccessibleDescription(problem)
            set_role(self, "wrong" if problem else "")
        # Nowhere yet, it would be a window of its own.
        self.problem.setVisible(bool(problem) and self.problem.parent() is not None)
        self.edited.emit()

    def _enter(self) -> None:
        """Write a number out as it is, with the point that is everywhere else; tell of another one."""
        value = self.value()
        if value is None:
            return
        if (text := number_text(value)) != self.text():
            self.lineEdit().setText(text)
        if value != self.entered_value:
            self.entered_value = value
            self.entered.emit(value)
