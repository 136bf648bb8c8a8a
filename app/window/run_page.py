"""The page that runs plans: new session, preview, live view, devices, queue."""

import time
from collections.abc import Callable
from pathlib import Path

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QHeaderView, QProgressBar, QSplitter, QTabWidget, QTreeWidget, QTreeWidgetItem, QWidget

from dragrig.config.errors import DragrigError
from dragrig.engine_host.messages import (
    AbortSession,
    Event,
    ExamineRig,
    GuardState,
    HostLost,
    LiveSamples,
    QueuedRun,
    RigExamined,
    RigSelection,
    RunFinished,
    RunStarted,
    RunStatus,
    SessionFinished,
    SessionJob,
    SessionStarted,
    SessionWaiting,
    StartSession,
)
from dragrig.present.numbers import duration_text
from dragrig.views.plan_view import PlanForm, RigDescription, SessionPreview
from dragrig.window.background import EngineLink
from dragrig.window.live_view import LiveView
from dragrig.window.new_session import NewSession, PlanPreview
from dragrig.window.session_queue import QueuedSession, QueueState, SessionQueue
from dragrig.window.widgets import (
    StoredSettings,
    bare_widget,
    button,
    column,
    current_item,
    fill_table,
    label,
    named,
    parent_of,
    row,
    table,
)


class DevicesView(QWidget):
    """Shows what the last look at the rig found; nothing moves for a look."""

    def __init__(self, look: Callable[[], None]) -> None:
        super().__init__()
        self._ask = look
        self._words = "Not looked at yet."
        self._looks = self._busy = False
        self.verdict = ""
        self.told = label(self._words, "faint", wrap=True)
        self.devices = named(table(("", "Device", "What was found")), "State of every device")
        self.again = button("Look agai&n", self.look, help_="Look at every device; nothing moves")
        self.setLayout(column(row(self.told, 1, self.again), self.devices, margin=8))

    def look(self) -> None:
        """Have the rig looked at."""
        self._looks = True
        self._ask()
        self._show_state()

    def show_found(self, found: RigExamined) -> None:
        """Show what was found."""
        self._looks = False
        fill_table(self.devices, [("ok" if one.fine else "NOT", one.what, one.detail) for one in found.devices])
        wrong = sum(not one.fine for one in found.devices)
        self.verdict = "NOT FOUND" if found.error else f"{wrong} NOT FINE" if wrong else "all fine"
        self._words = found.error or f"{len(found.devices)} things looked at, {self.verdict}."
        self._show_state()

    def give_up(self) -> None:
        """Nobody is there who could look."""
        self._looks = False
        self._show_state()

    def busy(self, *, busy: bool) -> None:
        """While a session is under way its devices are not looked at."""
        self._busy = busy
        self._show_state()

    def _show_state(self) -> None:
        self.again.setEnabled(not (self._busy or self._looks))
        if self._busy:
            self.told.setText("A session is under way: the guard looks at every block. This was found before.")
        else:
            self.told.setText("Looking at every device …" if self._looks else self._words)


_QUEUE_HEADER = ("Session", "Runs", "Takes", "State")
_JOB_ROLE = int(Qt.ItemDataRole.UserRole)


