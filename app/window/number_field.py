"""The field of one number: whatever the desktop's language, the number that it gives is the text that it shows."""

from decimal import Decimal

from PySide6.QtCore import QSize, Signal
from PySide6.QtGui import QShowEvent
from PySide6.QtWidgets import QAbstractSpinBox, QLabel

from dragrig.config import NumberRange, SettingsError, number_text, read_number
from dragrig.window.widgets import label, named, set_role

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
