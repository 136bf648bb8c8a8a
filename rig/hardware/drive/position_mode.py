"""The stage in position mode: the drive takes position commands over the serial link and makes trapezoidal strokes.

A profile is split at its standstills into strokes; a thread of the motion's own sends each at its time. The limits that
the drive must observe by itself (thrust limit, soft limits, silence timeout) are written to it and read back before
every motion.
"""

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from threading import Event as Signal

from dragrig.config import DeviceError, reason_of
from dragrig.rig import (
    LIMIT_SWITCH_CAUSES,
    MotionProfile,
    Piece,
    StageLimits,
    TravelEnd,
    Trip,
    TripCause,
    limits_with_override,
)
from dragrig.rig.hardware.card import PositionCounter
from dragrig.rig.hardware.dialects import Command, Halt, Parameter, Refusal, Request, Status
from dragrig.rig.hardware.drive.link import CancelledByStopError, RefusedError
from dragrig.rig.hardware.drive.monitor import StageDevices
from dragrig.rig.hardware.drive.stage_base import (
    MonitoredStage,
    Movement,
    write_safeguards,
    write_travel,
)
from dragrig.rig.hardware.drive.trial import (
    PULSE_ACCELERATION_MM_S2,
    PULSE_MM,
    PULSE_SPEED_MM_S,
    HomingWay,
    Pulse,
    homing_remedy,
)

_STANDSTILL_MM_S = 1e-6
_ACCELERATION_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True)
class Stroke:
    """One move that a drive makes by itself; a triangle has no steady part."""

    start_s: float
    duration_s: float
    """`start_s`, `duration_s`: when it begins, from the profile's start, and how long it takes."""
    end_mm: float
    """Where it ends, relative to the profile's start."""
    speed_mm_s: float
    acceleration_mm_s2: float
    """`speed_mm_s`, `acceleration_mm_s2`: greatest speed, and the acceleration of both ramps, without a sign."""

    @property
    def ends_s(self) -> float:
        """When it ends, from the profile's start."""
        return self.start_s + self.duration_s


def split_into_strokes(profile: MotionProfile) -> tuple[Stroke, ...]:
    """Split a profile at its standstills.

    Raises `DeviceError` when the motion between two standstills is no trapezoid with ramps of one acceleration.
    """
    pieces = profile.pieces()
    starts, speeds = profile.start_s.tolist(), profile.velocity_mm_s.tolist()
    positions = profile.position_mm.tolist()
    ends = [*positions[1:], float(profile.position(profile.duration_s))]
    strokes: list[Stroke] = []
    first: int | None = None
    for index, piece in enumerate(pieces):
        at_rest = abs(speeds[index]) <= _STANDSTILL_MM_S
        if first is None and at_rest and piece.acceleration_mm_s2 == 0:
            continue
        first = index if first is None else first
        end_speed = speeds[index + 1] if index + 1 < len(speeds) else float(profile.velocity(profile.duration_s))
        if abs(end_speed) > _STANDSTILL_MM_S:
            continue
        speed = _trapezoid_speed(pieces[first : index + 1])
        if speed is None:
            raise DeviceError(
                f"the drive cannot follow the motion from {starts[first]:g} s on: in position mode it makes strokes of "
                "one acceleration and one speed between standstills (hardware.drive.mode of the rig file)."
            )
        duration = starts[index] + piece.duration_s - starts[first]
        acceleration = abs(pieces[first].acceleration_mm_s2)
        strokes.append(Stroke(starts[first], duration, ends[index], speed, acceleration))
        first = None
    return tuple(strokes)


def _trapezoid_speed(pieces: Sequence[Piece]) -> float | None:
    """Return the greatest speed of a trapezoid or triangle; None for another shape."""
    if len(pieces) not in {2, 3}:
        return None
    up, *steady, down = (piece.acceleration_mm_s2 for piece in pieces)
    if abs(up + down) > _ACCELERATION_TOLERANCE * abs(up) or any(steady):
        return None
    return abs(up) * pieces[0].duration_s


_RESERVED_ROUND_TRIPS = 3
_STROKE_END_TIMEOUT_S = 0.5


