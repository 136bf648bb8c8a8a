"""A session on its worker thread, while the calling thread answers its prompts and the signals that end it."""

import queue
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from threading import Event as Signal
from typing import Protocol, TypeVar

from dragrig.config import (
    AbortedError,
    Calibration,
    CommissioningRecord,
    require_text,
)
from dragrig.end_signals import EndSignals, rig_open
from dragrig.rig import (
    AcquisitionOutcome,
    Answer,
    Backend,
    CampaignProgress,
    IdleReading,
    NullOperator,
    Operator,
    PlannedRun,
    Programme,
    Prompt,
    RunStatus,
    Session,
    SessionObserver,
    SessionRecord,
    SessionResult,
    Store,
    ignore,
    preflight,
    read_idle,
    specimen_remark,
    wiring_key,
    write_commissioning,
)
from dragrig.setup import (
    HARDWARE_BACKEND,
    SIMULATED_BACKEND,
    Pace,
    Setup,
    opened_rig,
)

ResultT = TypeVar("ResultT")

_POLL_S = 0.02
_BETWEEN_RUNS_S = 1.0
"""For what a simulated stage does between two runs, homing included."""
_IDLE_MEAN_S = 0.1
"""Five periods of the mains."""


class PromptRelay:
    """Passes a session's prompts to the operator on the calling thread.

    Parameters
    ----------
    look
        Reads force and position meanwhile: the thread that asks waits for the answer, so nothing else uses the rig.
    """

    def __init__(self, operator: Operator, look: Callable[[], IdleReading] | None = None) -> None:
        self._operator, self._look = operator, look
        # Not a SimpleQueue: up to Python 3.12, its `get` waits for ever when a signal's handler outlasts the timeout.
        self._prompts: queue.Queue[tuple[Prompt, Future[Answer]]] = queue.Queue()

    @property
    def attended(self) -> bool:
        """Whether a person answers prompts that need no hands."""
        return self._operator.attended

    def ask(self, prompt: Prompt) -> Answer:
        """Wait for the answer from the calling thread."""
        answer: Future[Answer] = Future()
        self._prompts.put((prompt, answer))
        return answer.result()

    def homes(self, *, over: bool) -> None:
        """Tell the operator, on the thread that moves the stage."""
        self._operator.homes(over=over)

    def answer_next(self, within_s: float, signals: EndSignals) -> None:
        """Answer the next prompt, if there is one in this time; Ctrl-C at or before a prompt ends the session."""
        try:
            prompt, answered = self._prompts.get(timeout=within_s)
        except queue.Empty:
            return
        answer = Answer.ABORT
        try:
            with suppress(KeyboardInterrupt, EOFError), signals.prompting():
                answer = self._operator.ask(replace(prompt, look=prompt.look or self._look))
        finally:
            answered.set_result(answer)


def idle_reader(backend: Backend, *, timed: bool) -> Callable[[], IdleReading]:
    """Return the reader of force and position while nothing is acquired; it takes no time where time is simulated."""
    duration_s = _IDLE_MEAN_S if timed else 0.0
    return lambda: read_idle(backend, duration_s)


def run_on_worker(work: Callable[[], ResultT], abort: Callable[[str], None], operator: PromptRelay) -> ResultT:
    """Run work that moves the rig on a worker thread, while this thread handles signals and prompts.

    This thread wakes every few milliseconds, because on Windows nothing else lets it receive Ctrl-C.

    Parameters
    ----------
    work
        Runs on the worker thread, such as `Session.run`.
    abort
        Ends it in good order; called for Ctrl-C and the other signals that end a program.

    Raises
    ------
    DragrigError
        The errors of `work`.
    """
    with rig_open() as signals, ThreadPoolExecutor(1, "session") as worker:
        result = worker.submit(work)
        try:
            with signals.aborting(abort):
                while not result.done():
                    operator.answer_next(_POLL_S, signals)
        finally:
            if not result.done():
                abort("its host failed")
    return result.result()


class SessionOperator(Operator, SessionObserver, Protocol):
    """Answers prompts and observes the session."""


