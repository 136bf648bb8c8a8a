"""The velocity loop: a thread that streams speed setpoints as voltages and corrects them by the encoder.

All times are counted in samples of the analog output, as the card counts them, so that neither this computer's clock
nor its scheduling shifts the setpoint. What is written is put out `ahead` updates later at most; a stop takes as long
to begin.
"""

import itertools
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dragrig.config.errors import DeviceError, reason_of
from dragrig.config.hardware import VelocityOutputSettings
from dragrig.config.rig import GuardSettings, RigSettings, StageSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Clock, Trip, TripCause
from dragrig.rig.hardware.card.tasks import AI_START_TRIGGER, AO_RANGE_V, PositionCounter, UnderflowError, VoltageOutput
from dragrig.rig.hardware.drive.stage_base import first_motion_s
from dragrig.rig.hardware.sync import MotionSamplingSync
from dragrig.rig.profile import MotionProfile, Phase, stationary_piece

_ZERO_MOTION = MotionProfile.from_pieces([stationary_piece(1.0, Phase.HOLD)])


@dataclass(frozen=True, slots=True)
class MotionCommand:
    """What the stage is to do.

    Attributes
    ----------
    profile, origin_mm
        The motion and the absolute position that it starts from; beyond its end, to stay there.
    first
        Sample of the output at which the profile is at 0; may have a fraction.
    closed
        Whether the measured position corrects the speed.
    """

    profile: MotionProfile
    origin_mm: float
    first: float
    closed: bool = True

    @property
    def end_mm(self) -> float:
        """The absolute position that it comes to."""
        return self.origin_mm + float(self.profile.position(self.profile.duration_s))

    @classmethod
    def hold(cls, position_mm: float) -> "MotionCommand":
        """Return the command to stay at a position."""
        return cls(_ZERO_MOTION, position_mm, 0.0)

    def beginning(self, first: float) -> "MotionCommand":
        """Return the same command from another sample on."""
        return replace(self, first=first)

    @classmethod
    def rest(cls) -> "MotionCommand":
        """Return the command to have no speed, wherever that is."""
        return cls(_ZERO_MOTION, 0.0, 0.0, closed=False)


class SpeedController:
    """Speeds for a drive, sample after sample. Belongs to one thread at a time.

    Each speed is the profile's, taken `lag_s` early, plus `gain_per_s` times the distance between command and
    position; neither it nor its change exceeds what the stage may do. A stop takes it to 0 at the stop's deceleration.
    """

    def __init__(self, velocity: VelocityOutputSettings, stage: StageSettings) -> None:
        self._velocity = velocity
        self._stage = stage
        self._command = MotionCommand.rest()
        self._braking = False
        self.told = 0
        """Samples for which speeds were given."""
        self._speed_mm_s = 0.0

    @property
    def command(self) -> MotionCommand:
        """What the stage is to do at present."""
        return self._command

    @property
    def braking(self) -> bool:
        """Whether it comes to a standstill, or has, since it was told to."""
        return self._braking

    @property
    def stands(self) -> bool:
        """Whether the latest speed is 0."""
        return self._speed_mm_s == 0.0

    def begin(self) -> None:
        """Count samples from 0 again, at speed 0."""
        self.told, self._speed_mm_s, self._braking = 0, 0.0, False

    def follow(self, command: MotionCommand) -> None:
        """Do something else from the next sample on."""
        self._command, self._braking = command, False

    def brake(self) -> None:
        """Come to a standstill from the next sample on, whatever the position says, and have no speed then."""
        self._command, self._braking = MotionCommand.rest(), True

    def error_mm(self, sample: float, position_mm: float) -> float:
        """Return how far the stage is behind its command while an output's sample is put out."""
        if not self._command.closed:
            return 0.0
        at_s = (sample - self._command.first) / self._velocity.rate_hz
        return float(self._command.origin_mm + self._command.profile.position(at_s) - position_mm)

    def off_command(self, sample: float, position_mm: float, error_mm: float, guard: GuardSettings) -> Trip | None:
        """Return the trip for a stage that is further off its command than the guard allows; None when it is not."""
        at_s = (sample - self._command.first) / self._velocity.rate_hz
        speed_mm_s = abs(float(self._command.profile.velocity(at_s)))
        most_mm = guard.following_error_mm + guard.following_error_per_speed_s * speed_mm_s
        if abs(error_mm) <= most_mm:
            return None
        return Trip(
            TripCause.FOLLOWING_ERROR,
            f"the stage is {abs(error_mm):.2f} mm off its command at {position_mm:.2f} mm, where {most_mm:.2f} mm are "
            "allowed (guard.following_error_mm): something holds it, the encoder does not count, or "
            "hardware.drive.velocity does not fit the drive",
        )

    def is_over(self, sample: float) -> bool:
        """Whether the command's motion has ended at a sample."""
        if self._braking:
            return self.stands
        at_s = (sample - self._command.first) / self._velocity.rate_hz
        return at_s >= self._command.profile.motion_ends_s

    def speeds(self, samples: int, error_mm: float) -> FloatArray:
        """Return the next speeds [mm/s], shape `(samples,)`."""
        if self._braking:
            wanted = np.zeros(samples)
            most = self._stage.stop_accel_mm_s2
        else:
            middles_s = (self.told + np.arange(samples) + 0.5 - self._command.first) / self._velocity.rate_hz
            wanted = self._command.profile.velocity(middles_s + self._velocity.lag_s)
            wanted = wanted + self._velocity.gain_per_s * error_mm
            most = self._stage.max_accel_mm_s2
        self.told += samples
        return self._limited(wanted, most / self._velocity.rate_hz)

    def _limited(self, wanted: FloatArray, step: float) -> FloatArray:
        fastest = self._stage.max_speed_mm_s
        speed, speeds = self._speed_mm_s, np.empty_like(wanted)
        for place, target in enumerate(np.clip(wanted, -fastest, fastest).tolist()):
            speed += min(max(target - speed, -step), step)
            speeds[place] = speed
        self._speed_mm_s = speed
        return speeds


