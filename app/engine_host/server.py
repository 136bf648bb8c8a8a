"""The engine host's process: two connection threads, the operator prompts, and one request after the other."""

import os
import queue
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event as Signal
from threading import Lock, Thread

from dragrig import campaign_session as campaigns
from dragrig.api.measure import examine
from dragrig.api.stage import run_on_bench
from dragrig.campaign_session import Made, SessionOptions
from dragrig.config.errors import DragrigError, TrippedError
from dragrig.engine_host.messages import (
    SILENCE_TIMEOUT_S,
    AbortSession,
    DeviceFinding,
    Event,
    ExamineRig,
    GuardState,
    Heartbeat,
    HostReady,
    LiveRingWriter,
    MirrorStatus,
    OperatorWarning,
    PromptReply,
    PromptShown,
    QueuedRun,
    Request,
    RequestRefused,
    ResetGuard,
    RigExamined,
    RigSelection,
    RingMemory,
    RunFinished,
    RunStarted,
    SessionFinished,
    SessionJob,
    SessionStarted,
    SessionWaiting,
    StartSession,
    StopHost,
)
from dragrig.rig.engine import AcquisitionOutcome
from dragrig.rig.operator import Answer, Prompt
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.reading import Reading
from dragrig.rig.runfile.model import RunStatus
from dragrig.setup import resolve, resolve_rig

_POLL_S = 0.25
CLIENT_GONE = "the window is gone"
CLIENT_SILENT = "the window has been silent for too long"


class EventSender:
    """Sends events in order from a thread of its own; `say` returns at once."""

    def __init__(self, connection: "Connection[Event, Request]") -> None:
        self._connection = connection
        self._events: queue.SimpleQueue[Event | None] = queue.SimpleQueue()
        self._thread = Thread(target=self._send_all, name="mouth", daemon=True)
        self._thread.start()

    def say(self, event: Event) -> None:
        """Have an event sent."""
        self._events.put(event)

    def close(self, within_s: float = 2.0) -> None:
        """Wait until all is sent, or nobody listens."""
        self._events.put(None)
        self._thread.join(within_s)

    def _send_all(self) -> None:
        while (event := self._events.get()) is not None:
            try:
                self._connection.send(event)
            except OSError:
                return


class RequestReceiver:
    """Hears requests on a thread of its own: stops and answers at once, the others in order from `next`.

    A stop is for what had been asked before it came, under way or still to be begun, and for nothing asked later.

    Attributes
    ----------
    gone
        Set once there is no client any more, or it wants the host to end.
    """

    def __init__(self, connection: "Connection[Event, Request]", silence_s: float = SILENCE_TIMEOUT_S) -> None:
        self._connection = connection
        self._silence_s = silence_s
        self._requests: queue.SimpleQueue[tuple[int, Request] | None] = queue.SimpleQueue()
        self._lock = Lock()
        self._heard = self._at_hand = self._stopped = 0
        self._stop: Callable[[str], None] | None = None
        self._stop_reason = ""
        self._questions: dict[int, queue.SimpleQueue[Answer]] = {}
        self.gone = Signal()
        Thread(target=self._listen, name="ear", daemon=True).start()

    def next(self) -> Request | None:
        """Wait for a request; none once the client is gone."""
        found = None if self.gone.is_set() else self._requests.get()
        if found is None:
            return None
        with self._lock:
            self._at_hand, request = found
        return request

    def stops(self, stop: Callable[[str], None] | None) -> None:
        """Name what stops the request at hand; a stop that came before it is passed on now."""
        with self._lock:
            self._stop, reason = stop, self._stop_reason if self._ending else ""
        if stop is not None and reason:
            stop(reason)

    def await_answer(self, question: int, put: Callable[[], None]) -> Answer:
        """Put a question and wait for its answer; abort where the request at hand is to end."""
        box: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        with self._lock:
            self._questions[question] = box
            if self._ending:
                box.put(Answer.ABORT)
        try:
            # Not before there is a box for the answer, which may be quick.
            put()
            return box.get()
        finally:
            with self._lock:
                del self._questions[question]

    @property
    def _ending(self) -> bool:
        """Whether the request at hand is to end; asked with the lock held."""
        return self._at_hand <= self._stopped

    def _listen(self) -> None:
        reason = CLIENT_GONE
        heard = time.monotonic()
        with suppress(EOFError, OSError):
            while True:
                if self._connection.poll(_POLL_S):
                    request = self._connection.recv()
                    heard = time.monotonic()
                    self._hear(request)
                    if isinstance(request, StopHost):
                        reason = "the window was closed"
                        break
                elif time.monotonic() - heard > self._silence_s:
                    reason = CLIENT_SILENT
                    break
        self.gone.set()
        self._end(reason)
        self._requests.put(None)

    def _hear(self, request: Request) -> None:
        match request:
            case AbortSession(reason):
                self._end(reason)
            case PromptReply(question, answer):
                with self._lock:
                    box = self._questions.get(question)
                if box is not None:
                    box.put(answer)
            case Heartbeat() | StopHost():
                pass
            case _:
                with self._lock:
                    self._heard += 1
                    self._requests.put((self._heard, request))

    def _end(self, reason: str) -> None:
        with self._lock:
            if self._stopped < self._heard:  # else all that was asked is to end already, for the reason given first
                self._stopped, self._stop_reason = self._heard, reason
            stop, reason, boxes = self._stop, self._stop_reason, tuple(self._questions.values())
        if stop is not None:
            stop(reason)
        for box in boxes:
            box.put(Answer.ABORT)


