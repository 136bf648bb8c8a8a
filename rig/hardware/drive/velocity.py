"""The stage whose drive takes its speed as a voltage, with the position loop closed here."""

from collections.abc import Mapping
from dataclasses import replace

from dragrig.config.errors import DeviceError
from dragrig.config.lab import Calibration
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import Clock, Side, StageLimits, StageState
from dragrig.rig.guard import SWITCHES
from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.position import PositionCounter
from dragrig.rig.hardware.card.scaling import Scaling
from dragrig.rig.hardware.card.voltage import RANGE_V, VoltageOutput
from dragrig.rig.hardware.coupling import Coupling
from dragrig.rig.hardware.deadman import Deadman
from dragrig.rig.hardware.drive.feeding import Feeder
from dragrig.rig.hardware.drive.follower import Follower
from dragrig.rig.hardware.drive.heart import Heart
from dragrig.rig.hardware.drive.link import DriveLink
from dragrig.rig.hardware.drive.looping import VelocityLoop
from dragrig.rig.hardware.drive.parameters import write_safeguards, write_travel
from dragrig.rig.hardware.drive.refusals import (
    refuse_late,
    sets_out_s,
)
from dragrig.rig.hardware.drive.seeking import Seeker
from dragrig.rig.hardware.drive.watched import WatchedStage
from dragrig.rig.hardware.lines import Lines
from dragrig.rig.profile import MotionProfile
from dragrig.rig.trips import Cause

_STANDSTILL_S = 1.0
_HOLDS_MM = 0.02


class VelocityStage(WatchedStage):
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
        lines: Lines,
        coupling: Coupling,
        clock: Clock,
        deadman: Deadman,
        connection: Connection,
        calibrations: Mapping[str, Calibration],
    ) -> None:
        velocity = settings.hardware.drive.velocity
        heart = Heart(lines, self._is_well)
        super().__init__(settings, link, heart, coupling, clock, deadman, settings.hardware.drive.silence_s)
        fastest_mm_s = min(settings.stage.max_speed_mm_s, RANGE_V * velocity.per_V)
        self._limits = replace(self._limits, speed_mm_s=fastest_mm_s)
        self._homed = self._homing = False
        self._counter = PositionCounter(connection, velocity.counter, Scaling.of(settings, calibrations).mm_per_count)
        self._output = VoltageOutput(
            connection, velocity.channel, velocity.rate_hz, velocity.ahead * velocity.update_samples
        )
        follower = Follower(velocity, settings.stage)
        feeder = Feeder(self._output, follower, velocity, clock)
        self._loop = VelocityLoop(
            feeder, follower, self._counter, settings, coupling, clock, self._monitor.latch, self._cut, self._let_go
        )
        self._seeker = Seeker(self._loop, lines, settings, coupling, clock)
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
            cause = SWITCHES[Side(self._drive.homing_direction)]
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
            refuse_late(sets_out_s(profile), self._coupling, self._clock)
            self._deadman.feed()
            self._loop.follow(profile, origin_mm, mark)

    def stop(self) -> None:
        """Brake to a standstill now; an acquisition under way ends there. Allowed at any time, from any thread.

        Returns at once; the voltage goes down as soon as what is written is put out.
        """
        self._coupling.set_stopped()
        self._loop.brake()

    def _come_to_rest(self) -> None:
        self._ready.await_standstill(_STANDSTILL_S)
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
        return inside_mm if abs(inside_mm - held_mm) <= _HOLDS_MM else held_mm

    def _as_the_drive_counts(self, limits: StageLimits, origin_mm: float) -> StageLimits:
        # The drive was not homed, so that its positions have another zero.
        shift_mm = self._axis.position_mm() - origin_mm
        return replace(limits, lowest_mm=limits.lowest_mm + shift_mm, highest_mm=limits.highest_mm + shift_mm)

    def _is_well(self) -> bool:
        fault = self._monitor.fault
        return fault is None or fault.cause is not Cause.WATCHDOG

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