_CHECKS_PER_UPDATE = 4


class AOStreamer:
    """A follower and the output that it speaks through. Belongs to one thread at a time."""

    def __init__(
        self, output: VoltageOutput, follower: SpeedController, velocity: VelocityOutputSettings, clock: Clock
    ) -> None:
        self._output, self._follower, self._clock = output, follower, clock
        self._velocity = velocity
        self._ahead = velocity.ahead * velocity.update_samples
        self.error_mm = 0.0
        """How far the stage is behind its command, as seen last."""

    @property
    def written(self) -> int:
        """Samples of the present waveform that were written."""
        return self._output.written

    @property
    def generated(self) -> int:
        """Samples of the present waveform that were put out; raises what the output does."""
        return self._output.generated

    def begin(self, command: MotionCommand, trigger: str = "") -> None:
        """End the waveform where it is, at 0 V, and begin one that does `command`; see `VoltageOutput.begin`."""
        self._output.end()
        self._follower.begin()
        self._follower.follow(command)
        self.error_mm = 0.0
        self._output.begin(self._volts(self._ahead), trigger)

    def fill(self, generated: int) -> float:
        """Write what is due, and return how long nothing will be.

        Raises
        ------
        UnderflowError
            When it ran dry.
        DeviceError
            When the card refuses.
        """
        update = self._velocity.update_samples
        while self._output.written - generated <= self._ahead - update:
            self._output.write(self._volts(update))
        left = self._output.written - generated - self._ahead + update if generated else 0
        return max(left, update / _CHECKS_PER_UPDATE) / self._velocity.rate_hz

    def drain(self) -> None:
        """Brake, and end the waveform at 0 V."""
        self._follower.brake()
        while not self._follower.stands:
            self._wait(self.fill(self._output.generated))
        zero_from = self._output.written
        try:
            self._output.write(np.zeros(2 * self._ahead))
            while (left := zero_from + 1 - self._output.generated) > 0:
                self._wait(left / self._velocity.rate_hz)
        except UnderflowError:
            # It ran dry at 0 V, where it was to end.
            return
        finally:
            self._output.end()

    def zero(self) -> None:
        """Put out 0 V at once."""
        self._output.zero()

    def _volts(self, samples: int) -> FloatArray:
        speeds = self._follower.speeds(samples, self.error_mm)
        return np.ascontiguousarray(np.clip(speeds / self._velocity.per_V, -AO_RANGE_V, AO_RANGE_V))

    def _wait(self, duration_s: float) -> None:
        self._clock.sleep(duration_s, threading.Event())


STANDSTILL_TIMEOUT_S = 0.5
"""So long a stage may take to stand after its voltage is 0."""
_STILL_COUNTS = 1.5