class RemoteOperator:
    """Asks and tells somebody in another process; tells never wait, asks wait for the answer or the end."""

    def __init__(self, mouth: EventSender, ear: RequestReceiver, live: LiveRingWriter) -> None:
        self._mouth, self._ear, self._live = mouth, ear, live
        self._numbers = count(1)
        self._job = self._order = 0

    def takes(self, job: int) -> None:
        """Say which session is told of from here on."""
        self._job = job

    def ask(self, prompt: Prompt) -> Answer:
        """Put a prompt and wait for the answer; abort when the session is to end."""
        question = next(self._numbers)
        asked = PromptShown(question, prompt.text, prompt.can_redo, prompt.can_skip, prompt.hands)
        return self._ear.await_answer(question, lambda: self._mouth.say(asked))

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Tell which runs are still to be made."""
        del programme
        self._mouth.say(SessionStarted(self._job, tuple(map(_queued_run, pending)), real_time))

    def waits(self, duration_s: float, why: str) -> None:
        """Tell that nothing moves for a while."""
        self._mouth.say(SessionWaiting(duration_s, why))

    def run_begins(self, run: PlannedRun, order: int) -> None:
        """Tell that a run starts."""
        self._order = order
        self._live.begin()
        self._mouth.say(RunStarted(_queued_run(run), order))

    def reads(self, reading: Reading) -> None:
        """Put a block where a screen may find it."""
        self._live.put(reading)

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Tell how a run ended."""
        warnings = tuple(outcome.checks.warnings)
        self._mouth.say(
            RunFinished(_queued_run(run), self._order, outcome.status, outcome.reason, outcome.samples, warnings)
        )


def _queued_run(run: PlannedRun) -> QueuedRun:
    return QueuedRun(run.index, run.protocol.summary(), run.wait_s, run.duration_s)


NOT_YET_RESET = "nobody has looked at the rig yet: its way free, hands out, the e-stop in reach"


def serve(
    connection: "Connection[Event, Request]",
    memory: RingMemory,
    rig: RigSelection,
    silence_s: float = SILENCE_TIMEOUT_S,
) -> None:
    """Host an engine until the client leaves or dies; what a process of its own runs."""
    # Ctrl-C in the terminal is the client's to hear; a session under way hears it by itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    mouth, ear = EventSender(connection), RequestReceiver(connection, silence_s)
    EngineHost(mouth, ear, LiveRingWriter(memory), rig).run()
    mouth.close()


class EngineHost:
    """Answers requests on the process's main thread, where a session hears signals."""

    def __init__(self, mouth: EventSender, ear: RequestReceiver, live: LiveRingWriter, rig: RigSelection) -> None:
        self._mouth, self._ear, self._rig = mouth, ear, rig
        self._person = RemoteOperator(mouth, ear, live)
        self._latched_on = NOT_YET_RESET

    def run(self) -> None:
        """Answer until the client is gone."""
        self._mouth.say(HostReady(os.getpid()))
        self._mouth.say(GuardState(self._latched_on))
        while (request := self._ear.next()) is not None:
            try:
                self._answer(request)
            except Exception as error:  # noqa: BLE001  # the client must hear of it, and the host must go on
                self._mouth.say(RequestRefused(f"a bug ({type(error).__name__}: {error}); please report it."))

    def _answer(self, request: Request) -> None:
        match request:
            case StartSession(job):
                self._start(job)
            case ExamineRig():
                self._mouth.say(self._examined())
            case ResetGuard():
                self._reset()
            case _:
                pass

    def _start(self, job: SessionJob) -> None:
        if self._latched_on:
            sentence = f"the guard is tripped: {self._latched_on}; see to it, then reset the guard"
            self._mouth.say(SessionFinished(job.number, None, sentence))
            return
        self._person.takes(job.number)
        ended = SessionFinished(job.number, RunStatus.FAILED, "the engine met a bug")
        try:
            made = self._carry_out(job)
            ended = SessionFinished(
                job.number, made.session.status, made.session.reason, made.folder, _mirror_status(made)
            )
        except DragrigError as error:
            ended = SessionFinished(job.number, None, str(error))
        finally:
            self._ear.stops(None)
            self._mouth.say(ended)
        if ended.status is RunStatus.TRIPPED:
            self._latch(ended.reason)

    def _carry_out(self, job: SessionJob) -> Made:
        terms = SessionOptions(
            Path(),
            operator=job.operator,
            note=job.note,
            pace=job.pace,
            begun=self._ear.stops,
            mirror=job.mirror,
            tell=lambda sentence: self._mouth.say(OperatorWarning(sentence)),
        )
        if job.resume is not None:
            return campaigns.resume_campaign(job.resume, terms, self._person)
        return campaigns.start_campaign(resolve(job.plan, **self._rig.choices()), job.out, terms, self._person)

    def _reset(self) -> None:
        try:
            setup = resolve_rig(**self._rig.choices())
            pace = self._rig.pace if setup.double else None
            run_on_bench(lambda bench: bench.manual.reset(), setup, pace, self._person)
        except TrippedError as error:
            self._latch(str(error))
        except DragrigError as error:
            self._mouth.say(RequestRefused(str(error)))
        else:
            self._latch("")

    def _latch(self, reason: str) -> None:
        self._latched_on = reason
        self._mouth.say(GuardState(reason))

    def _examined(self) -> RigExamined:
        found = RigExamined(())
        try:
            for one in examine(**self._rig.choices()):
                found = replace(found, devices=(*found.devices, DeviceFinding(one.what, one.fine, one.detail)))
        except DragrigError as error:
            return replace(found, error=str(error))
        return found


def _mirror_status(made: Made) -> MirrorStatus | None:
    found = made.mirrored
    return None if found is None else MirrorStatus(found.folder, len(found.copied), tuple(found.missing.items()))
