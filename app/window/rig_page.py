"""The page of the rig: its settings, edited and saved to the lab, and the calibration of its sensors."""

from collections.abc import Callable, Mapping

from PySide6.QtCore import QSignalBlocker, Signal
from PySide6.QtWidgets import QComboBox, QListWidget, QWidget

from dragrig import engine_host
from dragrig.config import ANY_NUMBER, Calibration, DragrigError, NumberRange, SettingsError
from dragrig.settings_form import RigSettingsForm, rig_settings_form
from dragrig.views import (
    FieldKind,
    FieldPlace,
    Form,
    FormField,
    FormGroup,
    RigDescription,
    first_key_named,
    parse_field,
    within_rig,
)
from dragrig.window.forms import CHANGED_MARK, FormEditor
from dragrig.window.widgets import (
    DocumentView,
    MessageText,
    bare_widget,
    button,
    card,
    column,
    label,
    named,
    row,
    scrolling,
    set_role,
    tabs_of,
)

NO_LAB = "There is no lab folder: make one with dragrig init, and open the window there."


class SettingsView(QWidget):
    """The lab's rig settings, table by table of their file."""

    saved = Signal(str)
    """What of it applies only later; empty for nothing."""

    def __init__(self, rig: engine_host.RigSelection) -> None:
        super().__init__()
        self._rig = rig
        self._form: RigSettingsForm | None = None
        self.groups = named(QListWidget(), "Groups of settings")
        self.groups.setMaximumWidth(_GROUPS_PX)
        self.groups.currentRowChanged.connect(self._show_group)
        self.heading = label("", "title")
        self.editor = FormEditor(explains=True)
        self.editor.changed.connect(self._show_state)
        self.state = MessageText(most_lines=2)
        self.problem = MessageText("wrong", most_lines=2)
        self.changes = MessageText(most_lines=2)
        self.undo = button("&Undo changes", self.read, help_="Show the settings as they are in the file")
        self.save = button("Sa&ve", self._save, "main", "Write the changes to the lab's rig file")
        fields = scrolling(column(self.editor, 1), across=False)
        right = column(self.heading, fields, self.changes, self.problem, stretch={1: 1})
        self.setLayout(
            column(
                row(self.groups, right, stretch={0: 2, 1: 5}),
                row(self.state, self.undo, self.save, stretch={0: 1}),
                margin=8,
                stretch={0: 1},
            )
        )
        self.read()

    @property
    def in_lab(self) -> bool:
        """Whether there is a lab folder, whose settings can be changed."""
        return self._form is not None and self._form.path is not None

    def read(self) -> None:
        """Show the settings as they are in the file."""
        try:
            form = self._form = rig_settings_form(self._rig.rig)
        except SettingsError as error:
            self._form = None
            self.state.setText(str(error))
            self._show_state()
            return
        chosen = max(self.groups.currentRow(), 0)
        with QSignalBlocker(self.groups):
            self.groups.clear()
            self.groups.addItems([self._list_text(number) for number in range(len(form.groups))])
            self.groups.setCurrentRow(min(chosen, len(form.groups) - 1))
        self.editor.edit(form, group=self.groups.currentRow())
        self.editor.setEnabled(self.in_lab)
        self.state.setText(self._source_text(form))
        self._show_group(self.groups.currentRow())

    def _source_text(self, form: RigSettingsForm) -> str:
        if form.path is None:
            return f"These are the settings that ship with dragrig. {NO_LAB}"
        assigned = [text for text in self._rig.assignments if text.startswith("rig.")]
        beside = f" The command line adds to them: {', '.join(assigned)}." if assigned else ""
        return f"{form.path}{beside}"

    def _list_text(self, number: int, mark: str = "") -> str:
        if self._form is None:
            return ""
        *outer, last = self._form.groups[number].name.replace("_", " ").split(".")
        return f"{_INDENT * len(outer)}{last.capitalize()}{mark}"

    def _show_group(self, number: int) -> None:
        if self._form is not None and number >= 0:
            self.heading.setText(self._form.title(number))
            self.editor.show_group(number)
        self._show_state()

    def _show_state(self) -> None:
        form = self._form
        problems: Mapping[FieldPlace, str] = {}
        changes: Mapping[FieldPlace, str] = {}
        if form is not None:
            values = self.editor.values()
            problems, changes = form.problems(values), form.changes(values)
            self.editor.mark(problems, changes)
            marked = {number for number, _ in (*problems, *changes)}
            for number in range(len(form.groups)):
                self.groups.item(number).setText(self._list_text(number, CHANGED_MARK if number in marked else ""))
            told = [f"{self._field_name(form, place)}: {problem}" for place, problem in problems.items()]
            self.problem.setText(told[0] if told else "")
            self.changes.setText(
                f"Changed: {'; '.join(f'{self._field_name(form, place)} {text}' for place, text in changes.items())}."
            )
        self.problem.setVisible(bool(problems))
        self.changes.setVisible(bool(changes))
        self.save.setEnabled(bool(changes) and not problems)
        self.undo.setEnabled(bool(changes) or form is None)

    def _field_name(self, form: RigSettingsForm, place: FieldPlace) -> str:
        return f"{form.title(place[0])}: {form.field_name(place)}"

    def _save(self) -> None:
        if self._form is None:
            return
        before = self._form.settings
        try:
            settings = self._form.save(self.editor.values())
        except DragrigError as error:
            self.problem.setText(str(error))
            self.problem.show()
            return
        self.read()
        other = settings.backend != before.backend
        self.saved.emit("The backend is another one when the window is opened again." if other else "")


