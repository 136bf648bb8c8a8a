"""Common to the stages of both drive modes: drive state, limits, override of a limit switch, checks before motion.

`DriveTracker` polls the drive and knows when a movement is over; `MonitoredStage` is the base of the two stages.
"""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from math import isfinite
from threading import Event as Signal

from dragrig.config import DeviceError, RigSettings
from dragrig.rig import (
    LIMIT_SWITCH_CAUSES,
    MAX_BLOCK_S,
    MotionProfile,
    StageLimits,
    StageState,
    TravelEnd,
    Trip,
    TripCause,
    limits_with_override,
    require_within_limits,
    stage_limits,
)
from dragrig.rig.hardware.dialects import Command, Halt, Lack, Parameter, Refusal, Request, Status
from dragrig.rig.hardware.drive.link import DriveLink, RefusedError
from dragrig.rig.hardware.drive.monitor import Monitor, StageDevices
from dragrig.rig.hardware.drive.trial import Pulse

POSITION_TOLERANCE_MM = 2e-3
"""A stage that stands a count or two beyond its limit is not refused."""
_START_GRACE_S = 0.1
"""For so long after a command the drive may go on reporting standstill, and why it stopped before."""
_ENABLE_TIMEOUT_S = 0.5
_ENABLE_RETRY_S = 0.01
_STANDSTILL_POLL_S = 0.01
_TRIP_CAUSES = {Halt.SILENCE: TripCause.WATCHDOG, Halt.EMERGENCY_STOP: TripCause.EMERGENCY_STOP}


class Movement:
    """A command that keeps the drive moving for a while: homing, or one stroke after the other.

    Times are readings of `time.monotonic`.

    Parameters
    ----------
    planned_at
        `link.stop_count` when it was planned: a stop requested since drops it.
    """

    def __init__(self, link: DriveLink, planned_at: int) -> None:
        self._link = link
        self.planned_at = planned_at
        self._started_s: float | None = None
        self._complete_s: float | None = None
        self._seen_moving = False

    @property
    def is_stopped(self) -> bool:
        """Whether a stop was requested since it was planned."""
        return self._link.stop_count != self.planned_at

    @property
    def direction(self) -> float:
        """Sign of the present velocity; 0 when it is not known."""
        return 0.0

    def mark_started(self) -> None:
        """Record that the drive has accepted the command; only its reports from here on count."""
        self._started_s, self._seen_moving = time.monotonic(), False

    def mark_complete(self) -> None:
        """Record that no further command follows; earlier status reports do not end it. Safe to call twice."""
        if self._complete_s is None:
            self._complete_s = time.monotonic()

    def cancel(self) -> None:
        """Send nothing more."""

    def is_over(self, status: Status, requested_s: float) -> bool:
        """Whether a status, requested at a time, shows that nothing moves any more and nothing will."""
        if self._complete_s is None or requested_s < self._complete_s or status.moving:
            return False
        return self._started_s is None or self._has_set_out(requested_s)

    def stop_trip(self, status: Status, requested_s: float) -> Trip | None:
        """Return why the drive stopped by itself; None when it did not."""
        self._seen_moving |= status.moving and self._started_s is not None and requested_s >= self._started_s
        regular = {Halt.TARGET, Halt.UNKNOWN, Halt.NONE} | ({Halt.STOP} if self.is_stopped else set())
        if status.moving or status.halt in regular or not self._has_set_out(requested_s):
            return None
        cause = _TRIP_CAUSES.get(status.halt, TripCause.DRIVE_FAULT)
        if status.halt is Halt.LIMIT_SWITCH and self.direction:
            cause = TripCause.LIMIT_SWITCH_LOW if self.direction < 0 else TripCause.LIMIT_SWITCH_HIGH
        return Trip(cause, f"the drive stopped by itself, because {status.halt}")

    def _has_set_out(self, requested_s: float) -> bool:
        if self._started_s is None or requested_s < self._started_s:
            return False
        return self._seen_moving or self.is_stopped or requested_s >= self._started_s + _START_GRACE_S


