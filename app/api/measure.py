"""Check a plan or the rig, simulate a plan, run it, and resume an interrupted campaign."""

from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from threading import Event as Signal
from typing import TYPE_CHECKING, Unpack

from dragrig.config import OutputError
from dragrig.notification import check_notification
from dragrig.rig import (
    Preflight,
    RigCheck,
    Run,
    check_calibration,
    check_limits,
    check_stops,
    check_wiring,
    ignore,
    preflight,
    specimen_remark,
)
from dragrig.setup import (
    CALIBRATED_QUANTITIES,
    HARDWARE_BACKEND,
    AssignmentsLike,
    Pace,
    PlanLike,
    RigChoices,
    RigSetup,
    Setup,
    SetupChoices,
    find_backend,
    open_backend,
    resolve,
    resolve_rig,
)

if TYPE_CHECKING:
    from dragrig.campaign_session import Made
    from dragrig.hosted_session import SessionOperator


def examine(**choices: Unpack[RigChoices]) -> Iterator[RigCheck]:
    """Check the rig's limits, calibrations and devices one after the other; nothing moves.

    Parameters
    ----------
    choices
        `rig`, `model`: a file or a shipped name each; `backend`: a name; `double`: whether to use its double;
        `assignments`: changes, `{"rig.hardware.drive.port": "COM3"}` or, as on the command line,
        `["rig.hardware.drive.port=COM3"]`.

    Raises
    ------
    TypeError
        For any other keyword.
    SettingsError
        For settings that cannot be used at all.
    DeviceError
        When the backend cannot be loaded; a device that fails is a finding.

    Examples
    --------
    >>> import dragrig
    >>> all(check.passed for check in dragrig.examine(backend="simulated"))
    True
    """
    return _rig_findings(resolve_rig(**choices))


def _rig_findings(setup: RigSetup) -> Iterator[RigCheck]:
    request = replace(setup.request(), connect=False)
    rig, calibrations = setup.rig, request.calibrations
    with closing(open_backend(setup.backend, request, double=setup.double)) as backend:
        yield check_limits(rig)
        if backend.needs_hands:
            yield from check_wiring(rig, calibrations)
            yield check_stops(rig, setup.stops())
        for quantity in CALIBRATED_QUANTITIES:
            if quantity in calibrations or (backend.needs_hands and not setup.double):
                yield check_calibration(quantity, calibrations.get(quantity), rig, backend.clock.now())
        yield from backend.examine()
    yield from check_notification(setup.rig_folder)


def check(plan: PlanLike, *, out: str | Path | None = None, **choices: Unpack[SetupChoices]) -> Preflight:
    """Check the motions of a plan against the limits; nothing moves.

    Parameters
    ----------
    plan
        A shipped plan's name, a file, a `Plan`, the table of one as a dict, or a protocol.
    out
        Folder whose free space is checked (default: the rig's data root).
    choices
        `rig`, `specimen`, `model`, `capsule`: a file or a shipped name each, or the model itself; `backend`: a name;
        `double`: whether to use its double, in place of the hardware; `effects`: added to those of the model of the
        simulated rig, `["stribeck:ratio=0.4,speed_mm_s=2"]`; keys of the plan's steps, `speed_mm_s=5` or
        `speed_mm_s=[5, 10]`; `assignments`: changes of anything, `{"rig.stage.highest_mm": 120}` or, as on the command
        line, `["rig.stage.highest_mm=120"]`.

    Raises
    ------
    TypeError
        For any other keyword.
    SettingsError, PlanError
        For settings that cannot be used at all.

    Examples
    --------
    >>> import dragrig
    >>> dragrig.check("drag").findings
    ()
    """
    setup = resolve(plan, **choices)
    return check_setup(setup, Path(out) if out is not None else setup.data_root)


def check_setup(setup: Setup, folder: Path) -> Preflight:
    """Check the motions of a session against the limits; nothing moves.

    Parameters
    ----------
    folder
        Whose free space is checked.

    Raises
    ------
    SettingsError, PlanError
        For settings that cannot be used at all.
    """
    find_backend(setup.backend, double=setup.double)
    is_real = setup.backend == HARDWARE_BACKEND
    further = len(setup.rig.hardware.card.inputs) if is_real else None
    stops = setup.stops() if is_real else None
    checked = preflight(setup.programme(), setup.rig, setup.limits, folder, setup.plan_source, further, stops)
    remark = specimen_remark(setup.specimen) if is_real else ""
    return replace(checked, remarks=(*setup.differences, *((remark,) if remark else ()), *checked.remarks))