_GROUPS_PX = 240
_INDENT = "    "


def _calibration_field(
    key: str, name: str, help_: str, kind: FieldKind, allowed: NumberRange = ANY_NUMBER, default: str = ""
) -> FormField:
    return FormField(key, name, help_, kind, allowed, default, empty="")


_COUNT, _DURATION = NumberRange(whole=True), NumberRange("s")
_REPEATS, _NOTE = (
    _calibration_field("repeats", "repeats", "How often it is measured", FieldKind.NUMBER, _COUNT, "3"),
    _calibration_field("note", "note", "Stored with the result", FieldKind.TEXT),
)
_FORCE = FormGroup(
    "force sensor",
    "You are asked to hang each weight on the sensor, which is read then; a line is fitted. Nothing moves.",
    (
        _calibration_field(
            "weights", "weights", "At least three, as 0, 20.5, 50; 0 is the empty sensor",
            FieldKind.NUMBERS, NumberRange("g"),
        ),
        _calibration_field("repeats", "repeats", "Series, up and down alternately", FieldKind.NUMBER, _COUNT, "1"),
        _calibration_field("seconds", "reading", "Duration of each reading", FieldKind.NUMBER, _DURATION, "2"),
        _NOTE,
    ),
    {"weights": "0, 20, 50, 100"},
)  # fmt: skip
_ENCODER = FormGroup(
    "encoder",
    "The stage goes a known travel, there and back, or you push it against a gauge; a line is fitted to the counts.",
    (
        _calibration_field(
            "travel_mm", "travel", "Signed; each stroke is announced first", FieldKind.NUMBER, NumberRange("mm")
        ),
        _calibration_field(
            "measured_mm", "measured", "What a gauge showed for every repeat, as 50.1, 49.9; or nothing",
            FieldKind.NUMBERS, NumberRange("mm"),
        ),
        _REPEATS,
        _calibration_field("speed_mm_s", "speed", "Speed of the travel", FieldKind.NUMBER, NumberRange("mm/s"), "10"),
        _calibration_field("by_hand", "pushed by hand", "The stage is switched off", FieldKind.SWITCH, default="no"),
        _calibration_field("seconds", "time for a push", "By hand only", FieldKind.NUMBER, _DURATION, "20"),
        _NOTE,
    ),
    {"travel_mm": "50"},
)  # fmt: skip
_CALIBRATIONS = Form(groups=(_FORCE, _ENCODER))