class RunCounter(NullOperator):
    """Answers every prompt, and reports how many runs are made, of all that steps after the session count as too."""

    def __init__(self, progress: Callable[[int, int], None], further_steps: int = 0) -> None:
        self._progress = progress
        self._made, self._of = 0, further_steps

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Count the runs to be made."""
        del programme, real_time
        self._of += len(pending)

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Count a run."""
        del run, outcome
        self._made += 1
        self._progress(self._made, self._of)

    def step(self, steps: int) -> Callable[[int, int], None]:
        """Return the progress of work that counts as so many runs."""
        before = self._made
        self._made += steps
        return lambda done, of: self._progress(before + steps * done // max(of, 1), self._of)


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """How a session is carried out."""

    folder: Path
    """The campaign's folder, whose free space is checked."""
    operator: str = ""
    note: str = ""
    pace: Pace | None = None
    """Of a simulated rig, or of a double."""
    origin: datetime | None = None
    """Time of day at which a simulated session starts (default: now)."""
    first_run_at: datetime | None = None
    """Start of the campaign's first run, in a resumed campaign."""
    progress: CampaignProgress = field(default_factory=CampaignProgress)
    begun: Callable[[Callable[[str], None], Path], None] = ignore
    """Called before anything moves with a function that ends the session in good order from any thread, and the
    campaign's folder."""
    pause: Signal | None = None
    """Set by anybody to have the session wait for a person before its next run."""
    mirror: Path | None = None
    """Folder for a second copy of each finished file."""
    tell: Callable[[str], None] = ignore
    """Called, from any thread, with a warning that does not stop the session."""

    def __post_init__(self) -> None:
        require_text(operator=self.operator, note=self.note)


def run_session(
    setup: Setup,
    open_store: Callable[[SessionRecord], AbstractContextManager[Store]],
    options: SessionOptions,
    person: SessionOperator | None = None,
) -> SessionResult:
    """Check a plan and carry it out; the calling thread handles Ctrl-C and prompts.

    Parameters
    ----------
    open_store
        Opens the store of the session once everything is checked; gets the session's record.
    person
        Answers prompts and observes (default: every prompt counts as done).

    Raises
    ------
    PlanError, SettingsError
        Before anything moves.
    DragrigError
        When a record cannot be opened or finished; the stage is stopped first.
    """
    from dragrig.analysis import steady_force_of

    observer: SessionOperator = person or NullOperator()
    programme = setup.programme()
    left = replace(programme, runs=programme.pending(options.progress.done))
    if not left.runs:
        # Without runs, neither prompt nor homing.
        return SessionResult(RunStatus.COMPLETE, "", ())
    request = setup.request(options.pace)
    origin = options.origin or begins_at(setup, left, real_time=request.real_time)
    request = replace(request, origin=origin, first_run_at=options.first_run_at)
    with opened_rig(setup.backend, request, double=setup.double) as backend:
        further = len(backend.sampler.channels) - 2
        stops = setup.stops() if backend.needs_hands else None
        checked = preflight(left, setup.rig, backend.stage.limits, options.folder, setup.plan_source, further, stops)
        checked.require()
        if backend.needs_hands and (remark := specimen_remark(setup.specimen)):
            options.tell(f"{remark}.")
        record = _session_record(setup, backend, options, request.calibrations)
        timed = request.real_time or backend.needs_hands
        operator = PromptRelay(observer, idle_reader(backend, timed=timed))
        run_on_worker(
            lambda: _ask_for_commissioning(setup, operator, backend.clock.now, checked.remarks),
            ignore,
            operator,
        )
        with open_store(record) as store:
            session = Session(
                backend,
                programme,
                record,
                store,
                operator,
                observer,
                options.progress,
                real_time=timed,
                pause=options.pause,
                steady_force=steady_force_of,
                stops=stops,
            )
            options.begun(session.abort, options.folder)
            with _kept_awake(setup):
                return run_on_worker(session.run, session.abort, operator)


def begins_at(setup: Setup, programme: Programme, *, real_time: bool) -> datetime:
    """Return when a session begins: now, or where rests take no time so much earlier that it ends now.

    No run is dated before its specimen was taken and mounted, so that the last ones may lie in the future then.
    """
    now = datetime.now().astimezone()
    if real_time or setup.backend != SIMULATED_BACKEND:
        return now
    specimen = setup.specimen
    earliest = (moment for moment in (specimen.excised_at, specimen.mounted_at) if moment is not None)
    lasts_s = programme.duration_s + _BETWEEN_RUNS_S * len(programme.runs)
    return max((now - timedelta(seconds=lasts_s), *earliest))


@contextmanager
def _kept_awake(setup: Setup) -> Iterator[None]:
    """Keep a computer that runs a real rig from falling asleep; a desktop without such a service is left as it is."""
    if setup.backend != HARDWARE_BACKEND or setup.double:
        yield
        return
    from wakepy import keep

    with keep.running(on_fail="pass"):
        yield


def _ask_for_commissioning(
    setup: Setup, operator: Operator, now: Callable[[], datetime], remarks: Sequence[str]
) -> None:
    """Ask once, on real hardware, before it moves with wires that nobody has looked at since they changed.

    The prompt ends with the session's remarks: how far the stage goes on without its program.

    Raises `AbortedError` when the person wants to look first.
    """
    if setup.backend != HARDWARE_BACKEND or setup.double or setup.rig_folder is None:
        return
    record = setup.commissioning() or CommissioningRecord(
        made_at=now(), made_on=setup.made_on, wiring=wiring_key(setup.rig)
    )
    if record.skipped or record.passed:
        return
    why = "nobody has looked at this rig's wiring since it was set up or changed"
    if failed := ", ".join(signal.name for signal in record.signals if not signal.passed):
        why = f"the look at this rig on {record.made_at:%Y-%m-%d} found faults ({failed})"
    sentences = (f"{why}: end here and try dragrig check --live, or go on without", *remarks)
    prompt = ". ".join(sentence[0].upper() + sentence[1:] for sentence in sentences)
    if operator.ask(Prompt(prompt)) is not Answer.DONE:
        raise AbortedError("ended before anything moved: look at the rig with dragrig check --live.")
    # What a look found stays in the record.
    write_commissioning(setup.rig_folder, record.model_copy(update={"skipped": True}))


def _session_record(
    setup: Setup, backend: Backend, options: SessionOptions, calibrations: Mapping[str, Calibration]
) -> SessionRecord:
    ids = {quantity: entry.id for quantity, entry in calibrations.items()}
    return SessionRecord(
        begun_at=backend.clock.now(),
        backend=setup.backend,
        double=setup.double,
        contact_mm=setup.contact_mm if setup.rig.stage.start_from == "contact" else None,
        operator=options.operator,
        note=options.note,
        calibration_id=ids.get("force", ""),
        encoder_calibration_id=ids.get("encoder", ""),
        beside=setup.plan_folder,
        first_order=options.progress.first_order,
        plan=setup.plan,
        specimen=setup.specimen,
        model=setup.model,
        rig=setup.rig,
    )
