"""The next session: its plan as a form, operator and pace, and a preview of what it will do."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from PySide6.QtCore import QFileSystemWatcher, QSignalBlocker, QTimer, Signal
from PySide6.QtGui import QStandardItem, QStandardItemModel
from PySide6.QtWidgets import QCheckBox, QComboBox, QFormLayout, QHeaderView, QLineEdit, QTreeView, QWidget

from dragrig.config import DragrigError, OutputError, Plan, to_toml
from dragrig.engine_host import Pace, RigSelection, SessionJob
from dragrig.present import BLUE, PURPLE, duration_text, size_text, write_text
from dragrig.settings_form import specimen_form
from dragrig.views import (
    CampaignToExtend,
    FieldPlace,
    Form,
    PlanForm,
    RigDescription,
    SessionPreview,
    campaign_to_extend,
    form_from_plan,
    known_plans,
    motion_curves,
    plan_form,
    preview_session,
    within_rig,
)
from dragrig.window.background import FileWorker
from dragrig.window.forms import DEFAULT_TEXT, FormEditor
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


class PlanEditor(FormEditor):
    """Edits the steps of a plan."""

    def __init__(self) -> None:
        super().__init__()
        self.steps = named(QComboBox(), "Step of the plan")
        self.steps.currentIndexChanged.connect(self.show_group)
        self._rows.insertWidget(0, self.steps)

    def edit(self, form: Form, values: Sequence[Mapping[str, str]] | None = None, group: int = 0) -> None:
        """Show a step of a plan; the same plan again shows the step that was shown before."""
        group = max(self.shown, 0) if form == self._form else group
        with QSignalBlocker(self.steps):
            self.steps.clear()
            self.steps.addItems(
                [f"Step {number} of {len(form.groups)}: {step.name}" for number, step in enumerate(form.groups, 1)]
            )
            self.steps.setCurrentIndex(group)
        self.steps.setVisible(len(form.groups) > 1)
        super().edit(form, values, group)


class PlanChoice(QComboBox):
    """The plans by name; the list that opens has their descriptions too."""

    def __init__(self) -> None:
        super().__init__()
        self._items = QStandardItemModel(0, 2, self)
        self.setModel(self._items)
        view = QTreeView()
        view.setRootIsDecorated(False)
        view.setHeaderHidden(True)
        view.header().setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        view.setMinimumWidth(_PLANS_PX)
        self.setView(view)

    def describe(self, at: int, about: str) -> None:
        """Set the description of a plan."""
        self._items.setItem(at, 1, QStandardItem(about))


_PLANS_PX = 760
_PREVIEW_HEADER = (
    "Run",
    "Protocol",
    "Capsule",
    "Fixture",
    "Position (mm)",
    "Speed (mm/s)",
    "Wait before",
    "Duration",
    "Prompt before",
)


_MIN_RUNS_PX = 112
"""Its header, two runs, and the bar that scrolls it sideways."""


class PlanPreview(QWidget):
    """Preview of a planned session, with the motion of the selected run."""

    def __init__(self) -> None:
        super().__init__()
        self.summary = ElidedLabel("", "title")
        self.findings = MessageText()
        self.conditions = MessageText(most_lines=4)
        self.runs = named(table(_PREVIEW_HEADER), "Runs of the plan")
        self.runs.setMinimumHeight(_MIN_RUNS_PX)
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
            self.conditions,
            self.position.widget,
            self.speed.widget,
            self.runs,
            margin=8,
            stretch={3: 1, 4: 1, 5: 1},
        )
        layout.setSpacing(4)
        # What starts and ends a session stays in view below it, also under a prompt.
        self.setLayout(column(scrolling(layout)))

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
        self.conditions.setText("\n".join((session.conditions, *(f"NOTE {text}." for text in preflight.remarks))))
        rows = [
            (
                str(preview.run.index),
                preview.run.summary,
                preview.run.capsule.name,
                preview.run.fixture.value,
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
        self.position.stage_limits(session.lowest_mm, session.highest_mm)
        self.position.clear()
        self.speed.clear()
        if count:
            self.runs.setCurrentCell(0, 0)
            self._draw(0)

    def refuse(self, sentence: str) -> None:
        """Show why the plan cannot be used."""
        self.summary.setText("This plan cannot be used yet")
        self.findings.setText(sentence)
        set_role(self.findings, "wrong")
        # What is shown is of the plan before, which nobody is about to run.
        self._session = None
        self.conditions.setText("")
        fill_table(self.runs, [])
        self.position.remove_levels()
        self.position.clear()
        self.speed.clear()

    def _draw(self, index: int) -> None:
        previews = () if self._session is None else self._session.preflight.previews
        if 0 <= index < len(previews):
            time, position, speed = motion_curves(previews[index])
            self._position_line.points(time, position)
            self._speed_line.points(time, speed)
            self.position.fit()
            self.speed.fit()


_EDIT_DELAY_MS, _FOLLOW_DELAY_MS = 250, 500
_NOT_IN_A_NAME = re.compile(r"[^\w.-]+")
"""What a file's name may have and the name of a plan may not, which folders and files of its runs are named after."""
_MAX_UNDO = 100
_SIMULATED_PACES: dict[str, Pace] = {"as fast as the real rig": "real", "as fast as possible": "fast"}
_DOUBLE_PACES: dict[str, Pace] = {"as fast as the real rig": "real", "5 times faster": 5.0, "20 times faster": 20.0}


