"""The engine: one acquisition at a time, from armed devices to a finished record.

::

    IDLE ──acquire──▶ ARMED ──start──▶ RUNNING ──profile over──────────────────▶ FINISHING ──▶ IDLE
                        │                 │ abort, trip, fault, full disk           ▲
                        └─────────────────┴──▶ STOPPING ──stage stands, or 1 s──────┘

Whatever happens, the stage is stopped first; every step of the clean-up stands on its own, so that one that
fails keeps no other from being made; and the reason is written.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from threading import Event as Signal
from threading import Lock

from dragrig.config.errors import DeviceError, RecordingError, TrippedError
from dragrig.config.rig import RigSettings
from dragrig.rig.acquiring import Acquiring, Outcome, attempt
from dragrig.rig.backend import Backend
from dragrig.rig.devices import Acquisition
from dragrig.rig.guard import Guard
from dragrig.rig.profile import Phase
from dragrig.rig.reading import Reading
from dragrig.rig.runfile.model import Status
from dragrig.rig.store import Sink


class State(StrEnum):
    """What the engine is doing."""

    IDLE = "idle"
    ARMED = "armed"
    RUNNING = "running"
    STOPPING = "stopping"
    FINISHING = "finishing"


@dataclass(frozen=True, slots=True)
class EngineStatus:
    """A snapshot that any thread may take."""

    state: State = State.IDLE
    run_id: str = ""
    samples: int = 0
    expected_samples: int = 0
    phase: Phase = Phase.REST
    position_mm: float = 0.0
    force_mN: float = 0.0


class Engine:
    """Runs acquisitions on a backend; `acquire` belongs to one thread, `abort` and `status` to any."""

    def __init__(self, backend: Backend, rig: RigSettings, guard: Guard) -> None:
        self._backend = backend
        self._rig = rig
        self._guard = guard
        self._lock = Lock()
        self._status = EngineStatus()
        self._latest: Reading | None = None
        self._cancel = Signal()
        self._aborting = False
        self._abort_reason = ""
        self._aborted_at_s = 0.0

    @property
    def status(self) -> EngineStatus:
        """What the engine is doing right now."""
        with self._lock:
            status, reading = self._status, self._latest
        if reading is None:
            return status
        return replace(
            status,
            samples=reading.end_index,
            phase=Phase(int(reading.phase[-1])),
            position_mm=float(reading.channels["position"][-1]),
            force_mN=float(reading.channels["force"][-1]),
        )

    @property
    def cancelled(self) -> Signal:
        """Set once somebody asked for an end; waits between runs listen to it too."""
        return self._cancel

    @property
    def abort_reason(self) -> str:
        """Why somebody asked for an end; empty when nobody did."""
        return self._abort_reason

    def abort(self, reason: str) -> None:
        """Ask for an end from any thread or signal handler; the first reason stands."""
        # No lock of ours: a signal handler may interrupt the very thread that holds it, and an Event has one inside, so
        # that a second signal must not set what the first one is setting. The stage is stopped from here, because the
        # thread that acquires may be waiting for a disk or a terminal.
        if not self._aborting:
            self._aborting = True
            self._abort_reason, self._aborted_at_s = reason, self._backend.clock.monotonic()
            self._cancel.set()
        attempt(self._backend.stage.stop)

    def acquire(
        self,
        acquisition: Acquisition,
        sink: Sink | None = None,
        view: Callable[[Reading], None] | None = None,
        tare_mN: float = 0.0,
        until: Callable[[Reading], bool] | None = None,
    ) -> Outcome:
        """Make one acquisition, guarded, recorded in `sink` and shown to `view`.

        Parameters
        ----------
        until
            Asked at every reading that the guard passed; once it says yes, the stage is stopped and the acquisition
            counts as complete.

        Raises
        ------
        TrippedError
            When the guard is latched: nothing moves then.
        """
        if self._guard.trip is not None:
            raise TrippedError(f"the guard is tripped: {self._guard.trip.message}; clear the cause and reset it.")
        try:
            self._guard.watch(acquisition.profile.extremes())
            run = Acquiring(self._backend, self._rig, self._guard, acquisition, sink, view, tare_mN)
            expected = acquisition.profile.samples(self._backend.sampler.sample_rate_hz)
        except Exception as error:
            if sink is not None:
                sink.close(Status.FAILED, str(error), self._backend.clock.now(), {})
            raise
        status = EngineStatus(State.ARMED, acquisition.run_id, expected_samples=expected)
        self._latest = None
        self._set(status)
        try:
            self._drive(run, status, until)
        finally:
            self._set(replace(status, state=State.FINISHING))
            try:
                outcome = run.finish()
            finally:
                self._set(EngineStatus())
        return outcome

    def _drive(self, run: Acquiring, status: EngineStatus, until: Callable[[Reading], bool] | None) -> None:
        try:
            if run.start(self._cancel):
                self._set(replace(status, state=State.RUNNING))
                while (reading := run.step(self._cancel)) is not None:
                    self._latest = reading
                    if until is not None and until(reading):
                        run.end(Status.COMPLETE, "")
                        return
            if self._cancel.is_set():
                run.end(Status.ABORTED, self.abort_reason or "aborted", self._aborted_at_s)
        except (DeviceError, RecordingError) as error:
            run.fail(error)
        except BaseException as error:
            run.end(Status.FAILED, f"{type(error).__name__}: {error}")
            raise
        finally:
            if run.ended:
                self._set(replace(status, state=State.STOPPING))
                run.settle()

    def _set(self, status: EngineStatus) -> None:
        with self._lock:
            self._status = status