class DriveTracker:
    """The drive's last reported status, and the movement in progress. Any thread may call any method.

    Parameters
    ----------
    self_stop_s
        After so long without an answer, in wall time, the drive has stopped by itself.
    on_over
        Called when a movement is over.

    Raises
    ------
    DeviceError
        When the drive does not answer.
    """

    def __init__(self, devices: StageDevices, self_stop_s: float, on_over: Callable[[], None]) -> None:
        self._link, self._sync, self._on_over = devices.link, devices.sync, on_over
        self._self_stop_s = self_stop_s
        self._lock = self.ending = threading.RLock()
        """`ending`: held while a movement ends."""
        self._movement: Movement | None = None
        self._stop_trip: Trip | None = None
        self._answered_s = time.monotonic()
        self.status = self._request_status()
        """The status that the drive reported last."""
        # A drive left on by a program that was killed goes off with its enable line, which is no fault of its own.
        self._switched_on = False

    def begin(self, movement: Movement) -> None:
        """Track a movement from here on."""
        with self._lock:
            self._movement = movement
            self._answered_s = time.monotonic()
            self._sync.set_moving(True)

    def cancel_stopped(self) -> None:
        """Have the movement in progress send nothing more, if a stop was requested since it was planned."""
        movement = self._movement
        # Whoever heeds a stop may do so late, when the motion after it has begun: that goes on.
        if movement is not None and movement.is_stopped:
            movement.cancel()

    def drop_movement(self) -> None:
        """End a movement that the drive never got a command for."""
        with self._lock:
            self._end_movement()

    def set_switched_on(self, on: bool) -> None:
        """Set whether the drive is meant to be on; switching it off clears why it stopped."""
        with self._lock:
            self._switched_on = on
            self._stop_trip = self._stop_trip if on else None

    def clear_stop_cause(self, cause: TripCause) -> None:
        """Clear that the drive stopped by itself for this cause."""
        with self._lock:
            if self._stop_trip is not None and self._stop_trip.cause is cause:
                self._stop_trip = None

    def poll(self) -> Trip | None:
        """Request the drive's status and return the fault that forbids motion.

        Raises `DeviceError` when it does not answer, or its port fails. After `self_stop_s` without an answer it counts
        as standing.
        """
        requested_s = time.monotonic()
        try:
            status = self._request_status()
        except DeviceError:
            with self._lock:
                if time.monotonic() - self._answered_s > self._self_stop_s:
                    self._end_movement()
            raise
        with self._lock:
            self._answered_s, self.status = requested_s, status
            if self._movement is not None:
                self._stop_trip = self._stop_trip or self._movement.stop_trip(status, requested_s)
                if self._movement.is_over(status, requested_s):
                    self._end_movement()
            return self._trip(status)

    def position_mm(self) -> float:
        """Request the position; raises `DeviceError` when the drive does not answer, or with no number."""
        value = self._link.exchange(Request(Command.POSITION)).value
        if value is None or not isfinite(value):
            raise DeviceError(
                f"the drive on {self._link.port} answered without a position: check hardware.drive.dialect."
            )
        return value

    def _request_status(self) -> Status:
        status = self._link.exchange(Request(Command.STATUS)).status
        if status is None:
            raise DeviceError(
                f"the drive on {self._link.port} answered without a status: check hardware.drive.dialect."
            )
        return status

    def _trip(self, status: Status) -> Trip | None:
        if status.alarm:
            return Trip(TripCause.DRIVE_FAULT, f"the drive reports {self._link.dialect.alarm(status.alarm)}")
        if self._stop_trip is not None:
            return self._stop_trip
        if self._switched_on and not status.enabled:
            return Trip(TripCause.DRIVE_FAULT, "the drive switched itself off")
        return None

    def _end_movement(self) -> None:
        if self._movement is not None:
            self._movement = None
            self._on_over()
            self._sync.set_moving(False)


def write_safeguards(link: DriveLink, settings: RigSettings) -> None:
    """Write thrust limit, silence timeout (if it has one) and the deceleration of a stop, and read each back.

    Raises `DeviceError` when the drive holds another value than the one that was written, refuses, or does not answer.
    """
    drive = settings.hardware.drive
    for parameter, value, key in (
        (Parameter.THRUST_LIMIT_N, drive.thrust_limit_N, "hardware.drive.thrust_limit_N"),
        (Parameter.SILENCE_S, drive.silence_s, "hardware.drive.silence_s"),
        (Parameter.STOP_ACCELERATION_MM_S2, settings.stage.stop_accel_mm_s2, "stage.stop_accel_mm_s2"),
    ):
        if parameter is not Parameter.SILENCE_S or Lack.SILENCE_TIMEOUT not in link.dialect.lacks:
            link.set_and_verify(parameter, value, key)


