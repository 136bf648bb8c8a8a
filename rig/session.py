"""A session: the runs of a programme one after the other, with prompts, tares, waits and return strokes between them.

The session's settings are recorded beside its run files, so that it can be resumed or repeated.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from uuid import uuid4

from pydantic import AwareDatetime

from dragrig.config.errors import AbortedError, DeviceError, RunFileError, SettingsError, TrippedError, reason_of
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.config.rig import RigSettings
from dragrig.config.settings import Settings, load_settings, parse, to_toml
from dragrig.config.specimen import Fixture, Specimen
from dragrig.rig.devices import Acquisition, Backend, Contact
from dragrig.rig.engine import Engine, Store, attempt, early_end_error, require_complete
from dragrig.rig.guard import Guard
from dragrig.rig.operator import (
    START_TOLERANCE_MM,
    Answer,
    Operator,
    Prompt,
    RunResult,
    SessionObserver,
    await_standstill,
    enable_and_home,
    park,
    positioning_profile,
    reset_guard,
)
from dragrig.rig.profile import MotionProfile, Phase, stationary_piece
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.runfile import read_info
from dragrig.rig.runfile.model import Attribute, RunHeader, RunStatus


def run_acquisition(order: int, run: PlannedRun, dwell_s: float) -> Acquisition:
    """Return the acquisition of a run whose contact is `dwell_s` old at its first sample."""
    return Acquisition(
        run_id=str(uuid4()),
        order=order,
        kind=run.protocol.kind,
        profile=run.profile,
        capsule=run.capsule,
        specimen=run.specimen,
        fixture=run.fixture,
        contact=run.contact,
        insertion_dwell_s=dwell_s,
        shear_strain=run.shear_strain,
        sheared_from=run.sheared_from,
    )


def auxiliary_acquisition(order: int, kind: str, run: PlannedRun, profile: MotionProfile) -> Acquisition:
    """Return what is made for a run beside it, with the capsule clear of the gut: a tare, the way to its start."""
    free = replace(run, profile=profile, contact=Contact.NONE, fixture=Fixture.NONE)
    return replace(run_acquisition(order, free, 0.0), kind=kind, recorded=False)


_RECORD_PATTERN = "session-*.toml"


class SessionRecord(Settings):
    """The full settings of a session."""

    begun_at: AwareDatetime
    backend: str
    double: bool = False
    """Whether it is the backend's double."""
    operator: str = ""
    note: str = ""
    calibration_id: str = ""
    """Of the force sensor."""
    encoder_calibration_id: str = ""
    contact_mm: float | None = None
    """Absolute position of the contact that touch-off found; none where it is not known."""
    beside: Path | None = None
    """Folder that files named in the plan are relative to."""
    plan: Plan
    specimen: Specimen
    model: FrictionModelSettings
    rig: RigSettings

    def file_name(self) -> str:
        """Name of the record in the campaign's folder, in UTC, so that names stay in order when clocks are put back."""
        return f"session-{self.begun_at.astimezone(UTC):%Y%m%d-%H%M%SZ}.toml"


def write_session_record(record: SessionRecord, folder: Path) -> Path:
    """Put the record into the campaign's folder; raises `OSError`."""
    path = folder / record.file_name()
    with path.open("x", encoding="utf-8", newline="\n") as file:
        file.write(to_toml(record))
    return path


def session_record_of_run(run_file: Path) -> SessionRecord:
    """Read the record that a run carries of the session it belongs to.

    Raises
    ------
    RunFileError
        When the file is no run file, or one that was not made by this software.
    SettingsError
        When its settings cannot be used.
    """
    settings = read_info(run_file).header.settings_toml
    if not settings:
        raise RunFileError(f"{run_file}: carries no settings of a session, so that it cannot be made again.")
    try:
        return parse(SessionRecord, tomllib.loads(settings), f"settings in {run_file}")
    except tomllib.TOMLDecodeError as error:
        raise RunFileError(f"{run_file}: its settings are damaged ({error}).") from error