class QueueView(QWidget):
    """Shows a queue and lets its waiting sessions be moved and taken out."""

    chosen_folder = Signal(str)
    """The folder of a finished session that a person wants to look at."""

    def __init__(self, queue: SessionQueue) -> None:
        super().__init__()
        self._queue = queue
        self._shown: list[tuple[object, ...]] = []
        self.tree = QTreeWidget()
        self.tree.setHeaderLabels(list(_QUEUE_HEADER))
        self.tree.setAccessibleName("Queue of sessions")
        self.tree.setAlternatingRowColors(True)
        self.tree.header().setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        self.tree.itemDoubleClicked.connect(lambda item, _: self._look(item))
        self.progress = QProgressBar()
        self.progress.setRange(0, 1000)
        self.progress.setAccessibleName("Progress of the session under way")
        self.up = button("&Up", lambda: self._move(-1), help_="Make the chosen session earlier")
        self.down = button("Do&wn", lambda: self._move(1), help_="Make the chosen session later")
        self.out = button("Re&move", self._remove, help_="Take the chosen session out of the queue")
        self.clear = button("C&lear finished", self._clear, help_="Forget sessions that are over; their files stay")
        self.look = button("Loo&k at it", self._look_at_chosen, help_="Show the chosen session's runs")
        buttons = row(self.up, self.down, self.out, self.clear, 1, self.look)
        self.setLayout(column(label("Queue", "title"), self.progress, self.tree, buttons))
        self.show_queue()

    def show_queue(self) -> None:
        """Bring the screen to what the queue is now."""
        state = [self._state(one) for one in self._queue.entries]
        if state != self._shown:
            self._shown = state
            self._rebuild()
        self._tell_progress()

    def _state(self, entry: QueuedSession) -> tuple[object, ...]:
        moving = entry.under_way.index if entry.under_way is not None else -1
        return entry.job.number, entry.stage, len(entry.runs), tuple(entry.ended), moving, entry.reason

    def _tell_progress(self) -> None:
        entry = self._queue.current
        waiting = sum(one.stage is QueueState.WAITING for one in self._queue.entries)
        if entry is None:
            self.progress.setValue(0)
            told = f"{waiting} waiting, {duration_text(self._queue.left_s)}" if waiting else "nothing waits"
            self.progress.setFormat(f"not running; {told}")
            return
        self.progress.setValue(round(1000 * entry.share))
        more = f"; {waiting} more waiting, {duration_text(self._queue.left_s)} in all" if waiting else ""
        # A dry run's rests take no time, and nobody knows how fast it is.
        left = f", {duration_text(entry.left_s)} left" if entry.real_time else ""
        self.progress.setFormat(f"{entry.title}: run {entry.place} of {entry.count}{left}{more}")

    def _rebuild(self) -> None:
        chosen = self._chosen()
        self.tree.clear()
        for entry in self._queue.entries:
            told = f"{entry.stage.value}{f': {entry.reason}' if entry.reason else ''}{_mirror_text(entry)}"
            item = QTreeWidgetItem([entry.title, str(entry.count), duration_text(entry.seconds), told])
            item.setData(0, _JOB_ROLE, entry.job.number)
            item.setToolTip(3, told)
            self.tree.addTopLevelItem(item)
            for run in entry.runs:
                item.addChild(QTreeWidgetItem([f"{run.index}  {run.summary}", "", duration_text(run.duration_s),
                                               _run_state_text(entry, run)]))  # fmt: skip
            missing = entry.mirror.missing if entry.mirror is not None else ()
            for name, why in missing:
                item.addChild(QTreeWidgetItem([name, "", "", f"NOT IN THE MIRROR: {why}"]))
            item.setExpanded(entry.stage is QueueState.RUNNING or bool(missing))
            if entry is chosen:
                self.tree.setCurrentItem(item)

    def _chosen(self) -> QueuedSession | None:
        item = current_item(self.tree)
        while item is not None and (above := parent_of(item)) is not None:
            item = above
        number = item.data(0, _JOB_ROLE) if item is not None else None
        return next((one for one in self._queue.entries if one.job.number == number), None)

    def _move(self, by: int) -> None:
        if (entry := self._chosen()) is not None:
            self._queue.move(entry, by)
            self.show_queue()

    def _remove(self) -> None:
        if (entry := self._chosen()) is not None:
            self._queue.remove(entry)
            self.show_queue()

    def _clear(self) -> None:
        self._queue.clear_finished()
        self.show_queue()

    def _look(self, item: QTreeWidgetItem) -> None:
        self.tree.setCurrentItem(item)
        self._look_at_chosen()

    def _look_at_chosen(self) -> None:
        entry = self._chosen() or next((one for one in reversed(self._queue.entries) if one.folder), None)
        if entry is not None and entry.folder:
            self.chosen_folder.emit(entry.folder)


