"""Carrying out a plan: the session on its worker thread, its campaign folder, and campaigns that go on."""

import queue
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from itertools import count
from math import inf
from pathlib import Path
from threading import Event as Signal
from typing import Protocol, TypeVar, Unpack

from dragrig.analysis import count_text
from dragrig.config import (
    UNSTATED,
    AbortedError,
    Calibration,
    CommissioningRecord,
    DragrigError,
    OutputError,
    RigSettings,
    SettingsError,
    Specimen,
    reason_of,
    rig_file_of,
)
from dragrig.end_signals import EndSignals, rig_open
from dragrig.rig import (
    AcquisitionOutcome,
    Answer,
    Backend,
    BackendRequest,
    Campaign,
    CampaignProgress,
    FolderStore,
    IdleReading,
    Mirror,
    MirrorReport,
    NullOperator,
    Operator,
    PlannedRun,
    Programme,
    Prompt,
    RecoveryOutcome,
    ReturnProtocol,
    RunInfo,
    RunStatus,
    Session,
    SessionObserver,
    SessionRecord,
    SessionResult,
    SteadyForce,
    Store,
    latest_session_record,
    preflight,
    read_campaign,
    read_commissioning,
    read_idle,
    read_run,
    read_session_records,
    recover,
    specimen_key,
    specimen_remark,
    wiring_key,
    write_commissioning,
    write_session_record,
)
from dragrig.session_state import SessionState, StatePublisher, session_lock
from dragrig.setup import (
    HARDWARE_BACKEND,
    Assignments,
    Pace,
    PlanLike,
    Setup,
    SetupChoices,
    contact_position,
    load_settings,
    opened_rig,
    require_shipped_dialect,
    resolve,
    resolve_pace,
    within_lab,
)

ResultT = TypeVar("ResultT")

_POLL_S = 0.02
_IDLE_MEAN_S = 0.1
"""Five periods of the mains."""
MIRROR_ANSWER_S = 10.0
"""How long a mirror may take to answer before a session."""


@dataclass(slots=True)
class _PendingPrompt:
    prompt: Prompt
    answered: Signal = field(default_factory=Signal)
    answer: Answer = Answer.ABORT


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
        self._prompts: queue.Queue[_PendingPrompt] = queue.Queue()

    @property
    def attended(self) -> bool:
        """Whether a person answers what needs no hands."""
        return self._operator.attended

    def ask(self, prompt: Prompt) -> Answer:
        """Wait for the answer from the calling thread."""
        pending = _PendingPrompt(prompt)
        self._prompts.put(pending)
        pending.answered.wait()
        return pending.answer

    def answer_next(self, within_s: float, signals: EndSignals) -> None:
        """Answer the next prompt, if there is one in this time; Ctrl-C at or before a prompt ends the session."""
        try:
            pending = self._prompts.get(timeout=within_s)
        except queue.Empty:
            return
        try:
            with signals.prompting():
                pending.answer = self._operator.ask(replace(pending.prompt, look=pending.prompt.look or self._look))
        except (KeyboardInterrupt, EOFError):
            pending.answer = Answer.ABORT
        finally:
            pending.answered.set()


def idle_reader(backend: Backend, *, timed: bool) -> Callable[[], IdleReading]:
    """Return what reads force and position while nothing is acquired; it takes no time where time is simulated."""
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
    with rig_open() as signals:
        worker.start()
        try:
            with signals.aborting(abort):
                while worker.is_alive():
                    operator.answer_next(_POLL_S, signals)
        finally:
            if worker.is_alive():
                abort("its host failed")
            worker.join()
    if errors:
        raise errors[0]
    return results[0]


class SessionOperator(Operator, SessionObserver, Protocol):
    """Answers prompts and observes the session."""


class RunCounter(NullOperator):
    """Answers every prompt, and reports how many runs are made."""

    def __init__(self, progress: Callable[[int, int], None]) -> None:
        self._progress = progress
        self._made, self._of = 0, 0

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Count the runs to be made."""
        del programme, real_time
        self._of = len(pending)

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Count a run."""
        del run, outcome
        self._made += 1
        self._progress(self._made, self._of)