def read_session_records(folder: Path) -> tuple[tuple[SessionRecord, ...], tuple[str, ...]]:
    """Read every record of a campaign, the earliest first, and say what is wrong with those that are damaged."""
    found: list[SessionRecord] = []
    damaged: list[str] = []
    for path in sorted(folder.glob(_RECORD_PATTERN)):
        try:
            found.append(load_settings(SessionRecord, path))
        except SettingsError as error:
            damaged.append(reason_of(error))
    return tuple(found), tuple(damaged)


def latest_session_record(folder: Path) -> SessionRecord:
    """Read the newest record of a campaign; raises `RunFileError` when there is none, `SettingsError` when damaged."""
    records = sorted(folder.glob(_RECORD_PATTERN))
    if not records:
        raise RunFileError(f"{folder}: holds no session-….toml, so there is no session to go on with.")
    return load_settings(SessionRecord, records[-1])


def run_header(
    run: PlannedRun,
    acquisition: Acquisition,
    record: SessionRecord,
    backend: Backend,
    settings_toml: str,
    facts: Mapping[str, Attribute],
) -> RunHeader:
    """Gather the header of a run about to be made.

    Parameters
    ----------
    settings_toml
        The session's record as text, written once for all its runs.
    facts
        Further attributes of `/entry`.
    """
    now = backend.clock.now()
    entry: dict[str, Attribute] = {
        "software": software_version(),
        "plan": record.plan.name,
        "plan_run": run.index,
        "origin_mm": backend.stage.state().position_mm,
        "insertion_dwell_s": acquisition.insertion_dwell_s,
        "operator": record.operator,
        "note": "; ".join(part for part in (record.note, run.note) if part),
        "calibration_id": record.calibration_id,
        "encoder_calibration_id": record.encoder_calibration_id,
        **({"double": record.backend} if record.double else {}),
        **({"contact_mm": record.contact_mm} if record.contact_mm is not None else {}),
        **({"way_back_of": run.follows} if run.follows >= 0 else {}),
        **backend.description(),
        **facts,
    }
    return RunHeader(
        run_id=acquisition.run_id,
        start_time=now,
        order=acquisition.order,
        backend=backend.name,
        kind=run.protocol.kind,
        sample_rate_hz=backend.sampler.sample_rate_hz,
        channels=backend.sampler.channels,
        entry={key: value for key, value in entry.items() if value != ""},
        protocol={key: value for key, value in run.protocol.attributes().items() if key != "kind"},
        capsule=_as_attributes(run.capsule),
        specimen={**_as_attributes(run.specimen), "fixture": acquisition.fixture.value},
        settings_toml=f"# run {run.index} of this session, order {acquisition.order}\n{settings_toml}",
    )


@cache
def software_version() -> str:
    """Return name and version of this software."""
    return f"dragrig {version('dragrig')}"


def _as_attributes(settings: Settings) -> dict[str, Attribute]:
    values = settings.model_dump(mode="json", exclude_none=True)
    return {key: value for key, value in values.items() if value != ""}


@dataclass(frozen=True, slots=True)
class SessionResult:
    """How a session ended: `complete` when every pending run was made or skipped."""

    status: RunStatus
    reason: str
    runs: tuple[RunResult, ...]

    def require(self) -> None:
        """Raise the error, with its exit code, that stands for an early end."""
        if self.status is RunStatus.COMPLETE:
            return
        raise early_end_error(self.status, f"the session ended early: {self.reason}.")


@dataclass(frozen=True, slots=True)
class CampaignProgress:
    """What earlier sessions of the same campaign did."""

    done: frozenset[int] = frozenset()
    next_order: int = 0