def write_travel(link: DriveLink, limits: StageLimits) -> None:
    """Write the soft limits to the drive and read them back; raises as `write_safeguards`."""
    link.set_and_verify(Parameter.LOWEST_MM, limits.lowest_mm, "stage.lowest_mm")
    link.set_and_verify(Parameter.HIGHEST_MM, limits.highest_mm, "stage.highest_mm")


class MonitoredStage(ABC):
    """A stage with drive and switches monitored from the monitor's start until `close`.

    Parameters
    ----------
    self_stop_s
        After so long without an answer, in wall time, the drive has stopped by itself.

    Raises
    ------
    DeviceError
        When the drive does not answer.
    """

    def __init__(self, devices: StageDevices, self_stop_s: float) -> None:
        settings = devices.settings
        self._settings, self._drive, self._clock = settings, settings.hardware.drive, devices.clock
        self._link, self._lines, self._sync = devices.link, devices.lines, devices.sync
        self._watchdog = devices.watchdog
        self.limits = stage_limits(settings.stage)
        """Soft limits of travel, and the greatest speed and acceleration."""
        self._max_late_s = settings.guard.stale_data_s
        # One command at a time; a stop waits for none.
        self._commands = threading.RLock()
        self._override: TravelEnd | None = None
        self._trial_due = True
        self._tracker = DriveTracker(devices, self_stop_s, self._end_override)
        self._monitor = Monitor(devices, self._tracker.poll, self.stop, self._may_beat, self._tracker.ending)

    @property
    def fault(self) -> Trip | None:
        """The fault that drive and switches reported at the last poll; a latched one stays until `disable`."""
        return self._monitor.fault

    @property
    def late_replies(self) -> int:
        """How many replies of the drive came late so far, and were good all the same."""
        return self._link.late_replies

    @property
    @abstractmethod
    def start_uncertainty_s(self) -> float:
        """Uncertainty of the last motion's time 0 against the first sample."""

    def state(self) -> StageState:
        """Poll drive, switches and position now; raises `DeviceError` when drive or card do not answer."""
        fault = self._monitor.poll()
        was_moving, position_mm = self._sync.moving, self._position_mm()
        if was_moving and not self._sync.moving:
            # It came to rest after the position was read, which is then not where it stands.
            position_mm = self._position_mm()
        drive_mm = self._drive_position_mm(position_mm)
        return StageState(position_mm, self._is_enabled, self._is_homed, self._sync.moving, fault, drive_mm)

    def _drive_position_mm(self, position_mm: float) -> float:
        """Return the drive's own position; `position_mm` is that of `_position_mm`."""
        return position_mm

    @abstractmethod
    def enable(self) -> None:
        """Switch the drive on and hold the position.

        Raises `DeviceError` when something forbids motion: remove the cause, then `disable`; or when drive or card
        refuse or are silent.
        """

    @property
    def trial_due(self) -> bool:
        """Whether the first motion has yet to show that command, drive and encoder agree."""
        return self._trial_due

    def prove_motion(self) -> None:
        """Move by a short pulse, if none has been made since connecting, and compare command, drive and encoder.

        Homing and moves do so by themselves. Raises `DeviceError` as they do, and when the three do not agree.
        """
        planned_at = self._stop_count
        with self._commands:
            self._refuse_not_ready()
            write_safeguards(self._link, self._settings)
            self._prove_motion(planned_at)

    def home(self) -> None:
        """Find the index pulse, which becomes 0; return when the stage stands there, or at the soft limit next to it.

        Raises
        ------
        DeviceError
            When the drive is off, moving, has a fault, refuses, or stops before the pulse was found.
        SettingsError
            When the program homes and limit switch or index pulse are not wired.
        """
        planned_at = self._stop_count
        with self._commands:
            side = TravelEnd(self._drive.homing_direction)
            self._refuse_not_ready(ignoring=LIMIT_SWITCH_CAUSES[side])
            write_safeguards(self._link, self._settings)
            self._prove_motion(planned_at, ignoring=LIMIT_SWITCH_CAUSES[side])
            self._find_index(side, planned_at)

    def move(self, profile: MotionProfile) -> None:
        """Begin to follow a profile: now, or with the first sample when the sampler is armed.

        Raises `DeviceError` when the drive is off, not homed, moving, has a fault, refuses or does not answer; when the
        first sample is too long past; when the profile leaves the stage's limits, does not end at a standstill, or
        cannot be made in the drive's mode; and when the drive does not hold a limit that was written to it.
        """
        planned_at = self._stop_count
        with self._commands:
            self._refuse_not_ready()
            if not self._is_homed:
                raise DeviceError("the stage does not know its position: home it before it moves.")
            if profile.duration_s <= 0:
                return
            limits = self._checked_limits(profile, self._origin_mm())
            self._prove_motion(planned_at)
            self._follow(profile, self._origin_mm(), limits, planned_at)

    def withholding(self, *, polls: bool = False, beats: bool = False) -> AbstractContextManager[None]:
        """Neither poll the drive nor beat for a while, as chosen: whether it goes off then is being tried."""
        return self._monitor.withholding(polls=polls, beats=beats)

    @property
    def last_beat_s(self) -> float:
        """When the heartbeat last changed its line, as of `time.monotonic`."""
        return self._monitor.last_beat_s

    def beat_late_since(self, from_s: float) -> bool:
        """Return whether a relay may have opened since a `time.monotonic`: a beat came late, or is late now."""
        return self._monitor.beat_late_since(from_s)

    def await_end(self, cancel: Signal) -> None:
        """Wait until the motion begun last is over, for `guard.stale_data_s` at most: no sample is taken any more.

        Returns early once `cancel` is set or `fault` reports something. Raises `DeviceError` when it still moves then.
        """
        if self._await_standstill(self._max_late_s, cancel):
            return
        raise DeviceError(
            f"the drive had not made its motion {self._max_late_s:g} s after the time for it was over, and was stopped "
            "on its way: it begins too late, is slower than commanded, or this computer is overloaded."
        )

    @abstractmethod
    def stop(self) -> None:
        """Brake to a standstill now; an acquisition in progress ends there. Safe at any time, from any thread.

        Returns at once.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop, and disconnect from the drive. Safe to call twice."""

    @property
    @abstractmethod
    def _is_enabled(self) -> bool: ...

    @property
    @abstractmethod
    def _is_homed(self) -> bool: ...

    @property
    @abstractmethod
    def _stop_count(self) -> int:
        """Number of stops requested so far: a motion that was planned at a lower count is dropped."""

    @abstractmethod
    def _position_mm(self) -> float: ...

    def _origin_mm(self) -> float:
        """Return the position from which a motion starts."""
        return self._position_mm()

    def _prove_motion(self, planned_at: int, ignoring: TripCause | None = None) -> None:
        if not self._trial_due:
            return
        override = self._override
        pulse = self._make_pulse(planned_at)
        if override is not None:
            # It holds for one motion, and that is still to come.
            self.override_limit(override)
            ignoring = LIMIT_SWITCH_CAUSES[override]
        self._refuse_fault(ignoring)
        if self._stop_count != planned_at:
            raise DeviceError("the stage was stopped while a short motion was to show that it moves as told.")
        if pulse is not None and (problem := pulse.problem(self._settings)):
            raise DeviceError(f"the first motion was not as commanded, and nothing else moves: {problem}.")
        self._trial_due = False

    @abstractmethod
    def _make_pulse(self, planned_at: int) -> Pulse | None:
        """Move by a pulse and return it; None where there is no encoder to compare with."""

    @abstractmethod
    def _find_index(self, side: TravelEnd, planned_at: int) -> None:
        """Home over the limit switch of a side."""

    @abstractmethod
    def _follow(self, profile: MotionProfile, origin_mm: float, limits: StageLimits, planned_at: int) -> None:
        """Write the limits to the drive and begin to follow a profile."""

    @abstractmethod
    def _come_to_rest(self) -> None:
        """Wait for standstill after a stop, for a limited time, and hold the stage no longer."""

    def disable(self) -> None:
        """Stop, switch the drive off, and clear its alarm and the latched fault.

        Raises `DeviceError` when the drive does not answer; its enable line is cleared all the same.
        """
        self.stop()
        with self._commands:
            try:
                self._come_to_rest()
                self._set_switched_on(on=False)
                self._power_off()
            finally:
                self._end_override()
                self._monitor.clear()
                self._monitor.poll()

    def override_limit(self, side: TravelEnd) -> None:
        """Let a pressed limit switch forbid nothing until the next move has ended, which must lead slowly away from it.

        Raises
        ------
        DeviceError
            While the stage moves.
        """
        with self._commands:
            self._refuse_moving()
            self._override = side
            self._monitor.tolerate(LIMIT_SWITCH_CAUSES[side])
            self._tracker.clear_stop_cause(LIMIT_SWITCH_CAUSES[side])
            self._monitor.poll()

    def _is_on_switch(self, side: TravelEnd) -> bool:
        switches = self._lines.read_switches()
        return switches.limit_low if side is TravelEnd.LOW else switches.limit_high

    def _may_beat(self) -> bool:
        """Whether the heartbeat relay may keep the drive's power on."""
        return True

    def _power_on(self) -> None:
        """Set the enable line and switch the drive on; raises `DeviceError`."""
        self._lines.set_enable(True)
        try:
            self._exchange_enable()
        except DeviceError:
            self._lines.set_enable(False)
            raise
        self._set_switched_on(on=True)
        self._monitor.poll()

    def _exchange_enable(self) -> None:
        until_s = time.monotonic() + _ENABLE_TIMEOUT_S
        while True:
            try:
                self._link.exchange(Request(Command.ENABLE))
            except RefusedError as error:
                # A drive takes a while to see its enable line, and a relay to see its first edges.
                if error.refusal is not Refusal.DISABLED or time.monotonic() > until_s:
                    raise
                time.sleep(_ENABLE_RETRY_S)
            else:
                return

    def _power_off(self) -> None:
        """Switch the drive off, clear its alarm, and clear the enable line even when the drive does not answer."""
        try:
            self._link.exchange(Request(Command.DISABLE))
            self._link.exchange(Request(Command.CLEAR_ALARM))
        finally:
            self._lines.set_enable(False)

    def _set_switched_on(self, on: bool) -> None:
        self._tracker.set_switched_on(on)
        self._monitor.set_drive_on(on)

    def _end_override(self) -> None:
        self._override = None
        self._monitor.tolerate(None)

    def _checked_limits(self, profile: MotionProfile, origin_mm: float) -> StageLimits:
        """Return the limits of a profile from a position, with an override; raises `DeviceError` beyond them.

        With an overridden limit switch, a motion towards it, or away from it in haste, is refused.
        """
        if self._override is not None:
            extremes, max_mm_s = profile.extremes(), self._drive.homing_speed_mm_s
            further_mm = -extremes.lowest_mm if self._override is TravelEnd.LOW else extremes.highest_mm
            if not further_mm <= POSITION_TOLERANCE_MM:
                switch = LIMIT_SWITCH_CAUSES[self._override]
                raise DeviceError(f"the {switch} is overridden for a move away from it only: reverse the travel.")
            if not extremes.speed_mm_s <= max_mm_s * (1 + 1e-9):
                raise DeviceError(
                    f"off an overridden limit switch the stage moves at {max_mm_s:g} mm/s at most, not at "
                    f"{extremes.speed_mm_s:g} (hardware.drive.homing_speed_mm_s of the rig file)."
                )
        limits = limits_with_override(self.limits, self._override, origin_mm)
        require_within_limits(profile, origin_mm, limits, POSITION_TOLERANCE_MM)
        return limits

    def _refuse_late_start(self, start_s: float) -> None:
        """Refuse a motion that was to begin `start_s` after the first sample, more than a block ago."""
        first = self._sync.first_sample
        if first is not None and self._clock.monotonic() > first.at_s + start_s + MAX_BLOCK_S:
            raise DeviceError("the move was requested too long after the first sample: start it before.")

    def _refuse_fault(self, ignoring: TripCause | None = None) -> None:
        fault = self._monitor.poll()
        if fault is not None and fault.cause is not ignoring:
            raise DeviceError(f"{fault.message}: remove the cause, then switch the drive off and on.")

    def _refuse_moving(self) -> None:
        if self._sync.moving:
            raise DeviceError("the stage is still moving: wait until it stands or stop it first.")

    def _refuse_not_ready(self, ignoring: TripCause | None = None) -> None:
        self._refuse_fault(ignoring)
        if not self._is_enabled:
            raise DeviceError("the drive is off: enable the stage first.")
        self._refuse_moving()

    def _await_standstill(self, timeout_s: float, cancel: Signal | None = None) -> bool:
        """Wait until nothing moves, at most `timeout_s` of wall time; return whether the stage stands.

        With `cancel`, also return True once that is set or something forbids motion.
        """
        until_s = time.monotonic() + timeout_s
        while self._sync.moving:
            if cancel is not None and (cancel.is_set() or self.fault is not None):
                return True
            if time.monotonic() > until_s:
                return False
            self._monitor.poll()
            if self._sync.moving:
                time.sleep(_STANDSTILL_POLL_S)
        return True
