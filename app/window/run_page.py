"""The page that runs plans: new session, preview, live view, devices, queue."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QHeaderView,
    QPlainTextEdit,
    QProgressBar,
    QPushButton,
    QTreeWidget,
    QTreeWidgetItem,
    QWidget,
)

from dragrig import engine_host
from dragrig.config import DragrigError, NumberRange, Plan
from dragrig.present import duration_text
from dragrig.views import RIG_LIMIT, FurtherRuns, PlanForm, RigDescription, SessionPreview, last_heard
from dragrig.window.background import EngineLink
from dragrig.window.forms import NumberField
from dragrig.window.live_view import LiveView
from dragrig.window.new_session import NewSession, PlanPreview
from dragrig.window.session_queue import ENGINE_LOST, QueuedSession, QueueState, SessionQueue
from dragrig.window.widgets import (
    MessageText,
    StoredSettings,
    Topic,
    bare_widget,
    button,
    card,
    column,
    current_item,
    fill_table,
    flow,
    label,
    named,
    parent_of,
    row,
    scrolling,
    set_role,
    split,
    table,
    tabs_of,
    top_items,
)


class DevicesView(QWidget):
    """Results of the last check of the devices; checking moves nothing."""

    def __init__(self, check: Callable[[], None]) -> None:
        super().__init__()
        self._request_check = check
        self._result_text = "Not checked yet."
        self._checking = self._session_running = False
        self.verdict = ""
        self.status = label(self._result_text, "faint", wrap=True)
        self.devices = named(table(("State", "Device", "Result")), "State of every device")
        self.again = button("Chec&k again", self.check, help_="Check every device; nothing moves")
        self.watch = QCheckBox("Read force and position between sessions (&J)")
        self.watch.setToolTip("The rig is held for it; switched off, other programs may use the rig between sessions")
        self.watch.setChecked(True)
        self.setLayout(column(row(self.status, self.again, stretch={0: 1}), self.devices, self.watch, margin=8))

    def check(self) -> None:
        """Request a check of every device."""
        self._checking = True
        self._request_check()
        self._show_state()

    def show_result(self, result: engine_host.RigExamined) -> None:
        """Show the result of a check."""
        self._checking = False
        fill_table(
            self.devices, [("ok" if check.passed else "FAILED", check.name, check.detail) for check in result.devices]
        )
        faults = sum(not check.passed for check in result.devices)
        self.verdict = "NOT FOUND" if result.error else f"{faults} FAILED" if faults else "all ok"
        self._result_text = result.error or f"{len(result.devices)} checks at {time.strftime('%H:%M')}, {self.verdict}."
        self._show_state()

    def engine_lost(self) -> None:
        """Expect no result of a check."""
        self._checking = False
        self._show_state()

    def set_session_running(self, *, running: bool) -> None:
        """Allow no check while a session is running."""
        self._session_running = running
        self._show_state()

    def _show_state(self) -> None:
        self.again.setEnabled(not (self._session_running or self._checking))
        if self._session_running:
            self.status.setText("A session is running; these results are from before it.")
        else:
            self.status.setText("Checking every device …" if self._checking else self._result_text)


_OVERRIDES: Mapping[str, engine_host.TravelEnd | None] = {
    "none": None,
    "low": engine_host.TravelEnd.LOW,
    "high": engine_host.TravelEnd.HIGH,
}
_JOG_MM, _JOG_MM_S = 5.0, 10.0
_TOUCH_MM, _TOUCH_MN, _TOUCH_MM_S = 20.0, 20.0, 1.0


class HandView(QWidget):
    """Motion by hand: home, jog, touch-off; each is announced and asked for first, guarded, and not recorded."""

    def __init__(self, move: Callable[[engine_host.HandMotion], None], operator: Callable[[], str]) -> None:
        super().__init__()
        self._request_move, self._operator = move, operator
        self.busy = False
        """Whether a motion is asked for or under way."""
        self._idle = self._armed = False
        self.distance = NumberField("Distance of the jog", _DISTANCE, _JOG_MM)
        self.speed = NumberField("Speed of the jog", _SPEED, _JOG_MM_S)
        self.most = NumberField("Longest travel of the touch-off", _DISTANCE, _TOUCH_MM)
        self.force = NumberField("Change of the force that is a contact", _FORCE, _TOUCH_MN)
        self.approach = NumberField("Speed of the touch-off", _SPEED, _TOUCH_MM_S)
        self.back = NumberField("Way back after the contact", _BACK, 0.0)
        self._jogged_by, self._touched_by = (
            (self.distance, self.speed),
            (self.most, self.force, self.approach, self.back),
        )
        self._speed_range = _SPEED
        self.override = named(QComboBox(), "Limit switch that the next motion may leave")
        for name, side in _OVERRIDES.items():
            self.override.addItem(name, side)
        self.override.setToolTip(
            "For the next homing or jog alone, away from the pressed switch and slow; everything else stays guarded"
        )
        self.override.currentIndexChanged.connect(lambda _: self._choose_override())
        self._usual_mm_s: float | None = None
        """Speed before a limit switch was overridden."""
        self.home = button(
            "Ho&me", lambda: self._move(engine_host.HomeStage(self._side)), help_="Find the stage's origin"
        )
        self.jog = button("&Jog", self._jog, help_="Move the stage by the distance")
        self.touch = button("Touc&h off", self._touch, help_="Approach until the force changes; plans can start there")
        self.state = MessageText()
        self.state.setText("Each motion is announced first. Escape and STOP end it at once.")
        jog = flow(self.jog, _titled("by", self.distance), _titled("at", self.speed))
        touch = flow(self.touch, _titled("within", self.most), _titled("until", self.force),
                     _titled("at", self.approach), _titled("then back by", self.back))  # fmt: skip
        off_switch = row(label("Allow moving off a pressed limit switch:"), self.override, 1)
        jogging = card(jog, *(field.problem for field in self._jogged_by))
        touching = card(touch, *(field.problem for field in self._touched_by))
        motions = column(self.state, card(row(self.home, 1)), jogging, off_switch, touching, 1, margin=8)
        self.setLayout(column(scrolling(motions)))
        for field in (*self._jogged_by, *self._touched_by):
            field.edited.connect(self._show_state)
        self._show_state()

    def set_limits(self, rig: RigDescription) -> None:
        """Refuse travels and speeds beyond the rig's limits."""
        travel_mm = rig.highest_mm - rig.lowest_mm
        self._speed_range = _SPEED.within(0.0, rig.max_speed_mm_s, RIG_LIMIT)
        self.approach.set_range(self._speed_range)
        for field in (self.distance, self.most):
            field.set_range(_DISTANCE.within(-travel_mm, travel_mm, "the rig's travel"))
        self._limit_speed()

    def allow(self, *, idle: bool, armed: bool) -> None:
        """Allow motions while nothing else is done: with the guard armed, or off a pressed limit switch."""
        self._idle, self._armed = idle, armed
        self._show_state()

    def end(self, sentence: str) -> None:
        """Show how the motion ended; an override was for that motion alone."""
        self.busy = False
        self.state.setText(sentence)
        self.override.setCurrentIndex(0)
        self._show_state()

    @property
    def _side(self) -> engine_host.TravelEnd | None:
        return _OVERRIDES[self.override.currentText()]

    def _show_state(self) -> None:
        free, off_switch = self._idle and not self.busy, self._side is not None
        may_start = free and (self._armed or off_switch)
        self.home.setEnabled(may_start)
        self.jog.setEnabled(may_start and None not in _numbers(self._jogged_by))
        self.touch.setEnabled(free and self._armed and not off_switch and None not in _numbers(self._touched_by))
        self.override.setEnabled(free)

    def _choose_override(self) -> None:
        """Show the highest speed off a switch where the jog's is above it; the speed before comes back afterwards."""
        if self._side is None and self._usual_mm_s is not None:
            usual_mm_s, self._usual_mm_s = self._usual_mm_s, None
            self._limit_speed()
            self.speed.put(usual_mm_s)
        elif self._side is not None and (self.speed.value() or 0.0) > engine_host.MAX_OVERRIDE_SPEED_MM_S:
            self._usual_mm_s = self.speed.value()
            self.speed.put(engine_host.MAX_OVERRIDE_SPEED_MM_S)
        self._limit_speed()
        self._show_state()

    def _limit_speed(self) -> None:
        most = math.inf if self._side is None else engine_host.MAX_OVERRIDE_SPEED_MM_S
        self.speed.set_range(self._speed_range.within(0.0, most, "the most off a limit switch"))

    def _jog(self) -> None:
        match _numbers(self._jogged_by):
            case (float(distance_mm), float(speed_mm_s)):
                self._move(engine_host.JogStage(distance_mm, speed_mm_s, self._side))

    def _touch(self) -> None:
        match _numbers(self._touched_by):
            case (float(most_mm), float(force_mN), float(speed_mm_s), float(back_mm)):
                self._move(engine_host.TouchOffStage(most_mm, force_mN, speed_mm_s, back_mm, self._operator()))

    def _move(self, motion: engine_host.HandMotion) -> None:
        self.busy = True
        self.state.setText("The motion is being prepared …")
        self._show_state()
        self._request_move(motion)


