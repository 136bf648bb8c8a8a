"""Carrying out a plan: backend, record, store and people put together, and the session run to its end."""

from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Protocol

from dragrig.backends import open_backend
from dragrig.hosting import HandedOver, host
from dragrig.rig.backend import Backend, BackendRequest
from dragrig.rig.calibration import latest
from dragrig.rig.people import Nobody, Operator, Watcher
from dragrig.rig.preflight import preflight
from dragrig.rig.record import SessionRecord
from dragrig.rig.session import Progress, Session, SessionResult
from dragrig.rig.store import Store
from dragrig.setup import Setup


class Person(Operator, Watcher, Protocol):
    """Somebody who answers prompts and follows the session."""


@dataclass(frozen=True, slots=True)
class Terms:
    """How a session is carried out.

    Attributes
    ----------
    folder
        The campaign's folder, whose free space is checked.
    real_time
        Whether a simulated rig runs at the pace of the wall's clock.
    origin
        Time of day at which a simulated session begins; now unless given.
    """

    folder: Path
    operator: str = ""
    note: str = ""
    real_time: bool = False
    origin: datetime | None = None
    progress: Progress = field(default_factory=Progress)


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
    request = BackendRequest(setup.rig, setup.model, terms.real_time, terms.origin)
    with closing(open_backend(setup.backend, request)) as backend:
        left = replace(programme, runs=tuple(run for run in programme.runs if run.index not in terms.progress.done))
        preflight(left, setup.rig, backend.stage.limits, terms.folder, setup.plan_source).require()
        record = _record(setup, backend, terms)
        operator = HandedOver(someone)
        with open_store(record) as store:
            session = Session(backend, programme, record, store, operator, someone, terms.progress)
            return host(session, operator)


def _record(setup: Setup, backend: Backend, terms: Terms) -> SessionRecord:
    calibration = latest(setup.rig_folder) if setup.rig_folder is not None else None
    return SessionRecord(
        begun_at=backend.clock.now(),
        backend=setup.backend,
        operator=terms.operator,
        note=terms.note,
        calibration_id=calibration.id if calibration is not None else "",
        beside=setup.plan_folder,
        plan=setup.plan,
        specimen=setup.specimen,
        model=setup.model,
        rig=setup.rig,
    )
