"""Check a plan or the rig, simulate a plan, run it, and resume an interrupted campaign."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Unpack

from dragrig import campaign_session as campaigns
from dragrig import setup as backends
from dragrig.campaign_session import Made, SessionOperator, SessionOptions, discard_message, run_session
from dragrig.config.errors import OutputError
from dragrig.rig.devices import BackendRequest, RigCheck
from dragrig.rig.memory import MemoryStore
from dragrig.rig.preflight import Preflight, check_calibration, check_limits, check_wiring, preflight
from dragrig.rig.runfile import read_run
from dragrig.rig.runfile.model import Run
from dragrig.setup import (
    CALIBRATED_QUANTITIES,
    Pace,
    PlanLike,
    RigChoices,
    RigSetup,
    SetupChoices,
    open_backend,
    resolve,
    resolve_rig,
)


def examine(**choices: Unpack[RigChoices]) -> Iterator[RigCheck]:
    """Look at the rig's limits, calibrations and devices, and tell one after the other; nothing moves.

    Parameters
    ----------
    choices
        `rig`, `model`: a file or a shipped name each; `backend`: a name; `double`: whether its double is meant;
        `assignments`: changes as on the command line, `["rig.hardware.drive.port=COM3"]`.

    Raises
    ------
    SettingsError
        For settings that cannot be used at all.
    DeviceError
        When the backend cannot be loaded; what a device refuses is a finding.

    Examples
    --------
    >>> import dragrig
    >>> all(finding.fine for finding in dragrig.examine(backend="simulated"))
    True
    """
    return _rig_findings(resolve_rig(**choices))


def _rig_findings(setup: RigSetup) -> Iterator[RigCheck]:
    rig, calibrations = setup.rig, setup.calibrations()
    request = BackendRequest(rig, setup.model, calibrations=calibrations, connect=False)
    with closing(open_backend(setup.backend, request, double=setup.double)) as backend:
        yield check_limits(rig)
        if backend.needs_hands:
            yield from check_wiring(rig, calibrations)
        for quantity in CALIBRATED_QUANTITIES:
            if quantity in calibrations or (backend.needs_hands and not setup.double):
                yield check_calibration(quantity, calibrations.get(quantity), rig, backend.clock.now())
        yield from backend.examine()


def check(plan: PlanLike, *, out: str | Path | None = None, **choices: Unpack[SetupChoices]) -> Preflight:
    """Say what a plan would do and what forbids it; nothing moves.

    Parameters
    ----------
    plan
        A shipped plan's name, a file, a `Plan`, or a protocol.
    out
        Folder whose free space counts; the rig's data root unless given.
    choices
        `rig`, `specimen`, `model`, `capsule`: a file or a shipped name each, or the model itself; `backend`: a name;
        `double`: whether its double is meant, in place of the hardware; `effects`: what the simulated rig has beside
        the model's, `["stribeck:ratio=0.4,speed_mm_s=2"]`; `assignments`: changes as on the command line,
        `["speed_mm_s=5", "rig.stage.highest_mm=120"]`.

    Raises
    ------
    SettingsError, PlanError
        For settings that cannot be used at all.

    Examples
    --------
    >>> import dragrig
    >>> dragrig.check("drag").findings
    ()
    """
    setup = resolve(plan, **choices)
    backends.find_backend(setup.backend, double=setup.double)
    folder = Path(out) if out is not None else setup.data_root
    further = len(setup.rig.hardware.card.inputs) if setup.backend == "hardware" else None
    return preflight(setup.programme(), setup.rig, setup.limits, folder, setup.plan_source, further)


def simulate(plan: PlanLike, *, out: str | Path | None = None, **choices: Unpack[SetupChoices]) -> tuple[Run, ...]:
    """Carry out a plan on the simulated rig, with every prompt answered done.

    Parameters
    ----------
    plan
        A shipped plan's name, a file, a `Plan`, or a protocol, as `Drag(speed_mm_s=5)`.
    out
        Folder for run files, new or without runs; unless given, the runs stay in memory.
    choices
        As of `check`.

    Returns
    -------
    The runs in the order they were made, ways back included.

    Raises
    ------
    SettingsError, PlanError
        For settings that cannot be used.
    TrippedError, DeviceError
        When the session ended early.

    Examples
    --------
    >>> import dragrig
    >>> drag, back = dragrig.simulate("drag", assignments=["speed_mm_s=10"])
    >>> drag.trace.force.shape
    (8025,)
    >>> sticky, back = dragrig.simulate("drag", effects=["stribeck:ratio=0.4"])  # doctest: +SKIP
    """
    choices["backend"] = "simulated"
    setup = resolve(plan, **choices)
    if out is not None:
        made = campaigns.start_campaign(setup, Path(out), SessionOptions(Path(out)), None)
        made.session.require()
        return tuple(read_run(one.path) for one in made.session.runs if one.path is not None)
    store = MemoryStore()
    run_session(setup, lambda _record: nullcontext(store), SessionOptions(Path())).require()
    return tuple(store.runs)


def run(
    plan: PlanLike,
    *,
    out: str | Path | None = None,
    operator: str = "",
    note: str = "",
    pace: Pace | None = None,
    person: SessionOperator | None = None,
    mirror: str | Path | None = None,
    tell: Callable[[str], None] = discard_message,
    **choices: Unpack[SetupChoices],
) -> Made:
    """Carry out a plan on the rig, one run file per run.

    Everything is checked before anything moves; Ctrl-C stops the stage first and keeps what was recorded.

    Parameters
    ----------
    plan
        A shipped plan's name, a file, a `Plan`, or a protocol.
    out
        Folder of the campaign, new or without runs; one below the rig's data root unless given.
    operator, note
        Kept in the run files.
    pace
        Of a simulated rig: as fast as it can unless given, or as fast as a real one. Of a double: as fast as a real one
        unless given, or so many times faster.
    person
        Who answers prompts and watches; without one, every prompt counts as done.
    mirror
        Folder, on another disk, that gets a second copy of each finished file, compared after reading it back. It never
        holds a run up; `made.mirrored` says what is in it and what is not.
    tell
        Called with a sentence, from any thread, when a file cannot be mirrored.
    choices
        As of `check`.

    Returns
    -------
    The campaign's folder and how the session ended; `made.session.require()` raises when it ended early.

    Raises
    ------
    SettingsError, PlanError, OutputError
        Before anything moves.
    RecordingError
        When the disk takes no more; the stage is stopped first.

    Examples
    --------
    >>> import dragrig
    >>> made = dragrig.run("drag", out="first-drag", operator="me")  # doctest: +SKIP
    >>> dragrig.table(made.folder)  # doctest: +SKIP
    """
    setup = resolve(plan, **choices)
    folder = Path(out) if out is not None else None
    return campaigns.start_campaign(setup, folder, _session_options(operator, note, pace, mirror, tell), person)


def resume(
    campaign: str | Path,
    *,
    operator: str = "",
    note: str = "",
    pace: Pace | None = None,
    person: SessionOperator | None = None,
    assignments: Sequence[str] = (),
    mirror: str | Path | None = None,
    tell: Callable[[str], None] = discard_message,
) -> Made:
    """Go on with a campaign that ended early, with the settings it was begun with.

    Runs that a crash left unfinished are recovered first; every run that is not complete, or is marked bad, is
    made again.

    Parameters
    ----------
    assignments
        Changes to the rig, as `["rig.guard.force_limit_mN=9000"]`; nothing else can be changed.
    mirror, tell
        As of `run`; the runs that were there before are copied too.

    Raises
    ------
    RunFileError
        When `campaign` is no folder of a session.
    DragrigError
        As `run`.
    """
    folder = Path(campaign)
    if not folder.is_dir():
        raise OutputError(f"{folder}: there is no such campaign; name the folder that run printed.")
    return campaigns.resume_campaign(folder, _session_options(operator, note, pace, mirror, tell), person, assignments)


def _session_options(
    operator: str, note: str, pace: Pace | None, mirror: str | Path | None, tell: Callable[[str], None]
) -> SessionOptions:
    to = None if mirror is None else Path(mirror)
    return SessionOptions(Path(), operator=operator, note=note, pace=pace, mirror=to, tell=tell)