def discard_message(sentence: str) -> None:
    """Ignore a message."""
    del sentence


def _ignore_abort(abort: Callable[[str], None]) -> None:
    """Ignore how to end the session."""
    del abort


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
    begun: Callable[[Callable[[str], None]], None] = _ignore_abort
    """Called before anything moves with a function that ends the session in good order from any thread."""
    pause: Signal | None = None
    """Set by anybody to have the session wait for a person before its next run."""
    mirror: Path | None = None
    """Folder for a second copy of each finished file."""
    tell: Callable[[str], None] = discard_message
    """Called, from any thread, with a warning that does not stop the session."""


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
    pace = resolve_pace(options.pace, double=setup.double)
    calibrations = setup.calibrations()
    request = BackendRequest(
        setup.rig,
        setup.model,
        pace.real_time,
        options.origin,
        calibrations,
        pace=pace.times_faster,
        first_run_at=options.first_run_at,
    )
    with opened_rig(setup.backend, request, double=setup.double) as backend:
        further = len(backend.sampler.channels) - 2
        preflight(
            left,
            setup.rig,
            backend.stage.limits,
            options.folder,
            setup.plan_source,
            further,
            has_drive=backend.needs_hands,
        ).require()
        if backend.needs_hands and (remark := specimen_remark(setup.specimen)):
            options.tell(f"{remark}.")
        record = _session_record(setup, backend, options, calibrations)
        timed = pace.real_time or backend.needs_hands
        operator = PromptRelay(observer, idle_reader(backend, timed=timed))
        run_on_worker(lambda: _ask_for_commissioning(setup, operator, backend.clock.now), discard_message, operator)
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
            )
            options.begun(session.abort)
            with _kept_awake(setup):
                return run_on_worker(session.run, session.abort, operator)


@contextmanager
def _kept_awake(setup: Setup) -> Iterator[None]:
    """Keep a computer that runs a real rig from falling asleep; a desktop without such a service is left as it is."""
    if setup.backend != HARDWARE_BACKEND or setup.double:
        yield
        return
    from wakepy import keep

    with keep.running(on_fail="pass"):
        yield


def _ask_for_commissioning(setup: Setup, operator: Operator, now: Callable[[], datetime]) -> None:
    """Ask once, on real hardware, before it moves with wires that nobody has looked at since they changed.

    Raises `AbortedError` when the person wants to look first.
    """
    if setup.backend != HARDWARE_BACKEND or setup.double or setup.rig_folder is None:
        return
    record, wiring = read_commissioning(setup.rig_folder), wiring_key(setup.rig)
    if record is None or (record.made_on, record.wiring) != (setup.made_on, wiring):
        record = CommissioningRecord(made_at=now(), made_on=setup.made_on, wiring=wiring)
    if record.skipped or record.passed:
        return
    why = "nobody has looked at this rig's wiring since it was set up or changed"
    if failed := ", ".join(signal.name for signal in record.signals if not signal.passed):
        why = f"the look at this rig on {record.made_at:%Y-%m-%d} found faults ({failed})"
    prompt = f"{why[0].upper()}{why[1:]}: end here and try dragrig check --live, or go on without"
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


@dataclass(frozen=True, slots=True)
class Made:
    """The result of a session: the campaign's folder, and how each run ended."""

    folder: Path
    session: SessionResult
    mirrored: MirrorReport | None = None
    """Content of the mirror; None without one."""

    @property
    def files(self) -> tuple[Path, ...]:
        """The run files, in order."""
        return tuple(run.path for run in self.session.runs if run.path is not None)

    def summary(self) -> str:
        """Return one line: how many runs ended in each status."""
        counts = Counter(run.outcome.status.value for run in self.session.runs)
        if not counts:
            return "no run was recorded"
        statuses = ", ".join(f"{count} {status}" for status, count in counts.items())
        return f"{counts.total()} run{'' if counts.total() == 1 else 's'}: {statuses}"


