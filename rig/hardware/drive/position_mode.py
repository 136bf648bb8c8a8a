"""The stage in position mode: the drive takes position commands over the serial link and makes trapezoidal strokes.

A profile is split at its standstills into strokes; a thread of the motion's own sends each at its time. What the drive
must observe by itself (thrust limit, soft limits, silence timeout) is written to it and read back before every motion.
"""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from dragrig.config.errors import DeviceError, reason_of
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import Clock, StageLimits, StageState, TravelEnd, Trip, TripCause
from dragrig.rig.guard import LIMIT_SWITCH_CAUSES
from dragrig.rig.hardware.dialects.base import Command, Parameter, Refusal, Request
from dragrig.rig.hardware.drive.link import CancelledByStopError, DriveLink, RefusedError
from dragrig.rig.hardware.drive.monitor import Watchdog
from dragrig.rig.hardware.drive.stage_base import MonitoredStage, Movement, refuse_late_start
from dragrig.rig.hardware.lines import DigitalLines
from dragrig.rig.hardware.sync import MotionSamplingSync
from dragrig.rig.profile import MotionProfile, Piece

_STANDSTILL_MM_S = 1e-6
_ACCELERATION_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True)
class Stroke:
    """One move that a drive makes by itself; a triangle has no steady part.

    Attributes
    ----------
    start_s, duration_s
        When it begins, from the profile's start, and how long it takes.
    end_mm
        Where it ends, relative to the profile's start.
    speed_mm_s, acceleration_mm_s2
        Greatest speed, and the acceleration of both ramps, without a sign.
    """

    start_s: float
    duration_s: float
    end_mm: float
    speed_mm_s: float
    acceleration_mm_s2: float

    @property
    def ends_s(self) -> float:
        """When it ends, from the profile's start."""
        return self.start_s + self.duration_s


def split_into_strokes(profile: MotionProfile) -> tuple[Stroke, ...]:
    """Cut a profile at its standstills.

    Raises
    ------
    DeviceError
        When a stretch between two standstills is no trapezoid with ramps of one acceleration.
    """
    pieces = profile.pieces()
    starts, speeds = profile.start_s.tolist(), profile.velocity_mm_s.tolist()
    positions = profile.position_mm.tolist()
    ends = [*positions[1:], float(profile.position(profile.duration_s))]
    strokes: list[Stroke] = []
    first: int | None = None
    for place, piece in enumerate(pieces):
        stands = abs(speeds[place]) <= _STANDSTILL_MM_S
        if first is None and stands and piece.acceleration_mm_s2 == 0:
            continue
        first = place if first is None else first
        after = speeds[place + 1] if place + 1 < len(speeds) else float(profile.velocity(profile.duration_s))
        if abs(after) > _STANDSTILL_MM_S:
            continue
        speed = _trapezoid_speed(pieces[first : place + 1])
        if speed is None:
            raise DeviceError(
                f"the drive cannot follow the motion from {starts[first]:g} s on: in position mode it makes strokes of "
                "one acceleration and one speed between standstills (hardware.drive.mode of the rig file)."
            )
        duration = starts[place] + piece.duration_s - starts[first]
        accel = abs(pieces[first].acceleration_mm_s2)
        strokes.append(Stroke(starts[first], duration, ends[place], speed, accel))
        first = None
    return tuple(strokes)


def _trapezoid_speed(pieces: Sequence[Piece]) -> float | None:
    if len(pieces) not in {2, 3}:
        return None
    up, down = pieces[0], pieces[-1]
    steady = pieces[1:-1]
    same = abs(up.acceleration_mm_s2 + down.acceleration_mm_s2) <= _ACCELERATION_TOLERANCE * abs(up.acceleration_mm_s2)
    if not same or any(piece.acceleration_mm_s2 != 0 for piece in steady):
        return None
    return abs(up.acceleration_mm_s2) * up.duration_s


def write_safeguards(link: DriveLink, settings: RigSettings) -> None:
    """Write thrust limit, silence timeout and the deceleration of a stop, and read each back.

    Raises
    ------
    DeviceError
        When the drive holds another value than the one that was written, refuses, or does not answer.
    """
    drive = settings.hardware.drive
    for parameter, value, key in (
        (Parameter.THRUST_LIMIT_N, drive.thrust_limit_N, "hardware.drive.thrust_limit_N"),
        (Parameter.SILENCE_S, drive.silence_s, "hardware.drive.silence_s"),
        (Parameter.STOP_ACCELERATION_MM_S2, settings.stage.stop_accel_mm_s2, "stage.stop_accel_mm_s2"),
    ):
        link.set_and_verify(parameter, value, key)


