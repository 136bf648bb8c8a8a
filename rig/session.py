"""A session: the runs of a programme one after another, with prompts, tares, waits and return strokes between them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from math import isfinite
from threading import Event as Signal
from uuid import uuid4

from dragrig.config import (
    UNSTATED,
    AbortedError,
    DeviceError,
    Fixture,
    SentinelSettings,
    TrippedError,
    reason_of,
    to_toml,
)
from dragrig.rig.devices import Acquisition, Backend, Contact
from dragrig.rig.engine import (
    AcquisitionOutcome,
    Engine,
    Store,
    attempt,
    early_end_error,
    require_agreement,
    require_complete,
)
from dragrig.rig.guard import Guard
from dragrig.rig.operator import (
    START_TOLERANCE_MM,
    Answer,
    Operator,
    Prompt,
    RunResult,
    SessionObserver,
    await_standstill,
    confirm,
    enable_and_home,
    park,
    positioning_profile,
    reset_guard,
)
from dragrig.rig.profile import MotionProfile, Phase, stationary_piece
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.runfile import Attribute, Run, RunHeader, RunStatus, SessionRecord, software_version
from dragrig.rig.sentinel import SENTINEL_ROLE, Drift, SteadyForce
from dragrig.rig.stops import Stops

_SHORTEST_REST_S = 1e-6
"""Rounding of the clock."""
_UNSAMPLED_REST_S = 1.0
"""The end of a rest, which is left for devices to be armed in, so that it does not become longer."""
_LONGEST_REST_S = 300.0
"""A longer rest is sampled in several acquisitions."""
_MAX_START_ERROR_MM = 0.05
"""How far from a run's start the stage may come to rest: more than the velocity loop's hold error of 0.02 mm."""


def run_acquisition(order: int, run: PlannedRun, dwell_s: float) -> Acquisition:
    """Return the acquisition of a run with a contact `dwell_s` old at its first sample."""
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


def run_header(
    run: PlannedRun,
    acquisition: Acquisition,
    record: SessionRecord,
    backend: Backend,
    settings_toml: str,
    facts: Mapping[str, Attribute],
) -> RunHeader:
    """Return the header of a run about to be made.

    Parameters
    ----------
    settings_toml
        The session's record as text, the same for all its runs.
    facts
        Further attributes of `/entry/run`.
    """
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
        **({"role": SENTINEL_ROLE} if run.sentinel else {}),
        **backend.description(),
        **facts,
    }
    return RunHeader(
        run_id=acquisition.run_id,
        start_time=backend.clock.now(),
        order=acquisition.order,
        backend=backend.name,
        kind=run.protocol.kind,
        sample_rate_hz=backend.sampler.sample_rate_hz,
        channels=backend.sampler.channels,
        entry=_without_empty(entry),
        protocol={key: value for key, value in run.protocol.attributes().items() if key != "kind"},
        capsule=_without_empty(run.capsule.model_dump(mode="json", exclude_none=True)),
        specimen={
            **_without_empty(run.specimen.model_dump(mode="json", exclude_none=True)),
            # A simulated specimen has no such facts; of a real one they exist, and nobody said them.
            **(dict.fromkeys(run.specimen.not_stated, UNSTATED) if backend.needs_hands else {}),
            "fixture": acquisition.fixture.value,
        },
        settings_toml=f"# run {run.index} of this session, order {acquisition.order}\n{settings_toml}",
    )


def _without_empty(attributes: Mapping[str, Attribute]) -> dict[str, Attribute]:
    return {key: value for key, value in attributes.items() if value != ""}


@dataclass(frozen=True, slots=True)
class SessionResult:
    """How a session ended: `complete` when every pending run was made or skipped."""

    status: RunStatus
    reason: str
    runs: tuple[RunResult, ...]

    def require(self) -> None:
        """Raise the error, with its exit code, of a session that ended early."""
        if self.status is not RunStatus.COMPLETE:
            raise early_end_error(self.status, f"the session ended early: {self.reason}.")


@dataclass(frozen=True, slots=True)
class CampaignProgress:
    """Runs that earlier sessions of the same campaign made."""

    done: frozenset[int] = frozenset()
    """Runs of the plan."""
    first_order: int = 0
    """Order of the plan's first run: earlier runs are of the plans that it is appended to."""
    next_order: int = 0
    sentinels: tuple[SteadyForce, ...] = ()
    """Steady forces of its sentinels, in order."""
    undecided: bool = False
    """Whether nothing was made after the plan's last sentinel."""


def unmeasured(run: Run) -> SteadyForce:
    """Measure nothing."""
    return SteadyForce(run.info.header.order, None, reason="nothing measures it here")