def start_campaign(setup: Setup, out: Path | None, options: SessionOptions, person: SessionOperator | None) -> Made:
    """Carry out a plan into a new campaign.

    Parameters
    ----------
    out
        The campaign's folder, new or without runs (default: a new one in the data root).

    Raises
    ------
    OutputError
        When the folder cannot be made, holds a campaign, or another session uses it.
    DragrigError
        What `run_session` raises.
    """
    if out is not None:
        require_no_runs(out)
        with ExitStack() as lock:
            return _run_campaign(setup, replace(options, folder=out), person, _folder_maker(out, lock, new=False))
    now = options.origin or datetime.now().astimezone()
    name = f"{now:%Y%m%d-%H%M%S}-{setup.plan.name}"
    folders = (setup.data_root / (name if number == 1 else f"{name}-{number}") for number in count(1))
    # Two sessions may start within one second: nothing has moved yet, and the later one takes the next name.
    for folder in (folder for folder in folders if not folder.exists()):
        with ExitStack() as lock, suppress(_FolderTakenError):
            return _run_campaign(setup, replace(options, folder=folder), person, _folder_maker(folder, lock, new=True))
    raise AssertionError("unreachable")


class _FolderTakenError(OutputError):
    """Another session took the folder meanwhile."""


def resume_campaign(
    folder: Path, options: SessionOptions, person: SessionOperator | None, assignments: Sequence[str] = ()
) -> Made:
    """Make the missing runs of a campaign's latest plan, with its own settings.

    Runs that a crash left unfinished are recovered first. A run counts when it is complete and not marked bad.

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
    with _continued_campaign(folder, options.tell) as (record, before):
        setup = _setup_from_record(record, folder).with_rig(assignments)
        progress = _progress(before, setup, record.first_order)
        return _continue_campaign(setup, record, before, replace(options, progress=progress), person)


def append_to_campaign(
    plan: PlanLike,
    folder: Path,
    options: SessionOptions,
    person: SessionOperator | None,
    **choices: Unpack[SetupChoices],
) -> Made:
    """Carry out a further plan into a campaign, on its rig and, where no other is stated, its specimen.

    Parameters
    ----------
    choices
        As of `resolve`; what is not chosen is as in the campaign's latest session.

    Raises
    ------
    RunFileError, SettingsError
        When there is no campaign, or what is chosen does not suit its runs.
    DragrigError
        What `run_session` raises.
    """
    with _continued_campaign(folder, options.tell) as (latest, before):
        record = _session_of_specimen(folder, latest, choices)
        setup = resolve(plan, folder=folder, campaign=record, **choices)
        _require_suiting(setup, record, folder)
        for remark in _append_remarks(setup, record, latest, before, folder):
            options.tell(f"{remark}.")
        first_order = max((run.header.order for run in before.runs), default=-1) + 1
        progress = _progress(before, setup, first_order)
        return _continue_campaign(setup, latest, before, replace(options, progress=progress), person)


@contextmanager
def _continued_campaign(folder: Path, tell: Callable[[str], None]) -> Iterator[tuple[SessionRecord, Campaign]]:
    """Hold a campaign for a further session, its interrupted runs recovered; yield its latest session and its runs."""
    latest_session_record(folder)
    with session_lock(folder):
        for recording in recover(folder):
            if recording.outcome is RecoveryOutcome.IN_USE:
                raise OutputError(f"{recording.recording}: is being recorded; go on with the campaign after that.")
        record, damaged = latest_session_record(folder)
        for problem in damaged:
            tell(f"{problem.rstrip('.')}. The session before it counts.")
        yield record, read_campaign(folder)


def _continue_campaign(
    setup: Setup, latest: SessionRecord, before: Campaign, options: SessionOptions, person: SessionOperator | None
) -> Made:
    # Rests of a dry run take no wall time, so that its last run may end in the future.
    ended = [run.end_time or run.header.start_time for run in before.runs]
    origin = max([datetime.now().astimezone(), latest.begun_at + timedelta(seconds=1), *ended])
    first = min((run.header.start_time for run in _runs_of_specimen(before.runs, setup.specimen)), default=None)
    options = replace(options, folder=before.folder, origin=origin, first_run_at=first)
    return _run_campaign(setup, options, person, lambda: None, before)


def _identity(specimen: Specimen) -> str:
    """Return what `specimen_key` is of its runs."""
    return specimen.name if specimen.id in {"", UNSTATED} else specimen.id


def _runs_of_specimen(runs: Sequence[RunInfo], specimen: Specimen) -> Sequence[RunInfo]:
    return [run for run in runs if specimen_key(run) == _identity(specimen)]


def _session_of_specimen(folder: Path, latest: SessionRecord, choices: SetupChoices) -> SessionRecord:
    """Return the campaign's latest session with the specimen that is asked for, as it was stated then.

    Raises `SettingsError` where the campaign has several specimens and none is named.
    """
    records, _ = read_session_records(folder)
    specimens = {_identity(record.specimen): record.specimen for record in records}
    stated = Assignments.of(choices.get("assignments", ())).others["specimen"]
    if choices.get("specimen") is None and len(specimens) > 1 and not stated.keys() & {"id", "name"}:
        raise SettingsError(
            f"{folder}: has runs of several specimens ({', '.join(sorted(specimens))}); say which one is on the "
            "rig with --set specimen.id=…, or a fresh id."
        )
    named = str(stated.get("id", stated.get("name", "")))
    return latest.model_copy(update={"specimen": specimens.get(named, latest.specimen)})


_SAME_IN_A_CAMPAIGN = ("encoder", "force_sensor", "sampling", "simulated")
_SAME_IN_A_SPECIMEN = ("wall_thickness_mm", "animal", "segment", "excised_at")


def _require_suiting(setup: Setup, record: SessionRecord, folder: Path) -> None:
    """Refuse runs whose differences from those of the campaign would be taken for the specimen's or the rig's.

    Raises `SettingsError`.
    """

    def shown(backend: str, *, double: bool) -> str:
        return f"the double of {backend}" if double else backend

    ours, theirs = shown(setup.backend, double=setup.double), shown(record.backend, double=record.double)
    if ours != theirs:
        raise SettingsError(f"{folder}: its runs were made on {theirs}, not on {ours}; start a campaign of its own.")
    now, then = setup.rig.model_dump(mode="json"), record.rig.model_dump(mode="json")
    differing = [
        f"{part}.{key} is {now[part][key]}, not {then[part][key]}"
        for part in _SAME_IN_A_CAMPAIGN
        for key in now[part]
        if now[part][key] != then[part][key]
    ]
    if differing:
        raise SettingsError(
            f"{folder}: its runs were made with another rig: {'; '.join(differing)}; start a campaign of its own."
        )
    if _identity(setup.specimen) != _identity(record.specimen):
        return
    for key in _SAME_IN_A_SPECIMEN:
        value, before = getattr(setup.specimen, key), getattr(record.specimen, key)
        if value != before and before not in {None, ""}:
            raise SettingsError(
                f"specimen.{key} = {value}: is {before} in {folder}; a fresh piece needs an id of its own, as "
                "--set specimen.id=P8."
            )
    is_simulated = setup.backend != HARDWARE_BACKEND or setup.double
    if is_simulated and setup.model != record.model:
        raise SettingsError(
            f"{folder}: its simulated gut follows another friction model; leave out --model, --effect and --set "
            "model.…, or give the other gut an id of its own, as --set specimen.id=P8."
        )


def _append_remarks(
    setup: Setup, record: SessionRecord, latest: SessionRecord, before: Campaign, folder: Path
) -> Iterator[str]:
    ours, theirs = _identity(setup.specimen), _identity(record.specimen)
    if ours != theirs:
        yield (
            f"The runs are of specimen {ours}; those of {theirs} in {folder} stay apart, and an evaluation is of one "
            "of them"
        )
    elif before.runs:
        ended = max(run.end_time or run.header.start_time for run in before.runs)
        hours = (datetime.now().astimezone() - ended).total_seconds() / 3600
        if hours > 1:
            yield (
                f"The last run in {folder} ended {hours:.1f} h ago; the runs count as of the same specimen {ours}, "
                "which is so much older now: a fresh piece needs --set specimen.id=…"
            )
    if left := _missing_runs(latest, before):
        yield (
            f"{count_text(left, 'run')} of the plan {latest.plan.name} before it "
            f"{'is' if left == 1 else 'are'} missing and will not be made: --resume makes them, as long as nothing is "
            "appended"
        )


def _missing_runs(latest: SessionRecord, before: Campaign) -> int:
    programme = _setup_from_record(latest, before.folder).programme()
    return len(programme.pending(_progress_done(before, latest.first_order)))


def missing_runs(folder: Path) -> int:
    """Return how many runs of a campaign's latest plan are missing, which a resumed session makes.

    Raises `RunFileError` where there is no campaign.
    """
    return _missing_runs(latest_session_record(folder)[0], read_campaign(folder))


def rig_time_s(folder: Path) -> float:
    """Return the rig time of a campaign's runs by their plans: rests, tares and returns included, without hands.

    Raises `RunFileError` where there is no campaign.
    """
    latest_session_record(folder)
    # A resumed session goes on with the orders of the one before.
    records = {record.first_order: record for record in read_session_records(folder)[0]}
    runs, firsts, total_s = read_campaign(folder).runs, sorted(records), 0.0
    for first, end in zip(firsts, (*firsts[1:], inf), strict=True):
        made = {run.header.entry.get("plan_run") for run in runs if first <= run.header.order < end}
        programme = _setup_from_record(records[first], folder).programme()
        total_s += replace(programme, runs=tuple(run for run in programme.runs if run.index in made)).duration_s
    return total_s


def _folder_maker(folder: Path, lock: ExitStack, *, new: bool) -> Callable[[], None]:
    """Return a function that makes a campaign's folder and locks it for this session."""

    def make() -> None:
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            folder.mkdir(exist_ok=not new)
        except FileExistsError:
            if new:
                raise _FolderTakenError(f"{folder}: exists already.") from None
            raise
        lock.enter_context(session_lock(folder))
        require_no_runs(folder)

    return make


