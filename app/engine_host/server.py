"""The engine host's process: two connection threads, the operator prompts, and one request after the other."""

import os
import queue
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, replace
from functools import partial
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event as Signal
from threading import Lock, Thread

from dragrig.api import (
    calibrate_encoder,
    calibrate_force,
    examine,
    home,
    jog,
    run_on_bench,
    store_calibration,
    touch_off,
)
from dragrig.campaign_session import Made, append_to_campaign, resume_campaign, start_campaign
from dragrig.config import Calibration, DragrigError, SettingsError, TrippedError, reason_of
from dragrig.engine_host import messages
from dragrig.hosted_session import SessionOptions, idle_reader
from dragrig.present import sensor_calibration_document
from dragrig.rig import (
    HOMING,
    LIMIT_SWITCH_CAUSES,
    AcquisitionOutcome,
    Answer,
    Backend,
    Drift,
    IdleReading,
    Phase,
    PlannedRun,
    Programme,
    Prompt,
    Reading,
    RigCheck,
    RunStatus,
    latest_session_record,
)
from dragrig.setup import open_backend, resolve, resolve_rig

_POLL_S = 0.05
CLIENT_GONE = "the window is gone"
CLIENT_SILENT = "the window has been silent for too long"
CLIENT_FROZEN = "the window did not respond while the stage could move"


class EventSender:
    """Sends events in order from its own thread; `say` returns at once."""

    def __init__(self, connection: "Connection[messages.Event, messages.Request]") -> None:
        self._connection = connection
        self._events: queue.SimpleQueue[messages.Event | None] = queue.SimpleQueue()
        self._thread = Thread(target=self._send_all, name="sender", daemon=True)
        self._thread.start()

    def say(self, event: messages.Event) -> None:
        """Queue an event."""
        self._events.put(event)

    def close(self, within_s: float = 2.0) -> None:
        """Wait until all events are sent, or the client is gone."""
        self._events.put(None)
        self._thread.join(within_s)

    def _send_all(self) -> None:
        while (event := self._events.get()) is not None:
            try:
                self._connection.send(event)
            except OSError:
                return


