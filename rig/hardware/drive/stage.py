"""The stage whose drive takes position commands over a serial link."""

from dragrig.config.errors import DeviceError, plain
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import Clock, Side, StageState
from dragrig.rig.guard import SWITCHES
from dragrig.rig.hardware.coupling import Coupling
from dragrig.rig.hardware.deadman import Deadman
from dragrig.rig.hardware.dialects.base import Command, Request
from dragrig.rig.hardware.drive.link import DriveLink
from dragrig.rig.hardware.drive.movement import Movement
from dragrig.rig.hardware.drive.mover import Strokes
from dragrig.rig.hardware.drive.parameters import write_homing, write_motion, write_safeguards
from dragrig.rig.hardware.drive.refusals import refuse_late
from dragrig.rig.hardware.drive.strokes import strokes_of
from dragrig.rig.hardware.drive.watched import WatchedStage
from dragrig.rig.hardware.lines import Lines
from dragrig.rig.profile import MotionProfile
from dragrig.rig.trips import Cause, Trip

_LOOK_S = 0.1
_SPARE_S = 0.1
_STANDSTILL_S = 1.0
_BEYOND_LIMITS_MM = 50.0


class SerialStage(WatchedStage):
    """One axis in position mode. It watches drive and switches from its making until `close`.

    Parameters
    ----------
    clock
        The rig's time, in which motions are.
    deadman
        Fed by whoever reads the samples.

    Raises
    ------
    DeviceError
        When the drive does not answer.
    """

    def __init__(
        self, settings: RigSettings, link: DriveLink, lines: Lines, coupling: Coupling, clock: Clock, deadman: Deadman
    ) -> None:
        braking_s = settings.stage.max_speed_mm_s / settings.stage.stop_accel_mm_s2
        unheard_s = settings.hardware.drive.silence_s + braking_s + _SPARE_S
        super().__init__(settings, link, lines, coupling, clock, deadman, unheard_s)
        self._strokes: Strokes | None = None
        link.on_stop(self._heed_stop)
        if self._axis.status.moving:
            self._stop_what_moves()
        self._monitor.start()

    @property
    def start_uncertainty_s(self) -> float:
        """How far any stroke of the last motion may have begun off its time, as measured on the link."""
        return 0.0 if self._strokes is None else self._strokes.start_uncertainty_s

    def state(self) -> StageState:
        """Ask drive and switches now.

        Raises
        ------
        DeviceError
            When the drive does not answer.
        """
        fault = self._monitor.look()
        position_mm, status = self._axis.position_mm(), self._axis.status
        return StageState(position_mm, status.enabled, status.homed, self._coupling.moving, fault)

    def enable(self) -> None:
        """Switch the drive on.

        Raises
        ------
        DeviceError
            When something forbids motion: see to it, then `disable`; or when the drive refuses or does not answer.
        """
        with self._commands:
            self._ready.refuse_fault()
            self._power.on()
            self._switched(on=True)
            self._monitor.look()

    def home(self) -> None:
        """Let the drive find its index pulse, which becomes 0; returns when it stands there.

        Raises
        ------
        DeviceError
            When the drive is off, moving, has a fault, refuses, or was stopped before it had found the pulse.
        """
        as_of = self._link.stops
        with self._commands:
            towards = Side(self._drive.homing_direction)
            self._refuse_unready(enabled=self._axis.status.enabled, but=SWITCHES[towards])
            write_safeguards(self._link, self._settings)
            write_homing(self._link, self._settings)
            movement = Movement(self._link, as_of)
            self._monitor.tolerate(SWITCHES[towards])
            self._axis.begin(movement)
            try:
                self._link.exchange(Request(Command.HOME, value=-1.0 if towards is Side.LOW else 1.0), movement.as_of)
            except DeviceError:
                self._link.stop()
                raise
            finally:
                # Whether or not it answered, it may move from here on.
                movement.begun()
                movement.complete()
                self._await_homed()
            self._ready.refuse_fault()
            if movement.is_stopped or not self._axis.status.homed:
                raise DeviceError("homing ended before the index pulse was found: clear the way, then home again.")

    def move(self, profile: MotionProfile) -> None:
        """Begin to follow a profile: now, or with the first sample when the sampler is armed.

        Raises
        ------
        DeviceError
            When the drive is off, not homed, moving, has a fault, refuses or does not answer; when the first sample is
            too long past; when the profile leaves the stage's limits, does not end at a standstill, or is none that the
            drive can follow; and when the drive does not keep a limit that was written to it.
        """
        as_of = self._link.stops
        with self._commands:
            self._refuse_unready(enabled=self._axis.status.enabled)
            if not self._axis.status.homed:
                raise DeviceError("the stage does not know where it is: home it before it moves.")
            if profile.duration_s <= 0:
                return
            origin_mm = self._axis.position_mm()
            limits = self._allowed(profile, origin_mm)
            strokes = strokes_of(profile)
            if not strokes:
                return
            round_trip_s = write_motion(self._link, self._settings, limits, strokes[0], self._clock)
            refuse_late(strokes[0].start_s, self._coupling, self._clock)
            self._strokes = Strokes(
                strokes, origin_mm, self._link, as_of, self._coupling, self._clock, round_trip_s, self._failed,
                self._all_sent,
            )  # fmt: skip
            self._deadman.feed()
            self._axis.begin(self._strokes)
            self._strokes.set_out((strokes[0].speed_mm_s, strokes[0].acceleration_mm_s2))

    def stop(self) -> None:
        """Brake to a standstill now; an acquisition under way ends there. Allowed at any time, from any thread.

        Returns at once; the drive hears it at the latest after the reply that the link awaits.
        """
        self._coupling.set_stopped()
        self._link.stop()

    def _come_to_rest(self) -> None:
        self._ready.await_standstill(self._drive.silence_s + _STANDSTILL_S)

    def close(self) -> None:
        """Stop, and let go of the drive. Twice is once."""
        self._link.stop()
        self._monitor.close()
        self._link.close()

    def _stop_what_moves(self) -> None:
        # Left by a program that was killed; asking the drive how it is keeps its silence timeout from ending it.
        movement = Movement(self._link, self._link.stops)
        movement.complete()
        self._axis.begin(movement)
        self._link.stop()

    def _heed_stop(self) -> None:
        self._axis.cancel()
        self._monitor.hurry()

    def _all_sent(self, strokes: Strokes) -> None:
        if strokes.has_tried:
            self._monitor.hurry()
        else:
            self._axis.forget()

    def _failed(self, error: DeviceError) -> None:
        self._monitor.latch(Trip(Cause.DRIVE_FAULT, plain(error)))

    def _await_homed(self) -> None:
        travel_mm = self._limits.highest_mm - self._limits.lowest_mm + _BEYOND_LIMITS_MM
        until_s = self._clock.monotonic() + 2 * travel_mm / self._drive.homing_speed_mm_s
        while not self._ready.await_standstill(_LOOK_S):
            if self._clock.monotonic() > until_s:
                self._give_up_homing()
                return

    def _give_up_homing(self) -> None:
        self._link.stop()
        if not self._ready.await_standstill(self._drive.silence_s + _STANDSTILL_S):
            raise DeviceError(
                "the drive says that it still moves, although homing has taken its time and it was told to stop: take "
                "its power away by hand, and look at the rig."
            )
