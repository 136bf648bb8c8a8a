"""Carrying out a plan: the session on its worker thread, its campaign folder, and resuming an interrupted campaign."""

import queue
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from itertools import count
from pathlib import Path
from threading import Event as Signal
from types import FrameType
from typing import Protocol, TypeVar

from dragrig.config.errors import DragrigError, OutputError, reason_of
from dragrig.config.rig import Calibration, rig_file_of
from dragrig.rig.devices import Backend, BackendRequest
from dragrig.rig.engine import Store
from dragrig.rig.operator import Answer, NullOperator, Operator, Prompt, SessionObserver
from dragrig.rig.preflight import preflight
from dragrig.rig.runfile import Campaign, FolderStore, RecoveryOutcome, read_campaign, recover
from dragrig.rig.runfile.model import RunStatus
from dragrig.rig.runfile.store import Mirror, MirrorReport
from dragrig.rig.session import (
    CampaignProgress,
    Session,
    SessionRecord,
    SessionResult,
    latest_session_record,
    write_session_record,
)
from dragrig.session_state import SessionState, StatePublisher, session_lock
from dragrig.setup import Pace, Setup, contact_position, open_backend, resolve_pace

ResultT = TypeVar("ResultT")

_POLL_S = 0.02
_END_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")


@dataclass(slots=True)
class _PendingPrompt:
    prompt: Prompt
    answered: Signal = field(default_factory=Signal)
    answer: Answer = Answer.ABORT


class PromptRelay:
    """An operator whom a session asks on its own thread and who answers on the one that hosts it."""

    def __init__(self, operator: Operator) -> None:
        self._operator = operator
        self._questions: queue.SimpleQueue[_PendingPrompt] = queue.SimpleQueue()

    def ask(self, prompt: Prompt) -> Answer:
        """Put a prompt to the hosting thread and wait for the answer."""
        question = _PendingPrompt(prompt)
        self._questions.put(question)
        question.answered.wait()
        return question.answer

    def answer_next(self, within_s: float) -> None:
        """Answer one prompt if there is one; Ctrl-C at a prompt ends the session."""
        try:
            question = self._questions.get(timeout=within_s)
        except queue.Empty:
            return
        try:
            with _signals_raise():
                question.answer = self._operator.ask(question.prompt)
        except (KeyboardInterrupt, EOFError):
            question.answer = Answer.ABORT
        finally:
            question.answered.set()


def run_on_worker(work: Callable[[], ResultT], abort: Callable[[str], None], operator: PromptRelay) -> ResultT:
    """Run what moves a rig to its end and return what it returns.

    Parameters
    ----------
    work
        Made on a thread of its own, as `Session.run`.
    abort
        Asks it for an end in good order: Ctrl-C and the other signals that end a program call it.

    Raises
    ------
    DragrigError
        What `work` raises.
    """
    results: list[ResultT] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(work())
        except BaseException as error:  # noqa: BLE001  # raised again on the calling thread
            errors.append(error)

    worker = threading.Thread(target=run, name="session")
    with _signals_abort(abort):
        worker.start()
        try:
            while worker.is_alive():
                operator.answer_next(_POLL_S)
        finally:
            if worker.is_alive():
                abort("its host failed")
            worker.join()
    if errors:
        raise errors[0]
    return results[0]


@contextmanager
def _signals_abort(abort: Callable[[str], None]) -> Iterator[None]:
    def heard(number: int, frame: FrameType | None) -> None:
        del frame
        abort("Ctrl-C" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}")

    with _signal_handler(heard):
        yield


@contextmanager
def _signals_raise() -> Iterator[None]:
    with _signal_handler(signal.default_int_handler):
        yield


@contextmanager
def _signal_handler(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may handle signals
        return
    present = [signal.Signals[name] for name in _END_SIGNALS if name in signal.Signals.__members__]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        # Under nohup a session outlives its terminal.
        present.remove(signal.SIGHUP)
    before = {number: signal.signal(number, handler) for number in present}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, signal.SIG_DFL if earlier is None else earlier)


class SessionOperator(Operator, SessionObserver, Protocol):
    """Somebody who answers prompts and follows the session."""


def discard_message(sentence: str) -> None:
    """Tell nobody."""
    del sentence


def _ignore_abort(abort: Callable[[str], None]) -> None:
    """Leave the end of a session to its host."""
    del abort


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """How a session is carried out.

    Attributes
    ----------
    folder
        The campaign's folder, whose free space is checked.
    pace
        Of a simulated rig, or of a double.
    origin
        Time of day at which a simulated session begins; now unless given.
    first_run_at
        When the campaign's first run began, in a session that goes on with it.
    begun
        Told, before anything moves, what ends the session in good order from any thread, for a reason.
    mirror
        Folder that is to hold a second copy of each finished file.
    tell
        Called, from any thread, with what a person has to know at once and that stops nothing.
    """

    folder: Path
    operator: str = ""
    note: str = ""
    pace: Pace | None = None
    origin: datetime | None = None
    first_run_at: datetime | None = None
    progress: CampaignProgress = field(default_factory=CampaignProgress)
    begun: Callable[[Callable[[str], None]], None] = _ignore_abort
    mirror: Path | None = None
    tell: Callable[[str], None] = discard_message