def simulate(
    plan: PlanLike,
    *,
    out: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    **choices: Unpack[SetupChoices],
) -> tuple[Run, ...]:
    """Carry out a plan on the simulated rig, with every prompt answered done.

    Parameters
    ----------
    plan
        A shipped plan's name, a file, a `Plan`, the table of one as a dict, or a protocol, as `Drag(speed_mm_s=5)`.
    out
        Folder for run files, new or without runs (default: none, the runs stay in memory).
    progress
        Called after each run with the numbers of runs that are made, and in all.
    choices
        As of `check`.

    Returns
    -------
    The runs in order, return strokes included.

    Raises
    ------
    SettingsError, PlanError
        For settings that cannot be used.
    TrippedError, DeviceError
        When the session ended early.

    Examples
    --------
    >>> import dragrig
    >>> drag, back = dragrig.simulate("drag", speed_mm_s=10)
    >>> drag.trace.force.shape
    (8025,)
    >>> sticky, back = dragrig.simulate("drag", effects=["stribeck:ratio=0.4"])  # doctest: +SKIP
    """
    from dragrig.campaign_session import start_campaign
    from dragrig.hosted_session import RunCounter, SessionOptions, run_session
    from dragrig.rig import MemoryStore, read_run

    person = None if progress is None else RunCounter(progress)
    choices["backend"] = "simulated"
    setup = resolve(plan, **choices)
    if out is not None:
        made = start_campaign(setup, Path(out), SessionOptions(Path(out)), person)
        made.session.require()
        return tuple(map(read_run, made.files))
    store = MemoryStore()
    run_session(setup, lambda _record: nullcontext(store), SessionOptions(Path()), person).require()
    return tuple(store.runs)


def run(
    plan: PlanLike,
    *,
    out: str | Path | None = None,
    append: str | Path | None = None,
    operator: str = "",
    note: str = "",
    pace: Pace | None = None,
    person: "SessionOperator | None" = None,
    mirror: str | Path | None = None,
    tell: Callable[[str], None] | None = None,
    pause: Signal | None = None,
    **choices: Unpack[SetupChoices],
) -> "Made":
    """Carry out a plan on the rig, one run file per run.

    Everything is checked before anything moves; Ctrl-C stops the stage first and keeps the recorded samples.

    Parameters
    ----------
    plan
        A shipped plan's name, a file, a `Plan`, the table of one as a dict, or a protocol.
    out
        Folder of the campaign, new or without runs (default: a new one in the rig's data root).
    append
        Folder of a campaign, in place of `out`, to which the runs are added, on another day too. What `choices` leaves
        open is as in its latest session; another rig, or another state of the same specimen, is refused.
    operator, note
        Stored in the run files.
    pace
        Of a simulated rig: "fast" (default) or "real". Of a double: "real" (default), or this many times faster.
    person
        Answers prompts and observes (default: every prompt counts as done; the session ends where one needs hands).
    mirror
        Folder, on another disk, for a second copy of each finished file, verified by reading it back. It never delays a
        run; `made.mirrored` lists the files that were copied and those that were not.
    tell
        Called with a sentence, from any thread, when a file cannot be mirrored (default: nobody is told).
    pause
        Set by anybody to have the session ask `person` before its next run.
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
    from dragrig.campaign_session import append_to_campaign, start_campaign
    from dragrig.hosted_session import SessionOptions

    target = None if mirror is None else Path(mirror)
    options = SessionOptions(Path(), operator, note, pace, mirror=target, tell=tell or ignore, pause=pause)
    if append is not None:
        if out is not None:
            raise OutputError(f"{append}: the runs go into this campaign, so leave out the folder {out}.")
        return append_to_campaign(plan, _campaign_folder(append), options, person, **choices)
    return start_campaign(resolve(plan, **choices), Path(out) if out is not None else None, options, person)


def resume(
    campaign: str | Path,
    *,
    operator: str = "",
    note: str = "",
    pace: Pace | None = None,
    person: "SessionOperator | None" = None,
    assignments: AssignmentsLike = (),
    mirror: str | Path | None = None,
    tell: Callable[[str], None] | None = None,
    pause: Signal | None = None,
) -> "Made":
    """Resume the latest plan of a campaign that ended early, with its own settings.

    Runs that a crash left unfinished are recovered first; every run that is not complete, or is marked bad, is made
    again.

    Parameters
    ----------
    assignments
        Changes to the rig, as `{"rig.guard.force_limit_mN": 9000}`; nothing else can be changed.
    mirror, tell, pause
        As of `run`; earlier runs are copied too.

    Raises
    ------
    RunFileError
        When `campaign` is no folder of a session.
    DragrigError
        As `run`.
    """
    from dragrig.campaign_session import resume_campaign
    from dragrig.hosted_session import SessionOptions

    target = None if mirror is None else Path(mirror)
    options = SessionOptions(Path(), operator, note, pace, mirror=target, tell=tell or ignore, pause=pause)
    return resume_campaign(_campaign_folder(campaign), options, person, assignments)


def _campaign_folder(campaign: str | Path) -> Path:
    folder = Path(campaign)
    if not folder.is_dir():
        missing = "is a file" if folder.is_file() else "there is no such campaign"
        raise OutputError(f"{folder}: {missing}; name the folder that run printed.")
    return folder