class CalibrateView(QWidget):
    """Calibrates force sensor or encoder; the result is shown, and stored when the person says so."""

    finished = Signal(str)
    """What came of it, for the log."""

    def __init__(
        self, ask: Callable[[engine_host.Request], None], stop: Callable[[], None], operator: Callable[[], str]
    ) -> None:
        super().__init__()
        self._ask, self._operator = ask, operator
        self.busy = False
        """Whether a calibration is under way."""
        self._idle = self._armed = self._in_lab = False
        self._entry: Calibration | None = None
        self._problems: dict[FieldPlace, str] = {}
        self._form = _CALIBRATIONS
        self.sensor = named(QComboBox(), "Sensor to calibrate")
        self.sensor.addItems([group.name.capitalize() for group in _CALIBRATIONS.groups])
        self.editor = FormEditor()
        self.editor.edit(self._form)
        self.sensor.currentIndexChanged.connect(self._choose)
        self.editor.changed.connect(self._edited)
        self.start = button("S&tart", self._start, "main", "Begin; questions are asked above the page")
        self.cancel = button("Ca&ncel", stop, help_="End it at once; nothing is stored")
        self.state = MessageText(most_lines=4)
        self.record = DocumentView()
        self.store = button("St&ore", self._store, "main", "Add it to the lab's history; it applies from then on")
        self.discard = button("Discar&d", self._discard, help_="Forget the result")
        fields = scrolling(column(self.editor, 1), across=False)
        left = card(column(self.sensor, fields, row(1, self.cancel, self.start), stretch={1: 1}))
        self.deciding = bare_widget(row(1, self.discard, self.store))
        right = bare_widget(column(self.state, self.record, self.deciding, 0, margin=8, stretch={1: 1, 3: 1}))
        self.setLayout(row(left, right, stretch={0: 1, 1: 2}))
        self._say("The result is shown before it is stored.")
        self._discard_record()
        self._show_state()

    def set_limits(self, rig: RigDescription) -> None:
        """Refuse speeds beyond the rig's limit."""
        self._form = within_rig(_CALIBRATIONS, rig)
        self.editor.edit(self._form, self.editor.values(), self.editor.shown)
        self._show_state()

    def allow(self, *, idle: bool, armed: bool, in_lab: bool) -> None:
        """Allow calibrations while nothing else is done; one that moves the stage with the guard armed."""
        self._idle, self._armed, self._in_lab = idle, armed, in_lab
        if not in_lab:
            self._say(f"A calibration is stored in the lab. {NO_LAB}")
        self._show_state()

    def show_result(self, result: engine_host.CalibrationMeasured) -> None:
        """Show what was measured, to be stored or not; or why nothing was."""
        self.busy, self._entry = False, result.entry
        if result.record is None:
            number = self.editor.shown
            key = first_key_named(self._form.groups[number], result.problem)
            if key is not None:
                self._problems = {(number, key): result.problem}
            self._say(f"Not calibrated: {result.problem}", wrong=True)
            self.finished.emit(f"Not calibrated: {result.problem}")
        else:
            self.record.show_document(result.record)
            self.record.show()
            self.deciding.show()
            self._say("Look at the residuals, then store it or discard it.")
            self.finished.emit(f"Calibration measured: {result.record.title}.")
        self._show_state()

    def show_stored(self, stored: engine_host.CalibrationStored) -> None:
        """Show that the result is stored, or why not."""
        entry = self._entry
        if stored.problem or entry is None:
            self._say(f"Not stored: {stored.problem}", wrong=True)
            return
        self._entry = None
        self.deciding.hide()
        self._say(f"Stored as {entry.id} in the lab's history; it applies from now on.")
        self.finished.emit(f"Calibration stored: {entry.id}.")

    def end(self, sentence: str) -> None:
        """End a calibration whose engine is gone."""
        if self.busy:
            self.busy = False
            self._say(sentence, wrong=True)
        self._show_state()

    def _choose(self, number: int) -> None:
        self._problems = {}
        self.editor.show_group(number)
        self._show_state()

    def _edited(self) -> None:
        self._problems = {}
        self._show_state()

    def _show_state(self) -> None:
        number = self.editor.shown
        invalid = {place: text for place, text in self._form.misread(self.editor.values()).items()
                   if place[0] == number}  # fmt: skip
        self.editor.mark({**self._problems, **invalid}, {})
        moves = number == _CALIBRATIONS.groups.index(_ENCODER)
        ready = self._idle and self._in_lab and not self.busy and (self._armed or not moves)
        self.start.setEnabled(ready and not invalid)
        self.cancel.setEnabled(self.busy)
        self.sensor.setEnabled(not self.busy)
        self.editor.setEnabled(not self.busy)

    def _start(self) -> None:
        try:
            job = self._job()
        except SettingsError as error:
            key, _, problem = str(error).partition(": ")
            self._problems = {(self.editor.shown, key): problem}
            self._show_state()
            return
        self._problems = {}
        self._discard_record()
        self.busy = True
        self._say("Answer what is asked above. Cancel, STOP and Escape end it at once, and nothing is stored.")
        self._show_state()
        self._ask(job)

    def _job(self) -> engine_host.CalibrationJob:
        group = self._form.groups[self.editor.shown]
        texts = self.editor.values()[self.editor.shown]
        fields = {field.key: field for field in group.fields}

        def numbers(key: str) -> tuple[float, ...]:
            value = parse_field(fields[key], texts[key].strip() or fields[key].default, group.name)
            return tuple(value) if isinstance(value, list) else (value,) if isinstance(value, int | float) else ()

        def number(key: str) -> float:
            if not (one := numbers(key)):
                raise SettingsError(f"{key}: is needed.")
            return one[0]

        terms = {"operator": self._operator(), "note": texts["note"].strip()}
        repeats, seconds = int(number("repeats")), number("seconds")
        if group.name == _FORCE.name:
            return engine_host.CalibrateForce(numbers("weights"), repeats, seconds, **terms)
        return engine_host.CalibrateEncoder(
            number("travel_mm"),
            numbers("measured_mm"),
            repeats,
            number("speed_mm_s"),
            texts["by_hand"] == "yes",
            seconds,
            **terms,
        )

    def _store(self) -> None:
        if self._entry is not None:
            self._ask(engine_host.StoreCalibration(self._entry))

    def _discard(self) -> None:
        self._discard_record()
        self._say("Discarded; the calibration before still applies.")

    def _discard_record(self) -> None:
        self._entry = None
        self.record.hide()
        self.deciding.hide()

    def _say(self, sentence: str, *, wrong: bool = False) -> None:
        self.state.setText(sentence)
        set_role(self.state, "wrong" if wrong else "")


class RigPage(QWidget):
    """Settings and calibration of the rig.

    Parameters
    ----------
    ask, stop
        Send the engine a request; stop what it does.
    operator
        Returns the operator's name, stored with a calibration.
    """

    def __init__(
        self,
        rig: engine_host.RigSelection,
        ask: Callable[[engine_host.Request], None],
        stop: Callable[[], None],
        operator: Callable[[], str],
    ) -> None:
        super().__init__()
        self.setObjectName("page")
        self.settings = SettingsView(rig)
        self.calibrate = CalibrateView(ask, stop, operator)
        self.tabs = tabs_of((self.settings, "&Settings"), (self.calibrate, "&Calibrate"))
        self.setLayout(column(self.tabs, margin=8))
