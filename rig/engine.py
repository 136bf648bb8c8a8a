"""The engine: one acquisition at a time, from armed devices to a finished record.

::

    IDLE ──acquire──▶ ARMED ──start──▶ RUNNING ──profile over──────────────────▶ FINISHING ──▶ IDLE
                        │                 │ abort, trip, fault, full disk           ▲
                        └─────────────────┴──▶ STOPPING ──stage stands, or 1 s──────┘

Each block passes guard, record, checks and viewer. In every case the stage is stopped first; each step of the
clean-up is independent, so that a failing step prevents no other; and the reason is written.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from math import isnan, nan
from pathlib import Path
from threading import Event as Signal
from typing import Protocol

import numpy as np

from dragrig.config import (
    AbortedError,
    DeviceError,
    DragrigError,
    OverrunError,
    RecordingError,
    RigSettings,
    StaleDataError,
    TrippedError,
    reason_of,
)
from dragrig.rig.devices import Acquisition, Backend, Block, CountsLateReplies, Trip, TripCause
from dragrig.rig.guard import Guard
from dragrig.rig.profile import AnyFloatArray, Phase, PhaseArray
from dragrig.rig.reading import BlockExtremes, CheckReport, Reading, RunChecks, SetpointSampler
from dragrig.rig.runfile import Attribute, Run, RunEnding, RunEvent, RunHeader, RunStatus

_REST = int(Phase.REST)
_SETTLING_S = 1.0
"""Longest time that is still recorded after the end of braking."""


class Sink(Protocol):
    """Where readings are recorded."""

    def offer(self, first_index: int, arrays: Mapping[str, AnyFloatArray | PhaseArray]) -> None:
        """Take a reading's arrays; raises `RecordingError` once they cannot be stored."""

    def event(self, event: RunEvent) -> None:
        """Take an event."""

    def annotate(self, entry: Mapping[str, Attribute]) -> None:
        """Take attributes of `/entry/run` that become known during the run."""

    def close(self, ending: RunEnding) -> Path:
        """Finish the record; return its file."""


class Store(Protocol):
    """Opens a record for each run and manages the finished ones."""

    def open(self, header: RunHeader, expected_samples: int) -> Sink:
        """Begin a record; raises `RecordingError` or `OutputError` when it cannot be."""

    def mark_bad(self, order: int, reason: str) -> None:
        """Mark a run of this session as bad."""

    def write_note(self, order: int, text: str) -> None:
        """Write a note on a finished run of this campaign."""

    def read(self, order: int) -> Run:
        """Return a run of this session, once every finished run is in its final place; raises as `settle`."""

    def settle(self) -> None:
        """Wait until every finished run is in its final place; raises `RecordingError` when one cannot be put there."""


@dataclass(frozen=True, slots=True)
class AcquisitionOutcome:
    """How an acquisition ended; `mean_force_mN` is the mean over all samples, before any tare."""

    status: RunStatus
    reason: str
    samples: int
    checks: CheckReport
    mean_force_mN: float
    path: Path | None = None