_DISTANCE, _BACK = NumberRange("mm"), NumberRange("mm", 0.0)
_SPEED, _FORCE = NumberRange("mm/s", 0.0, above_lowest=True), NumberRange("mN", 0.0, above_lowest=True)


def _numbers(fields: Sequence[NumberField]) -> tuple[float | None, ...]:
    return tuple(field.value() for field in fields)


def _titled(text: str, field: NumberField) -> QWidget:
    return bare_widget(row(label(text), field, field.unit))


_QUEUE_HEADER = ("Session", "Runs", "Duration", "State")
_JOB_ROLE = int(Qt.ItemDataRole.UserRole)


class QueueView(QWidget):
    """The queue; waiting sessions can be moved and removed."""

    chosen_folder = Signal(str)
    """Folder of a finished session whose runs are to be shown."""
    chosen_job = Signal(engine_host.SessionJob)
    """Session that is to be shown in the form."""
    gone_on_with = Signal(QueuedSession)
    """Session whose missing runs are to be made."""
    changed = Signal()

    def __init__(self, queue: SessionQueue) -> None:
        super().__init__()
        self._queue = queue
        self._shown: list[tuple[object, ...]] = []
        self._followed: tuple[int, int | None] | None = None
        self.tree = QTreeWidget()
        self.tree.setHeaderLabels(list(_QUEUE_HEADER))
        self.tree.setAccessibleName("Queue of sessions")
        self.tree.setAlternatingRowColors(True)
        self.tree.header().setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        self.tree.itemDoubleClicked.connect(lambda item, _: self._open(item))
        self.progress = QProgressBar()
        self.progress.setRange(0, 1000)
        self.progress.setAccessibleName("Progress of the running session")
        up, down = (partial(queue.move, by=by) for by in (-1, 1))
        self.up = self._button("Up", up, "Move the selected session up", "Ctrl+Up")
        self.down = self._button("Down", down, "Move the selected session down", "Ctrl+Down")
        self.out = self._button("Re&move", queue.remove, "Remove the selected session from the queue")
        self.edit = self._button(
            "To the form", self._edit, "Put the selected session back into the form", "Ctrl+Shift+F"
        )
        self.copy = self._button("Duplicate", self._duplicate, "Add the selected session once more", "Ctrl+Shift+D")
        self.missing = self._button(
            "Make the missing runs", self.gone_on_with.emit, "Go on with what ended early", "Ctrl+Shift+M"
        )
        self.clear = button(
            "C&lear finished", self._clear, help_="Remove ended sessions from the list; their files stay"
        )
        self.back = button("Put back", self._put_back, help_="Put back what was removed last", keys="Ctrl+Shift+Z")
        self.look = button("S&how runs", self._open_selected, help_="Show the recorded runs of the selected session")
        of_selected = (self.up, self.down, self.edit, self.copy, self.out, self.look, self.missing)
        self.setLayout(column(self.tree, flow(*of_selected, self.back, self.clear), margin=8))
        self.tree.currentItemChanged.connect(lambda *_: self._show_buttons())
        self.show_queue()

    def show_queue(self) -> None:
        """Show the present state of the queue."""
        state = [self._state(entry) for entry in self._queue.entries]
        if state != self._shown:
            self._shown = state
            self._rebuild()
            self._follow()
            self.changed.emit()
        self._show_buttons()
        self._show_progress()

    def _show_buttons(self) -> None:
        """Allow what can be done with the selected session."""
        entry, seen = self._selected(), self._queue.entries
        waits = entry is not None and entry.stage is QueueState.WAITING
        self.up.setEnabled(waits)
        self.down.setEnabled(waits)
        self.out.setEnabled(entry is not None and entry.stage is not QueueState.RUNNING)
        self.edit.setEnabled(waits and entry is not None and entry.job.resume is None)
        self.copy.setEnabled(entry is not None and entry.job.resume is None)
        self.missing.setEnabled(entry is not None and bool(entry.missing))
        self.look.setEnabled(any(queued.folder for queued in (seen if entry is None else (entry,))))
        self.back.setEnabled(self._queue.can_put_back)

    def _state(self, entry: QueuedSession) -> tuple[object, ...]:
        current = tuple(run.index for run in (entry.current_run, entry.resting) if run is not None)
        return entry.job.number, entry.stage, len(entry.runs), tuple(entry.ended), current, entry.reason, entry.folder

    def _follow(self) -> None:
        """Bring the run in progress into view once it starts; what a person scrolls to then stays."""
        entry = self._queue.current
        if entry is None or entry.current_run is None:
            return
        now = entry.job.number, entry.number_of(entry.current_run)
        if now == self._followed:
            return
        self._followed = now
        for item in top_items(self.tree):
            if item.data(0, _JOB_ROLE) == entry.job.number:
                item.setExpanded(True)
                running = next(at for at, run in enumerate(entry.runs) if run.index == entry.current_run.index)
                self.tree.scrollToItem(item.child(running), QTreeWidget.ScrollHint.PositionAtCenter)

    def _show_progress(self) -> None:
        entry = self._queue.current
        waiting = sum(queued.stage is QueueState.WAITING for queued in self._queue.entries)
        if entry is None:
            self.progress.setValue(0)
            text = f"{waiting} waiting, {duration_text(self._queue.left_s)}" if waiting else "queue empty"
            self.progress.setFormat(f"not running; {text}")
            return
        self.progress.setValue(round(1000 * entry.progress))
        more = f"; {waiting} more waiting, {duration_text(self._queue.left_s)} in all" if waiting else ""
        # Simulated time may pass faster than real time.
        left = f", {duration_text(entry.left_s)} left" if entry.real_time else ""
        self.progress.setFormat(f"{entry.title}: {entry.over_count} of {entry.run_count} runs over{left}{more}")

    def _rebuild(self) -> None:
        selected = self._selected()
        closed = {
            item.data(0, _JOB_ROLE) for item in top_items(self.tree) if item.childCount() and not item.isExpanded()
        }
        scrolled_to = self.tree.verticalScrollBar().value()
        self.tree.clear()
        for entry in self._queue.entries:
            state = f"{entry.stage.value}{f': {entry.reason}' if entry.reason else ''}{_mirror_text(entry)}"
            item = QTreeWidgetItem([entry.title, str(entry.run_count), duration_text(entry.planned_s), state])
            item.setData(0, _JOB_ROLE, entry.job.number)
            item.setToolTip(3, state)
            item.setToolTip(0, f"{entry.title}: {entry.why}" if entry.why else entry.title)
            self.tree.addTopLevelItem(item)
            for run in entry.runs:
                number = entry.number_of(run)
                name = f"{'–' if number is None else number}  {run.summary}"
                made = QTreeWidgetItem([name, "", duration_text(run.duration_s), _run_state_text(entry, run)])
                item.addChild(made)
                if entry.current_run is not None and entry.current_run.index == run.index:
                    _embolden(made)
            missing = entry.mirror.missing if entry.mirror is not None else ()
            for name, why in missing:
                item.addChild(QTreeWidgetItem([name, "", "", f"NOT IN THE MIRROR: {why}"]))
            open_ = entry.stage is QueueState.RUNNING or bool(missing)
            item.setExpanded(open_ and entry.job.number not in closed)
            if entry is selected:
                self.tree.setCurrentItem(item)
        self.tree.doItemsLayout()
        self.tree.verticalScrollBar().setValue(scrolled_to)

    def _selected(self) -> QueuedSession | None:
        item = current_item(self.tree)
        while item is not None and (parent := parent_of(item)) is not None:
            item = parent
        number = item.data(0, _JOB_ROLE) if item is not None else None
        return next((entry for entry in self._queue.entries if entry.job.number == number), None)

    def _button(self, text: str, action: Callable[[QueuedSession], None], help_: str, keys: str = "") -> QPushButton:
        """Return a button that does something with the selected session."""

        def pressed() -> None:
            if (entry := self._selected()) is not None:
                action(entry)
                self.show_queue()

        return button(text, pressed, help_=help_, keys=keys)

    def _edit(self, entry: QueuedSession) -> None:
        self._queue.remove(entry)
        self.chosen_job.emit(entry.job)

    def _duplicate(self, entry: QueuedSession) -> None:
        job = replace(entry.job, number=self._queue.next_number())
        runs = () if entry.folder else entry.runs
        self._queue.add(QueuedSession(job, entry.title, entry.planned_s, entry.run_count, runs=runs))

    def _put_back(self) -> None:
        self._queue.put_back()
        self.show_queue()

    def _clear(self) -> None:
        self._queue.clear_finished()
        self.show_queue()

    def _open(self, item: QTreeWidgetItem) -> None:
        self.tree.setCurrentItem(item)
        self._open_selected()

    def _open_selected(self) -> None:
        entry = self._selected() or next((queued for queued in reversed(self._queue.entries) if queued.folder), None)
        if entry is not None and entry.folder:
            self.chosen_folder.emit(entry.folder)