class StrokeMovement(Movement):
    """Strokes from an absolute position, each sent at its time by a thread of its own.

    Parameters
    ----------
    planned_at
        As in `Movement`.
    round_trip_s
        Time between a request and its reply, in the rig's time: a request takes half of it to the drive.
    on_failure
        Called from the thread with the error of a stroke that the drive did not accept.
    on_all_sent
        Called once no stroke is left to be sent.
    """

    def __init__(
        self,
        devices: StageDevices,
        strokes: Sequence[Stroke],
        origin_mm: float,
        planned_at: int,
        round_trip_s: float,
        on_failure: Callable[[DeviceError], None],
        on_all_sent: Callable[["StrokeMovement"], None],
    ) -> None:
        super().__init__(devices.link, planned_at)
        self._strokes, self._origin_mm = strokes, origin_mm
        self._sync, self._clock = devices.sync, devices.clock
        self._round_trip_s = round_trip_s
        self._on_failure, self._on_all_sent = on_failure, on_all_sent
        self._cancel = threading.Event()
        self._sending_uncertainty_s = self._first_sample_uncertainty_s = 0.0
        self._accepted = 0
        self.was_sent = False
        """Whether the drive may have received a stroke."""
        # The speed and acceleration that the drive holds: those of the first stroke are written before the start.
        self._written = strokes[0].speed_mm_s, strokes[0].acceleration_mm_s2

    @property
    def start_uncertainty_s(self) -> float:
        """Measured uncertainty of any stroke's start against its time, in the rig's time."""
        return self._first_sample_uncertainty_s + self._sending_uncertainty_s

    @property
    def end_mm(self) -> float:
        """Absolute position where the last stroke ends."""
        return self._origin_mm + self._strokes[-1].end_mm

    @property
    def direction(self) -> float:
        """Sign of the latest stroke; 0 before the first."""
        if not self._accepted:
            return 0.0
        start_mm = self._strokes[self._accepted - 2].end_mm if self._accepted > 1 else 0.0
        return 1.0 if self._strokes[self._accepted - 1].end_mm > start_mm else -1.0

    def start(self) -> None:
        """Start the thread."""
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
            # Nothing is to be sent any more, and the caller of the stop knows why.
            return
        except DeviceError as error:
            self._on_failure(error)
        finally:
            self.mark_complete()
            self._on_all_sent(self)

    def _await_start(self) -> float | None:
        if not self._sync.armed:
            return self._clock.monotonic()
        first = self._sync.await_first_sample(self._cancel)
        if first is None:
            return None
        self._first_sample_uncertainty_s = first.uncertainty_s
        return first.at_s

    def _send(self, stroke: Stroke, began_s: float) -> None:
        due_s = began_s + stroke.start_s
        if self._written != (stroke.speed_mm_s, stroke.acceleration_mm_s2):
            self._write_parameters(stroke)
        # Close to the start the link is reserved, or the monitor's request would delay the stroke by a round trip.
        self._sleep_until(due_s - _RESERVED_ROUND_TRIPS * self._round_trip_s)
        with self._link.reserved():
            self._link.prepare(self._request(stroke), self.planned_at)
            self._sleep_until(due_s - self._round_trip_s / 2)
            self.was_sent = True
            sent_s = self._clock.monotonic()
            self._go(stroke)
            replied_s = self._clock.monotonic()
        if not self._sync.armed and not self._accepted:
            due_s = (sent_s + replied_s) / 2
        error_s = abs((sent_s + replied_s) / 2 - due_s) + (replied_s - sent_s) / 2
        self._sending_uncertainty_s = max(self._sending_uncertainty_s, error_s)
        self._accepted += 1
        self.mark_started()
        if self._accepted == len(self._strokes):
            self.mark_complete()
        self._sleep_until(began_s + stroke.ends_s)

    def _write_parameters(self, stroke: Stroke) -> None:
        # Not while it moves: some drives apply a new speed to the stroke in progress.
        self._await_standstill()
        self._link.set(Parameter.SPEED_MM_S, stroke.speed_mm_s)
        self._link.set(Parameter.ACCELERATION_MM_S2, stroke.acceleration_mm_s2)
        self._written = stroke.speed_mm_s, stroke.acceleration_mm_s2

    def _request(self, stroke: Stroke) -> Request:
        return Request(Command.GO, value=self._origin_mm + stroke.end_mm)

    def _go(self, stroke: Stroke) -> None:
        request = self._request(stroke)
        try:
            self._link.exchange(request, self.planned_at)
        except RefusedError as error:
            # A refused request had no effect, so that it may be sent again once the previous stroke has ended.
            if error.refusal is not Refusal.MOVING or not self._accepted:
                raise
            self._await_standstill()
            self._link.exchange(request, self.planned_at)

    def _await_standstill(self) -> None:
        until_s = time.monotonic() + _STROKE_END_TIMEOUT_S
        while time.monotonic() < until_s:
            status = self._link.exchange(Request(Command.STATUS), self.planned_at).status
            if status is not None and not status.moving:
                return

    def _sleep_until(self, due_s: float) -> None:
        if not self._clock.sleep(due_s - self._clock.monotonic(), self._cancel):
            raise CancelledByStopError("the stage was stopped before the motion was over.")