class StandstillDetector:
    """Two looks, a while apart, that see the same position.

    Parameters
    ----------
    count_mm
        Length of a count.
    apart, longest
        How far two looks are apart, and how long it may take to stand: both in samples of the output.
    """

    def __init__(self, count_mm: float, apart: int, longest: int) -> None:
        self._still_mm = _STILL_COUNTS * count_mm
        self._apart, self._longest = apart, longest
        self._since = self._seen = 0
        self._before_mm: float | None = None

    def forget(self) -> None:
        """Begin anew."""
        self._before_mm = None

    def is_seen(self, generated: int, zero_from: int, position_mm: float) -> bool:
        """Look at the position while `generated` samples were put out; those from `zero_from` on are 0.

        Raises
        ------
        DeviceError
            When it does not stand after all the time that it may take.
        """
        if self._before_mm is None:
            self._since = self._seen = zero_from
            self._before_mm = position_mm
        if generated < self._seen + self._apart:
            return False
        if abs(position_mm - self._before_mm) <= self._still_mm:
            return True
        if generated - self._since > self._longest:
            raise DeviceError("the stage did not stop at 0 V, so that the drive was switched off: look at the drive.")
        self._seen, self._before_mm = generated, position_mm
        return False

    def is_awaited(self, counter: PositionCounter, clock: Clock, apart_s: float) -> bool:
        """Look at a counter until it stands or had all the time for it; raises `DeviceError` when it cannot be read."""
        until_s = clock.monotonic() + STANDSTILL_TIMEOUT_S
        before_mm = counter.read()
        while clock.monotonic() < until_s:
            clock.sleep(apart_s, threading.Event())
            now_mm = counter.read()
            if abs(now_mm - before_mm) <= self._still_mm:
                return True
            before_mm = now_mm
        return False


_OBSERVATION_ATTEMPTS = 3


