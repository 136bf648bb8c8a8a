"""The velocity loop: a thread that streams speed setpoints as voltages and corrects them by the encoder.

All times are counted in samples of the analog output, as the card counts them, so that neither this computer's clock
nor its scheduling shifts the setpoint. A voltage is put out `ahead` updates after its writing at most; a stop takes as
long to begin.
"""

import itertools
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dragrig.config import DeviceError, GuardSettings, StageSettings, VelocityOutputSettings, reason_of
from dragrig.rig import Clock, FloatArray, MotionProfile, Phase, Trip, TripCause, stationary_piece
from dragrig.rig.hardware.card import AI_START_TRIGGER, AO_RANGE_V, PositionCounter, UnderflowError, VoltageOutput
from dragrig.rig.hardware.drive.monitor import StageDevices

_ZERO_MOTION = MotionProfile.from_pieces([stationary_piece(1.0, Phase.HOLD)])


@dataclass(frozen=True, slots=True)
class MotionCommand:
    """The controller of the stage's speed."""

    profile: MotionProfile
    origin_mm: float
    """`profile`, `origin_mm`: the motion and the absolute position that it starts from; after its end, to stay there.
    """
    first: float = 0.0
    """Sample of the output at which the profile is at time 0; may have a fraction."""
    closed: bool = True
    """Whether the measured position corrects the speed."""

    @property
    def end_mm(self) -> float:
        """The absolute position at its end."""
        return self.origin_mm + float(self.profile.position(self.profile.duration_s))

    @classmethod
    def hold(cls, position_mm: float) -> "MotionCommand":
        """Return the command to stay at a position."""
        return cls(_ZERO_MOTION, position_mm)

    @classmethod
    def rest(cls) -> "MotionCommand":
        """Return the command to have no speed, at any position."""
        return cls(_ZERO_MOTION, 0.0, closed=False)


class SpeedController:
    """Speed setpoints, sample after sample: computation only, no device. Belongs to one thread at a time.

    Each speed is the profile's, taken `lag_s` early, plus `gain_per_s` times the following error; neither it nor its
    change exceeds the stage's limits. A stop takes it to 0 at the stop's deceleration.
    """

    def __init__(self, velocity: VelocityOutputSettings, stage: StageSettings) -> None:
        self._velocity = velocity
        self._stage = stage
        self.command = MotionCommand.rest()
        """What the stage is to do at present."""
        self.braking = False
        """Whether it brakes or has braked to a standstill since `brake`."""
        self._computed = 0
        self._speed_mm_s = 0.0

    @property
    def at_rest(self) -> bool:
        """Whether the latest speed is 0."""
        return self._speed_mm_s == 0.0

    def reset(self) -> None:
        """Count samples from 0 again, at speed 0."""
        self._computed, self._speed_mm_s, self.braking = 0, 0.0, False

    def follow(self, command: MotionCommand) -> None:
        """Carry out another command from the next sample on."""
        self.command, self.braking = command, False

    def brake(self) -> None:
        """Come to a standstill from the next sample on, at any position, and stay at speed 0."""
        self.command, self.braking = MotionCommand.rest(), True

    def following_error_mm(self, sample: float, position_mm: float) -> float:
        """Return how far the stage is behind its command while a sample is put out."""
        if not self.command.closed:
            return 0.0
        return float(self.command.origin_mm + self.command.profile.position(self._time_s(sample)) - position_mm)

    def following_error_trip(
        self, sample: float, position_mm: float, error_mm: float, guard: GuardSettings
    ) -> Trip | None:
        """Return the trip of a following error beyond the guard's limit; None within it."""
        speed_mm_s = abs(float(self.command.profile.velocity(self._time_s(sample))))
        limit_mm = guard.following_error_mm + guard.following_error_per_speed_s * speed_mm_s
        if abs(error_mm) <= limit_mm:
            return None
        return Trip(
            TripCause.FOLLOWING_ERROR,
            f"the stage is {abs(error_mm):.2f} mm off its command at {position_mm:.2f} mm, where {limit_mm:.2f} mm are "
            "allowed (guard.following_error_mm): it is blocked, the encoder does not count, or "
            "hardware.drive.velocity does not fit the drive",
        )

    def is_over(self, sample: float) -> bool:
        """Whether the command's motion has ended at a sample."""
        return self.at_rest if self.braking else self._time_s(sample) >= self.command.profile.motion_ends_s

    def speeds(self, samples: int, error_mm: float) -> FloatArray:
        """Return the next speeds [mm/s], shape `(samples,)`."""
        if self.braking:
            wanted = np.zeros(samples)
            max_accel_mm_s2 = self._stage.stop_accel_mm_s2
        else:
            middle_s = self._time_s(self._computed) + (np.arange(samples) + 0.5) / self._velocity.rate_hz
            wanted = self.command.profile.velocity(middle_s + self._velocity.lag_s)
            wanted = wanted + self._velocity.gain_per_s * error_mm
            max_accel_mm_s2 = self._stage.max_accel_mm_s2
        self._computed += samples
        max_speed, max_step = self._stage.max_speed_mm_s, max_accel_mm_s2 / self._velocity.rate_hz
        speed, speeds = self._speed_mm_s, np.empty(samples)
        for index, target in enumerate(np.clip(wanted, -max_speed, max_speed).tolist()):
            speed += min(max(target - speed, -max_step), max_step)
            speeds[index] = speed
        self._speed_mm_s = speed
        return speeds

    def _time_s(self, sample: float) -> float:
        """Return the profile's time of a sample."""
        return (sample - self.command.first) / self._velocity.rate_hz


