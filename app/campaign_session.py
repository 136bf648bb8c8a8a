"""The campaign of a session: begun in a new folder, resumed, or gone on with by another plan."""

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from itertools import count
from math import inf
from pathlib import Path
from typing import Unpack

from dragrig.analysis import count_text
from dragrig.config import (
    UNSTATED,
    DragrigError,
    OutputError,
    SettingsError,
    Specimen,
    parse_toml,
    reason_of,
)
from dragrig.hosted_session import SessionOperator, SessionOptions, begins_at, run_session
from dragrig.notification import Notifier
from dragrig.rig import (
    Campaign,
    CampaignProgress,
    FolderStore,
    Mirror,
    MirrorReport,
    NullOperator,
    RecoveryOutcome,
    ReturnProtocol,
    RigMemory,
    RunInfo,
    RunStatus,
    SessionRecord,
    SessionResult,
    SteadyForce,
    latest_session_record,
    read_campaign,
    read_run,
    read_session_records,
    recover,
    specimen_key,
    write_session_record,
)
from dragrig.session_state import SessionState, StatePublisher, session_lock
from dragrig.setup import (
    HARDWARE_BACKEND,
    Assignments,
    AssignmentsLike,
    PlanLike,
    Setup,
    SetupChoices,
    resolve,
)

_POLL_S = 0.02
FINISHING_S = 5.0
"""How long the finisher of a session that was killed may still be at work on its last recording."""
MIRROR_ANSWER_S = 10.0
"""How long a mirror may take to answer before a session."""


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
        The errors of `run_session`.
    """
    if out is not None:
        require_no_runs(out)
        with ExitStack() as lock:
            make_folder = partial(_make_folder, out, lock, new=False)
            return _run_campaign(setup, replace(options, folder=out), person, make_folder)
    now = options.origin or datetime.now().astimezone()
    name = f"{now:%Y%m%d-%H%M%S}-{setup.plan.name}"
    folders = (setup.data_root / (name if number == 1 else f"{name}-{number}") for number in count(1))
    # Two sessions may start within one second: nothing has moved yet, and the later one takes the next name.
    for folder in (folder for folder in folders if not folder.exists()):
        with ExitStack() as lock, suppress(_FolderTakenError):
            make_folder = partial(_make_folder, folder, lock, new=True)
            return _run_campaign(setup, replace(options, folder=folder), person, make_folder)
    raise AssertionError("unreachable")


class _FolderTakenError(OutputError):
    """Another session took the folder meanwhile."""


def resume_campaign(
    folder: Path,
    options: SessionOptions,
    person: SessionOperator | None,
    assignments: AssignmentsLike = (),
    memory: RigMemory | None = None,
) -> Made:
    """Make the missing runs of a campaign's latest plan, with its own settings.

    Runs that a crash left unfinished are recovered first. A run counts when it is complete and not marked bad.

    Parameters
    ----------
    assignments
        Changes to the rig, each `rig.key=value`.
    memory
        As of `resolve_rig`.

    Raises
    ------
    RunFileError, SettingsError
        When there is no campaign, or its record is damaged.
    DragrigError
        The errors of `run_session`.
    """
    with _continued_campaign(folder, options.tell) as (record, before):
        setup = replace(_setup_from_record(record, folder).with_rig(assignments), memory=memory or RigMemory())
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
        As of `resolve`; all else is as in the campaign's latest session.

    Raises
    ------
    RunFileError, SettingsError
        When there is no campaign, or a choice does not suit its runs.
    DragrigError
        The errors of `run_session`.
    """
    with _continued_campaign(folder, options.tell) as (latest, before):
        setup, remarks = setup_to_append(plan, latest, before, **choices)
        for remark in remarks:
            options.tell(f"{remark}.")
        # Where none of its files is there, the plan before has given no order, and is another plan all the same.
        progress = _progress(before, setup, max(before.next_order, latest.first_order + 1))
        return _continue_campaign(setup, latest, before, replace(options, progress=progress), person)


def setup_to_append(
    plan: PlanLike, latest: SessionRecord, before: Campaign, *, running: bool = False, **choices: Unpack[SetupChoices]
) -> tuple[Setup, tuple[str, ...]]:
    """Return the setup of a further plan in a campaign, and the remarks on it; nothing is written.

    Parameters
    ----------
    latest, before
        The campaign's latest session, and its runs.
    running
        Whether that session is still under way, so that none of its runs is missing yet.
    choices
        As of `append_to_campaign`.

    Raises
    ------
    SettingsError, PlanError
        When a choice does not suit the campaign's runs.
    """
    folder = before.folder
    record = _session_of_specimen(folder, latest, choices)
    setup = resolve(plan, folder=folder, campaign=record, **choices)
    _require_suiting(setup, record, folder)
    return setup, tuple(_append_remarks(setup, record, None if running else latest, before, folder))


@contextmanager
def _continued_campaign(folder: Path, tell: Callable[[str], None]) -> Iterator[tuple[SessionRecord, Campaign]]:
    """Hold a campaign for a further session, its interrupted runs recovered; yield its latest session and its runs."""
    latest_session_record(folder)
    with session_lock(folder):
        until_s = time.monotonic() + FINISHING_S
        while in_use := [entry for entry in recover(folder) if entry.outcome is RecoveryOutcome.IN_USE]:
            if time.monotonic() > until_s:
                raise OutputError(f"{in_use[0].recording}: is being recorded; go on with the campaign after that.")
            time.sleep(_POLL_S)
        record, damaged = latest_session_record(folder)
        for problem in damaged:
            tell(f"{problem.rstrip('.')}. The session before it counts.")
        before = read_campaign(folder)
        if before.unreadable:
            names = ", ".join(path.name for path, _ in before.unreadable)
            tell(
                f"{folder}: {count_text(len(before.unreadable), 'run file')} cannot be read ({names}): a run that no "
                "other file holds counts as missing, and no number is given again."
            )
        yield record, before


