"""A session: the runs of a programme one after the other, with prompts, tares, waits and ways back between them."""

from dataclasses import dataclass
from datetime import datetime
from math import isfinite

from dragrig.config.errors import AbortedError, DeviceError, TrippedError, plain
from dragrig.config.loading import to_toml
from dragrig.rig.acquiring import attempt
from dragrig.rig.acquisitions import recorded, unrecorded
from dragrig.rig.backend import Backend
from dragrig.rig.devices import Contact
from dragrig.rig.endings import early_end, require_complete
from dragrig.rig.engine import Engine
from dragrig.rig.guard import Guard
from dragrig.rig.header import header_of
from dragrig.rig.people import Answer, Operator, Prompt, RunResult, Watcher
from dragrig.rig.profile import MotionProfile, Phase, still
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.readiness import IN_PLACE_MM, await_standstill, make_ready, park, positioning, reset
from dragrig.rig.record import SessionRecord
from dragrig.rig.runfile.model import Attribute, Status
from dragrig.rig.store import Store


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
        raise early_end(self.status, f"the session ended early: {self.reason}.")


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
        status, reason = Status.COMPLETE, ""
        try:
            self._prepare()
            self._make_all()
        except TrippedError as error:
            status, reason = Status.TRIPPED, plain(error)
        except AbortedError as error:
            status, reason = Status.ABORTED, self.engine.abort_reason or plain(error)
        except DeviceError as error:
            # What a stop from elsewhere interrupted, homing above all, tells of it as a failure.
            status = Status.ABORTED if self.engine.cancelled.is_set() else Status.FAILED
            reason = self.engine.abort_reason or plain(error)
        finally:
            failures = [*park(self._backend, reason), attempt(self._store.settle)]
        reason = "; ".join(part for part in (reason, *failures) if part)
        if status is Status.COMPLETE and any(failures):
            status = Status.FAILED
        return SessionResult(status, reason, tuple(self._results))

    def _prepare(self) -> None:
        reset(self._backend, self._guard, self._operator)
        self._stop_if_cancelled()
        make_ready(self._backend, self._operator)
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
        if not in_gut or abs(self._way_to(run)) <= IN_PLACE_MM:
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
        acquisition = recorded(self._order, run, clock.monotonic() - self._contact_since)
        facts: dict[str, Attribute] = {} if tare is None else {"tare_mN": tare}
        if self._inserted_at is not None:
            facts["inserted_at"] = self._inserted_at.isoformat()
        header = header_of(run, acquisition, self._record, self._backend, self._settings, facts)
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
        rest = MotionProfile.from_pieces([still(run.tare_s, Phase.REST)])
        outcome = self.engine.acquire(unrecorded(self._order, "tare", run, rest))
        require_complete(outcome)
        if not isfinite(outcome.mean_force_mN):
            raise DeviceError(f"a tare of {run.tare_s:g} s is too short for a sample.")
        self._must(self._ask_plainly("Bring the capsule into the gut again", run))
        self._note_contact(run)
        return outcome.mean_force_mN

    def _go_to(self, run: PlannedRun) -> None:
        way = self._way_to(run)
        if abs(way) <= IN_PLACE_MM:
            return
        profile = positioning(way, self._backend.stage.limits)
        require_complete(self.engine.acquire(unrecorded(self._order, "positioning", run, profile)))
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