def write_travel(link: DriveLink, limits: StageLimits) -> None:
    """Write the soft limits and read them back; raises as `write_safeguards`."""
    link.set_and_verify(Parameter.LOWEST_MM, limits.lowest_mm, "stage.lowest_mm")
    link.set_and_verify(Parameter.HIGHEST_MM, limits.highest_mm, "stage.highest_mm")


def write_motion(link: DriveLink, settings: RigSettings, limits: StageLimits, first: Stroke, clock: Clock) -> float:
    """Write what a motion must keep to and its first stroke's speed, read it back, and return the link's round trip.

    The round trip is in the rig's time. Raises as `write_safeguards`.
    """
    began_s, wall_s = clock.monotonic(), time.perf_counter()
    write_safeguards(link, settings)
    write_travel(link, limits)
    for parameter, value, key in (
        (Parameter.SPEED_MM_S, first.speed_mm_s, "the motion's speed"),
        (Parameter.ACCELERATION_MM_S2, first.acceleration_mm_s2, "the motion's acceleration"),
    ):
        link.set_and_verify(parameter, value, key)
    pace = (clock.monotonic() - began_s) / (time.perf_counter() - wall_s)
    return link.round_trip_s * pace


def write_homing(link: DriveLink, settings: RigSettings) -> None:
    """Write what homing needs and read it back; raises as `write_safeguards`."""
    speed = settings.hardware.drive.homing_speed_mm_s
    link.set_and_verify(Parameter.HOMING_SPEED_MM_S, speed, "hardware.drive.homing_speed_mm_s")


_RESERVED_ROUND_TRIPS = 3
_STROKE_END_TIMEOUT_S = 0.5


class StrokeMovement(Movement):
    """Strokes from one absolute position.

    Parameters
    ----------
    as_of
        As of `Movement`.
    round_trip_s
        Time between a request and its reply, in the rig's time: a request takes half of it to the drive.
    failed
        Called from the motion's thread with what the drive did not take.
    over
        Called once no stroke is left to be sent.
    """

    def __init__(
        self,
        strokes: Sequence[Stroke],
        origin_mm: float,
        link: DriveLink,
        as_of: int,
        coupling: MotionSamplingSync,
        clock: Clock,
        round_trip_s: float,
        failed: Callable[[DeviceError], None],
        over: Callable[["StrokeMovement"], None],
    ) -> None:
        super().__init__(link, as_of)
        self._strokes, self._origin_mm = strokes, origin_mm
        self._coupling, self._clock = coupling, clock
        self._round_trip_s = round_trip_s
        self._failed, self._over = failed, over
        self._cancel = threading.Event()
        self._uncertainty_s = 0.0
        self._first_uncertainty_s = 0.0
        self._sent = 0
        self._tried = False
        self._set: tuple[float, float] | None = None

    @property
    def start_uncertainty_s(self) -> float:
        """How far any stroke's start may be off its time, as measured, in the rig's time."""
        return self._first_uncertainty_s + self._uncertainty_s

    @property
    def has_tried(self) -> bool:
        """Whether the drive may have heard of it."""
        return self._tried

    @property
    def direction(self) -> float:
        """Which way the latest stroke goes; 0 before the first."""
        if not self._sent:
            return 0.0
        before_mm = self._strokes[self._sent - 2].end_mm if self._sent > 1 else 0.0
        return 1.0 if self._strokes[self._sent - 1].end_mm > before_mm else -1.0

    def set_out(self, parameters: tuple[float, float]) -> None:
        """Start the thread. `parameters` are the speed and acceleration that the drive holds already."""
        self._set = parameters
        threading.Thread(target=self._send_all, name="drive motion", daemon=True).start()

    def cancel(self) -> None:
        """Send nothing more."""
        self._cancel.set()

    def _send_all(self) -> None:
        try:
            began_s = self._await_start()
            if began_s is not None:
                for stroke in self._strokes:
                    self._send(stroke, began_s)
        except CancelledByStopError:
            # Nothing is to be sent any more, and whoever stopped knows why.
            return
        except DeviceError as error:
            self._failed(error)
        finally:
            self.complete()
            self._over(self)

    def _await_start(self) -> float | None:
        if not self._coupling.armed:
            return self._clock.monotonic()
        first = self._coupling.await_first_sample(self._cancel)
        if first is None:
            return None
        self._first_uncertainty_s = first.uncertainty_s
        return first.at_s

    def _send(self, stroke: Stroke, began_s: float) -> None:
        due_s = began_s + stroke.start_s
        if self._set != (stroke.speed_mm_s, stroke.acceleration_mm_s2):
            self._prepare(stroke)
        # Close to the start the line is kept free, or the monitor's question would delay it by a round trip.
        self._sleep_until(due_s - _RESERVED_ROUND_TRIPS * self._round_trip_s)
        with self._link.reserved():
            self._sleep_until(due_s - self._round_trip_s / 2)
            self._tried = True
            sent_s = self._clock.monotonic()
            self._go(stroke)
            replied_s = self._clock.monotonic()
        if not self._coupling.armed and not self._sent:
            due_s = (sent_s + replied_s) / 2
        off_s = abs((sent_s + replied_s) / 2 - due_s) + (replied_s - sent_s) / 2
        self._uncertainty_s = max(self._uncertainty_s, off_s)
        self._sent += 1
        self.begun()
        if self._sent == len(self._strokes):
            self.complete()
        self._sleep_until(began_s + stroke.ends_s)

    def _prepare(self, stroke: Stroke) -> None:
        # Not while it moves: some drives apply a new speed to the stroke under way.
        self._await_standstill()
        self._link.set(Parameter.SPEED_MM_S, stroke.speed_mm_s)
        self._link.set(Parameter.ACCELERATION_MM_S2, stroke.acceleration_mm_s2)
        self._set = (stroke.speed_mm_s, stroke.acceleration_mm_s2)

    def _go(self, stroke: Stroke) -> None:
        request = Request(Command.GO, value=self._origin_mm + stroke.end_mm)
        try:
            self._link.exchange(request, self._as_of)
        except RefusedError as error:
            # Refused is not done, so that it may be sent again once the stroke before has ended.
            if error.refusal is not Refusal.MOVING or not self._sent:
                raise
            self._await_standstill()
            self._link.exchange(request, self._as_of)

    def _await_standstill(self) -> None:
        until_s = time.monotonic() + _STROKE_END_TIMEOUT_S
        while time.monotonic() < until_s:
            status = self._link.exchange(Request(Command.STATUS), self._as_of).status
            if status is not None and not status.moving:
                return

    def _sleep_until(self, due_s: float) -> None:
        if not self._clock.sleep(due_s - self._clock.monotonic(), self._cancel):
            raise CancelledByStopError("the stage was stopped before the motion was over.")


