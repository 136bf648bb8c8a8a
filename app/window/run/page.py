"""The page that runs plans."""

import time
from pathlib import Path

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QSplitter, QTabWidget, QWidget

from dragrig.config.errors import DragrigError
from dragrig.engine_host.live import Fresh
from dragrig.engine_host.messages import (
    Abort,
    Began,
    Ended,
    Event,
    Examine,
    Examined,
    Job,
    Latched,
    Lost,
    RigTerms,
    RunBegan,
    RunEnded,
    Start,
    Status,
    Waiting,
)
from dragrig.plan_forms import PlanForm
from dragrig.planned import PlannedSession, RigInWords
from dragrig.window.engine_link import EngineLink
from dragrig.window.remembered import Remembered
from dragrig.window.run.devices import DevicesView
from dragrig.window.run.live import LiveView
from dragrig.window.run.new_session import NewSession
from dragrig.window.run.preview import Preview
from dragrig.window.run.queue_model import Entry, Queue, Stage
from dragrig.window.run.queue_view import QueueView
from dragrig.window.widgets import button, column, holder, label, row
from dragrig.wording import duration

_TELL_S = 0.2


class RunPage(QWidget):
    """Plans in, run files out: form, preview, queue, live traces, devices."""

    moves = Signal(bool)
    """Whether a session is under way."""
    complained = Signal(str)
    look_at = Signal(str)

    def __init__(
        self, engine: EngineLink, rig: RigTerms, words: RigInWords, lab: Path | None, remembered: Remembered
    ) -> None:
        super().__init__()
        self.setObjectName("page")
        self._engine = engine
        self._goes_on = False
        self._told_at = 0.0
        self._latched = "the engine is not there yet"
        self.queue = Queue()
        self.new = NewSession(rig, words, lab, remembered)
        self.preview, self.live = Preview(), LiveView()
        self.queue_view = QueueView(self.queue)
        self.devices = DevicesView(lambda: engine.ask(Examine()))
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

    def enqueue(self, session: PlannedSession) -> Entry | None:
        """Put what is filled in into the queue."""
        try:
            plan = self.new.plan()
        except DragrigError as error:
            self.complained.emit(str(error))
            return None
        job = Job(
            self.queue.number(),
            plan,
            self.new.operator.text(),
            self.new.note.text(),
            self.new.chosen_pace,
            mirror=self.new.chosen_mirror,
        )
        entry = Entry(job, plan.name, session.duration_s, len(session.runs))
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
        entry.stage = Stage.RUNNING
        self._engine.ask(Start(entry.job))
        self.tabs.setCurrentWidget(self.live)
        self.live.begin(f"{entry.title}: getting ready …")
        self._show_state()

    def stop(self, reason: str) -> None:
        """Stop the stage at once; nothing of the queue is begun until somebody says so."""
        self._goes_on = False
        self._engine.ask(Abort(reason))

    def take(self, event: Event) -> None:
        """Hear what the engine says."""
        match event:
            case Began():
                self.queue.begins(event)
            case Waiting(duration_s, why):
                self.live.begin(f"{why}: {duration(duration_s)}")
            case RunBegan(run, order):
                self.queue.run_begins(event)
                self.live.begin(f"Run {order}: {run.summary}")
            case RunEnded():
                self.queue.run_ends(event)
                self._tell_warnings(event)
            case Ended():
                self._ended(event)
            case Latched(reason):
                self._latched = reason
            case Examined():
                self.devices.show_found(event)
                self.tabs.setTabText(self.tabs.indexOf(self.devices), f"Devi&ces: {self.devices.verdict}")
            case Lost():
                self._goes_on, self._latched = False, "the engine is gone"
                self.queue.is_lost(self._latched)
                self.devices.give_up()
            case _:
                return
        self._show_state()

    def sample(self, fresh: Fresh) -> None:
        """Take live samples."""
        self.live.take(fresh)
        entry, now = self.queue.current, time.monotonic()
        if entry is not None and self.live.run is not None and now - self._told_at > _TELL_S:
            self._told_at = now
            entry.elapsed_s = self.live.run.latest.time_s
            self.queue_view.show_queue()

    def _ended(self, event: Ended) -> None:
        self.queue.ends(event)
        if event.mirror is not None and event.mirror.missing:
            names = ", ".join(name for name, _ in event.mirror.missing)
            self.complained.emit(
                f"NOT IN THE MIRROR {event.mirror.folder}: {names}; the queue says why. They are in {event.folder}."
            )
        if event.status is Status.COMPLETE:
            self.live.begin(f"Complete: {event.folder}")
        else:
            self._goes_on = False
            self.live.begin(f"Ended early: {event.reason}")
            if event.status is Status.TRIPPED:
                self._latched = event.reason
            else:
                self.complained.emit(f"The session ended early: {event.reason}")
        if self._goes_on:
            self.go_on()

    def _tell_warnings(self, event: RunEnded) -> None:
        for warning in event.warnings:
            self.complained.emit(f"Run {event.order}, {event.run.summary}: {warning}.")

    def _want(self, *, start: bool) -> None:
        self.new.look()
        session = self.new.session
        if session is None or session.findings or self.enqueue(session) is None:
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
        right.addWidget(holder(column(buttons, self.queue_view)))
        right.setSizes([640, 290])
        right.setStretchFactor(0, 1)
        whole = QSplitter(Qt.Orientation.Horizontal)
        self.new.setMinimumWidth(430)
        whole.addWidget(self.new)
        whole.addWidget(right)
        whole.setSizes([450, 1000])
        whole.setStretchFactor(1, 1)
        self.setLayout(column(whole, margin=8))
