"""Carrying out a plan: backend, record, store and people put together, and the session run to its end."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Protocol

from dragrig.backends import open_backend
from dragrig.config.lab import Calibration
from dragrig.hosting import HandedOver, host
from dragrig.pacing import Pace, pacing
from dragrig.rig.backend import Backend, BackendRequest
from dragrig.rig.people import Nobody, Operator, Watcher
from dragrig.rig.preflight import preflight
from dragrig.rig.record import SessionRecord
from dragrig.rig.runfile.model import Status
from dragrig.rig.session import Progress, Session, SessionResult
from dragrig.rig.store import Store
from dragrig.setup import Setup


class Person(Operator, Watcher, Protocol):
    """Somebody who answers prompts and follows the session."""


def unheard(sentence: str) -> None:
    """Tell nobody."""
    del sentence


def _nobody_else(abort: Callable[[str], None]) -> None:
    """Leave the end of a session to its host."""
    del abort


@dataclass(frozen=True, slots=True)
class Terms:
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
    progress: Progress = field(default_factory=Progress)
    begun: Callable[[Callable[[str], None]], None] = _nobody_else
    mirror: Path | None = None
    tell: Callable[[str], None] = unheard


def carry_out(
    setup: Setup,
    open_store: Callable[[SessionRecord], AbstractContextManager[Store]],
    terms: Terms,
    person: Person | None = None,
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
    someone: Person = person or Nobody()
    programme = setup.programme()
    left = replace(programme, runs=programme.pending(terms.progress.done))
    if not left.runs:
        # Nobody is asked, and no stage is sent home, for nothing.
        return SessionResult(Status.COMPLETE, "", ())
    pace = pacing(terms.pace, double=setup.double)
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
        record = _record(setup, backend, terms, calibrations)
        operator = HandedOver(someone)
        with open_store(record) as store:
            timed = pace.real_time or backend.needs_hands
            session = Session(backend, programme, record, store, operator, someone, terms.progress, real_time=timed)
            terms.begun(session.abort)
            return host(session.run, session.abort, operator)


def _record(setup: Setup, backend: Backend, terms: Terms, calibrations: Mapping[str, Calibration]) -> SessionRecord:
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