class RunningAcquisition:
    """One acquisition in progress; owned by the engine's thread."""

    def __init__(
        self,
        backend: Backend,
        rig: RigSettings,
        guard: Guard,
        acquisition: Acquisition,
        sink: Sink | None,
        view: Callable[[Reading], None] | None,
        tare_mN: float,
    ) -> None:
        self._stage, self._sampler, self._clock = backend.stage, backend.sampler, backend.clock
        self._guard, self._acquisition, self._sink, self._view = guard, acquisition, sink, view
        self._rate_hz = self._sampler.sample_rate_hz
        self._stop_accel = rig.stage.stop_accel_mm_s2
        self._setpoints = SetpointSampler(acquisition.profile, self._rate_hz, tare_mN)
        self._checks = RunChecks(
            self._rate_hz,
            self._sampler.force_range_mN,
            rig.force_sensor.accuracy_mN,
            acquisition.contact,
            1e-3 * rig.encoder.resolution_um,
        )
        self._guard_settings = rig.guard
        self._drive_from_mm, self._late_replies_before = nan, 0
        self._expected = acquisition.profile.samples(self._rate_hz)
        self._began_s = self._clock.monotonic()
        self._settle_until_s = self._braking_from_s = 0.0
        self._stopped_at_mm: float | None = None
        self._position_mm = 0.0
        self._samples = 0
        self._end_index = 0
        self._force_sum = 0.0
        self._phase = -1
        self._uncertainty_s: float | None = None
        self.ended = False
        """Whether it was ended before the profile was over."""
        self._status = RunStatus.COMPLETE
        self._reason = ""

    def start(self, cancel: Signal) -> bool:
        """Arm the sampler, start the stage, take the first sample; return False when `cancel` is set before.

        A stop after arming drops the motion; arming forgets one before it, which has set `cancel`.
        """
        self._late_replies_before = self._late_replies()
        self._drive_from_mm = self._stage.state().drive_mm
        self._sampler.arm(self._acquisition)
        if cancel.is_set():
            return False
        self._stage.move(self._acquisition.profile)
        self._sampler.start()
        self._began_s = self._clock.monotonic()
        self._note("start", self._acquisition.kind)
        return True

    def step(self, cancel: Signal) -> Reading | None:
        """Take the next block through guard, record and viewer; None when there is none, or the guard tripped."""
        block = self._sampler.read(cancel)
        if block is None:
            if not cancel.is_set() and self._end_index < self._expected:
                if fault := self._fault():
                    self.trip(self._guard.latch(fault))
                else:
                    reason = f"sampling ended after {self._end_index} of {self._expected} samples"
                    self.end(RunStatus.FAILED, reason)
            return None
        reading = self._setpoints.with_setpoint(block)
        extremes = BlockExtremes.of(block, reading.command)
        if fault := self._fault() or self._without_override(block.fault):
            trip = self._guard.latch(fault)
        else:
            trip = self._guard.inspect(block, reading.command, extremes, self._rate_hz)
        # The stage brakes from the end of this block, so the command has to as well.
        self._end_index = block.end_index
        self.trip(trip)
        self._take(block, reading, extremes)
        if reading.phase[-1] != _REST:
            self._annotate_uncertainty()
        return None if self.ended else reading

    def await_end(self, cancel: Signal) -> None:
        """Wait for a stage that is later than its last sample: a stop now would end its motion short of the end."""
        self._stage.await_end(cancel)
        if fault := self._fault():
            self.trip(self._guard.latch(fault))
        elif not cancel.is_set():
            self._compare_travel()

    def _compare_travel(self) -> None:
        """Compare drive and encoder at the standstill after the motion."""
        settings, travel_mm = self._guard_settings, self._stage.state().drive_mm - self._drive_from_mm
        if isnan(travel_mm):
            return
        bound_mm = settings.encoder_error_mm + settings.encoder_error_per_mm * abs(travel_mm)
        self._checks.compare_travel(travel_mm, bound_mm)

    def trip(self, trip: Trip | None) -> None:
        """Stop because of a trip; None, from a guard that was latched already, changes nothing."""
        if trip is None:
            return
        if trip.cause is TripCause.CARD_FAULT:
            # A failed card shows in its lines or in its samples, whichever is read first: one failure, not a trip.
            self.end(RunStatus.FAILED, trip.message)
        else:
            self.end(RunStatus.TRIPPED, f"{trip.cause}: {trip.message}")

    def fail(self, error: DragrigError) -> None:
        """Stop because of an error; one that follows from the watchdog's stop is reported after it."""
        fault = self._fault()
        if fault is not None and fault.cause is TripCause.WATCHDOG:
            self.trip(self._guard.latch(Trip(fault.cause, f"{fault.message}; {reason_of(error)}")))
        elif isinstance(error, StaleDataError):
            cause = TripCause.OVERRUN if isinstance(error, OverrunError) else TripCause.STALE_DATA
            self.trip(self._guard.latch(Trip(cause, reason_of(error))))
        else:
            self.end(RunStatus.FAILED, reason_of(error))

    def end(self, status: RunStatus, reason: str, stopped_at_s: float | None = None) -> None:
        """Stop the stage at once; status and reason of the first call are final.

        Parameters
        ----------
        status
            `RunStatus.COMPLETE` when the aim is reached and the rest of the profile is not needed.
        stopped_at_s
            Clock time at which the stage was stopped already; None for now.
        """
        now_s = self._clock.monotonic() if stopped_at_s is None else stopped_at_s
        if refusal := attempt(self._stage.stop):
            reason = "; and ".join(part for part in (reason, f"the stage did not take the stop ({refusal})") if part)
            status = RunStatus.FAILED if status is RunStatus.COMPLETE else status
        if not self.ended:
            self.ended, self._status, self._reason = True, status, reason
            braking_from = max(self._end_index / self._rate_hz, now_s - self._began_s)
            stopped = self._acquisition.profile.stopped(braking_from, self._stop_accel, _SETTLING_S)
            self._settle_until_s, self._braking_from_s = stopped.duration_s, braking_from
            self._setpoints.replace(stopped)
            with suppress(RecordingError):
                self._note("trip" if status is RunStatus.TRIPPED else "stop", reason or "aim reached", braking_from)

    def settle(self) -> None:
        """Record the samples until the stage stands still."""
        never, low_mm, high_mm = Signal(), self._position_mm, self._position_mm
        # The reason of the end is known; a device that fails again adds nothing to it.
        with suppress(Exception):
            while self._end_index < self._settle_until_s * self._rate_hz:
                block = self._sampler.read(never)
                if block is None:
                    break
                reading = self._setpoints.with_setpoint(block)
                extremes = BlockExtremes.of(block, reading.command)
                low_mm, high_mm = min(low_mm, extremes.min_position_mm), max(high_mm, extremes.max_position_mm)
                with suppress(RecordingError):
                    self._take(block, reading, extremes)
            self._explain_standing(high_mm - low_mm)

    def _explain_standing(self, counted_mm: float) -> None:
        """Give the reason of a stage that stands although it was to move, which not every thread sees at once."""
        if not self._guard.may_be_stopped:
            # The drive is not asked without need: one that does not answer would keep the run from its end.
            return
        drive_mm = nan
        with suppress(DeviceError):
            drive_mm = self._stage.state().drive_mm
        trip = self._guard.explain_standing(self._fault())
        if trip or (trip := self._guard.explain_silence(counted_mm, abs(drive_mm - self._drive_from_mm))):
            self._reason = f"{trip.cause}: {trip.message}"
            self._note("trip", self._reason, self._braking_from_s)

    def finish(self) -> AcquisitionOutcome:
        """Stop sampling, close the record and return the outcome; every step is made even if others fail."""
        failures = [text for step in (self._stage.stop, self._sampler.stop) if (text := attempt(step))]
        if self._stopped_at_mm is not None:
            travel_mm = abs(self._position_mm - self._stopped_at_mm)
            attempt(lambda: self._note("stopped", f"{travel_mm:.2f} mm after the stop, at {self._position_mm:.2f} mm"))
        if failures and self._status is RunStatus.COMPLETE:
            self._status = RunStatus.FAILED
        report = self._checks.report(self._late_replies() - self._late_replies_before)
        paths: list[Path] = []
        if (sink := self._sink) is not None:
            failures.append(attempt(self._annotate_uncertainty))
            ending = RunEnding(self._status, self._all_reasons(failures), self._clock.now(), report.values)
            failures.append(attempt(lambda: self._note("end", self._reason or "complete")))
            failures.append(attempt(lambda: paths.append(sink.close(ending))))
        if any(failures) and self._status is RunStatus.COMPLETE:
            self._status = RunStatus.FAILED
        mean = self._force_sum / self._samples if self._samples else float("nan")
        return AcquisitionOutcome(self._status, self._all_reasons(failures), self._samples, report, mean, *paths)

    def _all_reasons(self, failures: list[str]) -> str:
        return "; ".join(part for part in (self._reason, *failures) if part)

    def _late_replies(self) -> int:
        return self._stage.late_replies if isinstance(self._stage, CountsLateReplies) else 0

    def _fault(self) -> Trip | None:
        try:
            return self._without_override(self._stage.fault)
        except DeviceError as error:
            return Trip(TripCause.DRIVE_FAULT, reason_of(error))

    def _without_override(self, fault: Trip | None) -> Trip | None:
        return None if fault is None or self._guard.permits(fault) else fault

    def _annotate_uncertainty(self) -> None:
        uncertainty_s = self._stage.start_uncertainty_s
        if uncertainty_s:
            # Not on one clock: a drive that starts late is no lag of the stage.
            uncertainty_s = max(uncertainty_s, self._checks.start_delay_s)
        if self._sink is not None and uncertainty_s != self._uncertainty_s:
            self._uncertainty_s = uncertainty_s
            self._sink.annotate({"command_t0_uncertainty_s": uncertainty_s})

    def _take(self, block: Block, reading: Reading, extremes: BlockExtremes) -> None:
        self._name_overrun(block)
        raw = block.channels["force"]
        self._checks.add(reading, extremes, raw, commanded=not self.ended)
        self._samples += block.samples
        self._end_index = block.end_index
        self._follow_stop(reading)
        self._force_sum += float(np.add.reduce(raw, dtype=np.float64))
        self._mark_phases(reading)
        if self._view is not None:
            try:
                self._view(reading)
            except Exception as error:  # noqa: BLE001  # a failing viewer must not disturb the run
                self._view = None
                self._note("view", f"the viewer failed and gets no more data: {error}")
        if self._sink is not None:
            self._sink.offer(reading.first_index, reading.arrays())

    def _name_overrun(self, block: Block) -> None:
        """Say of a run that ended for another reason that samples are lost, which is known with the first one after."""
        fault = block.fault
        if self.ended and fault is not None and fault.cause is TripCause.OVERRUN and fault.message not in self._reason:
            self._reason = f"{self._reason}; {fault.cause}: {fault.message}" if self._reason else self._reason

    def _follow_stop(self, reading: Reading) -> None:
        """Remember where the stage was when it was stopped, and where it is."""
        position = reading.channels["position"]
        self._position_mm = float(position[-1])
        into = round(self._braking_from_s * self._rate_hz) - reading.first_index
        if self.ended and self._stopped_at_mm is None and into < len(position):
            self._stopped_at_mm = float(position[max(into, 0)])

    def _mark_phases(self, reading: Reading) -> None:
        phase = reading.phase
        if phase[0] == self._phase and phase[-1] == self._phase:
            return
        changes = np.flatnonzero(np.diff(phase, prepend=np.uint8(255) if self._phase < 0 else np.uint8(self._phase)))
        for index in changes:
            self._note("phase", Phase(int(phase[index])).name.lower(), float(reading.time[index]))
        self._phase = int(phase[-1])

    def _note(self, kind: str, message: str, time_s: float | None = None) -> None:
        if self._sink is not None:
            self._sink.event(RunEvent(self._end_index / self._rate_hz if time_s is None else time_s, kind, message))