class Session:
    """Makes the pending runs of a programme; `run` belongs to one thread, `abort` to any."""

    def __init__(
        self,
        backend: Backend,
        programme: Programme,
        record: SessionRecord,
        store: Store,
        operator: Operator,
        watcher: SessionObserver,
        progress: CampaignProgress = CampaignProgress(),
        *,
        real_time: bool = False,
    ) -> None:
        self._backend, self._programme, self._record = backend, programme, record
        self._settings = to_toml(record)
        self._store, self._operator, self._watcher = store, operator, watcher
        self._real_time = real_time
        self._done, self._order = progress.done, progress.next_order
        self._guard = Guard(record.rig.guard, 1e-3 * record.rig.encoder.resolution_um)
        self.engine = Engine(backend, record.rig, self._guard)
        self._results: list[RunResult] = []
        self._contact_since = 0.0
        self._inserted_at: datetime | None = None
        self._asked = False

    def abort(self, reason: str) -> None:
        """Ask for an end, from any thread or signal handler."""
        self.engine.abort(reason)

    def run(self) -> SessionResult:
        """Make every pending run, or as many as can be.

        Raises
        ------
        DragrigError
            When a record cannot be opened or finished; the stage is stopped and disabled first.
        """
        self._watcher.begins(self._programme, self._programme.pending(self._done), real_time=self._real_time)
        status, reason = RunStatus.COMPLETE, ""
        try:
            self._prepare()
            self._make_all()
        except TrippedError as error:
            status, reason = RunStatus.TRIPPED, reason_of(error)
        except AbortedError as error:
            status, reason = RunStatus.ABORTED, self.engine.abort_reason or reason_of(error)
        except DeviceError as error:
            # What a stop from elsewhere interrupted, homing above all, tells of it as a failure.
            status = RunStatus.ABORTED if self.engine.cancelled.is_set() else RunStatus.FAILED
            reason = self.engine.abort_reason or reason_of(error)
        finally:
            failures = [*park(self._backend, reason), attempt(self._store.settle)]
        reason = "; ".join(part for part in (reason, *failures) if part)
        if status is RunStatus.COMPLETE and any(failures):
            status = RunStatus.FAILED
        return SessionResult(status, reason, tuple(self._results))

    def _prepare(self) -> None:
        reset_guard(self._backend, self._guard, self._operator)
        self._stop_if_cancelled()
        enable_and_home(self._backend, self._operator)
        self._contact_since = self._backend.clock.monotonic()

    def _make_all(self) -> None:
        runs, place = self._programme.runs, 0
        while place < len(runs):
            self._stop_if_cancelled()
            run = runs[place]
            if self._is_stray_way_back(run) if run.follows >= 0 else run.index in self._done:
                place += 1
                continue
            match self._hands(run):
                case Answer.DONE:
                    self._make(run)
                    place += 1
                case Answer.REDO:
                    place = self._take_back()
                case Answer.SKIP:
                    place = self._next_prompted(place)
                case Answer.ABORT:
                    raise AbortedError("ended at a prompt.")

    def _is_stray_way_back(self, run: PlannedRun) -> bool:
        return run.follows >= 0 and (not self._results or self._results[-1].run.index != run.follows)

    def _take_back(self) -> int:
        last = next(result for result in reversed(self._results) if result.run.follows < 0)
        for result in self._results:
            if last.run.index in (result.run.index, result.run.follows) and result.order >= last.order:
                self._store.mark_bad(result.order, "made again at the operator's word")
        return last.run.index

    def _next_prompted(self, place: int) -> int:
        runs = self._programme.runs
        return next((later for later in range(place + 1, len(runs)) if runs[later].prompt), len(runs))

    def _hands(self, run: PlannedRun) -> Answer:
        if run.follows < 0 and not run.by_hand:
            # Whatever is asked next may put the capsule into the gut, so the stage moves before.
            self._must(self._clear_the_way(run))
            self._go_to(run)
        text = self._prompt_text(run)
        if text:
            can_redo = any(result.run.follows < 0 for result in self._results)
            prompt = Prompt(text, run, can_redo, can_skip=True, hands=self._backend.needs_hands)
            answer = self._operator.ask(prompt)
            self._stop_if_cancelled()
            if answer is not Answer.DONE:
                return answer
            self._note_contact(run)
        self._asked = True
        return Answer.DONE

    def _clear_the_way(self, run: PlannedRun) -> Answer:
        in_gut = bool(self._results) and self._results[-1].run.contact is not Contact.NONE
        if not in_gut or abs(self._way_to(run)) <= START_TOLERANCE_MM:
            return Answer.DONE
        text = f"Take the capsule out of the gut: the stage goes to {run.start_mm:g} mm"
        self._inserted_at = None
        return self._ask_plainly(text, run)

    def _ask_plainly(self, text: str, run: PlannedRun) -> Answer:
        return self._operator.ask(Prompt(text, run, hands=self._backend.needs_hands))

    def _note_contact(self, run: PlannedRun) -> None:
        clock = self._backend.clock
        self._contact_since = clock.monotonic()
        self._inserted_at = None if run.contact is Contact.NONE else clock.now()

    def _way_to(self, run: PlannedRun) -> float:
        return run.start_mm - self._backend.stage.state().position_mm

    def _prompt_text(self, run: PlannedRun) -> str:
        if run.prompt or self._asked:
            return run.prompt
        # A session that goes on in the middle of a step needs what that step's prompt prepares.
        before = [one for one in self._programme.runs[: run.index] if one.step == run.step and one.prompt]
        return before[-1].prompt if before else ""

    def _make(self, run: PlannedRun) -> None:
        tare = self._tare(run)
        self._go_to(run)
        self._wait(run)
        clock = self._backend.clock
        acquisition = run_acquisition(self._order, run, clock.monotonic() - self._contact_since)
        facts: dict[str, Attribute] = {} if tare is None else {"tare_mN": tare}
        if self._inserted_at is not None:
            facts["inserted_at"] = self._inserted_at.isoformat()
        header = run_header(run, acquisition, self._record, self._backend, self._settings, facts)
        self._watcher.run_begins(run, self._order)
        sink = self._store.open(header, run.profile.samples(header.sample_rate_hz))
        outcome = self.engine.acquire(acquisition, sink, self._watcher.reads, tare or 0.0)
        # The contact ages from the last standstill on, so the hold counts.
        self._contact_since = clock.monotonic() - (run.profile.duration_s - run.profile.motion_ends_s)
        self._results.append(RunResult(run, self._order, outcome, outcome.path))
        self._order += 1
        self._watcher.run_ends(run, outcome)
        require_complete(outcome)

    def _tare(self, run: PlannedRun) -> float | None:
        if not run.tare_s:
            return None
        self._must(self._ask_plainly("Hold the capsule clear of the gut: the sensor's zero is taken", run))
        rest = MotionProfile.from_pieces([stationary_piece(run.tare_s, Phase.REST)])
        outcome = self.engine.acquire(auxiliary_acquisition(self._order, "tare", run, rest))
        require_complete(outcome)
        if not isfinite(outcome.mean_force_mN):
            raise DeviceError(f"a tare of {run.tare_s:g} s is too short for a sample.")
        self._must(self._ask_plainly("Bring the capsule into the gut again", run))
        self._note_contact(run)
        return outcome.mean_force_mN

    def _go_to(self, run: PlannedRun) -> None:
        way = self._way_to(run)
        if abs(way) <= START_TOLERANCE_MM:
            return
        profile = positioning_profile(way, self._backend.stage.limits)
        require_complete(self.engine.acquire(auxiliary_acquisition(self._order, "positioning", run, profile)))
        await_standstill(self._backend)
        self._contact_since = self._backend.clock.monotonic()

    def _wait(self, run: PlannedRun) -> None:
        clock = self._backend.clock
        left = run.wait_s - (clock.monotonic() - self._contact_since)
        if left > 0:
            self._watcher.waits(left, f"rest before {run.protocol.summary()}")
            clock.sleep(left, self.engine.cancelled)
            self._stop_if_cancelled()

    def _must(self, answer: Answer) -> None:
        self._stop_if_cancelled()
        if answer is not Answer.DONE:
            raise AbortedError("ended at a prompt.")

    def _stop_if_cancelled(self) -> None:
        if self.engine.cancelled.is_set():
            raise AbortedError(self.engine.abort_reason or "aborted")