def _embolden(item: QTreeWidgetItem) -> None:
    font = item.font(0)
    font.setBold(True)
    for place in range(item.columnCount()):
        item.setFont(place, font)


def _run_state_text(entry: QueuedSession, run: engine_host.QueuedRun) -> str:
    ended = entry.ended.get(run.index)
    if entry.resting is not None and entry.resting.index == run.index:
        return "rest before it"
    if ended is None:
        return "running" if entry.current_run is not None and entry.current_run.index == run.index else ""
    reason = [ended.reason] if ended.status is not engine_host.RunStatus.COMPLETE else []
    return "; ".join([ended.status.value, *reason, *(f"NOTE {warning}" for warning in ended.warnings)])


def _mirror_text(entry: QueuedSession) -> str:
    mirror = entry.mirror
    if mirror is None:
        return ""
    if mirror.missing:
        total = mirror.copied + len(mirror.missing)
        return f"; {len(mirror.missing)} of {total} files NOT IN THE MIRROR {mirror.folder}"
    return f"; all {mirror.copied} files in the mirror {mirror.folder}"


_PROGRESS_INTERVAL_S = 0.2
_MISSING = ": missing runs"
_OWN_ENDS = ("by operator", "ended at a prompt")
"""Parts of the reasons of sessions that the person ended."""
_LOG_LINES = 10_000