def _run_state_text(entry: QueuedSession, run: QueuedRun) -> str:
    ended = entry.ended.get(run.index)
    if ended is None:
        return "moving" if entry.under_way is not None and entry.under_way.index == run.index else ""
    told = [ended.status.value, *([ended.reason] if ended.status is not RunStatus.COMPLETE else [])]
    return "; ".join((*told, *(f"NOTE {one}" for one in ended.warnings)))


def _mirror_text(entry: QueuedSession) -> str:
    found = entry.mirror
    if found is None:
        return ""
    if found.missing:
        return f"; {len(found.missing)} of {found.copied + len(found.missing)} files NOT IN THE MIRROR {found.folder}"
    return f"; all {found.copied} files in the mirror {found.folder}"


_PROGRESS_INTERVAL_S = 0.2


class RunPage(QWidget):
    """Plans in, run files out: form, preview, queue, live traces, devices."""

    moves = Signal(bool)
    """Whether a session is under way."""
    complained = Signal(str)
    look_at = Signal(str)

    def __init__(
        self, engine: EngineLink, rig: RigSelection, words: RigDescription, lab: Path | None, remembered: StoredSettings
    ) -> None:
        super().__init__()
        self.setObjectName("page")
        self._engine = engine
        self._goes_on = False
        self._told_at = 0.0
        self._latched = "the engine is not there yet"
        self.queue = SessionQueue()
        self.new = NewSession(rig, words, lab, remembered)
        self.preview, self.live = PlanPreview(), LiveView()
        self.queue_view = QueueView(self.queue)
        self.devices = DevicesView(lambda: engine.ask(ExamineRig()))
        self.state = label("Nothing is under way.", "faint")
        self.start_queue = button("Start &the queue", self.go_on, "main", "Carry the waiting sessions out, one by one")
        self.abort = button("&Abort the session", self._abort, help_="Stop the stage and end the session in good order")
        self.tabs = QTabWidget()
        self.tabs.addTab(self.preview, "W&hat it will do")
        self.tabs.addTab(self.live, "Li&ve")
        self.tabs.addTab(self.devices, "Devi&ces")
        self._lay_out()
        self._wire(engine)
        self.new.begin()
        self._show_state()

    @property
    def under_way(self) -> bool:
        """Whether a session is under way."""
        return self.queue.current is not None

    def offer_and_queue(self, name: str, plan: PlanForm) -> None:
        """Put a plan that comes from another page into the queue, and show what it will do; nothing begins."""
        self.new.offer(name, plan)
        self.tabs.setCurrentWidget(self.preview)
        self._want(start=False)

    def enqueue(self, session: SessionPreview) -> QueuedSession | None:
        """Put what is filled in into the queue."""
        try:
            plan = self.new.plan()
        except DragrigError as error:
            self.complained.emit(str(error))
            return None
        job = SessionJob(
            self.queue.number(),
            plan,
            self.new.operator.text(),
            self.new.note.text(),
            self.new.chosen_pace,
            mirror=self.new.chosen_mirror,
        )
        entry = QueuedSession(job, plan.name, session.preflight.duration_s, len(session.preflight.previews))
        self.queue.add(entry)
        self.new.keep()
        self._show_state()
        return entry

    def go_on(self) -> None:
        """Carry out what waits."""
        self._goes_on = True
        entry = self.queue.next
        if self.under_way or entry is None:
            return
        if self._engine.lost or self._latched:
            self._goes_on = False
            why = "the engine has ended; start it again" if self._engine.lost else "the guard is tripped; reset it"
            self.complained.emit(f"{entry.title} waits in the queue: {why}, then start the queue.")
            return
        entry.stage = QueueState.RUNNING
        self._engine.ask(StartSession(entry.job))
        self.tabs.setCurrentWidget(self.live)
        self.live.begin(f"{entry.title}: getting ready …")
        self._show_state()

    def stop(self, reason: str) -> None:
        """Stop the stage at once; nothing of the queue is begun until somebody says so."""
        self._goes_on = False
        self._engine.ask(AbortSession(reason))

    def take(self, event: Event) -> None:
        """Hear what the engine says."""
        match event:
            case SessionStarted():
                self.queue.begins(event)
            case SessionWaiting(duration_s, why):
                self.live.begin(f"{why}: {duration_text(duration_s)}")
            case RunStarted(run, order):
                self.queue.run_begins(event)
                self.live.begin(f"Run {order}: {run.summary}")
            case RunFinished():
                self.queue.run_ends(event)
                self._tell_warnings(event)
            case SessionFinished():
                self._ended(event)
            case GuardState(reason):
                self._latched = reason
            case RigExamined():
                self.devices.show_found(event)
                self.tabs.setTabText(self.tabs.indexOf(self.devices), f"Devi&ces: {self.devices.verdict}")
            case HostLost():
                self._goes_on, self._latched = False, "the engine is gone"
                self.queue.is_lost(self._latched)
                self.devices.give_up()
            case _:
                return
        self._show_state()

    def sample(self, fresh: LiveSamples) -> None:
        """Take live samples."""
        self.live.take(fresh)
        entry, now = self.queue.current, time.monotonic()
        if entry is not None and self.live.run is not None and now - self._told_at > _PROGRESS_INTERVAL_S:
            self._told_at = now
            entry.elapsed_s = self.live.run.latest.time_s
            self.queue_view.show_queue()

    def _ended(self, event: SessionFinished) -> None:
        self.queue.ends(event)
        if event.mirror is not None and event.mirror.missing:
            names = ", ".join(name for name, _ in event.mirror.missing)
            self.complained.emit(
                f"NOT IN THE MIRROR {event.mirror.folder}: {names}; the queue says why. They are in {event.folder}."
            )
        if event.status is RunStatus.COMPLETE:
            self.live.begin(f"Complete: {event.folder}")
        else:
            self._goes_on = False
            self.live.begin(f"Ended early: {event.reason}")
            if event.status is RunStatus.TRIPPED:
                self._latched = event.reason
            else:
                self.complained.emit(f"The session ended early: {event.reason}")
        if self._goes_on:
            self.go_on()

    def _tell_warnings(self, event: RunFinished) -> None:
        for warning in event.warnings:
            self.complained.emit(f"Run {event.order}, {event.run.summary}: {warning}.")

    def _want(self, *, start: bool) -> None:
        self.new.look()
        session = self.new.session
        if session is None or session.preflight.findings or self.enqueue(session) is None:
            return
        if start:
            self.go_on()

    def _abort(self) -> None:
        self.stop("aborted at the window")

    def _show_state(self) -> None:
        moving = self.under_way
        self.queue_view.show_queue()
        self.start_queue.setEnabled(not moving and self.queue.next is not None)
        self.abort.setEnabled(moving)
        self.state.setText("A session is under way." if moving else "Nothing is under way.")
        self.devices.busy(busy=moving)
        self.moves.emit(moving)

    def _wire(self, engine: EngineLink) -> None:
        engine.said.connect(self.take)
        engine.sampled.connect(self.sample)
        self.new.planned.connect(self.preview.show_session)
        self.new.refused.connect(self.preview.refuse)
        self.new.wanted.connect(lambda start: self._want(start=start))
        self.queue_view.chosen_folder.connect(self.look_at.emit)

    def _lay_out(self) -> None:
        buttons = row(self.state, 1, self.abort, self.start_queue)
        right = QSplitter(Qt.Orientation.Vertical)
        right.addWidget(self.tabs)
        right.addWidget(bare_widget(column(buttons, self.queue_view)))
        right.setSizes([640, 290])
        right.setStretchFactor(0, 1)
        whole = QSplitter(Qt.Orientation.Horizontal)
        self.new.setMinimumWidth(430)
        whole.addWidget(self.new)
        whole.addWidget(right)
        whole.setSizes([450, 1000])
        whole.setStretchFactor(1, 1)
        self.setLayout(column(whole, margin=8))