class RequestReceiver:
    """Receives requests on its own thread: aborts and answers act at once, the others come in order from `next`.

    An abort applies to all requests received before it, and to none received later.
    """

    def __init__(
        self,
        connection: "Connection[messages.Event, messages.Request]",
        silence: messages.SilenceLimits = messages.SILENCE_LIMITS,
    ) -> None:
        self._connection = connection
        self._silence = silence
        # No SimpleQueue: up to Python 3.12, its `get` waits for ever when a signal's handler outlasts the timeout.
        self._requests: queue.Queue[tuple[int, messages.Request] | None] = queue.Queue()
        self._lock = Lock()
        # Numbers of the request received last, of the current one, and of the last one that an abort applies to.
        self._received = self._current = self._aborted = 0
        self._abort: Callable[[str], None] | None = None
        self._abort_reason = ""
        self._answers: dict[int, queue.Queue[Answer]] = {}
        self.gone = Signal()
        """Set once the client is gone, or wants the host to end."""
        self.pause = Signal()
        """Set to have the session wait for a person before its next run."""
        self.stands = False
        """Whether the stage stands, for the moment, though the work can be aborted; set by whoever does it."""
        Thread(target=self._receive_all, name="receiver", daemon=True).start()

    def next(self, within_s: float | None = None) -> messages.Request | None:
        """Wait for a request; None once the client is gone, and when none arrives in this time."""
        with suppress(queue.Empty):
            if not self.gone.is_set() and (numbered := self._requests.get(timeout=within_s)) is not None:
                with self._lock:
                    self._current, request = numbered
                return request
        return None

    def stops(self, abort: Callable[[str], None] | None) -> None:
        """Set the abort of the current request, which may move from now on; an abort received before is applied now."""
        self.stands = False
        with self._lock:
            self._abort, reason = abort, self._abort_reason if self._is_aborted else ""
        if abort is not None and reason:
            abort(reason)

    def await_answer(self, question: int, ask: Callable[[], None], idle: Callable[[], None] | None = None) -> Answer:
        """Ask a question and wait for its answer, which is an abort if the current request is aborted.

        `idle` is called again and again meanwhile.
        """
        answers: queue.Queue[Answer] = queue.Queue()
        with self._lock:
            self._answers[question] = answers
            if self._is_aborted:
                answers.put(Answer.ABORT)
        try:
            # After its queue exists: the answer may arrive at once.
            ask()
            while True:
                with suppress(queue.Empty):
                    return answers.get(timeout=None if idle is None else IDLE_INTERVAL_S)
                if idle is not None:
                    idle()
        finally:
            with self._lock:
                del self._answers[question]

    @property
    def _is_aborted(self) -> bool:
        """Whether the current request is aborted; read with the lock held."""
        return self._current <= self._aborted

    @property
    def _may_move(self) -> bool:
        """Whether anything moves, or may without a further word from the client."""
        with self._lock:
            return self._abort is not None and not self._answers and not self.stands

    def _receive_all(self) -> None:
        reason = CLIENT_GONE
        last_s, frozen = time.monotonic(), False
        with suppress(EOFError, OSError):
            while True:
                # What has arrived comes first: a host that was held up itself has not heard it yet.
                if self._connection.poll(_POLL_S):
                    request = self._connection.recv()
                    last_s, frozen = time.monotonic(), False
                    self._receive(request)
                    if isinstance(request, messages.StopHost):
                        reason = "the window was closed"
                        break
                    continue
                silent_s = time.monotonic() - last_s
                if silent_s > self._silence.standing_s:
                    reason = CLIENT_SILENT
                    break
                if silent_s > self._silence.moving_s and not frozen and self._may_move:
                    frozen = True
                    self._abort_all(f"{CLIENT_FROZEN}, for {silent_s:.1f} s")
        self.gone.set()
        self._abort_all(reason)
        self._requests.put(None)

    def _receive(self, request: messages.Request) -> None:
        match request:
            case messages.AbortSession(reason):
                self._abort_all(reason)
            case messages.PromptReply(question, answer):
                with self._lock:
                    answers = self._answers.get(question)
                if answers is not None:
                    answers.put(answer)
            case messages.PauseSession(on):
                if on:
                    self.pause.set()
                else:
                    self.pause.clear()
            case messages.Heartbeat() | messages.StopHost():
                pass
            case _:
                with self._lock:
                    self._received += 1
                    self._requests.put((self._received, request))

    def _abort_all(self, reason: str) -> None:
        with self._lock:
            if self._aborted < self._received:  # else all requests are aborted already, for the first reason
                self._aborted, self._abort_reason = self._received, reason
            abort, reason, waiting = self._abort, self._abort_reason, tuple(self._answers.values())
        if abort is not None:
            abort(reason)
        for answers in waiting:
            answers.put(Answer.ABORT)


class RemoteOperator:
    """A session's operator and observer in the client process; only `ask` waits for it."""

    def __init__(self, sender: EventSender, receiver: RequestReceiver, live: messages.LiveRingWriter) -> None:
        self._sender, self._receiver, self._live = sender, receiver, live
        self._numbers = count(1)
        self._order = 0
        self.job, self.folder = 0, Path()
        """Number of the session that is reported, and its campaign's folder."""

    attended = True

    def ask(self, prompt: Prompt) -> Answer:
        """Show a prompt and wait for the answer, which is an abort if the session is aborted."""
        number = next(self._numbers)
        self._receiver.pause.clear()
        shown = messages.PromptShown(
            number, prompt.text, prompt.can_redo, prompt.can_skip, prompt.hands, prompt.can_measure
        )
        look = prompt.look

        def show() -> None:
            reading = look() if look is not None else None
            if isinstance(reading, IdleReading):
                self._sender.say(messages.RigIdle(reading, number))

        idle = None if look is None else show
        return self._receiver.await_answer(number, lambda: self._sender.say(shown), idle)

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Report the runs still to make."""
        del programme
        self._sender.say(messages.SessionStarted(self.job, tuple(map(_queued_run, pending)), real_time, self.folder))

    def homes(self, *, over: bool) -> None:
        """Report that the stage moves to its origin."""
        self._sender.say(messages.StageHomes("" if over else HOMING))

    def waits(self, run: PlannedRun, duration_s: float) -> None:
        """Report a rest, during which the stage stands."""
        self._receiver.stands = True
        self._live.begin()
        self._sender.say(messages.SessionWaiting(_queued_run(run), duration_s))

    def run_begins(self, run: PlannedRun, order: int) -> None:
        """Report the start of a run."""
        self._order = order
        self._receiver.stands = False
        self._live.begin()
        self._sender.say(messages.RunStarted(_queued_run(run), order))

    def reads(self, reading: Reading) -> None:
        """Write a block of samples to the live ring."""
        self._receiver.stands = reading.phase[-1] in _STANDING
        self._live.put(reading)

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Report the end of a run."""
        self._receiver.stands = False
        queued, warnings = _queued_run(run), tuple(outcome.checks.warnings)
        self._sender.say(
            messages.RunFinished(queued, self._order, outcome.status, outcome.reason, outcome.samples, warnings)
        )

    def sentinel_compared(self, drift: Drift) -> None:
        """Report how far the specimen has drifted."""
        self._sender.say(messages.SentinelCompared(drift.measured.order, str(drift)))