def run_session(
    setup: Setup,
    open_store: Callable[[SessionRecord], AbstractContextManager[Store]],
    terms: SessionOptions,
    person: SessionOperator | None = None,
) -> SessionResult:
    """Check a plan and carry it out, with Ctrl-C heard and people asked on the calling thread.

    Parameters
    ----------
    open_store
        Opens the store of the session, once everything has been checked and its record is known.
    person
        Who answers prompts and watches; nobody unless given, and every prompt counts as done.

    Raises
    ------
    PlanError, SettingsError
        Before anything moves.
    DragrigError
        When a record cannot be opened or finished; the stage is stopped first.
    """
    someone: SessionOperator = person or NullOperator()
    programme = setup.programme()
    left = replace(programme, runs=programme.pending(terms.progress.done))
    if not left.runs:
        # Nobody is asked, and no stage is sent home, for nothing.
        return SessionResult(RunStatus.COMPLETE, "", ())
    pace = resolve_pace(terms.pace, double=setup.double)
    calibrations = setup.calibrations()
    request = BackendRequest(
        setup.rig,
        setup.model,
        pace.real_time,
        terms.origin,
        calibrations,
        pace=pace.times_faster,
        first_run_at=terms.first_run_at,
    )
    with closing(open_backend(setup.backend, request, double=setup.double)) as backend:
        further = len(backend.sampler.channels) - 2
        preflight(left, setup.rig, backend.stage.limits, terms.folder, setup.plan_source, further).require()
        record = _session_record(setup, backend, terms, calibrations)
        operator = PromptRelay(someone)
        with open_store(record) as store:
            timed = pace.real_time or backend.needs_hands
            session = Session(backend, programme, record, store, operator, someone, terms.progress, real_time=timed)
            terms.begun(session.abort)
            return run_on_worker(session.run, session.abort, operator)


def _session_record(
    setup: Setup, backend: Backend, terms: SessionOptions, calibrations: Mapping[str, Calibration]
) -> SessionRecord:
    ids = {quantity: entry.id for quantity, entry in calibrations.items()}
    return SessionRecord(
        begun_at=backend.clock.now(),
        backend=setup.backend,
        double=setup.double,
        contact_mm=setup.contact_mm if setup.rig.stage.start_from == "contact" else None,
        operator=terms.operator,
        note=terms.note,
        calibration_id=ids.get("force", ""),
        encoder_calibration_id=ids.get("encoder", ""),
        beside=setup.plan_folder,
        plan=setup.plan,
        specimen=setup.specimen,
        model=setup.model,
        rig=setup.rig,
    )


@dataclass(frozen=True, slots=True)
class Made:
    """What a session left: the campaign's folder, and how each run ended."""

    folder: Path
    session: SessionResult
    mirrored: MirrorReport | None = None
    """What is in the mirror; None without one."""

    def summary(self) -> str:
        """One line for a person."""
        counts: dict[str, int] = {}
        for one in self.session.runs:
            counts[one.outcome.status.value] = counts.get(one.outcome.status.value, 0) + 1
        if not counts:
            return "no run was made"
        made = sum(counts.values())
        each = ", ".join(f"{count} {status}" for status, count in counts.items())
        return f"{made} run{'' if made == 1 else 's'}: {each}"


def start_campaign(setup: Setup, out: Path | None, terms: SessionOptions, person: SessionOperator | None) -> Made:
    """Carry out a plan into a new campaign.

    Parameters
    ----------
    out
        The campaign's folder, new or without runs; one below the data root unless given.

    Raises
    ------
    OutputError
        When the folder cannot be made, holds a campaign already, or another session is at work in it.
    DragrigError
        What `run_session` raises.
    """
    if out is not None:
        _require_no_runs(out)
        with ExitStack() as alone:
            return _run_campaign(setup, replace(terms, folder=out), person, _folder_maker(out, alone, own=False))
    now = terms.origin or datetime.now().astimezone()
    name = f"{now:%Y%m%d-%H%M%S}-{setup.plan.name}"
    names = (name if nth == 1 else f"{name}-{nth}" for nth in count(1))
    # Two sessions may begin within one second: here, where nothing has moved yet, the later one takes the next name.
    for folder in (folder for folder in (setup.data_root / one for one in names) if not folder.exists()):
        with ExitStack() as alone, suppress(_FolderTakenError):
            return _run_campaign(setup, replace(terms, folder=folder), person, _folder_maker(folder, alone, own=True))
    raise AssertionError("names do not run out")


class _FolderTakenError(OutputError):
    """Another session took the folder meanwhile."""


