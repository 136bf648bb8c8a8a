"""The stage in velocity mode: the drive takes its speed as a voltage, and the position loop is closed here.

Homing creeps onto a limit switch and off it again until the counter has seen the index pulse.
"""

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace

from dragrig.config.errors import DeviceError, SettingsError
from dragrig.config.rig import Calibration, RigSettings
from dragrig.rig.devices import Clock, StageLimits, StageState, TravelEnd, TripCause
from dragrig.rig.guard import LIMIT_SWITCH_CAUSES
from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.scaling import Scaling
from dragrig.rig.hardware.card.tasks import AO_RANGE_V, PositionCounter, VoltageOutput
from dragrig.rig.hardware.drive.link import DriveLink
from dragrig.rig.hardware.drive.monitor import Watchdog
from dragrig.rig.hardware.drive.position_mode import write_safeguards, write_travel
from dragrig.rig.hardware.drive.stage_base import MonitoredStage, first_motion_s, refuse_late_start
from dragrig.rig.hardware.drive.velocity_loop import AOStreamer, SpeedController, VelocityLoop
from dragrig.rig.hardware.lines import ConditionalHeartbeat, DigitalLines
from dragrig.rig.hardware.sync import MotionSamplingSync
from dragrig.rig.profile import MotionProfile, trapezoid

_UNREFERENCED_MM = 10_000.0
"""What the counter reads before the index pulse: no stage is so long."""
_HOMING_OVERTRAVEL_MM = 50.0
_HOMING_ACCELERATION_MM_S2 = 500.0
_POLL_S = 0.005
_ARRIVAL_COUNTS = 3
_ARRIVAL_TIMEOUT_S = 1.0


class IndexSearch:
    """Finds the index pulse by means of the velocity loop. Whoever calls it holds the stage's commands."""

    def __init__(
        self, loop: VelocityLoop, lines: DigitalLines, settings: RigSettings, coupling: MotionSamplingSync, clock: Clock
    ) -> None:
        self._loop, self._lines, self._coupling, self._clock = loop, lines, coupling, clock
        self._stage, self._drive = settings.stage, settings.hardware.drive
        self._wired = settings.hardware.card
        self._arrived_mm = _ARRIVAL_COUNTS * settings.encoder.resolution_um / 1000.0

    def seek(self, mark: int) -> None:
        """Find the index pulse, make it 0, and go to it or to the soft limit next to it.

        Parameters
        ----------
        mark
            What the loop's `stops` was when this was planned: a stop since then ends it at once.

        Raises
        ------
        SettingsError
            When switch or index pulse are not wired.
        DeviceError
            When a stop or a fault came first, or one of the two was not found.
        """
        side = TravelEnd(self._drive.homing_direction)
        self._refuse_unwired(side)
        towards = -1.0 if side is TravelEnd.LOW else 1.0
        if not self._is_pressed(side):
            mark = self._creep(towards, lambda: self._is_pressed(side), f"the {side} limit switch", mark)
        self._loop.recount(_UNREFERENCED_MM, index=True)
        mark = self._creep(-towards, lambda: abs(self._loop.look()) < _UNREFERENCED_MM / 2, "the index pulse", mark)
        position_mm = self._loop.look()
        self._loop.recount(position_mm, index=False)
        target_mm = min(max(0.0, self._stage.lowest_mm), self._stage.highest_mm)
        self._loop.follow(self._way(target_mm - position_mm), position_mm, mark)
        while self._coupling.moving:
            self._loop.look()
            self._clock.sleep(_POLL_S, threading.Event())
        # A drive with a little offset never quite gets there, and need not: the counter knows where it is.
        until_s = self._clock.monotonic() + _ARRIVAL_TIMEOUT_S
        while abs(self._loop.look() - target_mm) > self._arrived_mm and self._clock.monotonic() < until_s:
            self._clock.sleep(_POLL_S, threading.Event())
        if self._loop.stops != mark:
            raise DeviceError("homing was stopped: home again.")

    def _creep(self, direction: float, found: Callable[[], bool], what: str, mark: int) -> int:
        travel_mm = self._stage.highest_mm - self._stage.lowest_mm + _HOMING_OVERTRAVEL_MM
        self._loop.follow(self._way(direction * travel_mm), self._loop.look(), mark, closed=False)
        is_found = False
        while self._coupling.moving:
            if not is_found and found():
                is_found = True
                stopped = self._loop.brake()
                if stopped != mark + 1:
                    break
                mark = stopped
            self._loop.look()
            self._clock.sleep(_POLL_S, threading.Event())
        if not is_found or self._loop.stops != mark:
            raise DeviceError(f"homing ended before {what} was found: see what stopped the stage, then home again.")
        return mark

    def _way(self, travel_mm: float) -> MotionProfile:
        acceleration = min(_HOMING_ACCELERATION_MM_S2, self._stage.max_accel_mm_s2)
        return MotionProfile.from_pieces(trapezoid(travel_mm, self._drive.homing_speed_mm_s, acceleration))

    def _is_pressed(self, side: TravelEnd) -> bool:
        pressed = self._lines.pressed()
        return pressed.limit_low if side is TravelEnd.LOW else pressed.limit_high

    def _refuse_unwired(self, side: TravelEnd) -> None:
        lines = self._wired.lines
        wired = lines.limit_low if side is TravelEnd.LOW else lines.limit_high
        if not (wired and self._wired.encoder.z):
            raise SettingsError(
                f"homing in velocity mode needs the {side} limit switch and the index pulse: name them in "
                f"hardware.card.lines.limit_{side} and hardware.card.encoder.z."
            )


