"""One acquisition under way: the path of a block through guard, record, checks and viewer."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event as Signal

import numpy as np

from dragrig.config.errors import DeviceError, DragrigError, RecordingError, StaleDataError, plain
from dragrig.config.rig import RigSettings
from dragrig.rig.backend import Backend
from dragrig.rig.checks import CheckReport, RunChecks
from dragrig.rig.devices import Acquisition, Block, Contact
from dragrig.rig.guard import Guard
from dragrig.rig.profile import Phase
from dragrig.rig.reading import CommandTape, Look, Reading
from dragrig.rig.runfile.model import Event, Status
from dragrig.rig.store import Sink
from dragrig.rig.trips import Cause, Trip

_REST = int(Phase.REST)
_SETTLE_S = 1.0
"""How long a stage that stands after a stop is still recorded at most."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How an acquisition ended. `mean_force_mN` is over all samples, before any tare."""

    status: Status
    reason: str
    samples: int
    checks: CheckReport
    mean_force_mN: float
    path: Path | None = None


class Acquiring:
    """One acquisition under way; owned by the engine's thread."""

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
        self._tape = CommandTape(acquisition.profile, self._rate_hz, tare_mN)
        self._checks = RunChecks(
            self._rate_hz,
            self._sampler.force_range_mN,
            rig.force_sensor.accuracy_mN,
            sticking=acquisition.contact is Contact.STICKING,
        )
        self._expected = acquisition.profile.samples(self._rate_hz)
        self._began_s = self._clock.monotonic()
        self._settle_until_s = 0.0
        self._samples = 0
        self._end_index = 0
        self._force_sum = 0.0
        self._phase = -1
        self._uncertainty_s: float | None = None
        self._ended = False
        self._status = Status.COMPLETE
        self._reason = ""

    @property
    def ended(self) -> bool:
        """Whether it was ended before the profile was over."""
        return self._ended

    def start(self, cancel: Signal) -> bool:
        """Arm the sampler, start the stage, take the first sample; return False when `cancel` is set before.

        A stop that comes after the arming drops the motion; one before it is forgotten, but has set `cancel`.
        """
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
                self._ended_unasked()
            return None
        reading = self._tape.join(block)
        look = Look.at(block, reading.command)
        if fault := self._fault() or self._unpermitted(block.fault):
            trip = self._guard.latch(fault)
        else:
            trip = self._guard.inspect(block, reading.command, look, self._rate_hz)
        # The stage brakes from the end of this block, so the command has to as well.
        self._end_index = block.end_index
        self.trip(trip)
        self._take(block, reading, look)
        if reading.phase[-1] != _REST:
            self._tell_uncertainty()
        return None if self._ended else reading

    def trip(self, trip: Trip | None) -> None:
        """Stop because of the guard; None, from a guard that was latched already, changes nothing."""
        if trip is None:
            return
        if trip.cause is Cause.CARD_FAULT:
            # Whoever meets it first, the lines or the samples, it is told as the one failure that it is.
            self.end(Status.FAILED, trip.message)
        else:
            self.end(Status.TRIPPED, f"{trip.cause}: {trip.message}")

    def fail(self, error: DragrigError) -> None:
        """Stop because of an error; one that only follows from the watchdog's stop is told after it."""
        fault = self._fault()
        if fault is not None and fault.cause is Cause.WATCHDOG:
            self.trip(self._guard.latch(Trip(fault.cause, f"{fault.message}; {plain(error)}")))
        elif isinstance(error, StaleDataError):
            self.trip(self._guard.latch(Trip(Cause.STALE_DATA, plain(error))))
        else:
            self.end(Status.FAILED, plain(error))

    def end(self, status: Status, reason: str, stopped_at_s: float | None = None) -> None:
        """Stop the stage at once; what the first call says stands.

        Parameters
        ----------
        status
            `Status.COMPLETE` when what was sought is reached, so that the rest is not wanted.
        stopped_at_s
            Reading of the clock when the stage was told to stop already; now unless given.
        """
        now_s = self._clock.monotonic() if stopped_at_s is None else stopped_at_s
        if refusal := attempt(self._stage.stop):
            reason = "; and ".join(part for part in (reason, f"the stage did not take the stop ({refusal})") if part)
            status = Status.FAILED if status is Status.COMPLETE else status
        if not self._ended:
            self._ended, self._status, self._reason = True, status, reason
            braking_from = max(self._end_index / self._rate_hz, now_s - self._began_s)
            stopped = self._acquisition.profile.stopped(braking_from, self._stop_accel, _SETTLE_S)
            self._settle_until_s = stopped.duration_s
            self._tape.replace(stopped)
            with suppress(RecordingError):
                self._note("trip" if status is Status.TRIPPED else "stop", reason or "reached", braking_from)

    def settle(self) -> None:
        """Keep what is sampled until the stage stands still."""
        go_on = Signal()
        # The reason of the end is known; a device that fails again adds nothing to it.
        with suppress(Exception):
            while self._end_index < self._settle_until_s * self._rate_hz:
                block = self._sampler.read(go_on)
                if block is None:
                    return
                reading = self._tape.join(block)
                with suppress(RecordingError):
                    self._take(block, reading, Look.at(block, reading.command))

    def finish(self) -> Outcome:
        """Stop sampling, close the record, and say how it ended; each step is made whatever becomes of the others."""
        failures = [text for step in (self._stage.stop, self._sampler.stop) if (text := attempt(step))]
        if failures and self._status is Status.COMPLETE:
            self._status = Status.FAILED
        report = self._checks.report()
        paths: list[Path] = []
        if (sink := self._sink) is not None:
            failures.append(attempt(self._tell_uncertainty))
            now, reason = self._clock.now(), self._all_reasons(failures)
            failures.append(attempt(lambda: self._note("end", self._reason or "complete")))
            failures.append(attempt(lambda: paths.append(sink.close(self._status, reason, now, report.values))))
        if any(failures) and self._status is Status.COMPLETE:
            self._status = Status.FAILED
        mean = self._force_sum / self._samples if self._samples else float("nan")
        return Outcome(self._status, self._all_reasons(failures), self._samples, report, mean, *paths)

    def _all_reasons(self, failures: list[str]) -> str:
        return "; ".join(part for part in (self._reason, *failures) if part)

    def _ended_unasked(self) -> None:
        if fault := self._fault():
            self.trip(self._guard.latch(fault))
        else:
            self.end(Status.FAILED, f"sampling ended after {self._end_index} of {self._expected} samples")

    def _fault(self) -> Trip | None:
        try:
            return self._unpermitted(self._stage.fault)
        except DeviceError as error:
            return Trip(Cause.DRIVE_FAULT, plain(error))

    def _unpermitted(self, fault: Trip | None) -> Trip | None:
        return None if fault is None or self._guard.permits(fault) else fault

    def _tell_uncertainty(self) -> None:
        uncertainty_s = self._stage.start_uncertainty_s
        if self._sink is not None and uncertainty_s != self._uncertainty_s:
            self._uncertainty_s = uncertainty_s
            self._sink.annotate({"command_t0_uncertainty_s": uncertainty_s})

    def _take(self, block: Block, reading: Reading, look: Look) -> None:
        raw = block.channels["force"]
        self._checks.add(reading, look, raw, commanded=not self._ended)
        self._samples += block.samples
        self._end_index = block.end_index
        self._force_sum += float(np.add.reduce(raw, dtype=np.float64))
        self._mark_phases(reading)
        if self._view is not None:
            self._show(reading)
        if self._sink is not None:
            self._sink.offer(reading.first_index, reading.arrays())

    def _show(self, reading: Reading) -> None:
        try:
            if self._view is not None:
                self._view(reading)
        except Exception as error:  # noqa: BLE001  # whoever looks must not get in the way of the run
            self._view = None
            self._note("view", f"nobody watches any more: {error}")

    def _mark_phases(self, reading: Reading) -> None:
        phase = reading.phase
        if phase[0] == self._phase and phase[-1] == self._phase:
            return
        changes = np.flatnonzero(np.diff(phase, prepend=np.uint8(255) if self._phase < 0 else np.uint8(self._phase)))
        for place in changes:
            self._note("phase", Phase(int(phase[place])).name.lower(), float(reading.time[place]))
        self._phase = int(phase[-1])

    def _note(self, kind: str, message: str, time_s: float | None = None) -> None:
        if self._sink is not None:
            self._sink.event(Event(self._end_index / self._rate_hz if time_s is None else time_s, kind, message))


def attempt(step: Callable[[], object]) -> str:
    """Make a step of a clean-up; return what went wrong, whatever kind of error a driver raises, empty if nothing."""
    try:
        step()
    except DragrigError as error:
        return plain(error)
    except Exception as error:  # noqa: BLE001  # the steps after this one have to be made
        return f"{type(error).__name__}: {error}"
    return ""