def require_no_runs(folder: Path) -> None:
    """Refuse a folder that holds runs, as the place of a new campaign; raises `OutputError`."""
    if folder.is_dir() and any(folder.glob("*.h5")):
        raise OutputError(
            f"{folder}: holds runs already; name another folder, or go on with --resume {folder}, or --append {folder}."
        )


def _run_campaign(
    setup: Setup,
    options: SessionOptions,
    person: SessionOperator | None,
    make_folder: Callable[[], None],
    before: Campaign | None = None,
) -> Made:
    """Carry out a session with its state published, and its files mirrored where a mirror is named."""
    observer, folder = person or NullOperator(), options.folder
    for difference in setup.differences:
        options.tell(f"{difference}.")
    state = SessionState(plan=setup.plan.name, backend=setup.backend, double=setup.double)
    publisher = StatePublisher(observer, observer, folder, state)
    mirror = None if options.mirror is None else _open_mirror(options.mirror, folder, options.tell, before)
    status, reason = RunStatus.FAILED.value, "the program ended it"
    report = None
    try:
        copied = mirror.submit if mirror is not None else None
        session = run_session(setup, _store_opener(folder, make_folder, copied), options, publisher)
        status, reason = session.status.value, session.reason
    except DragrigError as error:
        reason = reason_of(error)
        raise
    finally:
        publisher.ends(status, reason)
        if mirror is not None:
            report = _close_mirror(mirror, folder)
    return Made(folder, session, report)