def _queued_run(run: PlannedRun) -> messages.QueuedRun:
    return messages.QueuedRun(run.index, run.summary, run.wait_s, run.duration_s, run.start_mm, run.follows >= 0)


_STANDING = (Phase.REST, Phase.HOLD)
NOT_YET_RESET = "the guard is not reset since the start"


def serve(
    connection: "Connection[messages.Event, messages.Request]",
    memory: messages.RingMemory,
    rig: messages.RigSelection,
    silence: messages.SilenceLimits = messages.SILENCE_LIMITS,
) -> None:
    """Host an engine until the client leaves or dies; the target of the host process."""
    # Ctrl-C in the terminal reaches the client too; a running session handles it by itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sender, receiver = EventSender(connection), RequestReceiver(connection, silence)
    EngineHost(sender, receiver, messages.LiveRingWriter(memory), rig).run()
    sender.close()


IDLE_INTERVAL_S = 0.2
"""Interval of the readings while nothing is acquired."""
_RETRY_S = 5.0
"""Interval of the attempts at a rig that another program uses, or that is not there."""


class IdleRig:
    """The rig while nothing is asked of it: opened to be read, its drive off, and closed for whoever moves it."""

    def __init__(self, rig: messages.RigSelection) -> None:
        self._rig = rig
        self._backend: Backend | None = None
        self._look: Callable[[], IdleReading] = lambda: IdleReading(None, None)
        self._failed = False
        self.on = False
        """Whether it is read; otherwise it is left to other programs."""

    @property
    def interval_s(self) -> float | None:
        """Time until the next reading; None for none."""
        return (_RETRY_S if self._failed else IDLE_INTERVAL_S) if self.on else None

    def look(self) -> IdleReading | None:
        """Return force and position; None when it is not to be read."""
        if not self.on:
            return None
        try:
            if self._backend is None:
                self._open()
        except DragrigError as error:
            self._failed = True
            return IdleReading(None, None, reason_of(error))
        reading = self._look()
        if failed := reading.force_mN is None:
            self.close()
        self._failed = failed
        return reading

    def close(self) -> None:
        """Leave the rig."""
        backend, self._backend, self._failed = self._backend, None, False
        if backend is not None:
            backend.close()

    def _open(self) -> None:
        setup = resolve_rig(**self._rig.choices())
        request = setup.request(self._rig.pace if setup.double else None)
        # Known before it is asked anything: whatever goes wrong from here on, `close` gives it back.
        backend = self._backend = open_backend(setup.backend, request, double=setup.double)
        self._look = idle_reader(backend, timed=request.real_time or backend.needs_hands)