class _PulseMovement(Movement):
    """A motion that the program ends by a stop of its own, which is no fault."""

    def stop_trip(self, status: Status, requested_s: float) -> Trip | None:
        return None if status.halt is Halt.STOP else super().stop_trip(status, requested_s)


_PULSE_TIMEOUT_S = 1.0
_PULSE_POLL_S = 0.005
_HOMING_POLL_S = 0.02
_SILENCE_MARGIN_S = 0.2
"""For a drive without a silence timeout, whose enable line is cleared within 0.1 s after it."""
_STANDSTILL_TIMEOUT_S = 1.0
_MAX_END_ERROR_MM = 0.05
_HOMING_OVERTRAVEL_MM = 50.0
"""How much longer than between the soft limits the way to a limit switch may be."""


class PositionModeStage(MonitoredStage):
    """One axis in position mode. It monitors drive and switches from its construction until `close`.

    Parameters
    ----------
    counter
        A counter of the card that nothing else uses, to compare drive and encoder; None on a bench without a card.

    Raises
    ------
    DeviceError
        When the drive does not answer.
    """

    def __init__(self, devices: StageDevices, counter: PositionCounter | None = None) -> None:
        settings = devices.settings
        braking_s = settings.stage.max_speed_mm_s / settings.stage.stop_accel_mm_s2
        super().__init__(devices, settings.hardware.drive.silence_s + braking_s + _SILENCE_MARGIN_S)
        self._devices, self._counter = devices, counter
        self._strokes: StrokeMovement | None = None
        self._link.on_stop(self._heed_stop)
        if self._tracker.status.moving:
            self._stop_leftover_motion()
        self._monitor.start()

    @property
    def start_uncertainty_s(self) -> float:
        """Uncertainty of the start of any stroke of the last motion, as measured on the link."""
        return 0.0 if self._strokes is None else self._strokes.start_uncertainty_s

    def enable(self) -> None:
        """Switch the drive on, which holds the position."""
        with self._commands:
            self._refuse_fault()
            self._power_on()

    def creep(self, travel_mm: float, speed_mm_s: float) -> None:
        """Begin to move slowly to where there is room, or to home where the position is not known; the caller ends it.

        Raises `DeviceError` as `move`.
        """
        planned_at = self._stop_count
        with self._commands:
            self._refuse_not_ready()
            write_safeguards(self._link, self._settings)
            if self._is_homed:
                begin_mm, limits = self._position_mm(), self.limits
                upward = begin_mm + travel_mm <= limits.highest_mm
                write_travel(self._link, limits)
                self._link.set(Parameter.SPEED_MM_S, speed_mm_s)
                self._link.set(Parameter.ACCELERATION_MM_S2, PULSE_ACCELERATION_MM_S2)
                request = Request(Command.GO, value=begin_mm + (travel_mm if upward else -travel_mm))
            else:
                self._link.set(Parameter.HOMING_SPEED_MM_S, speed_mm_s)
                request = Request(Command.HOME, value=-1.0 if self._drive.homing_direction == "low" else 1.0)
            self._begin(request, planned_at)

    def await_end(self, cancel: Signal) -> None:
        """Wait as every stage; raises `DeviceError` too when the drive then stands elsewhere than it was sent to."""
        super().await_end(cancel)
        strokes = self._strokes
        if strokes is None or strokes.is_stopped or self.fault is not None or cancel.is_set():
            return
        position_mm = self._tracker.position_mm()
        if not abs(position_mm - strokes.end_mm) <= _MAX_END_ERROR_MM:
            raise DeviceError(
                f"the drive stands at {position_mm:.3f} mm after a motion to {strokes.end_mm:.3f} mm: it was held up, "
                "or missed commands; look whether the stage moves freely, then home it."
            )

    def stop(self) -> None:
        """Brake to a standstill; the drive receives it at the latest after the reply in progress on the link."""
        self._sync.set_stop_requested()
        self._link.stop()

    def close(self) -> None:
        """Stop, and disconnect from the drive. Safe to call twice."""
        self._link.stop()
        self._monitor.close()
        self._link.close()

    @property
    def _is_enabled(self) -> bool:
        return self._tracker.status.enabled

    @property
    def _is_homed(self) -> bool:
        return self._tracker.status.homed

    @property
    def _stop_count(self) -> int:
        return self._link.stop_count

    def _position_mm(self) -> float:
        return self._tracker.position_mm()

    def _make_pulse(self, planned_at: int) -> Pulse | None:
        counter = self._counter
        if counter is None:
            return None
        try:
            pulse = None if self._is_homed else self._measured(counter, self._pulse_homing, planned_at)
            # A drive that came to its index meanwhile has another zero now.
            return self._measured(counter, self._pulse_to, planned_at) if self._is_homed else pulse
        finally:
            counter.close()

    def _measured(self, counter: PositionCounter, pulse: Callable[[float, int], Pulse], planned_at: int) -> Pulse:
        comes_back = self._is_homed and self._override is None
        counter.begin(0.0)
        begin_mm = self._position_mm()
        measured = replace(pulse(begin_mm, planned_at), counted_mm=counter.read())
        if comes_back and self._stop_count == planned_at and self.fault is None:
            self._go(begin_mm, planned_at)
        return measured

    def _pulse_to(self, begin_mm: float, planned_at: int) -> Pulse:
        """Move by a pulse away from an overridden switch, or to where there is room; return it, not counted yet."""
        limits = limits_with_override(self.limits, self._override, begin_mm)
        upward = self._override is TravelEnd.LOW or (
            self._override is None and begin_mm + PULSE_MM <= limits.highest_mm
        )
        travel_mm = PULSE_MM if upward else -PULSE_MM
        write_travel(self._link, limits)
        self._link.set(Parameter.SPEED_MM_S, min(PULSE_SPEED_MM_S, limits.speed_mm_s))
        self._link.set(Parameter.ACCELERATION_MM_S2, min(PULSE_ACCELERATION_MM_S2, limits.acceleration_mm_s2))
        self._go(begin_mm + travel_mm, planned_at)
        return Pulse(travel_mm, self._position_mm() - begin_mm, 0.0)

    def _go(self, target_mm: float, planned_at: int) -> None:
        try:
            self._begin(Request(Command.GO, value=target_mm), planned_at)
        finally:
            self._await_standstill(self._drive.silence_s + _PULSE_TIMEOUT_S)

    def _begin(self, request: Request, planned_at: int) -> None:
        movement = _PulseMovement(self._link, planned_at)
        self._tracker.begin(movement)
        try:
            self._link.exchange(request, planned_at)
        finally:
            movement.mark_started()
            movement.mark_complete()

    def _pulse_homing(self, begin_mm: float, planned_at: int) -> Pulse:
        """Begin to home and stop after a pulse's travel: a drive that is not homed may take no other command.

        From its switch it goes on until that is released, so that the homing after it begins beside the switch.
        """
        side = TravelEnd(self._drive.homing_direction)
        self._link.set(Parameter.HOMING_SPEED_MM_S, min(PULSE_SPEED_MM_S, self._drive.homing_speed_mm_s))
        on_switch, position_mm = self._is_on_switch(side), begin_mm
        way = HomingWay(side, begin_mm, on_switch=on_switch)
        movement = _PulseMovement(self._link, planned_at)
        self._monitor.tolerate(LIMIT_SWITCH_CAUSES[side])
        self._tracker.begin(movement)
        try:
            self._link.exchange(Request(Command.HOME, value=-1.0 if side is TravelEnd.LOW else 1.0), planned_at)
            movement.mark_started()
            until_s = time.monotonic() + _PULSE_TIMEOUT_S
            while (abs(position_mm - begin_mm) < PULSE_MM or on_switch) and time.monotonic() < until_s:
                if movement.is_stopped or self.fault is not None:
                    break
                time.sleep(_PULSE_POLL_S)
                on_switch, position_mm = self._is_on_switch(side), self._position_mm()
                way.add(position_mm, on_switch=on_switch)
            self._link.exchange(Request(Command.STOP))
        except DeviceError:
            self._link.stop()
            raise
        finally:
            movement.mark_started()
            movement.mark_complete()
            self._await_standstill(self._drive.silence_s + _STANDSTILL_TIMEOUT_S)
        return Pulse(None, self._position_mm() - begin_mm, 0.0, way.is_wrong())

    def _find_index(self, side: TravelEnd, planned_at: int) -> None:
        speed_mm_s, key = self._drive.homing_speed_mm_s, "hardware.drive.homing_speed_mm_s"
        self._link.set_and_verify(Parameter.HOMING_SPEED_MM_S, speed_mm_s, key)
        way = HomingWay(side, self._position_mm(), on_switch=self._is_on_switch(side))
        movement = Movement(self._link, planned_at)
        self._monitor.tolerate(LIMIT_SWITCH_CAUSES[side])
        self._tracker.begin(movement)
        try:
            self._link.exchange(Request(Command.HOME, value=-1.0 if side is TravelEnd.LOW else 1.0), planned_at)
        except DeviceError:
            self._link.stop()
            raise
        finally:
            # Whether or not it answered, it may move from here on.
            movement.mark_started()
            movement.mark_complete()
            self._await_homed(side, way)
        self._refuse_fault()
        if way.is_wrong(PULSE_MM):
            raise DeviceError(f"the drive homes the wrong way, and was stopped: {homing_remedy(self._settings)}.")
        if movement.is_stopped or not self._is_homed:
            raise DeviceError("homing ended before the index pulse was found: clear the way, then home again.")

    def _await_homed(self, side: TravelEnd, way: HomingWay) -> None:
        travel_mm = self.limits.highest_mm - self.limits.lowest_mm + _HOMING_OVERTRAVEL_MM
        # Onto the switch and back.
        until_s = self._clock.monotonic() + 2 * travel_mm / self._drive.homing_speed_mm_s
        while not self._await_standstill(_HOMING_POLL_S):
            # What a drive that does not answer means for the motion is the monitor's to say.
            with suppress(DeviceError):
                way.add(self._position_mm(), on_switch=self._is_on_switch(side))
            if way.is_wrong(PULSE_MM) or self._clock.monotonic() > until_s:
                break
        else:
            return
        self._link.stop()
        if not self._await_standstill(self._drive.silence_s + _STANDSTILL_TIMEOUT_S):
            raise DeviceError(
                "the drive reports that it still moves, although homing was ended by a stop: switch its power off by "
                "hand, and inspect the rig."
            )

    def _follow(self, profile: MotionProfile, origin_mm: float, limits: StageLimits, planned_at: int) -> None:
        strokes = split_into_strokes(profile)
        if not strokes:
            return
        began_s, wall_s = self._clock.monotonic(), time.perf_counter()
        write_safeguards(self._link, self._settings)
        write_travel(self._link, limits)
        self._link.set_and_verify(Parameter.SPEED_MM_S, strokes[0].speed_mm_s, "the motion's speed")
        acceleration = strokes[0].acceleration_mm_s2
        self._link.set_and_verify(Parameter.ACCELERATION_MM_S2, acceleration, "the motion's acceleration")
        pace = (self._clock.monotonic() - began_s) / (time.perf_counter() - wall_s)
        self._refuse_late_start(strokes[0].start_s)
        self._strokes = StrokeMovement(
            self._devices,
            strokes,
            origin_mm,
            planned_at,
            self._link.round_trip_s * pace,
            lambda error: self._monitor.latch(Trip(TripCause.DRIVE_FAULT, reason_of(error))),
            self._all_sent,
        )
        self._watchdog.feed()
        self._tracker.begin(self._strokes)
        self._strokes.start()

    def _come_to_rest(self) -> None:
        self._await_standstill(self._drive.silence_s + _STANDSTILL_TIMEOUT_S)

    def _stop_leftover_motion(self) -> None:
        # Left by a program that was killed; polling keeps the drive's silence timeout from ending it.
        movement = Movement(self._link, self._link.stop_count)
        movement.mark_complete()
        self._tracker.begin(movement)
        self._link.stop()

    def _heed_stop(self) -> None:
        self._tracker.cancel_stopped()
        self._monitor.poll_fast()

    def _all_sent(self, strokes: StrokeMovement) -> None:
        if strokes.was_sent:
            self._monitor.poll_fast()
        else:
            self._tracker.drop_movement()