def _open_mirror(target: Path, folder: Path, tell: Callable[[str], None], before: Campaign | None) -> Mirror:
    if (target.resolve() / folder.resolve().name) == folder.resolve():
        raise OutputError(f"--mirror {target}: is where the campaign itself goes; name a folder on another disk.")
    _require_mirror_in_reach(target)
    mirror = Mirror(target, folder.resolve().name, tell)
    for run in before.runs if before is not None else ():
        mirror.submit(run.path)
    return mirror


def _require_mirror_in_reach(target: Path) -> None:
    """Refuse a mirror that is not there, or whose disk does not answer, before anything moves."""
    answers = queue.Queue[bool]()
    # A lost network disk may hang for minutes, and with it whoever asks.
    threading.Thread(target=lambda: answers.put(target.is_dir()), name="mirror check", daemon=True).start()
    try:
        why = "" if answers.get(timeout=MIRROR_ANSWER_S) else "there is no such folder"
    except queue.Empty:
        why = f"its disk has not answered for {MIRROR_ANSWER_S:g} s"
    if why:
        raise OutputError(f"--mirror {target}: {why}; make it, mount the disk, or leave the mirror out.")


def _close_mirror(mirror: Mirror, folder: Path) -> MirrorReport:
    """Copy session records, marks and notes too, and wait for the last copy."""
    beside = ("session-*.toml", "*.mark.toml", "*.note.txt")
    for file in (file for pattern in beside for file in sorted(folder.glob(pattern))):
        mirror.submit(file)
    return mirror.close()