class EngineHost:
    """Handles requests on the process's main thread, where a session can handle signals."""

    def __init__(
        self, sender: EventSender, receiver: RequestReceiver, live: messages.LiveRingWriter, rig: messages.RigSelection
    ) -> None:
        self._sender, self._receiver, self._rig = sender, receiver, rig
        self._operator = RemoteOperator(sender, receiver, live)
        self._trip_reason = NOT_YET_RESET
        self._idle = IdleRig(rig)

    def run(self) -> None:
        """Handle requests until the client is gone."""
        self._sender.say(messages.HostReady(os.getpid()))
        self._sender.say(messages.GuardState(self._trip_reason, tripped=False))
        with closing(self._idle):
            while not self._receiver.gone.is_set():
                try:
                    self._handle_next()
                except Exception as error:  # noqa: BLE001  # the client must know, and the host must go on
                    self._sender.say(
                        messages.RequestRefused(f"a bug ({type(error).__name__}: {error}); please report it.")
                    )

    def _handle_next(self) -> None:
        request = self._receiver.next(self._idle.interval_s)
        if request is not None:
            # What is asked opens the rig itself.
            self._idle.close()
            self._handle(request)
        elif (reading := self._idle.look()) is not None:
            self._sender.say(messages.RigIdle(reading))

    def _handle(self, request: messages.Request) -> None:
        match request:
            case messages.WatchRig(on):
                self._idle.on = on
            case messages.SessionJob():
                self._start(request)
            case messages.ExamineRig():
                self._sender.say(self._examine())
            case messages.ResetGuard():
                self._reset()
            case messages.HomeStage() | messages.JogStage() | messages.TouchOffStage():
                overrides = not isinstance(request, messages.TouchOffStage) and request.override is not None
                # Off a pressed switch the guard can only be reset afterwards; everything else stays guarded.
                self._attempt(partial(self._moved_by, request), partial(messages.StageMoved, ""), guarded=not overrides)
            case messages.CalibrateForce() | messages.CalibrateEncoder():
                # Weights are hung on a stage that stands, its drive off; a travel needs the guard.
                guarded = isinstance(request, messages.CalibrateEncoder)
                self._attempt(
                    partial(self._calibrated, request),
                    partial(messages.CalibrationMeasured, None, None),
                    guarded=guarded,
                )
            case messages.StoreCalibration(entry):
                self._attempt(partial(self._store, entry), messages.CalibrationStored, guarded=False)
            case _:
                pass

    def _start(self, job: messages.SessionJob) -> None:
        if self._trip_reason:
            sentence = f"nothing may move: {self._trip_reason}; remove the cause, then reset the guard"
            self._sender.say(messages.SessionFinished(job.number, None, sentence))
            return
        self._operator.job = job.number
        self._receiver.pause.clear()
        finished = messages.SessionFinished(job.number, RunStatus.FAILED, "the engine met a bug")
        try:
            made = self._run_session(job)
            session, mirror = made.session, None
            if report := made.mirrored:
                mirror = messages.MirrorStatus(report.folder, len(report.copied), tuple(report.missing.items()))
            finished = messages.SessionFinished(job.number, session.status, session.reason, made.folder, mirror)
        except DragrigError as error:
            finished = messages.SessionFinished(job.number, None, str(error))
        finally:
            self._receiver.stops(None)
            self._sender.say(finished)
        if finished.status is RunStatus.TRIPPED:
            self._trip(finished.reason)

    def _run_session(self, job: messages.SessionJob) -> Made:
        def begun(abort: Callable[[str], None], folder: Path) -> None:
            self._operator.folder = folder
            self._receiver.stops(abort)

        options = SessionOptions(
            Path(),
            operator=job.operator,
            note=job.note,
            pace=job.pace,
            begun=begun,
            pause=self._receiver.pause,
            mirror=job.mirror,
            tell=lambda sentence: self._sender.say(messages.OperatorWarning(sentence)),
        )
        if job.resume is not None:
            self._require_this_rig(job.resume)
            return resume_campaign(job.resume, options, self._operator, memory=self._rig.memory)
        rig = replace(self._rig, assignments=(*self._rig.assignments, *job.specimen))
        if job.append is not None:
            return append_to_campaign(job.plan, job.append, options, self._operator, **rig.choices())
        return start_campaign(resolve(job.plan, **rig.choices()), job.out, options, self._operator)

    def _require_this_rig(self, campaign: Path) -> None:
        """Refuse a campaign whose own settings would move another rig than this host's; raises `SettingsError`."""
        record, _ = latest_session_record(campaign)
        setup = resolve_rig(**self._rig.choices())
        if (record.backend, record.double) != (setup.backend, setup.double):
            raise SettingsError(
                f"{campaign}: its runs were made on {'the double of ' if record.double else ''}{record.backend}; open "
                "the window for that."
            )

    def _reset(self) -> None:
        try:
            setup = resolve_rig(**self._rig.choices())
            pace = self._rig.pace if setup.double else None
            run_on_bench(lambda bench: bench.manual.reset(), setup, pace, self._operator)
        except TrippedError as error:
            self._trip(str(error))
        except DragrigError as error:
            self._sender.say(messages.RequestRefused(str(error)))
        else:
            self._trip("")

    def _attempt(
        self, work: Callable[[], messages.Event], refused: Callable[[str], messages.Event], *, guarded: bool
    ) -> None:
        """Do work beside sessions and report its result, or why there is none; `guarded`, with an armed guard alone."""
        if self._trip_reason and guarded:
            self._sender.say(refused(f"nothing may move: {self._trip_reason}; reset the guard first"))
            return
        try:
            result = work()
        except DragrigError as error:
            if isinstance(error, TrippedError):
                self._trip(str(error))
            result = refused(str(error))
        finally:
            self._receiver.stops(None)
        self._sender.say(result)

    def _moved_by(self, motion: messages.HandMotion) -> messages.StageMoved:
        """Make a motion by hand, as the command of its name does; an abort stops it as it does a session."""
        rig, person, begun = self._rig, self._operator, self._receiver.stops
        # A request's fields have the names of the function's parameters.
        match motion:
            case messages.HomeStage():
                move = home(**asdict(motion), pace=rig.pace, person=person, begun=begun, **rig.choices())
            case messages.JogStage():
                move = jog(**asdict(motion), pace=rig.pace, person=person, begun=begun, **rig.choices())
            case messages.TouchOffStage():
                contact = touch_off(**asdict(motion), pace=rig.pace, person=person, begun=begun, **rig.choices())
                return messages.StageMoved(
                    f"Contact at {contact.position_mm:.3f} mm, where the force changed by {contact.force_mN:.1f} mN; "
                    "stored as contact.toml in the lab folder."
                )
        if move.trip is not None:
            self._trip(move.trip.message)
            stays = f"and the guard stays tripped: {move.trip.message}."
            return messages.StageMoved(f"The stage is at {move.position_mm:.3f} mm, {stays}")
        freed = (
            f" The {LIMIT_SWITCH_CAUSES[motion.override]} is free: reset the guard."
            if motion.override is not None
            else ""
        )
        return messages.StageMoved(f"The stage is at {move.position_mm:.3f} mm.{freed}")

    def _calibrated(self, job: messages.CalibrationJob) -> messages.CalibrationMeasured:
        """Calibrate as the command does, but leave the result to be looked at before it is stored."""
        rig, person = self._rig, self._operator

        def begun(abort: Callable[[str], None]) -> None:
            self._receiver.stops(abort)
            self._receiver.stands = isinstance(job, messages.CalibrateForce) or job.by_hand

        calibrate = calibrate_force if isinstance(job, messages.CalibrateForce) else calibrate_encoder
        made = calibrate(**asdict(job), store=False, pace=rig.pace, person=person, begun=begun, **rig.choices())
        record = sensor_calibration_document(made.entry, made.points, made.line, made.notes, stored=False)
        return messages.CalibrationMeasured(made.entry, record)

    def _store(self, entry: Calibration) -> messages.CalibrationStored:
        store_calibration(entry, **self._rig.choices())
        return messages.CalibrationStored()

    def _trip(self, reason: str) -> None:
        self._trip_reason = reason
        self._sender.say(messages.GuardState(reason))

    def _examine(self) -> messages.RigExamined:
        checks: list[RigCheck] = []
        try:
            checks.extend(examine(**self._rig.choices()))
        except DragrigError as error:
            return messages.RigExamined(tuple(checks), str(error))
        return messages.RigExamined(tuple(checks))