class VelocityLoop:
    """Output, counter and what they follow. Any thread may call anything; `brake` waits for nobody.

    Parameters
    ----------
    failed
        Called with what ended the loop or forbids motion, from whatever thread found out.
    cut
        Called when the stage cannot be braked by its voltage: takes the drive's power, and must not raise.
    over
        Called whenever a motion has ended.
    """

    def __init__(
        self,
        feeder: AOStreamer,
        follower: SpeedController,
        counter: PositionCounter,
        settings: RigSettings,
        coupling: MotionSamplingSync,
        clock: Clock,
        failed: Callable[[Trip], None],
        cut: Callable[[], None],
        over: Callable[[], None],
    ) -> None:
        self._feeder, self._follower, self._counter = feeder, follower, counter
        self._coupling, self._clock, self._failed, self._cut, self._over = coupling, clock, failed, cut, over
        self._velocity, self._guard = settings.hardware.drive.velocity, settings.guard
        self._standing = StandstillDetector(
            settings.encoder.resolution_um / 1000.0,
            self._velocity.update_samples,
            round(STANDSTILL_TIMEOUT_S * self._velocity.rate_hz),
        )
        # Re-entrant, for whoever begins a motion also looks where it is.
        self._busy = threading.RLock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        # A counter may be used by a signal handler that interrupts its own user; an Event may not.
        self._counting = itertools.count(1)
        self._stops = self._heeded = 0
        self.start_uncertainty_s = 0.0
        """How far time 0 of the last motion may be off the first sample."""

    @property
    def running(self) -> bool:
        """Whether it holds the stage."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def stops(self) -> int:
        """Which stop was asked for last: a mark for `follow`."""
        return self._stops

    def start(self) -> None:
        """Hold the stage where it is; raises `DeviceError` when the card refuses."""
        with self._busy:
            self._ended.clear()
            self._heeded = self._stops
            self._feeder.begin(MotionCommand.hold(self._counter.read()))
        self._thread = threading.Thread(target=self._run, name="velocity loop", daemon=True)
        self._thread.start()

    def follow(self, profile: MotionProfile, origin_mm: float, as_of: int, *, closed: bool = True) -> None:
        """Follow a profile from now on; with an armed sampler return at once, for the card begins it with the sampling.

        Parameters
        ----------
        as_of
            What `stops` was when this was planned: a stop since then ends it at once.
        closed
            Whether the encoder corrects it.

        Raises
        ------
        DeviceError
            When the loop has ended, or the card refuses.
        """
        with self._busy:
            if not self.running:
                raise DeviceError("the velocity loop has ended: switch the drive off and on.")
            self._heeded = as_of
            first = self._begin(MotionCommand(profile, origin_mm, 0.0, closed))
            self._coupling.set_moving(True)
        while not self._coupling.armed and self._coupling.moving and self._feeder.generated <= first:
            self._clock.sleep(1.0 / self._velocity.rate_hz, self._ended)

    def brake(self) -> int:
        """Come to a standstill; begins once what is written is put out. Return the mark that `stops` is now.

        Safe in any thread and in signal handlers.
        """
        self._stops = next(self._counting)
        return self._stops

    def look(self) -> float:
        """Return the position now, and tell the sampler when nothing moves any more; raises `DeviceError`."""
        with self._busy:
            if not self.running:
                return self._counter.read()
            generated, position_mm = self._observe()
            self._settle(generated, position_mm)
            return position_mm

    def held_mm(self) -> float:
        """Return the position that a stage at rest is held at; raises `DeviceError` when that cannot be read."""
        with self._busy:
            command = self._follower.command
            return command.end_mm if self.running and command.closed else self._counter.read()

    def recount(self, at_mm: float, *, index: bool) -> None:
        """Let the counter count on from a position and hold that; `index` lets the index pulse make it 0.

        Raises
        ------
        DeviceError
            When the card refuses.
        """
        with self._busy:
            self._counter.begin(at_mm, index=index)
            self._follower.follow(MotionCommand.rest() if index else MotionCommand.hold(at_mm))

    def end(self) -> None:
        """Brake, bring the voltage to 0, end the thread. Twice is once."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _begin(self, command: MotionCommand) -> float:
        rate_hz, sample = self._velocity.rate_hz, self._coupling.first_sample
        if self._coupling.armed and sample is None:
            self._feeder.drain()
            self._feeder.begin(command, AI_START_TRIGGER)
            self.start_uncertainty_s = 1.0 / rate_hz
            return 0.0
        first, self.start_uncertainty_s = float(self._feeder.written), 0.0
        if sample is not None:
            due = self._feeder.generated - (self._clock.monotonic() - sample.at_s) * rate_hz
            first = max(due, first - first_motion_s(command.profile) * rate_hz)
            self.start_uncertainty_s = sample.uncertainty_s + (first - due + 1.0) / rate_hz
        self._follower.follow(command.beginning(first))
        return first

    def _run(self) -> None:
        try:
            while not self._ended.is_set():
                with self._busy:
                    wait_s = self._turn()
                self._clock.sleep(wait_s, self._ended)
            with self._busy:
                self._feeder.drain()
                self._rest()
        except UnderflowError as error:
            self._give_up(Trip(TripCause.WATCHDOG, reason_of(error)))
        except DeviceError as error:
            self._give_up(Trip(TripCause.DRIVE_FAULT, reason_of(error)))
        except Exception as error:
            self._give_up(Trip(TripCause.WATCHDOG, f"the velocity loop failed ({type(error).__name__}: {error})"))
            raise

    def _turn(self) -> float:
        generated, position_mm = self._observe()
        is_stopped, self._heeded = self._stops != self._heeded, self._stops
        if self._coupling.moving:
            if generated == 0 and (is_stopped or not self._coupling.armed):
                self._feeder.begin(MotionCommand.hold(position_mm))
                self._rest()
            elif is_stopped and not self._follower.braking:
                self._follower.brake()
                self._standing.forget()
        # A stage whose voltage ran dry has left its command too, and filling says why.
        if generated < self._feeder.written:
            self._refuse_to_run_away(generated, position_mm)
        wait_s = self._feeder.fill(generated)
        self._settle(generated, position_mm)
        return wait_s

    def _observe(self) -> tuple[int, float]:
        """Return how much was put out and the position at that time; keep the distance from the command."""
        longest = max(1, self._velocity.update_samples // 4)
        for _ in range(_OBSERVATION_ATTEMPTS):
            before = self._feeder.generated
            position_mm = self._counter.read()
            after = self._feeder.generated
            if after - before <= longest:
                # Sample `n - 1` is put out while `n` were.
                middle = (before + after - 1) / 2
                self._feeder.error_mm = self._follower.error_mm(middle, position_mm) if before else 0.0
                break
        return after, position_mm

    def _refuse_to_run_away(self, generated: int, position_mm: float) -> None:
        if trip := self._follower.off_command(generated, position_mm, self._feeder.error_mm, self._guard):
            self._feeder.error_mm = 0.0
            self._follower.brake()
            self._standing.forget()
            self._coupling.set_moving(True)
            self._failed(trip)

    def _settle(self, generated: int, position_mm: float) -> None:
        if not self._coupling.moving or generated == 0:
            return
        if not self._follower.braking:
            if self._follower.is_over(generated):
                self._rest()
            return
        if self._follower.stands and self._standing.is_seen(generated, self._feeder.written, position_mm):
            self._follower.follow(MotionCommand.hold(position_mm))
            self._rest()

    def _rest(self) -> None:
        self._coupling.set_moving(False)
        self._over()

    def _give_up(self, trip: Trip) -> None:
        self._failed(trip)
        try:
            self._feeder.zero()
            stands = self._standing.is_awaited(self._counter, self._clock, self._velocity.update_s)
        except DeviceError:
            stands = False
        if not stands:
            self._cut()
        self._rest()