def _store_opener(
    folder: Path, make_folder: Callable[[], None], finished: Callable[[Path], None] | None
) -> Callable[[SessionRecord], FolderStore]:
    def open_store(record: SessionRecord) -> FolderStore:
        try:
            make_folder()
            write_session_record(record, folder)
        except OSError as error:
            raise OutputError(
                f"{folder}: no runs can be written here ({error.strerror}); name another folder with --out."
            ) from error
        recording = record.rig.recording
        return FolderStore(folder, flush_s=recording.flush_s, reserve_mb=recording.reserve_mb, on_finished=finished)

    return open_store


def _setup_from_record(record: SessionRecord, folder: Path) -> Setup:
    rig_file = rig_file_of(folder)
    rig_folder = rig_file.parent if rig_file is not None else None
    differences: tuple[str, ...] = ()
    if rig_file is None:
        rig = require_shipped_dialect(record.rig, str(folder))
    else:
        hardware = record.backend == HARDWARE_BACKEND
        rig, differences = within_lab(record.rig, load_settings(RigSettings, "rig", rig_file)[0], hardware=hardware)
    return Setup(
        plan=record.plan,
        plan_source=f"{folder}, plan {record.plan.name}",
        plan_folder=record.beside,
        rig=rig,
        specimen=record.specimen,
        model=record.model,
        rig_folder=rig_folder,
        contact_mm=contact_position(rig_folder, record.contact_mm),
        backend=record.backend,
        double=record.double,
        differences=differences,
    )


def _progress_done(before: Campaign, first_order: int) -> frozenset[int]:
    """Return the runs of the plan that begins with this order which are made."""
    numbers = [
        run.header.entry.get("plan_run")
        for run in before.good
        if run.status is RunStatus.COMPLETE and run.header.order >= first_order
    ]
    return frozenset(number for number in numbers if isinstance(number, int))


def _progress(before: Campaign, setup: Setup, first_order: int) -> CampaignProgress:
    sentinels = _sentinel_forces(before, setup)
    own = [force for force in sentinels if force.order >= first_order]
    made_after = [
        run for run in before.runs if own and run.header.order > own[-1].order and run.kind != ReturnProtocol.kind
    ]
    return CampaignProgress(
        done=_progress_done(before, first_order),
        first_order=first_order,
        next_order=max((run.header.order for run in before.runs), default=-1) + 1,
        sentinels=sentinels,
        undecided=bool(own) and not made_after,
    )


def _sentinel_forces(before: Campaign, setup: Setup) -> tuple[SteadyForce, ...]:
    """Measure the complete sentinels that this plan's can be compared with, in the order in which they were made.

    They are of the same specimen, capsule and settings, and not marked bad.
    """
    from dragrig.analysis import steady_force_of

    planned = next((run for run in setup.programme().runs if run.sentinel), None)
    if planned is None:
        return ()
    settings = {key: value for key, value in planned.protocol.attributes().items() if key != "kind"}
    made = [
        run
        for run in _runs_of_specimen(before.good, planned.specimen)
        if run.is_sentinel
        and run.status is RunStatus.COMPLETE
        and (run.kind, dict(run.header.protocol)) == (planned.protocol.kind, settings)
        and run.header.capsule.get("name") == planned.capsule.name
    ]
    return tuple(steady_force_of(read_run(run.path)) for run in sorted(made, key=lambda run: run.header.order))