class Session:
    """Makes the pending runs of a programme; `run` belongs to one thread, `abort` to any.

    Parameters
    ----------
    pause
        Set by anybody to have the session wait for a person before its next run; cleared then.
    steady_force
        Measures a sentinel.
    stops
        The stops that end a motion when the program fails or its link; where that is late, the way to a run's start is
        slow.
    """

    def __init__(
        self,
        backend: Backend,
        programme: Programme,
        record: SessionRecord,
        store: Store,
        operator: Operator,
        observer: SessionObserver,
        progress: CampaignProgress = CampaignProgress(),
        *,
        real_time: bool = False,
        pause: Signal | None = None,
        steady_force: Callable[[Run], SteadyForce] = unmeasured,
        stops: Stops | None = None,
    ) -> None:
        self._backend, self._programme, self._record = backend, programme, record
        self._settings_toml = to_toml(record)
        self._store, self._operator, self._observer = store, operator, observer
        self._real_time = real_time
        self._pause = pause or Signal()
        self._done, self._order = progress.done, progress.next_order
        self._guard = Guard(record.rig.guard, 1e-3 * record.rig.encoder.resolution_um)
        self.engine = Engine(backend, record.rig, self._guard)
        self._results: list[RunResult] = []
        self._contact_since_s = 0.0
        self._inserted_at: datetime | None = None
        self._steady_force, self._stops = steady_force, stops
        self._sentinels, self._undecided = list(progress.sentinels), progress.undecided
        self._specimen_facts: Mapping[str, Attribute] = {}
        """What the last sentinel says about the specimen, for the files of the runs after it."""
        self._mounting = ""
        """Capsule and fixture of the run before; empty at the start, when nobody has said what is mounted."""

    def abort(self, reason: str) -> None:
        """Request an end, from any thread or signal handler."""
        self.engine.abort(reason)

    def run(self) -> SessionResult:
        """Make every pending run, or as many as possible.

        Raises `DragrigError` when a record cannot be opened or finished; the stage is stopped and disabled first.
        """
        self._observer.begins(self._programme, self._programme.pending(self._done), real_time=self._real_time)
        status, reason = RunStatus.COMPLETE, ""
        try:
            reset_guard(self._backend, self._guard, self._operator)
            self.engine.require_not_aborted()
            enable_and_home(self._backend, self._operator)
            self._contact_since_s = self._backend.clock.monotonic()
            self._make_all()
        except TrippedError as error:
            status, reason = RunStatus.TRIPPED, reason_of(error)
        except AbortedError as error:
            status, reason = RunStatus.ABORTED, self.engine.abort_reason or reason_of(error)
        except DeviceError as error:
            # An abort interrupts a device, homing above all, which then reports a failure.
            status = RunStatus.ABORTED if self.engine.cancelled.is_set() else RunStatus.FAILED
            reason = self.engine.abort_reason or reason_of(error)
        finally:
            failures = [*park(self._backend, reason), attempt(self._store.settle)]
        reason = "; ".join(part for part in (reason, *failures) if part)
        if status is RunStatus.COMPLETE and any(failures):
            status = RunStatus.FAILED
        return SessionResult(status, reason, tuple(self._results))

    def _make_all(self) -> None:
        runs, place = self._programme.runs, 0
        if self._undecided and self._sentinels:
            earlier = [run for run in runs if run.sentinel and run.index in self._done]
            self._follow_sentinel(earlier[-1], self._drift_of(self._sentinels[-1]))
        while place < len(runs):
            self.engine.require_not_aborted()
            run = runs[place]
            if not self._is_due(run):
                place += 1
                continue
            match self._pause_before(run) or self._prepare(run):
                case Answer.DONE:
                    self._make(run)
                    place += 1
                    sentinel = runs[run.follows] if run.follows >= 0 else run
                    if sentinel.sentinel and not (place < len(runs) and runs[place].follows == sentinel.index):
                        self._follow_sentinel(sentinel, self._compare_last_run(sentinel))
                case Answer.REDO:
                    place = self._discard_last_run()
                case Answer.SKIP:
                    later = range(place + 1, len(runs))
                    place = next((index for index in later if runs[index].prompt), len(runs))
                case Answer.ABORT:
                    raise AbortedError("ended at a prompt.")

    def _follow_sentinel(self, sentinel: PlannedRun, drift: Drift) -> None:
        """Go on after a sentinel; where it drifted beyond its bound, as a person decides."""
        decision = ""
        while drift.needs_decision and not decision:
            text = f"{drift}. Done goes on with the plan, measure makes the sentinel once more, abort ends the session"
            who = "decided by the operator" if self._operator.attended else "nobody was asked (--yes)"
            answer = self._operator.ask(Prompt(text, can_measure=True, hands=False))
            decision = {Answer.DONE: "go on", Answer.MEASURE: "measured once more"}.get(answer, "ended the session")
            decision = f"{decision}, {who}"
            self._store.write_note(drift.measured.order, f"{drift}; {decision}")
            self.engine.require_not_aborted()
            if answer is Answer.MEASURE:
                self._make_sentinel_again(sentinel)
                drift, decision = self._compare_last_run(sentinel), ""
            elif answer is not Answer.DONE:
                raise AbortedError("ended after a sentinel.")
        self._specimen_facts = drift.attributes(decision)

    def _compare_last_run(self, sentinel: PlannedRun) -> Drift:
        order = next(result.order for result in reversed(self._results) if result.run.index == sentinel.index)
        drift = self._drift_of(self._steady_force(self._store.read(order)))
        self._sentinels.append(drift.measured)
        self._observer.sentinel_compared(drift)
        return drift

    def _drift_of(self, measured: SteadyForce) -> Drift:
        settings = self._programme.plan.sentinel or SentinelSettings()
        earlier = (force for force in self._sentinels if force.order < measured.order and force.value_mN is not None)
        return Drift(measured, next(earlier, None), settings.bounds)

    def _make_sentinel_again(self, sentinel: PlannedRun) -> None:
        again = replace(sentinel, prompt="", by_hand=False)
        if self._prepare(again) is Answer.ABORT:
            raise AbortedError("ended at a prompt.")
        for run in (again, *(run for run in self._programme.runs if run.follows == sentinel.index)):
            self._make(run)

    def _pause_before(self, run: PlannedRun) -> Answer | None:
        """Wait for a person where a pause was asked for, but not between a run and its return stroke.

        Returns the answer that is to be followed in place of making the run; None to go on.
        """
        if not self._pause.is_set() or run.follows >= 0:
            return None
        self._pause.clear()
        if run.prompt:
            # Its own prompt waits.
            return None
        can_redo = any(result.run.follows < 0 for result in self._results)
        prompt = Prompt(f"Paused. Next is {run.summary}", run, can_redo, hands=False)
        answer = self._operator.ask(prompt)
        self.engine.require_not_aborted()
        return answer if answer is not Answer.DONE else None

    def _is_due(self, run: PlannedRun) -> bool:
        """Whether a run is to be made: a return stroke right after its run, or where only that is done."""
        if run.follows >= 0 and self._results and self._results[-1].run.index == run.follows:
            return True
        return run.index not in self._done and (run.follows < 0 or run.follows in self._done)

    def _discard_last_run(self) -> int:
        last = next(result for result in reversed(self._results) if result.run.follows < 0)
        for result in self._results:
            if last.run.index in (result.run.index, result.run.follows) and result.order >= last.order:
                self._store.mark_bad(result.order, "repeated at the operator's request")
                self._sentinels = [force for force in self._sentinels if force.order != result.order]
        return last.run.index

    def _prepare(self, run: PlannedRun) -> Answer:
        # A return stroke begins where its run ended, unless an earlier session made that.
        follows_at_once = run.follows >= 0 and run.follows not in self._done
        if not (follows_at_once or run.by_hand):
            # The next prompt may ask to put the capsule into the gut, so the stage moves before.
            in_gut = bool(self._results) and self._results[-1].run.contact is not Contact.NONE
            if in_gut and abs(self._travel_to(run)) > START_TOLERANCE_MM:
                self._inserted_at = None
                self._confirm(f"Take the capsule out of the gut: the stage moves to {run.start_mm:g} mm", run)
            self._go_to(run)
        if text := self._prompt_text(run):
            can_redo = any(result.run.follows < 0 for result in self._results)
            prompt = Prompt(text, run, can_redo, can_skip=True, hands=self._backend.needs_hands)
            answer = self._operator.ask(prompt)
            self.engine.require_not_aborted()
            if answer is not Answer.DONE:
                return answer
            self._note_contact(run)
        self._mounting = run.mounting
        return Answer.DONE

    def _prompt_text(self, run: PlannedRun) -> str:
        if run.prompt or run.mounting == self._mounting:
            return run.prompt
        # A session that resumes in the middle of a step needs what that step's prompt prepares.
        earlier = [planned.prompt for planned in self._programme.runs[: run.index] if planned.step == run.step]
        asked = next((prompt for prompt in reversed(earlier) if prompt), "")
        is_known = bool(self._mounting) or self._backend.needs_hands
        return asked or (f"Mount {run.mounting}" if is_known else "")

    def _confirm(self, text: str, run: PlannedRun) -> None:
        confirm(self._operator, Prompt(text, run, hands=self._backend.needs_hands))
        self.engine.require_not_aborted()

    def _note_contact(self, run: PlannedRun) -> None:
        clock = self._backend.clock
        self._contact_since_s = clock.monotonic()
        self._inserted_at = None if run.contact is Contact.NONE else clock.now()

    def _travel_to(self, run: PlannedRun) -> float:
        return run.start_mm - self._backend.stage.state().position_mm

    def _make(self, run: PlannedRun) -> None:
        tare_mN = self._tare(run)
        self._go_to(run)
        clock = self._backend.clock
        self._rest_before(run)
        acquisition = run_acquisition(self._order, run, clock.monotonic() - self._contact_since_s)
        facts: dict[str, Attribute] = dict(self._specimen_facts)
        if tare_mN is not None:
            facts["tare_mN"] = tare_mN
        if self._inserted_at is not None:
            facts["inserted_at"] = self._inserted_at.isoformat()
        header = run_header(run, acquisition, self._record, self._backend, self._settings_toml, facts)
        self._observer.run_begins(run, self._order)
        sink = self._store.open(header, run.profile.samples(header.sample_rate_hz))
        outcome = self.engine.acquire(acquisition, sink, self._observer.reads, tare_mN or 0.0)
        # The contact ages from the last standstill on, so the hold counts.
        self._contact_since_s = clock.monotonic() - (run.profile.duration_s - run.profile.motion_ends_s)
        self._results.append(RunResult(run, self._order, outcome, outcome.path))
        self._order += 1
        self._observer.run_ends(run, outcome)
        require_complete(outcome)

    def _rest_before(self, run: PlannedRun) -> None:
        """Let the contact rest; where time is real, sampled and guarded as a run is, for a person to see it relax."""
        clock, announced = self._backend.clock, False
        while (left_s := run.wait_s - (clock.monotonic() - self._contact_since_s)) > _SHORTEST_REST_S:
            sampled_s = min(left_s - _UNSAMPLED_REST_S, _LONGEST_REST_S) if self._real_time else 0.0
            if sampled_s > 0 or not announced:
                self._observer.waits(run, left_s)
                announced = True
            if sampled_s > 0:
                rest = MotionProfile.from_pieces([stationary_piece(sampled_s, Phase.REST)])
                self._acquire_unrecorded("rest", replace(run, profile=rest), self._observer)
            else:
                clock.sleep(left_s, self.engine.cancelled)
            self.engine.require_not_aborted()

    def _tare(self, run: PlannedRun) -> float | None:
        if not run.tare_s:
            return None
        self._confirm("Hold the capsule clear of the gut: the force sensor is tared", run)
        rest = MotionProfile.from_pieces([stationary_piece(run.tare_s, Phase.REST)])
        mean_mN = self._acquire_unrecorded("tare", _clear_of_gut(run, rest)).mean_force_mN
        if not isfinite(mean_mN):
            raise DeviceError(f"a tare of {run.tare_s:g} s is too short for a sample.")
        self._confirm("Put the capsule into the gut again", run)
        self._note_contact(run)
        return mean_mN

    def _go_to(self, run: PlannedRun) -> None:
        travel_mm = self._travel_to(run)
        if abs(travel_mm) <= START_TOLERANCE_MM:
            return
        limits = self._backend.stage.limits
        if self._stops is not None:
            room_mm = limits.highest_mm - run.start_mm if travel_mm > 0 else run.start_mm - limits.lowest_mm
            slow_mm_s = self._stops.approach_speed_mm_s(room_mm)
            limits = replace(limits, speed_mm_s=min(limits.speed_mm_s, slow_mm_s))
        self._acquire_unrecorded("positioning", _clear_of_gut(run, positioning_profile(travel_mm, limits)))
        await_standstill(self._backend)
        if not abs(off_mm := self._travel_to(run)) <= _MAX_START_ERROR_MM:
            raise DeviceError(
                f"the stage stands at {run.start_mm - off_mm:.3f} mm, not at the start of {run.start_mm:g} mm: it "
                "was held up, or its drive and encoder disagree; home it and look whether it moves freely."
            )
        self._contact_since_s = self._backend.clock.monotonic()

    def _acquire_unrecorded(
        self, kind: str, run: PlannedRun, observer: SessionObserver | None = None
    ) -> AcquisitionOutcome:
        """Make an acquisition beside a run."""
        dwell_s = self._backend.clock.monotonic() - self._contact_since_s
        outcome = self.engine.acquire(
            replace(run_acquisition(self._order, run, dwell_s), kind=kind, recorded=False),
            view=observer.reads if observer else None,
        )
        require_complete(outcome)
        require_agreement(outcome)
        return outcome


def _clear_of_gut(run: PlannedRun, profile: MotionProfile) -> PlannedRun:
    return replace(run, profile=profile, contact=Contact.NONE, fixture=Fixture.NONE)
