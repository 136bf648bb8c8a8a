"""Campaigns: the folder that a session's runs go to, and going on with one that ended early."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from itertools import count
from pathlib import Path

from dragrig.config.errors import DragrigError, OutputError, plain
from dragrig.config.lab import rig_file_of
from dragrig.rig.people import Nobody
from dragrig.rig.record import SessionRecord, latest_record, write_record
from dragrig.rig.runfile import Campaign, FolderStore, Outcome, campaign, recover
from dragrig.rig.runfile.mirror import Mirror, Mirrored
from dragrig.rig.runfile.model import Status
from dragrig.rig.session import Progress, SessionResult
from dragrig.rigs import contact_in
from dragrig.session_state import Announced, SessionState, alone_in
from dragrig.sessions import Person, Terms, carry_out
from dragrig.setup import Setup


@dataclass(frozen=True, slots=True)
class Made:
    """What a session left: the campaign's folder, and how each run ended."""

    folder: Path
    session: SessionResult
    mirrored: Mirrored | None = None
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


def begin(setup: Setup, out: Path | None, terms: Terms, person: Person | None) -> Made:
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
        What `carry_out` raises.
    """
    if out is not None:
        _require_no_runs(out)
        with ExitStack() as alone:
            return _made(setup, replace(terms, folder=out), person, _begun_in(out, alone, own=False))
    now = terms.origin or datetime.now().astimezone()
    name = f"{now:%Y%m%d-%H%M%S}-{setup.plan.name}"
    names = (name if nth == 1 else f"{name}-{nth}" for nth in count(1))
    # Two sessions may begin within one second: here, where nothing has moved yet, the later one takes the next name.
    for folder in (folder for folder in (setup.data_root / one for one in names) if not folder.exists()):
        with ExitStack() as alone, suppress(_TakenError):
            return _made(setup, replace(terms, folder=folder), person, _begun_in(folder, alone, own=True))
    raise AssertionError("names do not run out")


class _TakenError(OutputError):
    """Another session took the folder meanwhile."""


def go_on(folder: Path, terms: Terms, person: Person | None, assignments: Sequence[str] = ()) -> Made:
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
        What `carry_out` raises.
    """
    latest_record(folder)
    with alone_in(folder):
        for one in recover(folder):
            if one.outcome is Outcome.IN_USE:
                raise OutputError(
                    f"{one.recording}: is being recorded right now; a campaign goes on once its session is over."
                )
        record, before = latest_record(folder), campaign(folder)
        # A dry run's rests take no time, so that its last run may have ended later than it is now.
        ended = [one.end_time or one.header.start_time for one in before.runs]
        origin = max([datetime.now().astimezone(), record.begun_at + timedelta(seconds=1), *ended])
        setup = _setup_of(record, folder).with_rig(assignments)
        first = min((one.header.start_time for one in before.runs), default=None)
        terms = replace(terms, folder=folder, origin=origin, first_run_at=first, progress=_progress(before))
        return _made(setup, terms, person, lambda: None, before)


def _begun_in(folder: Path, alone: ExitStack, *, own: bool) -> Callable[[], None]:
    """Return what makes a campaign's folder, and takes it for this session until `alone` is left."""

    def begun() -> None:
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            folder.mkdir(exist_ok=not own)
        except FileExistsError:
            if own:
                raise _TakenError(f"{folder}: is there already.") from None
            raise
        alone.enter_context(alone_in(folder))
        _require_no_runs(folder)

    return begun


def _require_no_runs(folder: Path) -> None:
    if folder.is_dir() and any(folder.glob("*.h5")):
        raise OutputError(f"{folder}: holds runs already; name another folder, or go on with --resume {folder}.")


def _made(
    setup: Setup, terms: Terms, person: Person | None, begun: Callable[[], None], before: Campaign | None = None
) -> Made:
    """Carry out a session whose state others can see, with its files mirrored where that is wanted."""
    someone, folder = person or Nobody(), terms.folder
    state = SessionState(plan=setup.plan.name, backend=setup.backend, double=setup.double)
    announced = Announced(someone, someone, folder, state)
    mirror = None
    if terms.mirror is not None:
        mirror = Mirror(_require_elsewhere(terms.mirror, folder), folder.resolve().name, terms.tell)
        for run in before.runs if before is not None else ():
            mirror.submit(run.path)
    status, reason = Status.FAILED.value, "the program ended it"
    mirrored = None
    try:
        told = mirror.submit if mirror is not None else None
        session = carry_out(setup, _store_in(folder, begun, told), terms, announced)
        status, reason = session.status.value, session.reason
    except DragrigError as error:
        reason = plain(error)
        raise
    finally:
        announced.ends(status, reason)
        if mirror is not None:
            mirrored = _close(mirror, folder)
    return Made(folder, session, mirrored)


def _require_elsewhere(mirror: Path, folder: Path) -> Path:
    if (mirror.resolve() / folder.resolve().name) == folder.resolve():
        raise OutputError(f"--mirror {mirror}: is where the campaign itself goes; name a folder on another disk.")
    return mirror


def _close(mirror: Mirror, folder: Path) -> Mirrored:
    """Copy the sessions' records and the marks on runs too, and wait for the last copy."""
    for file in (*sorted(folder.glob("session-*.toml")), *sorted(folder.glob("*.mark.toml"))):
        mirror.submit(file)
    return mirror.close()


def _store_in(
    folder: Path, begun: Callable[[], None], told: Callable[[Path], None] | None
) -> Callable[[SessionRecord], FolderStore]:
    def opened(record: SessionRecord) -> FolderStore:
        try:
            begun()
            write_record(record, folder)
        except OSError as error:
            raise OutputError(
                f"{folder}: no runs can be written here ({error.strerror}); name another folder with --out."
            ) from error
        return FolderStore(
            folder, flush_s=record.rig.recording.flush_s, reserve_mb=record.rig.recording.reserve_mb, told=told
        )

    return opened


def _setup_of(record: SessionRecord, folder: Path) -> Setup:
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
        contact_mm=contact_in(rig_folder, record.contact_mm),
        backend=record.backend,
        double=record.double,
    )


def _progress(before: Campaign) -> Progress:
    planned = [one.header.entry.get("plan_run") for one in before.good if one.status is Status.COMPLETE]
    return Progress(
        done=frozenset(place for place in planned if isinstance(place, int)),
        next_order=max((one.header.order + 1 for one in before.runs), default=0),
    )