_STANDSTILL_TIMEOUT_S = 1.0
_MAX_HOLD_ERROR_MM = 0.02


class VelocityModeStage(MonitoredStage):
    """One axis in velocity mode. It watches drive and switches from its making until `close`.

    It follows any profile within the stage's limits. The voltage begins with the card's own trigger of the first
    sample, and a loop on the encoder's second counter holds the stage until it is switched off. The serial link carries
    no motion: it switches the drive on and off, asks how it is, and sets its thrust limit, soft limits and silence.
    Homing is the program's, since a drive in velocity mode takes no position commands: slowly onto the limit switch and
    off it again until the counter has seen the index pulse, which becomes 0.

    Parameters
    ----------
    clock
        The rig's time, in which motions are.
    deadman
        Fed by whoever reads the samples.
    connection
        The card whose output and counter are used.
    calibrations
        The calibrations that hold now, by quantity; that of the encoder is used.

    Raises
    ------
    DeviceError
        When drive or card do not answer.
    """

    def __init__(
        self,
        settings: RigSettings,
        link: DriveLink,
        lines: DigitalLines,
        coupling: MotionSamplingSync,
        clock: Clock,
        deadman: Watchdog,
        connection: Connection,
        calibrations: Mapping[str, Calibration],
    ) -> None:
        velocity = settings.hardware.drive.velocity
        heart = ConditionalHeartbeat(lines, self._is_well)
        super().__init__(settings, link, heart, coupling, clock, deadman, settings.hardware.drive.silence_s)
        fastest_mm_s = min(settings.stage.max_speed_mm_s, AO_RANGE_V * velocity.per_V)
        self._limits = replace(self._limits, speed_mm_s=fastest_mm_s)
        self._homed = self._homing = False
        self._counter = PositionCounter(connection, velocity.counter, Scaling.of(settings, calibrations).mm_per_count)
        self._output = VoltageOutput(
            connection, velocity.channel, velocity.rate_hz, velocity.ahead * velocity.update_samples
        )
        follower = SpeedController(velocity, settings.stage)
        feeder = AOStreamer(self._output, follower, velocity, clock)
        self._loop = VelocityLoop(
            feeder, follower, self._counter, settings, coupling, clock, self._monitor.latch, self._cut, self._let_go
        )
        self._seeker = IndexSearch(self._loop, lines, settings, coupling, clock)
        self._counter.begin(0.0)
        self._monitor.start()

    @property
    def start_uncertainty_s(self) -> float:
        """One sample of the voltage where the card's trigger began the last motion; else what the clocks leave open."""
        return self._loop.start_uncertainty_s

    def state(self) -> StageState:
        """Ask drive, switches and encoder now.

        Raises
        ------
        DeviceError
            When the card does not answer.
        """
        fault = self._monitor.look()
        position_mm = self._loop.look()
        return StageState(position_mm, self._is_enabled, self._homed, self._coupling.moving, fault)

    def enable(self) -> None:
        """Switch the drive on at 0 V and hold the position.

        Raises
        ------
        DeviceError
            When something forbids motion: see to it, then `disable`; or when drive or card refuse or do not answer.
        """
        with self._commands:
            self._ready.refuse_fault()
            if self._is_enabled:
                return
            self._output.zero()
            self._power.on()
            self._switched(on=True)
            self._monitor.look()
            self._loop.start()

    def home(self) -> None:
        """Find the index pulse, which becomes 0; return when the stage stands there, or at the soft limit next to it.

        Raises
        ------
        DeviceError
            When the drive is off, moving, has a fault, or stands before the pulse was found.
        SettingsError
            When limit switch or index pulse are not wired.
        """
        mark = self._loop.stops
        with self._commands:
            cause = LIMIT_SWITCH_CAUSES[TravelEnd(self._drive.homing_direction)]
            self._refuse_unready(enabled=self._is_enabled, but=cause)
            write_safeguards(self._link, self._settings)
            self._homed, self._homing = False, True
            self._monitor.tolerate(cause)
            try:
                self._seeker.seek(mark)
            except DeviceError:
                # What stopped the stage says more than that it stopped.
                self._ready.refuse_fault(cause)
                raise
            finally:
                self._homing = False
                self._let_go()
                self._loop.brake()
            self._ready.refuse_fault()
            self._homed = True

    def move(self, profile: MotionProfile) -> None:
        """Begin to follow a profile: now, or with the first sample when the sampler is armed.

        Raises
        ------
        DeviceError
            When the drive is off, not homed, moving, has a fault, refuses or does not answer; when the first sample is
            too long past; when the profile leaves the stage's limits or does not end at a standstill; and when the
            drive does not keep a limit that was written to it.
        """
        mark = self._loop.stops
        with self._commands:
            self._loop.look()
            self._refuse_unready(enabled=self._is_enabled)
            if not self._homed:
                raise DeviceError("the stage does not know where it is: home it before it moves.")
            if profile.duration_s <= 0:
                return
            origin_mm = self._origin_mm()
            limits = self._allowed(profile, origin_mm)
            write_safeguards(self._link, self._settings)
            write_travel(self._link, self._as_the_drive_counts(limits, origin_mm))
            refuse_late_start(first_motion_s(profile), self._coupling, self._clock)
            self._deadman.feed()
            self._loop.follow(profile, origin_mm, mark)

    def stop(self) -> None:
        """Brake to a standstill now; an acquisition under way ends there. Allowed at any time, from any thread.

        Returns at once; the voltage goes down as soon as what is written is put out.
        """
        self._coupling.set_stopped()
        self._loop.brake()

    def _come_to_rest(self) -> None:
        self._ready.await_standstill(_STANDSTILL_TIMEOUT_S)
        self._loop.end()

    def close(self) -> None:
        """Stop, and let go of drive and card. Twice is once."""
        self._loop.brake()
        self._loop.end()
        self._monitor.close()
        self._counter.close()
        self._link.close()

    @property
    def _is_enabled(self) -> bool:
        return self._axis.status.enabled and self._loop.running

    def _origin_mm(self) -> float:
        # Where it is held, not where it is found: what the loop leaves open must not add up, nor count as a limit.
        held_mm = self._loop.held_mm()
        inside_mm = min(max(held_mm, self._limits.lowest_mm), self._limits.highest_mm)
        return inside_mm if abs(inside_mm - held_mm) <= _MAX_HOLD_ERROR_MM else held_mm

    def _as_the_drive_counts(self, limits: StageLimits, origin_mm: float) -> StageLimits:
        # The drive was not homed, so that its positions have another zero.
        shift_mm = self._axis.position_mm() - origin_mm
        return replace(limits, lowest_mm=limits.lowest_mm + shift_mm, highest_mm=limits.highest_mm + shift_mm)

    def _is_well(self) -> bool:
        fault = self._monitor.fault
        return fault is None or fault.cause is not TripCause.WATCHDOG

    def _cut(self) -> None:
        try:
            self._power.off()
        except DeviceError:
            # Neither drive nor card answer: the heartbeat, which stands still with the card, takes the power.
            return

    def _let_go(self) -> None:
        # Homing goes on from the switch that it is tolerated to be on.
        if not self._homing:
            super()._let_go()