class CampaignChoice(QWidget):
    """Whether the runs go into a campaign of their own or are added to one; `changed` after every change, also of it.

    Parameters
    ----------
    folder
        Where to look for campaigns.
    """

    changed = Signal()

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self.read: CampaignToExtend | None = None
        """The campaign, once it is read."""
        self.reading = False
        self.problem = ""
        """Why there is none."""
        self.adds = QCheckBox("Add to an existing campaign (&Z)")
        self.adds.setToolTip("The runs go on with a campaign, on its rig and its specimen, instead of a new one")
        self.campaign = named(QLineEdit(), "Campaign that the runs are added to")
        self.campaign.setPlaceholderText("folder of a campaign")
        self.choose = button("Folder …", self._choose, help_="Choose the campaign", keys="Ctrl+Shift+O")
        self.state = ElidedLabel("", "faint")
        self.chosen = bare_widget(column(row(self.campaign, self.choose, stretch={0: 1}), self.state))
        self.chosen.hide()
        layout = column(self.adds, self.chosen)
        layout.setContentsMargins(0, 0, 8, 0)
        self.setLayout(layout)
        self.files = FileWorker(self._refuse, self)
        self._typed = QTimer(self)
        self._typed.setSingleShot(True)
        self._typed.timeout.connect(self.read_again)
        self.adds.toggled.connect(self._toggle)
        self.campaign.textChanged.connect(self._change)

    @property
    def path(self) -> Path | None:
        """Folder of the campaign that the runs are added to; None for a campaign of their own."""
        text = self.campaign.text().strip()
        return Path(text).expanduser().absolute() if self.adds.isChecked() and text else None

    def offer(self, folder: str) -> None:
        """Suggest a campaign; one that a person has chosen stays."""
        if not self.adds.isChecked():
            self.campaign.setText(folder)

    def read_again(self) -> None:
        """Read the campaign, as after a session of it."""
        self._typed.stop()
        path = self.path
        missing = "Choose the campaign that the runs are added to." if self.adds.isChecked() and path is None else ""
        self._show(None, missing, reading=path is not None)
        if path is not None:
            self.files.do(lambda: campaign_to_extend(path), self._take)

    def finish(self) -> None:
        """Finish reading."""
        self._typed.stop()
        self.files.drop()

    def _toggle(self, adds: bool) -> None:
        self.chosen.setVisible(adds)
        self.read_again()

    def _change(self, text: str) -> None:
        self.campaign.setToolTip(text)
        if self.adds.isChecked():
            self._show(None, "", reading=True)
            self._typed.start(_EDIT_DELAY_MS)

    def _take(self, campaign: CampaignToExtend) -> None:
        # Another may have been chosen meanwhile, or none.
        if campaign.before.folder == self.path:
            self._show(campaign, "")

    def _refuse(self, sentence: str) -> None:
        if self.adds.isChecked():
            self._show(None, sentence)

    def _show(self, campaign: CampaignToExtend | None, problem: str, *, reading: bool = False) -> None:
        self.read, self.problem, self.reading = campaign, problem, reading
        self.state.setText("Reading …" if reading else "" if campaign is None else campaign.summary)
        self.state.setVisible(bool(self.state.text()))
        self.changed.emit()

    def _choose(self) -> None:
        start = self.campaign.text().strip() or str(self._folder)
        choose_path(self, "Campaign that the runs are added to", start, self.campaign.setText)


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
        self._shown_plan = ""
        self._edited: dict[str, list[dict[str, str]]] = {}
        self._history: list[tuple[str, list[dict[str, str]]]] = []
        self.session: SessionPreview | None = None
        self.plans = named(PlanChoice(), "Plan")
        self._lab = None if lab is None else lab.absolute()
        self._plans_changed = QFileSystemWatcher(self)
        self._plans_changed.directoryChanged.connect(
            # A file is there before its content is.
            lambda _: QTimer.singleShot(_FOLLOW_DELAY_MS, self, self._list_plans)
        )
        self._list_plans()
        self.open = button("&Open …", self._choose_file, help_="Open a plan file")
        self.save = button(
            "Save …", self._choose_new_file, help_="Write the plan, as it is edited, to a file", keys="Ctrl+S"
        )
        self._plan_folder = "" if self._lab is None else str(self._lab / "plans")
        self.editor = PlanEditor()
        self.changes = MessageText(most_lines=2)
        self.problem = MessageText("wrong", most_lines=2)
        self.undo = button("Undo", self.undo_edit, help_="Take back the last change of the form", keys="Ctrl+Z")
        self.destination = CampaignChoice(Path(description.data_root))
        self.specimen = FormEditor()
        self._specimen_form = specimen_form()
        self.specimen.edit(self._specimen_form)
        self.specimen_told = ElidedLabel("", "faint")
        self.state_specimen = button(
            "State …", self._show_specimen, help_="What only you can know of the piece", keys="Ctrl+Shift+I"
        )
        self.state_specimen.setCheckable(True)
        self.operator = QLineEdit(stored.text("operator"))
        self.operator.setPlaceholderText("nobody is named")
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
            "&Start",
            lambda: self.submitted.emit(True),
            "main",
            "Start this session, before those that wait",
            "Ctrl+Return",
        )
        self._lay_out()
        self._edit_timer = QTimer(self)
        self._edit_timer.setSingleShot(True)
        self._edit_timer.timeout.connect(self.update_preview)
        for editor in (self.editor, self.specimen):
            editor.changed.connect(lambda: self._edit_timer.start(_EDIT_DELAY_MS))
        self.destination.changed.connect(self.update_preview)
        self.destination.adds.toggled.connect(self._change_specimen)
        self.plans.currentIndexChanged.connect(lambda _: self._load(str(self.plans.currentData())))
        self.plans.currentTextChanged.connect(self.plans.setToolTip)

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

    def _list_plans(self) -> None:
        """List the plans that there are now; the chosen one stays, and each that is nowhere in the lab."""
        folders = () if self._lab is None else (self._lab, self._lab / "plans")
        self._plans_changed.addPaths([str(folder) for folder in folders if folder.is_dir()])
        known = known_plans(self._lab)
        with QSignalBlocker(self.plans):
            for at in reversed(range(self.plans.count())):
                source = self.plans.itemData(at)
                if Path(source).parent in folders and source not in known and source != self.plans.currentData():
                    self.plans.removeItem(at)
            for at, (source, about) in enumerate(known.items()):
                if self.plans.findData(source) < 0:
                    self.plans.insertItem(at, Path(source).stem if source.endswith(".toml") else source, source)
                self.plans.describe(self.plans.findData(source), about)

    def offer(self, name: str, plan: PlanForm) -> None:
        """Show a plan from another page; it stays selectable as long as the window is open."""
        self._offered[name] = plan
        with QSignalBlocker(self.plans):
            if self.plans.findData(name) < 0:
                self.plans.addItem(plan.plan.name, name)
            self.plans.setCurrentIndex(self.plans.findData(name))
        self._note_edit()
        self._edited.pop(name, None)
        self._edit(name, plan)

    def take_back(self, job: SessionJob) -> None:
        """Show a session of the queue, to be changed: all that was chosen for it."""
        if isinstance(job.plan, str):
            return
        self.operator.setText(job.operator)
        self.note.setText(job.note)
        self.mirror.setText("" if job.mirror is None else str(job.mirror))
        self._choose_pace(job.pace)
        self.destination.campaign.setText("" if job.append is None else str(job.append))
        self.destination.adds.setChecked(job.append is not None)
        (texts,) = self._specimen_form.values()
        stated = (fact.removeprefix("specimen.").split("=", 1) for fact in job.specimen)
        self.specimen.edit(self._specimen_form, [{**texts, **{key: str(json.loads(text)) for key, text in stated}}])
        self.offer(f"queue, {job.plan.name}", form_from_plan(job.plan, job.plan.name))

    def plan(self) -> Plan:
        """Return the plan in the form; raises `DragrigError`."""
        if self._form is None:
            return plan_form(str(self.plans.currentData())).plan
        return self._form.filled(self.editor.values())

    def specimen_facts(self) -> tuple[str, ...]:
        """Return what is stated of the specimen, as assignments; raises `SettingsError`."""
        return self._specimen_form.assignments(self.specimen.values())

    def update_preview(self) -> None:
        """Preview the session."""
        self._edit_timer.stop()
        self._note_edit()
        self.session, refusal = None, ""
        if self.destination.reading:
            self.start.setEnabled(False)
            self.queue.setEnabled(False)
            return
        (facts,) = self.specimen.values()
        problems = self._specimen_form.problems([facts])
        self.specimen.mark(problems, {})
        self.specimen_told.setText(", ".join(text.strip() for text in facts.values() if text.strip()) or "not stated")
        if problems:
            self.state_specimen.setChecked(True)
            self._show_specimen()
        try:
            self.session = self._preview()
        except DragrigError as error:
            refusal = str(error)
            self.refused.emit(refusal)
        else:
            self.planned.emit(self.session)
        self._mark_fields(refusal.removeprefix(f"{self.destination.path}: "))
        allowed = self.session is not None and not self.session.preflight.findings
        self.start.setEnabled(allowed)
        self.queue.setEnabled(allowed)

    def _preview(self) -> SessionPreview:
        """Return the preview of what is in the form; raises `DragrigError`."""
        destination = self.destination
        if destination.problem:
            raise OutputError(destination.problem)
        return preview_session(self.plan(), self._rig, self.specimen_facts(), destination.read)

    def _change_specimen(self, of_campaign: bool) -> None:
        """Say what an empty field means; what is filled in stays."""
        values = self.specimen.values()
        self._specimen_form = specimen_form(of_campaign=of_campaign)
        self.specimen.edit(self._specimen_form, values)
        self._show_specimen()
        self.update_preview()

    def _show_specimen(self) -> None:
        # Of a simulated one nobody can know more than its model; but a campaign may be of several.
        simulated = self._description.title == "SIMULATED"
        is_stated = not simulated or self.destination.adds.isChecked()
        self._specimen_row.setVisible(is_stated)
        self.specimen.setVisible(is_stated and self.state_specimen.isChecked())

    def undo_edit(self) -> None:
        """Take back the last change, also of a plan that is not shown any more."""
        self._edit_timer.stop()
        self._note_edit()
        if not self._history:
            return
        plan, values = self._history.pop()
        self._edited[plan] = values
        # What the form shows is what is taken back: no edit to note.
        self._shown_plan = ""
        with QSignalBlocker(self.plans):
            self.plans.setCurrentIndex(self.plans.findData(plan))
        self._load(plan)

    def describe(self, description: RigDescription) -> None:
        """Take the rig as its settings are now, with other limits."""
        self._description = description
        self._load(str(self.plans.currentData()))

    def session_over(self, folder: Path) -> None:
        """Suggest the campaign of a session that has ended, or read the chosen one again, which may have more runs."""
        self.destination.offer(str(folder))
        if self.destination.adds.isChecked():
            self.destination.read_again()

    def note_session(self) -> None:
        """Remember the form as the last session of its plan, from which later edits are told."""
        self._stored.keep(f"last session, {self._shown_plan}", json.dumps(self.editor.values()))
        self._mark_fields("")

    def _note_edit(self) -> None:
        """Remember the values before a change, for undo."""
        if self._form is None or not self._shown_plan:
            return
        before, now = self._edited.get(self._shown_plan), self.editor.values()
        if before is not None and now != before:
            self._history = [*self._history, (self._shown_plan, before)][-_MAX_UNDO:]
        self._edited[self._shown_plan] = now
        self.undo.setEnabled(bool(self._history))

    def _mark_fields(self, refusal: str) -> None:
        form = self._form
        if form is None:
            self.changes.hide()
            self._say_problem(refusal)
            return
        invalid = form.misread(self.editor.values())
        findings: tuple[str, ...] = () if self.session is None else self.session.preflight.findings
        for sentence in (refusal, *findings) if not invalid else ():
            if place := form.place_of(sentence, self._step_of(sentence)):
                # Without where it stands: that is here.
                brief = re.sub(r"^.*?(steps\[\d+\][.:] ?|run \d+ \(.*?\) )", "", sentence)
                invalid.setdefault(place, brief)
        changes = self._changes(form)
        self.editor.mark(invalid, changes)
        problems = [f"{self._field_name(form, place)}: {problem}" for place, problem in invalid.items()]
        self._say_problem(problems[0] if problems else refusal[:1].upper() + refusal[1:] or next(iter(findings), ""))
        told = "; ".join(f"{self._field_name(form, place)} {change}" for place, change in changes.items())
        since = "the last session" if self._last_session(form) is not None else "the plan"
        self.changes.setText(f"Differs from {since}: {told}.")
        self.changes.setVisible(bool(changes))

    def _say_problem(self, sentence: str) -> None:
        self.problem.setText(sentence)
        self.problem.setVisible(bool(sentence))

    def _step_of(self, finding: str) -> int | None:
        """Return the step of the run that a finding is about."""
        named_run = re.search(r"\brun (\d+) \(", finding)
        previews = () if self.session is None else self.session.preflight.previews
        runs = {preview.run.index: preview.run.step for preview in previews}
        return runs.get(int(named_run[1])) if named_run else None

    def _last_session(self, form: PlanForm) -> list[dict[str, str]] | None:
        """Return the values of the last session of this plan, if it had the same steps and fields."""
        try:
            values = json.loads(self._stored.text(f"last session, {self._shown_plan}"))
            same = [list(map(str, texts)) for texts in values] == [list(texts) for texts in form.values()]
        except (ValueError, TypeError):
            return None
        return [{key: str(text) for key, text in texts.items()} for texts in values] if same else None

    def _changes(self, form: PlanForm) -> dict[FieldPlace, str]:
        """Return what differs from the last session of this plan, or from the plan where there was none."""
        before = self._last_session(form) or form.values()
        return {
            (number, key): f"{texts[key].strip() or DEFAULT_TEXT} (was {was.strip() or DEFAULT_TEXT})"
            for number, (texts, old) in enumerate(zip(self.editor.values(), before, strict=True))
            for key, was in old.items()
            if texts[key].strip() != was.strip()
        }

    def _field_name(self, form: PlanForm, place: FieldPlace) -> str:
        where = f"Step {place[0] + 1}, " if len(form.groups) > 1 else ""
        return where + form.field_name(place)

    def keep(self) -> None:
        """Store the choices for the next start, which begins with a campaign of its own."""
        if (plan := str(self.plans.currentData())) not in self._offered:
            self._stored.keep("plan", plan)
        self._stored.keep("operator", self.operator.text())
        self._stored.keep("mirror", self.mirror.text().strip())
        if self._paces:
            self._stored.keep(f"pace, {self._description.title}", self.pace.currentText())

    def _lay_out(self) -> None:
        form = QFormLayout()
        form.setContentsMargins(0, 0, 8, 0)
        form.setRowWrapPolicy(QFormLayout.RowWrapPolicy.WrapLongRows)
        form.addRow("Session note", named(self.note, "Session note"))
        if self._paces:
            form.addRow("Pace", named(self.pace, "Pace"))
        mirror = named(self.mirror, "Mirror folder")
        form.addRow("Mirror folder", row(mirror, self.choose_mirror, stretch={0: 1}))
        self.plans.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
        self.plans.setMinimumContentsLength(8)
        header = row(label("Plan"), self.plans, self.open, self.save, stretch={1: 1})
        # Seen first, whatever the plan: the rest may be below the fold.
        who = row(label("Operator"), named(self.operator, "Operator"), stretch={1: 1})
        self._specimen_row = bare_widget(
            row(label("Specimen"), self.specimen_told, self.state_specimen, stretch={1: 1})
        )
        self._show_specimen()
        fields = scrolling(column(self.specimen, self.destination, self.editor, form, 1), across=False)
        buttons = row(self.undo, 1, self.queue, self.start)
        self.changes.hide()
        self.problem.hide()
        parts = (who, self._specimen_row, header, fields, self.changes, self.problem, buttons)
        self.setLayout(column(card(column(*parts, stretch={3: 1}))))
        self.setMinimumWidth(330)

    def _choose_pace(self, pace: Pace | None) -> None:
        """Select the pace of the command line, else that used last."""
        name = next((text for text, known in self._paces.items() if known == pace), "")
        index = self.pace.findText(name or self._stored.text(f"pace, {self._description.title}"))
        self.pace.setCurrentIndex(max(index, 0))

    def _choose_file(self) -> None:
        start = self._stored.text("plan folder")
        choose_path(self, "Open a plan", start, self.open_file, filter_="Plans (*.toml)", folder=False)

    def _choose_new_file(self) -> None:
        folder = Path(self._stored.text("plan folder", self._plan_folder))
        start = str((folder if folder.is_dir() else folder.parent) / f"{self.plans.currentText()}.toml")
        choose_path(self, "Save the plan", start, self.save_as, filter_="Plans (*.toml)", folder=False, new_file="toml")

    def save_as(self, path: str) -> None:
        """Write the plan in the form to a file, and edit that from then on."""
        try:
            plan = self.plan().model_copy(update={"name": _NOT_IN_A_NAME.sub("-", Path(path).stem)})
            # The dialog asks before it names a file that exists.
            write_text(to_toml(plan), Path(path), overwrite=True, make_folder=True)
        except DragrigError as error:
            self._say_problem(str(error))
            return
        self._edited.pop(path, None)
        if self.plans.findData(path) >= 0 and self.plans.currentData() == path:
            self._load(path)
        self.open_file(path)

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
        self._note_edit()
        try:
            form = self._offered.get(name) or plan_form(name)
        except DragrigError as error:
            self._form, self._shown_plan = None, ""
            self._mark_fields(str(error))
            self.start.setEnabled(False)
            self.queue.setEnabled(False)
            self.refused.emit(str(error))
            return
        self._edit(name, form)

    def _edit(self, name: str, form: PlanForm) -> None:
        """Show a plan, with the edits made to it before in this window."""
        edited = self._edited.get(name)
        same = edited is not None and [list(texts) for texts in edited] == [list(texts) for texts in form.values()]
        form = within_rig(form, self._description)
        self._form, self._shown_plan = form, name
        self.plans.setToolTip(self.plans.currentText())
        self.editor.edit(form, edited if same else None)
        self._edited[name] = self.editor.values()
        self.update_preview()


def _allowed_paces(rig: RigSelection, description: RigDescription) -> dict[str, Pace]:
    """Return the paces of this rig by name, including that of the command line."""
    if description.real:
        return {}
    known = _DOUBLE_PACES if description.title == "DOUBLE" else _SIMULATED_PACES
    pace = rig.pace
    return {**known, f"{pace:g} times faster": pace} if isinstance(pace, int | float) else known