_CHECKS_PER_UPDATE = 4


class AOStreamer:
    """Keeps the velocity output a little ahead of its output: speeds from a controller, as voltages.

    Belongs to one thread at a time.
    """

    def __init__(
        self, output: VoltageOutput, controller: SpeedController, velocity: VelocityOutputSettings, clock: Clock
    ) -> None:
        self._output, self._controller, self._clock = output, controller, clock
        self._velocity = velocity
        self._ahead = velocity.ahead * velocity.update_samples
        self.error_mm = 0.0
        """The latest following error."""

    def begin(self, command: MotionCommand, trigger: str = "") -> None:
        """End the waveform where it is, at 0 V, and begin one for `command`; see `VoltageOutput.begin`."""
        self._output.end()
        self._controller.reset()
        self._controller.follow(command)
        self.error_mm = 0.0
        self._output.begin(self._volts(self._ahead), trigger)

    def fill(self, generated: int) -> float:
        """Write the voltages that are due, and return for how long none will be [s].

        Raises
        ------
        UnderflowError
            When the output's buffer ran empty.
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
        self._controller.brake()
        while not self._controller.at_rest:
            self._wait(self.fill(self._output.generated))
        zero_from = self._output.written
        try:
            self._output.write(np.zeros(2 * self._ahead))
            while (left := zero_from + 1 - self._output.generated) > 0:
                self._wait(left / self._velocity.rate_hz)
        except UnderflowError:
            # The buffer ran empty at 0 V, where the waveform was to end.
            return
        finally:
            self._output.end()

    def _volts(self, samples: int) -> FloatArray:
        speeds = self._controller.speeds(samples, self.error_mm)
        return np.ascontiguousarray(np.clip(speeds / self._velocity.per_V, -AO_RANGE_V, AO_RANGE_V))

    def _wait(self, duration_s: float) -> None:
        self._clock.sleep(duration_s, threading.Event())


STANDSTILL_TIMEOUT_S = 0.5
"""How long the stage may take to stand after its voltage is 0."""
_STILL_COUNTS = 1.5


class StandstillDetector:
    """Standstill by the encoder: two readings, some time apart, of the same position.

    Parameters
    ----------
    count_mm
        Length of a count.
    velocity
        The output; its update time is the time between two readings.
    """

    def __init__(self, count_mm: float, velocity: VelocityOutputSettings) -> None:
        self._still_mm = _STILL_COUNTS * count_mm
        self._velocity = velocity
        self._since = self._read_at = 0
        self._before_mm: float | None = None

    def reset(self) -> None:
        """Start again."""
        self._before_mm = None

    def is_standing(self, generated: int, zero_from: int, position_mm: float) -> bool:
        """Whether the stage stands, by its position when `generated` samples were put out, those from `zero_from` 0.

        Raises `DeviceError` when it does not stand after `STANDSTILL_TIMEOUT_S`.
        """
        if self._before_mm is None:
            self._since = self._read_at = zero_from
            self._before_mm = position_mm
        if generated < self._read_at + self._velocity.update_samples:
            return False
        if abs(position_mm - self._before_mm) <= self._still_mm:
            return True
        if generated - self._since > round(STANDSTILL_TIMEOUT_S * self._velocity.rate_hz):
            raise DeviceError("the stage did not stop at 0 V, so the drive was switched off: inspect the drive.")
        self._read_at, self._before_mm = generated, position_mm
        return False

    def wait(self, counter: PositionCounter, clock: Clock) -> bool:
        """Return True once the stage stands, False after `STANDSTILL_TIMEOUT_S`; raises `DeviceError`."""
        until_s = clock.monotonic() + STANDSTILL_TIMEOUT_S
        before_mm = counter.read()
        while clock.monotonic() < until_s:
            clock.sleep(self._velocity.update_s, threading.Event())
            now_mm = counter.read()
            if abs(now_mm - before_mm) <= self._still_mm:
                return True
            before_mm = now_mm
        return False


def first_motion_s(profile: MotionProfile) -> float:
    """Return when a profile's first motion begins; its end when it has none."""
    moving = profile.start_s[profile.acceleration_mm_s2 != 0]
    return float(moving[0]) if moving.size else profile.duration_s