class RunPage(QWidget):
    """Form, preview, live view, devices and queue."""

    running_changed = Signal(bool)
    complained = Signal(str, str)
    """A sentence, and the topic that settles it."""
    settled = Signal(str)
    """A topic whose complaints are no longer true."""
    session_over = Signal(QueuedSession)
    look_at = Signal(str)
    """Folder of a campaign whose runs are to be shown."""
    cut_off = Signal(str)
    """Which session was cut off when the window before this one died; empty once that is decided."""

    def __init__(
        self,
        engine: EngineLink,
        rig: engine_host.RigSelection,
        description: RigDescription,
        lab: Path | None,
        stored: StoredSettings,
    ) -> None:
        super().__init__()
        self.setObjectName("page")
        self._engine, self._stored = engine, stored
        self._queue_started = False
        self._progress_at = 0.0
        self._trip_reason = "the engine is starting"
        self.answered = 0
        """Number of the prompt that was answered last."""
        self.calibrating = False
        """Whether a calibration is under way, on the page of the rig."""
        self.restart_due = False
        """Whether the engine is about to start again, with other settings: no session starts before."""
        self.queue = SessionQueue()
        self._description = description
        self.queue.restore(stored.text(self._queue_key, "[]"))
        self.new = NewSession(rig, description, lab, stored)
        self.preview, self.live = PlanPreview(), LiveView()
        self.live.set_limits(description.lowest_mm, description.highest_mm)
        self.queue_view = QueueView(self.queue)
        self.why = MessageText(most_lines=2)
        self.why.setAccessibleName("Why these runs are made")
        self.hand = HandView(self._move_by_hand, self.new.operator.text)
        self.hand.set_limits(description)
        self.devices = DevicesView(lambda: engine.ask(engine_host.ExamineRig()))
        self.devices.watch.setChecked(stored.text("watch", "yes") == "yes")
        self.devices.watch.toggled.connect(lambda on: self._watch(on=on))
        self.start_queue = button(
            "Start &the queue", self.run_queue, "main", "Run the waiting sessions one after another"
        )
        stop = partial(self.stop, "aborted by operator")
        self.abort = button("&Abort the session", stop, help_="Stop the stage; the run and the session end as aborted")
        self.pause = button(
            "Pause after this run", self._pause, help_="Wait for you before the next run", keys="Ctrl+P"
        )
        self.pause.setCheckable(True)
        self.log = named(QPlainTextEdit(), "Log of this window")
        self.log.setReadOnly(True)
        self.log.setTabChangesFocus(True)
        self.log.setMaximumBlockCount(_LOG_LINES)
        self.tabs = tabs_of(
            (self.preview, "Previe&w"),
            (self.live, "Li&ve"),
            (self.queue_view, "Q&ueue"),
            (self.hand, "By ha&nd"),
            (self.devices, "Devi&ces"),
            (self.log, "Log (&X)"),
        )
        self._lay_out()
        self._connect(engine)
        self.new.begin()
        self._show_state()

    @property
    def _queue_key(self) -> str:
        return f"queue, {self._description.title}, {self._description.name}"

    @property
    def session_running(self) -> bool:
        """Whether a session is running."""
        return self.queue.current is not None

    @property
    def rig_busy(self) -> bool:
        """Whether anything moves or may move: a session, a motion by hand, a calibration."""
        return self.session_running or self.hand.busy or self.calibrating

    @property
    def armed(self) -> bool:
        """Whether the guard lets the stage move."""
        return not self._trip_reason

    def set_calibrating(self, *, calibrating: bool) -> None:
        """Allow no session and no motion by hand while a calibration is under way."""
        self.calibrating = calibrating
        self._show_state()

    def describe(self, description: RigDescription) -> None:
        """Show the rig as its settings are now."""
        self._description = description
        self.live.set_limits(description.lowest_mm, description.highest_mm)
        self.hand.set_limits(description)
        self.new.describe(description)

    def keep(self) -> None:
        """Store the form for the next start."""
        self.new.keep()
        self.new.destination.finish()
        self._keep_queue()

    def _keep_queue(self) -> None:
        """Store the queue, which outlives this process; nothing starts by itself at the next start."""
        self._stored.keep(self._queue_key, self.queue.as_text(), at_once=True)

    def show_cut_off(self) -> None:
        """Say which session was cut off, if any is still to be decided on."""
        entry = self.queue.cut_off
        told = "" if entry is None else f"Session {entry.title} was cut off {last_heard(Path(entry.folder))}."
        self.cut_off.emit(told)

    def decide_cut_off(self, go_on: bool) -> None:
        """Make the missing runs of the session that was cut off, or leave it as it is."""
        entry = self.queue.cut_off
        if entry is None:
            return
        if go_on:
            self.make_missing(entry)
        entry.stage, entry.reason = QueueState.ABORTED, "cut off"
        self.show_cut_off()
        self._show_state()

    def make_missing(self, entry: QueuedSession) -> None:
        """Queue the missing runs of a session that ended early, before what waits, and start them."""
        job = replace(entry.job, number=self.queue.next_number(), resume=Path(entry.folder), append=None, specimen=())
        title = f"{entry.title.removesuffix(_MISSING)}{_MISSING}"
        left_s = sum(map(entry.time_of, entry.missing))
        again = QueuedSession(job, title, left_s, len(entry.missing), runs=entry.missing)
        self.queue.add(again, before=self.queue.next)
        self._show_state()
        self.run_queue()

    def offer_and_queue(self, name: str, plan: PlanForm) -> None:
        """Append a plan from another page to the queue and preview it; nothing starts."""
        self.new.offer(name, plan)
        self.tabs.setCurrentWidget(self.preview)
        self._add_to_queue(start=False)

    def enqueue(self, session: SessionPreview, *, first: bool = False) -> QueuedSession | None:
        """Append the plan in the form to the queue, or put it before what waits."""
        try:
            plan, specimen = self.new.plan(), self.new.specimen_facts()
            campaign = self.new.destination.path
        except DragrigError as error:
            self.complained.emit(str(error), Topic.SESSION)
            return None
        job = replace(self._new_job(plan, self.new.note.text()), append=campaign, specimen=specimen)
        title = plan.name if campaign is None else f"{plan.name}, added to {campaign.name}"
        previews = session.preflight.previews
        planned = (preview.run for preview in previews)
        runs = tuple(engine_host.QueuedRun(run.index, run.summary, run.wait_s, run.duration_s) for run in planned)
        entry = QueuedSession(job, title, session.preflight.duration_s, len(previews), runs=runs)
        self.queue.add(entry, before=self.queue.next if first else None)
        self.new.keep()
        self.new.note_session()
        self._show_state()
        return entry

    def _new_job(self, plan: Plan, note: str) -> engine_host.SessionJob:
        new = self.new
        return engine_host.SessionJob(
            self.queue.next_number(), plan, new.operator.text(), note, new.chosen_pace, mirror=new.chosen_mirror
        )

    def add_to_campaign(self, runs: FurtherRuns) -> None:
        """Queue runs that go on with a campaign, unless they wait or run already, and start them if they are next."""
        entry = self.queue.of_campaign(runs.folder, runs.plan)
        if entry is None:
            job = self._new_job(runs.plan, runs.reason)
            job = replace(job, resume=runs.folder) if runs.resumes else replace(job, append=runs.folder)
            entry = QueuedSession(job, f"Settle {runs.folder.name}", 60 * runs.minutes, runs.count)
            self.queue.add(entry)
        self._show_state()
        if self.queue.next is entry:
            self.run_queue()
        elif entry.stage is QueueState.WAITING and not self.session_running:
            self.complained.emit(f"{entry.title} is waiting behind other sessions: start the queue.", Topic.SESSION)

    def run_queue(self) -> None:
        """Run the waiting sessions."""
        self._queue_started = True
        entry = self.queue.next
        if self.session_running or entry is None:
            return
        if hindrance := self._hindrance():
            self._queue_started = False
            self.complained.emit(f"{entry.title} is waiting: {hindrance}, then start the queue.", Topic.SESSION)
            return
        if self._engine.lost or self._trip_reason:
            self._queue_started = False
            cause = "the engine has ended; start it again" if self._engine.lost else "the guard is not armed; reset it"
            self.complained.emit(f"{entry.title} is waiting: {cause}, then start the queue.", Topic.GUARD)
            return
        entry.stage = QueueState.RUNNING
        for topic in (Topic.SESSION, Topic.PASSING):
            self.settled.emit(topic)
        self._engine.ask(entry.job)
        self.tabs.setCurrentWidget(self.live)
        self.live.begin_session(f"{entry.title}: preparing …")
        self._show_state()

    def _hindrance(self) -> str:
        """Return what must be over before a session starts; empty for nothing."""
        if self.restart_due:
            return "the engine starts again with the settings that were saved; reset the guard"
        if self.calibrating:
            return "a calibration is under way; end it"
        return "a motion by hand is under way; end it" if self.hand.busy else ""

    def await_engine(self, reason: str) -> None:
        """Let nothing move until a new engine says so itself; it starts tripped."""
        self._trip_reason = reason
        self.live.readings.clear(reason)
        self._show_state()

    def stop(self, reason: str) -> None:
        """Stop the stage at once, and the queue."""
        self._queue_started = False
        self._engine.ask(engine_host.AbortSession(reason))

    def take(self, event: engine_host.Event) -> None:
        """Handle an event of the engine."""
        match event:
            case engine_host.RigIdle(reading, question):
                if not question or question != self.answered:  # else read just before the answer arrived
                    self.live.show_idle(reading, "prompt open" if question else "at rest")
                return
            case engine_host.HostReady(pid):
                self.write_log(f"Engine ready, process {pid}.")
                self._engine.ask(engine_host.WatchRig(self.devices.watch.isChecked()))
                return
            case engine_host.GuardState(reason, tripped):
                self.write_log(f"{'GUARD TRIPPED' if tripped else 'Guard'}: {reason or 'armed'}.")
                self._trip_reason = reason
            case engine_host.StageMoved(sentence, problem):
                self.hand.end(sentence or f"Not done: {problem}")
                if sentence:
                    self.write_log(sentence)
                else:
                    self.complained.emit(problem, Topic.HAND)
            case engine_host.RigExamined():
                self.devices.show_result(event)
                self.tabs.setTabText(self.tabs.indexOf(self.devices), f"Devi&ces: {self.devices.verdict}")
            case engine_host.HostLost(exit_code):
                self.write_log(f"ENGINE LOST, exit code {exit_code}.")
                self._engine_lost(event)
            case _:
                self._follow_session(event)
        self._show_state()

    def _follow_session(self, event: engine_host.Event) -> None:
        self.queue.take(event)
        match event:
            case engine_host.PromptShown():
                self.write_log(f"Prompt: {event.text}.")
                self.pause.setChecked(False)
            case engine_host.SessionStarted(_, runs):
                self.write_log(f"Session started, {len(runs)} runs.")
            case engine_host.StageHomes(sentence):
                self.live.readings.end_motion(sentence or "preparing")
                self.write_log(f"{sentence or 'Homed'}.")
            case engine_host.SessionWaiting(run, duration_s):
                self.write_log(f"Rest before {run.summary}: {duration_text(duration_s)}.")
                self.live.begin_rest(run.summary, duration_s, run.start_mm)
            case engine_host.RunStarted(run, order):
                self.write_log(f"Run {order} started: {run.summary}.")
                self.live.begin_run(f"Run {order}: {run.summary}", run.start_mm)
            case engine_host.RunFinished():
                self._run_ended(event)
            case engine_host.OperatorWarning(sentence):
                # It was said in the preview, and hides nothing of the page here.
                self.write_log(sentence)
            case engine_host.SentinelCompared(_, sentence):
                self.live.begin(sentence)
                self.write_log(f"{sentence}.")
            case engine_host.SessionFinished():
                self._ended(event)
            case _:
                pass

    def _engine_lost(self, event: engine_host.HostLost) -> None:
        self._queue_started, self._trip_reason = False, ENGINE_LOST
        running = self.queue.current
        self.queue.take(event)
        if running is not None:
            self.session_over.emit(running)
        self.devices.engine_lost()
        self.hand.end("The engine has ended.")
        self.tabs.setTabText(self.tabs.indexOf(self.devices), "Devi&ces")
        self.live.end_run("The engine has ended")
        self.live.readings.clear("no engine")

    def sample(self, fresh: engine_host.LiveSamples) -> None:
        """Show live samples."""
        self.live.take(fresh)
        entry, now = self.queue.current, time.monotonic()
        if entry is not None and self.live.run is not None and now - self._progress_at > _PROGRESS_INTERVAL_S:
            self._progress_at = now
            entry.elapsed_s = self.live.run.latest.time_s
            entry.rest_left_s = self.live.rest_left_s
            self.queue_view.show_queue()

    def _watch(self, *, on: bool) -> None:
        self._stored.keep("watch", "yes" if on else "no")
        self._engine.ask(engine_host.WatchRig(on))
        if not on:
            self.live.readings.clear("not read between sessions")

    def _run_ended(self, event: engine_host.RunFinished) -> None:
        run, status = f"Run {event.order}", event.status.value
        self.write_log(f"{', '.join(filter(None, (f'{run} {status}', event.reason)))}: {event.samples} samples.")
        self.live.end_run(f"{run} ({event.run.summary}): {status}")
        for warning in event.warnings:
            self.complained.emit(f"{run}, {event.run.summary}: {warning}.", Topic.SESSION)

    def _ended(self, event: engine_host.SessionFinished) -> None:
        status = "not started" if event.status is None else event.status.value
        self.write_log(": ".join(filter(None, (f"Session {status}", event.reason, str(event.folder or "")))))
        if event.mirror is not None and event.mirror.missing:
            names, mirror = ", ".join(name for name, _ in event.mirror.missing), event.mirror.folder
            self.complained.emit(
                f"NOT IN THE MIRROR {mirror}: {names}. The originals are in {event.folder}, the reasons in the queue.",
                Topic.SESSION,
            )
        if event.status is engine_host.RunStatus.COMPLETE:
            self.live.end_run(f"Complete: {event.folder}")
        else:
            self._queue_started = False
            self.live.end_run(f"Session ended: {event.reason}")
            if event.status is engine_host.RunStatus.TRIPPED:
                self._trip_reason = event.reason
            else:
                own = any(words in event.reason for words in _OWN_ENDS)
                self.complained.emit(f"Session ended: {event.reason}", Topic.PASSING if own else Topic.SESSION)
        if event.folder is not None:
            self.new.session_over(event.folder)
        for entry in self.queue.entries:
            if entry.job.number == event.job:
                self.session_over.emit(entry)
        if self._queue_started:
            self.run_queue()

    def _add_to_queue(self, *, start: bool) -> None:
        self.new.update_preview()
        session = self.new.session
        if session is None or session.preflight.findings or self.enqueue(session, first=start) is None:
            return
        if start:
            self.run_queue()

    def _move_by_hand(self, motion: engine_host.HandMotion) -> None:
        self.settled.emit(Topic.HAND)
        self._engine.ask(motion)

    def _pause(self) -> None:
        self._engine.ask(engine_host.PauseSession(self.pause.isChecked()))
        self._show_pause()

    def _show_pause(self) -> None:
        """Say on the button after which run the session pauses, and that another press takes it back."""
        entry, pauses = self.queue.current, self.pause.isChecked()
        last = None if entry is None else entry.last_before_pause
        number = None if entry is None or last is None else entry.number_of(last)
        when = "before the next run" if number is None else f"after run {number}"
        self.pause.setText(f"Pauses {when} (undo)" if pauses else "Pause after this run")
        set_role(self.pause, "main" if pauses else "")

    def write_log(self, sentence: str) -> None:
        """Add a line to the log, with the time."""
        self.log.appendPlainText(f"{time.strftime('%Y-%m-%d %H:%M:%S')}  {sentence}")

    def _show_state(self) -> None:
        running = self.session_running
        self.queue_view.show_queue()
        self._show_buttons()
        self._show_why()
        self.abort.setEnabled(running)
        self.pause.setEnabled(running)
        if not running:
            self.pause.setChecked(False)
        self._show_pause()
        self.devices.set_session_running(running=running)
        self.hand.allow(idle=not (running or self.calibrating), armed=self.armed)
        self.running_changed.emit(running)

    def _show_why(self) -> None:
        """Show why the runs of the running session, or of the next one, are made."""
        entry = self.queue.current or self.queue.next
        self.why.setText("" if entry is None or not entry.why else f"{entry.title}: {entry.why}")
        self.why.setVisible(bool(self.why.text()))

    def _show_buttons(self) -> None:
        waiting = sum(entry.stage is QueueState.WAITING for entry in self.queue.entries)
        self.start_queue.setEnabled(not self.session_running and waiting > 0)
        self.tabs.setTabText(self.tabs.indexOf(self.queue_view), f"Q&ueue ({waiting})" if waiting else "Q&ueue")

    def _connect(self, engine: EngineLink) -> None:
        engine.event_received.connect(self.take)
        self.complained.connect(lambda sentence, _: self.write_log(sentence))
        engine.sampled.connect(self.sample)
        self.new.planned.connect(self.preview.show_session)
        self.new.refused.connect(self.preview.refuse)
        self.new.submitted.connect(lambda start: self._add_to_queue(start=start))
        self.queue_view.changed.connect(self._show_buttons)
        self.queue_view.changed.connect(self._show_why)
        self.queue_view.changed.connect(self._keep_queue)
        self.queue_view.chosen_job.connect(self.new.take_back)
        self.queue_view.gone_on_with.connect(self.make_missing)
        self.queue_view.chosen_folder.connect(self.look_at.emit)

    def _lay_out(self) -> None:
        bar = column(self.queue_view.progress, row(1, self.pause, self.abort, self.start_queue))
        right = bare_widget(column(self.why, self.tabs, bar, stretch={1: 1}))
        self.setLayout(column(split(self.new, right, (340, 680), self._stored, "run"), margin=6))
