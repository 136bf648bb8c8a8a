"""A session: the runs of a programme one after the other, with prompts, tares, waits and ways back between them."""

from dataclasses import dataclass, replace
from math import isfinite
from threading import Event as Signal
from uuid import uuid4

from dragrig.config.errors import AbortedError, DeviceError, DragrigError, TrippedError, plain
from dragrig.config.loading import to_toml
from dragrig.config.specimen import Fixture
from dragrig.rig.acquiring import Outcome, attempt
from dragrig.rig.backend import Backend
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.engine import Engine
from dragrig.rig.guard import Guard
from dragrig.rig.header import header_of
from dragrig.rig.people import Answer, Operator, Prompt, RunResult, Watcher
from dragrig.rig.profile import MotionProfile, Phase, still, trapezoid
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.record import SessionRecord
from dragrig.rig.runfile.model import Status
from dragrig.rig.store import Store

_IN_PLACE_MM = 0.005
_STANDSTILL_S = 10.0
"""How long the end of a session waits for the stage to stand before it is switched off."""
_POSITIONING_SPEED_MM_S = 20.0
_POSITIONING_ACCEL_MM_S2 = 200.0


@dataclass(frozen=True, slots=True)
class SessionResult:
    """How a session ended: `complete` when every pending run was made or skipped."""

    status: Status
    reason: str
    runs: tuple[RunResult, ...]

    def require(self) -> None:
        """Raise the error, with its exit code, that stands for an early end."""
        if self.status is Status.COMPLETE:
            return
        kind = {Status.ABORTED: AbortedError, Status.TRIPPED: TrippedError}.get(self.status, DeviceError)
        raise kind(f"the session ended early: {self.reason}.")