_HOMING_POLL_S = 0.1
_SILENCE_MARGIN_S = 0.1
_STANDSTILL_TIMEOUT_S = 1.0
_HOMING_OVERTRAVEL_MM = 50.0


class PositionModeStage(MonitoredStage):
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
        self,
        settings: RigSettings,
        link: DriveLink,
        lines: DigitalLines,
        coupling: MotionSamplingSync,
        clock: Clock,
        deadman: Watchdog,
    ) -> None:
        braking_s = settings.stage.max_speed_mm_s / settings.stage.stop_accel_mm_s2
        unheard_s = settings.hardware.drive.silence_s + braking_s + _SILENCE_MARGIN_S
        super().__init__(settings, link, lines, coupling, clock, deadman, unheard_s)
        self._strokes: StrokeMovement | None = None
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
            towards = TravelEnd(self._drive.homing_direction)
            self._refuse_unready(enabled=self._axis.status.enabled, but=LIMIT_SWITCH_CAUSES[towards])
            write_safeguards(self._link, self._settings)
            write_homing(self._link, self._settings)
            movement = Movement(self._link, as_of)
            self._monitor.tolerate(LIMIT_SWITCH_CAUSES[towards])
            self._axis.begin(movement)
            try:
                self._link.exchange(
                    Request(Command.HOME, value=-1.0 if towards is TravelEnd.LOW else 1.0), movement.as_of
                )
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
            strokes = split_into_strokes(profile)
            if not strokes:
                return
            round_trip_s = write_motion(self._link, self._settings, limits, strokes[0], self._clock)
            refuse_late_start(strokes[0].start_s, self._coupling, self._clock)
            self._strokes = StrokeMovement(
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
        self._ready.await_standstill(self._drive.silence_s + _STANDSTILL_TIMEOUT_S)

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

    def _all_sent(self, strokes: StrokeMovement) -> None:
        if strokes.has_tried:
            self._monitor.hurry()
        else:
            self._axis.forget()

    def _failed(self, error: DeviceError) -> None:
        self._monitor.latch(Trip(TripCause.DRIVE_FAULT, reason_of(error)))

    def _await_homed(self) -> None:
        travel_mm = self._limits.highest_mm - self._limits.lowest_mm + _HOMING_OVERTRAVEL_MM
        until_s = self._clock.monotonic() + 2 * travel_mm / self._drive.homing_speed_mm_s
        while not self._ready.await_standstill(_HOMING_POLL_S):
            if self._clock.monotonic() > until_s:
                self._give_up_homing()
                return

    def _give_up_homing(self) -> None:
        self._link.stop()
        if not self._ready.await_standstill(self._drive.silence_s + _STANDSTILL_TIMEOUT_S):
            raise DeviceError(
                "the drive says that it still moves, although homing has taken its time and it was told to stop: take "
                "its power away by hand, and look at the rig."
            )