def _continue_campaign(
    setup: Setup, latest: SessionRecord, before: Campaign, options: SessionOptions, person: SessionOperator | None
) -> Made:
    # Rests of a dry run take no wall time, so that its last run may end in the future.
    ended = [run.end_time or run.header.start_time for run in before.runs]
    now = begins_at(setup, setup.programme(), real_time=setup.request(options.pace).real_time)
    origin = max([now, latest.begun_at + timedelta(seconds=1), *ended])
    first = min((run.header.start_time for run in _runs_of_specimen(before.runs, setup.specimen)), default=None)
    options = replace(options, folder=before.folder, origin=origin, first_run_at=first)
    return _run_campaign(setup, options, person, lambda: None, before)


def _identity(specimen: Specimen) -> str:
    """Return the `specimen_key` of its runs."""
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
    setup: Setup, record: SessionRecord, latest: SessionRecord | None, before: Campaign, folder: Path
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
    if latest is not None and (left := _missing_runs(latest, before)):
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


def _make_folder(folder: Path, lock: ExitStack, *, new: bool) -> None:
    """Make a campaign's folder and lock it for this session."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(exist_ok=not new)
    except FileExistsError:
        if new:
            raise _FolderTakenError(f"{folder}: exists already.") from None
        raise
    lock.enter_context(session_lock(folder))
    require_no_runs(folder)


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
    notifier = Notifier(setup.rig_folder, options.tell)
    publisher = StatePublisher(observer, observer, folder, state, notifier.prompting)
    status, reason = RunStatus.FAILED.value, "the program ended it"
    mirror, report = None, None
    try:
        if before is not None:
            publisher.prepares()
        mirror = None if options.mirror is None else _open_mirror(options.mirror, folder, options.tell, before)
        copied = mirror.submit if mirror is not None else None
        session = run_session(setup, partial(_open_store, folder, make_folder, copied), options, publisher)
        status, reason = session.status.value, session.reason
    except DragrigError as error:
        reason = reason_of(error)
        raise
    finally:
        publisher.ends(status, reason)
        if mirror is not None:
            for pattern in ("session-*.toml", "*.mark.toml", "*.note.txt"):
                for file in sorted(folder.glob(pattern)):
                    mirror.submit(file)
            report = mirror.close()
        notifier.ended(folder.name, status, reason)
    return Made(folder, session, report)


def _open_mirror(target: Path, folder: Path, tell: Callable[[str], None], before: Campaign | None) -> Mirror:
    if (target.resolve() / folder.resolve().name) == folder.resolve():
        raise OutputError(f"--mirror {target}: is where the campaign itself goes; name a folder on another disk.")
    require_mirror_in_reach(target)
    mirror = Mirror(target, folder.resolve().name, tell)
    for run in before.runs if before is not None else ():
        mirror.submit(run.path)
    return mirror


def require_mirror_in_reach(target: Path) -> None:
    """Refuse a mirror that is not there, or whose disk does not answer, before anything moves; raises `OutputError`."""
    answers = queue.Queue[bool]()
    # A lost network disk may hang for minutes, and with it whoever asks.
    threading.Thread(target=lambda: answers.put(target.is_dir()), name="mirror check", daemon=True).start()
    try:
        why = "" if answers.get(timeout=MIRROR_ANSWER_S) else "there is no such folder"
    except queue.Empty:
        why = f"its disk has not answered for {MIRROR_ANSWER_S:g} s"
    if why:
        raise OutputError(f"--mirror {target}: {why}; make it, mount the disk, or leave the mirror out.")


def _open_store(
    folder: Path, make_folder: Callable[[], None], finished: Callable[[Path], None] | None, record: SessionRecord
) -> FolderStore:
    try:
        make_folder()
        write_session_record(record, folder)
    except OSError as error:
        raise OutputError(
            f"{folder}: no runs can be written here ({error.strerror}); name another folder with --out."
        ) from error
    recording = record.rig.recording
    return FolderStore(folder, flush_s=recording.flush_s, reserve_mb=recording.reserve_mb, on_finished=finished)


def _setup_from_record(record: SessionRecord, folder: Path) -> Setup:
    setup = resolve(record.plan, folder=folder, campaign=record, backend=record.backend, double=record.double)
    return replace(setup, plan_source=f"{folder}, plan {record.plan.name}", plan_folder=record.beside)


def _progress_done(before: Campaign, first_order: int) -> frozenset[int]:
    """Return the runs of the plan that begins with this order which are made."""
    numbers = [
        run.header.entry.get("plan_run")
        for run in before.good
        if run.status is RunStatus.COMPLETE and run.header.order >= first_order and _is_of_plan(run, first_order)
    ]
    return frozenset(number for number in numbers if isinstance(number, int))


def _is_of_plan(run: RunInfo, first_order: int) -> bool:
    """Whether a run is of the plan that begins with this order, by its own settings, as far as they say it.

    A file that was away when the plan was appended may have the order of one of its runs.
    """
    with suppress(SettingsError):
        return parse_toml(run.header.settings_toml, str(run.path)).get("first_order", first_order) == first_order
    return True


def _progress(before: Campaign, setup: Setup, first_order: int) -> CampaignProgress:
    sentinels = _sentinel_forces(before, setup)
    own = [force for force in sentinels if force.order >= first_order]
    made_after = [
        run for run in before.runs if own and run.header.order > own[-1].order and run.kind != ReturnProtocol.kind
    ]
    return CampaignProgress(
        done=_progress_done(before, first_order),
        first_order=first_order,
        next_order=max(before.next_order, first_order),
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