def attempt(step: Callable[[], object]) -> str:
    """Make one step of a clean-up; return its error, of any class, as text, empty if there is none."""
    try:
        step()
    except DragrigError as error:
        return reason_of(error)
    except Exception as error:  # noqa: BLE001  # the following steps must be made
        return f"{type(error).__name__}: {error}"
    return ""


def early_end_error(status: RunStatus, reason: str) -> DragrigError:
    """Return the error, with its exit code, for the status of an early end."""
    return {RunStatus.ABORTED: AbortedError, RunStatus.TRIPPED: TrippedError}.get(status, DeviceError)(reason)


def require_complete(outcome: AcquisitionOutcome) -> None:
    """Raise the error of an acquisition that ended early."""
    if outcome.status is not RunStatus.COMPLETE:
        raise early_end_error(outcome.status, outcome.reason)


def require_agreement(outcome: AcquisitionOutcome) -> None:
    """Raise `DeviceError` when drive and encoder disagree after a motion that no run file tells of."""
    if outcome.checks.encoder_fault:
        raise DeviceError(f"{outcome.checks.encoder_fault}; home the stage, and look at the encoder.")


class Engine:
    """Runs acquisitions on a backend; `acquire` belongs to one thread, `abort` to any."""

    def __init__(self, backend: Backend, rig: RigSettings, guard: Guard) -> None:
        self._backend = backend
        self._rig = rig
        self._guard = guard
        self.cancelled = Signal()
        """Set once an abort was requested; waits between runs observe it too."""
        self._aborting = False
        self._abort_reason = ""
        self._aborted_at_s = 0.0

    @property
    def abort_reason(self) -> str:
        """Reason of the abort; empty when none was requested."""
        return self._abort_reason

    def require_not_aborted(self) -> None:
        """Raise `AbortedError` once an abort was requested."""
        if self.cancelled.is_set():
            raise AbortedError(self._abort_reason or "aborted")

    def abort(self, reason: str) -> None:
        """Request an abort from any thread or signal handler; the first reason is final."""
        # No lock here: a signal handler may interrupt the very thread that holds it. An Event has a lock inside, so a
        # second signal must not set it while the first one does. The stage is stopped here, because the acquiring
        # thread may be waiting for a disk or a terminal.
        if not self._aborting:
            self._aborting = True
            self._abort_reason, self._aborted_at_s = reason, self._backend.clock.monotonic()
            self.cancelled.set()
        attempt(self._backend.stage.stop)

    def acquire(
        self,
        acquisition: Acquisition,
        sink: Sink | None = None,
        view: Callable[[Reading], None] | None = None,
        tare_mN: float = 0.0,
        stop_when: Callable[[Reading], bool] | None = None,
    ) -> AcquisitionOutcome:
        """Make one acquisition, guarded, recorded in `sink` and passed to `view`.

        Parameters
        ----------
        stop_when
            Called with every reading that the guard passed; once it returns True, the stage is stopped and the
            acquisition counts as complete.

        Raises
        ------
        TrippedError
            When the guard is tripped: nothing moves then.
        """
        self._guard.require_armed()
        try:
            self._guard.watch(acquisition.profile.extremes())
            run = RunningAcquisition(self._backend, self._rig, self._guard, acquisition, sink, view, tare_mN)
        except Exception as error:
            if sink is not None:
                sink.close(RunEnding(RunStatus.FAILED, str(error), self._backend.clock.now()))
            raise
        try:
            self._drive(run, stop_when)
        finally:
            outcome = run.finish()
        return outcome

    def _drive(self, run: RunningAcquisition, stop_when: Callable[[Reading], bool] | None) -> None:
        try:
            if run.start(self.cancelled):
                while (reading := run.step(self.cancelled)) is not None:
                    if stop_when is not None and stop_when(reading):
                        run.end(RunStatus.COMPLETE, "")
                        return
                if not (run.ended or self.cancelled.is_set()):
                    run.await_end(self.cancelled)
            if self.cancelled.is_set():
                run.end(RunStatus.ABORTED, self._abort_reason or "aborted", self._aborted_at_s)
        except (DeviceError, RecordingError) as error:
            run.fail(error)
        except BaseException as error:
            run.end(RunStatus.FAILED, f"{type(error).__name__}: {error}")
            raise
        finally:
            if run.ended:
                run.settle()