_OBSERVATION_ATTEMPTS = 3


class VelocityLoop:
    """Output, counter and the command that they follow. Any thread may call any method; `brake` never blocks.

    Parameters
    ----------
    on_fault
        Called with the fault that ended the loop or forbids motion, from the thread that noticed it.
    cut_power
        Called when the stage cannot be braked by its voltage: takes the drive's power, and must not raise.
    on_rest
        Called whenever a motion has ended.
    """

    def __init__(
        self,
        devices: StageDevices,
        output: VoltageOutput,
        counter: PositionCounter,
        on_fault: Callable[[Trip], None],
        cut_power: Callable[[], None],
        on_rest: Callable[[], None],
    ) -> None:
        settings = devices.settings
        self._output, self._counter, self._sync, self._clock = output, counter, devices.sync, devices.clock
        self._on_fault, self._cut_power, self._on_rest = on_fault, cut_power, on_rest
        self._velocity, self._guard = settings.hardware.drive.velocity, settings.guard
        self._controller = SpeedController(self._velocity, settings.stage)
        self._streamer = AOStreamer(output, self._controller, self._velocity, self._clock)
        self._standstill = StandstillDetector(settings.encoder.resolution_um / 1000.0, self._velocity)
        # Re-entrant, because the start of a motion also observes the position.
        self._busy = threading.RLock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        # A counter may be used by a signal handler that interrupts its own user; an Event may not.
        self._counting = itertools.count(1)
        self._stop_count = self._handled_stops = 0
        self.start_uncertainty_s = 0.0
        """Uncertainty of the last motion's time 0 against the first sample."""

    @property
    def running(self) -> bool:
        """Whether it controls the stage."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def stop_count(self) -> int:
        """Number of stops requested so far: `follow` drops motions planned at a lower count."""
        return self._stop_count

    def start(self, *, closed: bool = True) -> None:
        """Hold the stage where it is, or put out 0 V unless `closed`; raises `DeviceError` when the card refuses."""
        with self._busy:
            self._ended.clear()
            self._handled_stops = self._stop_count
            self._streamer.begin(MotionCommand.hold(self._counter.read()) if closed else MotionCommand.rest())
        self._thread = threading.Thread(target=self._run, name="velocity loop", daemon=True)
        self._thread.start()

    def follow(self, profile: MotionProfile, origin_mm: float, planned_at: int, *, closed: bool = True) -> None:
        """Follow a profile from now on; with an armed sampler return at once, as the card starts it with the sampling.

        Parameters
        ----------
        planned_at
            `stop_count` when this was planned: a stop requested since ends it at once.
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
            self._handled_stops = planned_at
            first = self._begin(MotionCommand(profile, origin_mm, closed=closed))
            self._sync.set_moving(True)
        while not self._sync.armed and self._sync.moving and self._output.generated <= first:
            self._clock.sleep(1.0 / self._velocity.rate_hz, self._ended)

    def hold(self) -> None:
        """Hold the stage where it is from here on; raises `DeviceError` when the position cannot be read."""
        with self._busy:
            self._controller.follow(MotionCommand.hold(self._counter.read()))

    def brake(self) -> int:
        """Come to a standstill, beginning once the written voltages are put out; return the new `stop_count`.

        Safe in any thread and in signal handlers.
        """
        self._stop_count = next(self._counting)
        return self._stop_count

    def position_mm(self) -> float:
        """Return the position now, and update whether the stage moves; raises `DeviceError`."""
        with self._busy:
            if not self.running:
                return self._counter.read()
            generated, position_mm = self._observe()
            self._update_motion(generated, position_mm)
            return position_mm

    def hold_position_mm(self) -> float:
        """Return the commanded position of a stage at rest; raises `DeviceError` when it cannot be read."""
        with self._busy:
            command = self._controller.command
            return command.end_mm if self.running and command.closed else self._counter.read()

    def reset_counter(self, position_mm: float, *, index: bool) -> None:
        """Restart the counter at a position and hold that; with `index`, the index pulse sets it to 0.

        Raises `DeviceError` when the card refuses.
        """
        with self._busy:
            self._counter.begin(position_mm, index=index)
            self._controller.follow(MotionCommand.rest() if index else MotionCommand.hold(position_mm))

    def end(self) -> None:
        """Brake, bring the voltage to 0, end the thread. Safe to call twice."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _begin(self, command: MotionCommand) -> float:
        """Start a command; return the sample of the output that is its time 0."""
        rate_hz, sample = self._velocity.rate_hz, self._sync.first_sample
        if self._sync.armed and sample is None:
            self._streamer.drain()
            self._streamer.begin(command, AI_START_TRIGGER)
            self.start_uncertainty_s = 1.0 / rate_hz
            return 0.0
        first, self.start_uncertainty_s = float(self._output.written), 0.0
        if sample is not None:
            due = self._output.generated - (self._clock.monotonic() - sample.at_s) * rate_hz
            first = max(due, first - first_motion_s(command.profile) * rate_hz)
            self.start_uncertainty_s = sample.uncertainty_s + (first - due + 1.0) / rate_hz
        self._controller.follow(replace(command, first=first))
        return first

    def _run(self) -> None:
        try:
            while not self._ended.is_set():
                with self._busy:
                    wait_s = self._cycle()
                self._clock.sleep(wait_s, self._ended)
            with self._busy:
                self._streamer.drain()
                self._come_to_rest()
        except UnderflowError as error:
            self._fail(Trip(TripCause.WATCHDOG, reason_of(error)))
        except DeviceError as error:
            self._fail(Trip(TripCause.DRIVE_FAULT, reason_of(error)))
        except Exception as error:
            self._fail(Trip(TripCause.WATCHDOG, f"the velocity loop failed ({type(error).__name__}: {error})"))
            raise

    def _cycle(self) -> float:
        generated, position_mm = self._observe()
        stop_requested, self._handled_stops = self._stop_count != self._handled_stops, self._stop_count
        if self._sync.moving:
            if generated == 0 and (stop_requested or not self._sync.armed):
                self._streamer.begin(MotionCommand.hold(position_mm))
                self._come_to_rest()
            elif stop_requested and not self._controller.braking:
                self._controller.brake()
                self._standstill.reset()
        # After an underflow the stage has left its command too, but then filling reports the cause.
        if generated < self._output.written:
            self._check_following_error(generated, position_mm)
        wait_s = self._streamer.fill(generated)
        self._update_motion(generated, position_mm)
        return wait_s

    def _observe(self) -> tuple[int, float]:
        """Return how much was put out and the position at that time; update the following error."""
        max_span = max(1, self._velocity.update_samples // 4)
        for _ in range(_OBSERVATION_ATTEMPTS):
            before = self._output.generated
            position_mm = self._counter.read()
            after = self._output.generated
            if after - before <= max_span:
                # Sample `n - 1` is put out while `n` were.
                middle = (before + after - 1) / 2
                error_mm = self._controller.following_error_mm(middle, position_mm) if before else 0.0
                self._streamer.error_mm = error_mm
                break
        return after, position_mm

    def _check_following_error(self, generated: int, position_mm: float) -> None:
        error_mm = self._streamer.error_mm
        if trip := self._controller.following_error_trip(generated, position_mm, error_mm, self._guard):
            self._streamer.error_mm = 0.0
            self._controller.brake()
            self._standstill.reset()
            self._sync.set_moving(True)
            self._on_fault(trip)

    def _update_motion(self, generated: int, position_mm: float) -> None:
        if not self._sync.moving or generated == 0:
            return
        if not self._controller.braking:
            if self._controller.is_over(generated):
                self._come_to_rest()
            return
        written = self._output.written
        if self._controller.at_rest and self._standstill.is_standing(generated, written, position_mm):
            self._controller.follow(MotionCommand.hold(position_mm))
            self._come_to_rest()

    def _come_to_rest(self) -> None:
        self._sync.set_moving(False)
        self._on_rest()

    def _fail(self, trip: Trip) -> None:
        self._on_fault(trip)
        try:
            self._output.zero()
            at_rest = self._standstill.wait(self._counter, self._clock)
        except DeviceError:
            at_rest = False
        if not at_rest:
            self._cut_power()
        self._come_to_rest()