@dataclass(frozen=True, slots=True)
class Progress:
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
        watcher: Watcher,
        progress: Progress = Progress(),
    ) -> None:
        self._backend, self._programme, self._record = backend, programme, record
        self._settings = to_toml(record)
        self._store, self._operator, self._watcher = store, operator, watcher
        self._done, self._order = progress.done, progress.next_order
        self._guard = Guard(record.rig.guard)
        self.engine = Engine(backend, record.rig, self._guard)
        self._results: list[RunResult] = []
        self._contact_since = 0.0
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
        pending = [run for run in self._programme.runs if run.index not in self._done]
        self._watcher.begins(self._programme, len(pending))
        status, reason = Status.COMPLETE, ""
        try:
            self._prepare()
            self._make_all()
        except _EndedEarlyError as end:
            status, reason = end.status, end.reason
        except DeviceError as error:
            status, reason = Status.FAILED, plain(error)
        finally:
            failures = [*self._park(), attempt(self._store.settle)]
        reason = "; ".join(part for part in (reason, *failures) if part)
        if status is Status.COMPLETE and any(failures):
            status = Status.FAILED
        return SessionResult(status, reason, tuple(self._results))

    def _prepare(self) -> None:
        stage = self._backend.stage
        still_tripped = self._guard.reset(stage.state())
        if still_tripped is not None:
            raise _EndedEarlyError(Status.TRIPPED, still_tripped.message)
        stage.enable()
        if not stage.state().homed:
            stage.home()
        self._contact_since = self._backend.clock.monotonic()

    def _park(self) -> list[str]:
        stage = self._backend.stage
        steps = (stage.stop, self._backend.sampler.stop, self._await_standstill, stage.disable)
        return [text for step in steps if (text := attempt(step))]

    def _await_standstill(self) -> None:
        # Switched off in motion, a stage coasts.
        stage, clock = self._backend.stage, self._backend.clock
        until = clock.monotonic() + _STANDSTILL_S
        while stage.state().moving and clock.monotonic() < until:
            clock.sleep(0.01, Signal())

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
                    raise _EndedEarlyError(Status.ABORTED, "ended at a prompt")

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
            answer = self._operator.ask(Prompt(text, run, can_redo))
            self._stop_if_cancelled()
            if answer is not Answer.DONE:
                return answer
            self._contact_since = self._backend.clock.monotonic()
        self._asked = True
        return Answer.DONE

    def _clear_the_way(self, run: PlannedRun) -> Answer:
        in_gut = bool(self._results) and self._results[-1].run.contact is not Contact.NONE
        if not in_gut or abs(self._way_to(run)) <= _IN_PLACE_MM:
            return Answer.DONE
        text = f"Take the capsule out of the gut: the stage goes to {run.start_mm:g} mm"
        return self._ask_plainly(text, run)

    def _ask_plainly(self, text: str, run: PlannedRun) -> Answer:
        return self._operator.ask(Prompt(text, run, can_redo=False, can_skip=False))

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
        acquisition = self._recorded(run, clock.monotonic() - self._contact_since)
        facts = {"tare_mN": tare} if tare is not None else {}
        header = header_of(run, acquisition, self._record, self._backend, self._settings, facts)
        self._watcher.run_begins(run, self._order)
        sink = self._store.open(header, run.profile.samples(header.sample_rate_hz))
        outcome = self.engine.acquire(acquisition, sink, self._watcher.reads, tare or 0.0)
        # The contact ages from the last standstill on, so the hold counts.
        self._contact_since = clock.monotonic() - (run.profile.duration_s - run.profile.motion_ends_s)
        self._results.append(RunResult(run, self._order, outcome, outcome.path))
        self._order += 1
        self._watcher.run_ends(run, outcome)
        self._require(outcome)

    def _tare(self, run: PlannedRun) -> float | None:
        if not run.tare_s:
            return None
        self._must(self._ask_plainly("Hold the capsule clear of the gut: the sensor's zero is taken", run))
        rest = MotionProfile.from_pieces([still(run.tare_s, Phase.REST)])
        outcome = self.engine.acquire(self._unrecorded("tare", run, rest))
        self._require(outcome)
        if not isfinite(outcome.mean_force_mN):
            raise _EndedEarlyError(Status.FAILED, f"a tare of {run.tare_s:g} s is too short for a sample")
        self._must(self._ask_plainly("Bring the capsule into the gut again", run))
        self._contact_since = self._backend.clock.monotonic()
        return outcome.mean_force_mN

    def _go_to(self, run: PlannedRun) -> None:
        way = self._way_to(run)
        if abs(way) <= _IN_PLACE_MM:
            return
        limits = self._backend.stage.limits
        speed = min(_POSITIONING_SPEED_MM_S, limits.speed_mm_s)
        accel = min(_POSITIONING_ACCEL_MM_S2, limits.acceleration_mm_s2)
        profile = MotionProfile.from_pieces(trapezoid(way, speed, accel))
        self._require(self.engine.acquire(self._unrecorded("positioning", run, profile)))
        self._contact_since = self._backend.clock.monotonic()

    def _wait(self, run: PlannedRun) -> None:
        clock = self._backend.clock
        left = run.wait_s - (clock.monotonic() - self._contact_since)
        if left > 0:
            self._watcher.waits(left, f"rest before {run.protocol.summary()}")
            clock.sleep(left, self.engine.cancelled)
            self._stop_if_cancelled()

    def _recorded(self, run: PlannedRun, dwell_s: float) -> Acquisition:
        return Acquisition(
            run_id=str(uuid4()),
            order=self._order,
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

    def _unrecorded(self, kind: str, run: PlannedRun, profile: MotionProfile) -> Acquisition:
        free = replace(run, profile=profile, contact=Contact.NONE, fixture=Fixture.NONE)
        return replace(self._recorded(free, 0.0), kind=kind)

    def _require(self, outcome: Outcome) -> None:
        if outcome.status is not Status.COMPLETE:
            raise _EndedEarlyError(outcome.status, outcome.reason)

    def _must(self, answer: Answer) -> None:
        self._stop_if_cancelled()
        if answer is not Answer.DONE:
            raise _EndedEarlyError(Status.ABORTED, "ended at a prompt")

    def _stop_if_cancelled(self) -> None:
        if self.engine.cancelled.is_set():
            raise _EndedEarlyError(Status.ABORTED, self.engine.abort_reason or "aborted")


class _EndedEarlyError(DragrigError):
    """Carries the end of a session from where it happened to `Session.run`."""

    def __init__(self, status: Status, reason: str) -> None:
        super().__init__(reason)
        self.status, self.reason = status, reason