def resume_campaign(
    folder: Path, terms: SessionOptions, person: SessionOperator | None, assignments: Sequence[str] = ()
) -> Made:
    """Make the runs that a campaign still lacks, with the settings it was begun with.

    Runs that a crash left behind are recovered first. A run counts as made when it is complete and not marked bad.

    Parameters
    ----------
    assignments
        Changes to the rig, each `rig.key=value`.

    Raises
    ------
    RunFileError, SettingsError
        When there is no campaign, or its record is damaged.
    DragrigError
        What `run_session` raises.
    """
    latest_session_record(folder)
    with session_lock(folder):
        for one in recover(folder):
            if one.outcome is RecoveryOutcome.IN_USE:
                raise OutputError(
                    f"{one.recording}: is being recorded right now; a campaign goes on once its session is over."
                )
        record, before = latest_session_record(folder), read_campaign(folder)
        # A dry run's rests take no time, so that its last run may have ended later than it is now.
        ended = [one.end_time or one.header.start_time for one in before.runs]
        origin = max([datetime.now().astimezone(), record.begun_at + timedelta(seconds=1), *ended])
        setup = _setup_from_record(record, folder).with_rig(assignments)
        first = min((one.header.start_time for one in before.runs), default=None)
        terms = replace(terms, folder=folder, origin=origin, first_run_at=first, progress=_resume_progress(before))
        return _run_campaign(setup, terms, person, lambda: None, before)


def _folder_maker(folder: Path, alone: ExitStack, *, own: bool) -> Callable[[], None]:
    """Return what makes a campaign's folder, and takes it for this session until `alone` is left."""

    def begun() -> None:
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            folder.mkdir(exist_ok=not own)
        except FileExistsError:
            if own:
                raise _FolderTakenError(f"{folder}: is there already.") from None
            raise
        alone.enter_context(session_lock(folder))
        _require_no_runs(folder)

    return begun


def _require_no_runs(folder: Path) -> None:
    if folder.is_dir() and any(folder.glob("*.h5")):
        raise OutputError(f"{folder}: holds runs already; name another folder, or go on with --resume {folder}.")


def _run_campaign(
    setup: Setup,
    terms: SessionOptions,
    person: SessionOperator | None,
    begun: Callable[[], None],
    before: Campaign | None = None,
) -> Made:
    """Carry out a session whose state others can see, with its files mirrored where that is wanted."""
    someone, folder = person or NullOperator(), terms.folder
    state = SessionState(plan=setup.plan.name, backend=setup.backend, double=setup.double)
    announced = StatePublisher(someone, someone, folder, state)
    mirror = None
    if terms.mirror is not None:
        mirror = Mirror(_require_other_folder(terms.mirror, folder), folder.resolve().name, terms.tell)
        for run in before.runs if before is not None else ():
            mirror.submit(run.path)
    status, reason = RunStatus.FAILED.value, "the program ended it"
    mirrored = None
    try:
        told = mirror.submit if mirror is not None else None
        session = run_session(setup, _store_opener(folder, begun, told), terms, announced)
        status, reason = session.status.value, session.reason
    except DragrigError as error:
        reason = reason_of(error)
        raise
    finally:
        announced.ends(status, reason)
        if mirror is not None:
            mirrored = _close_mirror(mirror, folder)
    return Made(folder, session, mirrored)


def _require_other_folder(mirror: Path, folder: Path) -> Path:
    if (mirror.resolve() / folder.resolve().name) == folder.resolve():
        raise OutputError(f"--mirror {mirror}: is where the campaign itself goes; name a folder on another disk.")
    return mirror


def _close_mirror(mirror: Mirror, folder: Path) -> MirrorReport:
    """Copy the sessions' records and the marks on runs too, and wait for the last copy."""
    for file in (*sorted(folder.glob("session-*.toml")), *sorted(folder.glob("*.mark.toml"))):
        mirror.submit(file)
    return mirror.close()


def _store_opener(
    folder: Path, begun: Callable[[], None], told: Callable[[Path], None] | None
) -> Callable[[SessionRecord], FolderStore]:
    def opened(record: SessionRecord) -> FolderStore:
        try:
            begun()
            write_session_record(record, folder)
        except OSError as error:
            raise OutputError(
                f"{folder}: no runs can be written here ({error.strerror}); name another folder with --out."
            ) from error
        return FolderStore(
            folder, flush_s=record.rig.recording.flush_s, reserve_mb=record.rig.recording.reserve_mb, on_finished=told
        )

    return opened


def _setup_from_record(record: SessionRecord, folder: Path) -> Setup:
    rig_file = rig_file_of(folder)
    rig_folder = rig_file.parent if rig_file is not None else None
    return Setup(
        plan=record.plan,
        plan_source=f"{folder}, plan {record.plan.name}",
        plan_folder=record.beside,
        rig=record.rig,
        specimen=record.specimen,
        model=record.model,
        rig_folder=rig_folder,
        contact_mm=contact_position(rig_folder, record.contact_mm),
        backend=record.backend,
        double=record.double,
    )


def _resume_progress(before: Campaign) -> CampaignProgress:
    planned = [one.header.entry.get("plan_run") for one in before.good if one.status is RunStatus.COMPLETE]
    return CampaignProgress(
        done=frozenset(place for place in planned if isinstance(place, int)),
        next_order=max((one.header.order + 1 for one in before.runs), default=0),
    )
