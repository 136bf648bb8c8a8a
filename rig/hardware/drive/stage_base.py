"""What the stages of both drive modes share: drive state, limits, override of a limit switch, checks before motion.

`DriveTracker` polls the drive and knows when a movement is over; `MonitoredStage` is the base of the two stages.
"""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable

from dragrig.config.errors import DeviceError
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import (
    MAX_BLOCK_S,
    Clock,
    StageLimits,
    StageState,
    TravelEnd,
    Trip,
    TripCause,
    limits_with_override,
    require_within_limits,
    stage_limits,
)
from dragrig.rig.guard import LIMIT_SWITCH_CAUSES
from dragrig.rig.hardware.dialects.base import Command, Halt, Refusal, Request, Status
from dragrig.rig.hardware.drive.link import DriveLink, NoReplyError, RefusedError
from dragrig.rig.hardware.drive.monitor import Monitor, Watchdog, poll_interval_s
from dragrig.rig.hardware.lines import DigitalLines
from dragrig.rig.hardware.sync import MotionSamplingSync
from dragrig.rig.profile import MotionProfile

_START_GRACE_S = 0.1
"""So long a drive that has taken a command may go on saying that it stands, and why it stood before."""
_TRIP_CAUSES = {Halt.SILENCE: TripCause.WATCHDOG, Halt.EMERGENCY_STOP: TripCause.EMERGENCY_STOP}


class Movement:
    """A command that keeps the drive moving for a while: homing, or one stroke after the other.

    Times are readings of `time.monotonic`.

    Parameters
    ----------
    as_of
        What `link.stops` was when it was planned: a stop since then, even one before it was made, drops it.
    """

    def __init__(self, link: DriveLink, as_of: int) -> None:
        self._link = link
        self._as_of = as_of
        self._began_s: float | None = None
        self._complete_s: float | None = None
        self._seen_moving = False

    @property
    def as_of(self) -> int:
        """Mark of the latest stop that was asked for before this was planned."""
        return self._as_of

    @property
    def is_stopped(self) -> bool:
        """Whether a stop was asked for since it was planned."""
        return self._link.stops != self._as_of

    @property
    def direction(self) -> float:
        """Which way it goes at present: below or above 0, or 0 when that is not known."""
        return 0.0

    def begun(self) -> None:
        """Say that the drive has taken the command; only what it says from here on counts."""
        self._began_s, self._seen_moving = time.monotonic(), False

    def complete(self) -> None:
        """Say that no further command follows; what the drive said before does not end it. Twice is once."""
        if self._complete_s is None:
            self._complete_s = time.monotonic()

    def cancel(self) -> None:
        """Send nothing more."""

    def is_over(self, status: Status, asked_s: float) -> bool:
        """Whether a status, asked for at a time, says that nothing moves any more and nothing will."""
        if self._complete_s is None or asked_s < self._complete_s or status.moving:
            return False
        return self._began_s is None or self._has_set_out(asked_s)

    def mishap(self, status: Status, asked_s: float) -> Trip | None:
        """Return why the drive ended it by itself; None while it did not."""
        self._seen_moving |= status.moving and self._began_s is not None and asked_s >= self._began_s
        fine = {Halt.TARGET, Halt.UNKNOWN, Halt.NONE} | ({Halt.STOP} if self.is_stopped else set())
        if status.moving or status.halt in fine or not self._has_set_out(asked_s):
            return None
        cause = _TRIP_CAUSES.get(status.halt, TripCause.DRIVE_FAULT)
        if status.halt is Halt.LIMIT_SWITCH and self.direction:
            cause = TripCause.LIMIT_SWITCH_LOW if self.direction < 0 else TripCause.LIMIT_SWITCH_HIGH
        return Trip(cause, f"the drive stopped by itself, because {status.halt}")

    def _has_set_out(self, asked_s: float) -> bool:
        if self._began_s is None or asked_s < self._began_s:
            return False
        return self._seen_moving or self.is_stopped or asked_s >= self._began_s + _START_GRACE_S


class DriveTracker:
    """The drive's state as last heard, and the movement under way. Any thread may call anything.

    Parameters
    ----------
    patience_s
        For so long a drive that does not answer counts as it was last heard: a busy computer is no fault.
    unheard_s
        After so long without an answer the drive has stopped by itself, of the wall's clock.
    over
        Called when a movement is over.

    Raises
    ------
    DeviceError
        When the drive does not answer.
    """

    def __init__(
        self,
        link: DriveLink,
        coupling: MotionSamplingSync,
        patience_s: float,
        unheard_s: float,
        over: Callable[[], None],
    ) -> None:
        self._link, self._coupling, self._over = link, coupling, over
        self._patience_s, self._unheard_s = patience_s, unheard_s
        self._lock = threading.RLock()
        self._movement: Movement | None = None
        self._mishap: Trip | None = None
        self._heard_s = time.monotonic()
        self._status = self._ask()
        # Left on by a program that was killed, it goes off with its enable line, which is no fault of its own.
        self._switched_on = False

    @property
    def status(self) -> Status:
        """What the drive said last."""
        return self._status

    def begin(self, movement: Movement) -> None:
        """Follow a movement from here on."""
        with self._lock:
            self._movement = movement
            self._heard_s = time.monotonic()
            self._coupling.set_moving(True)

    def cancel(self) -> None:
        """Let the movement under way send nothing more."""
        movement = self._movement
        if movement is not None:
            movement.cancel()

    def forget(self) -> None:
        """End the movement, which the drive never took."""
        with self._lock:
            self._end()

    def switched(self, on: bool) -> None:
        """Say whether the drive is meant to be on; switching it off forgets what went wrong."""
        with self._lock:
            self._switched_on = on
            self._mishap = self._mishap if on else None

    def forget_mishap(self, cause: TripCause) -> None:
        """Forget that the drive ended a movement for this cause."""
        with self._lock:
            if self._mishap is not None and self._mishap.cause is cause:
                self._mishap = None

    def poll(self) -> Trip | None:
        """Ask the drive how it is and return what forbids motion.

        Raises
        ------
        DeviceError
            When it has not answered for `patience_s`, or its port fails. A drive unheard for `unheard_s` counts as
            standing.
        """
        asked_s = time.monotonic()
        try:
            status = self._ask()
        except DeviceError as error:
            with self._lock:
                unheard_s = time.monotonic() - self._heard_s
                if unheard_s > self._unheard_s:
                    self._end()
                if isinstance(error, NoReplyError) and unheard_s < self._patience_s:
                    return self._judge(self._status)
            raise
        with self._lock:
            self._heard_s, self._status = asked_s, status
            if self._movement is not None:
                self._mishap = self._mishap or self._movement.mishap(status, asked_s)
                if self._movement.is_over(status, asked_s):
                    self._end()
            return self._judge(status)

    def position_mm(self) -> float:
        """Ask where it is; raises `DeviceError` when it does not answer."""
        value = self._link.exchange(Request(Command.POSITION)).value
        if value is None:
            raise DeviceError(
                f"the drive on {self._link.port} answered without a position: check hardware.drive.dialect."
            )
        return value

    def _ask(self) -> Status:
        status = self._link.exchange(Request(Command.STATUS)).status
        if status is None:
            raise DeviceError(
                f"the drive on {self._link.port} answered without a status: check hardware.drive.dialect."
            )
        return status

    def _judge(self, status: Status) -> Trip | None:
        if status.alarm:
            return Trip(TripCause.DRIVE_FAULT, f"the drive reports {self._link.dialect.alarm(status.alarm)}")
        if self._mishap is not None:
            return self._mishap
        if self._switched_on and not status.enabled:
            return Trip(TripCause.DRIVE_FAULT, "the drive switched itself off")
        return None

    def _end(self) -> None:
        if self._movement is not None:
            self._movement = None
            self._over()
            self._coupling.set_moving(False)


_ENABLE_TIMEOUT_S = 0.5
_ENABLE_RETRY_S = 0.01


class DrivePower:
    """The drive's power stage. Every method raises `DeviceError` when drive or line refuse or do not answer."""

    def __init__(self, link: DriveLink, lines: DigitalLines) -> None:
        self._link, self._lines = link, lines

    def on(self) -> None:
        """Set the enable line and switch the drive on."""
        self._lines.enable(True)
        until_s = time.monotonic() + _ENABLE_TIMEOUT_S
        while not self._is_on(last=time.monotonic() > until_s):
            time.sleep(_ENABLE_RETRY_S)

    def off(self) -> None:
        """Switch the drive off, clear its alarm, and take the enable line away, even from a drive that is silent."""
        try:
            self._link.exchange(Request(Command.DISABLE))
            self._link.exchange(Request(Command.CLEAR_ALARM))
        finally:
            self._lines.enable(False)

    def _is_on(self, *, last: bool) -> bool:
        try:
            self._link.exchange(Request(Command.ENABLE))
        except RefusedError as error:
            # A drive takes a while to see its enable line.
            if last or error.refusal is not Refusal.DISABLED:
                raise
            return False
        return True


_STANDSTILL_POLL_S = 0.01


class MotionInterlock:
    """Looks at drive and switches before every answer."""

    def __init__(self, monitor: Monitor, coupling: MotionSamplingSync) -> None:
        self._monitor, self._coupling = monitor, coupling

    def refuse_fault(self, but: TripCause | None = None) -> None:
        """Raise `DeviceError` when anything but one cause forbids motion."""
        fault = self._monitor.look()
        if fault is not None and fault.cause is not but:
            raise DeviceError(f"{fault.message}: see to it, then switch the drive off and on.")

    def refuse_moving(self) -> None:
        """Raise `DeviceError` while something moves."""
        if self._coupling.moving:
            raise DeviceError("the stage is still moving: wait until it stands or stop it first.")

    def await_standstill(self, longest_s: float) -> bool:
        """Wait until nothing moves, for so long of the wall's time at most; return whether it stands."""
        until_s = time.monotonic() + longest_s
        while self._coupling.moving:
            if time.monotonic() > until_s:
                return False
            self._monitor.look()
            if self._coupling.moving:
                time.sleep(_STANDSTILL_POLL_S)
        return True


POSITION_TOLERANCE_MM = 2e-3
"""A stage that stands a count or two off its limit is not beyond it."""


def refuse_towards_switch(profile: MotionProfile, side: TravelEnd, most_mm_s: float) -> None:
    """Refuse whatever goes towards an overridden limit switch, or leaves it fast.

    Raises
    ------
    DeviceError
        When the profile goes further that way, or exceeds `most_mm_s`.
    """
    extremes = profile.extremes()
    further_mm = -extremes.lowest_mm if side is TravelEnd.LOW else extremes.highest_mm
    if not further_mm <= POSITION_TOLERANCE_MM:
        raise DeviceError(f"the {side} limit switch is overridden for a move away from it only: turn the travel round.")
    if not extremes.speed_mm_s <= most_mm_s * (1 + 1e-9):
        raise DeviceError(
            f"off an overridden limit switch the stage moves at {most_mm_s:g} mm/s at most, not at "
            f"{extremes.speed_mm_s:g} (hardware.drive.homing_speed_mm_s of the rig file)."
        )


def refuse_late_start(start_s: float, coupling: MotionSamplingSync, clock: Clock) -> None:
    """Refuse a motion that should have begun more than a block ago, `start_s` after the first sample.

    Raises
    ------
    DeviceError
        When its start is too long past.
    """
    first = coupling.first_sample
    if first is not None and clock.monotonic() > first.at_s + start_s + MAX_BLOCK_S:
        raise DeviceError("the stage was told to move too long after the first sample: start it before.")


def first_motion_s(profile: MotionProfile) -> float:
    """Return when a profile's first motion begins; its end when it has none."""
    moving = profile.start_s[profile.acceleration_mm_s2 != 0]
    return float(moving[0]) if moving.size else profile.duration_s


class MonitoredStage(ABC):
    """A stage whose drive and switches are watched from `_watch` until `close`.

    Parameters
    ----------
    clock
        The rig's time, in which motions are.
    deadman
        Fed by whoever reads the samples.
    unheard_s
        After so long without an answer the drive has stopped by itself, of the wall's clock.

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
        unheard_s: float,
    ) -> None:
        self._settings, self._drive = settings, settings.hardware.drive
        self._limits = stage_limits(settings.stage)
        self._link, self._coupling, self._clock = link, coupling, clock
        self._deadman = deadman
        # One command at a time; a stop waits for none.
        self._commands = threading.RLock()
        self._override: TravelEnd | None = None
        self._axis = DriveTracker(link, coupling, self._drive.silence_s / 2, unheard_s, self._let_go)
        self._monitor = Monitor(
            self._axis.poll, self.stop, lines, coupling, deadman, settings.hardware.hang_s, poll_interval_s(settings)
        )
        self._ready, self._power = MotionInterlock(self._monitor, coupling), DrivePower(link, lines)

    @property
    def limits(self) -> StageLimits:
        """Soft limits of travel, and the greatest speed and acceleration."""
        return self._limits

    @property
    def fault(self) -> Trip | None:
        """What drive and switches reported when the monitor last looked; what was latched stays until `disable`."""
        return self._monitor.fault

    @property
    @abstractmethod
    def start_uncertainty_s(self) -> float:
        """How far time 0 of the last motion may be off the first sample."""

    @abstractmethod
    def state(self) -> StageState:
        """Ask drive and switches now."""

    @abstractmethod
    def enable(self) -> None:
        """Switch the drive on and hold the position."""

    @abstractmethod
    def home(self) -> None:
        """Find the origin of absolute positions; return when the stage stands there."""

    @abstractmethod
    def move(self, profile: MotionProfile) -> None:
        """Begin to follow a profile: now, or with the first sample when the sampler is armed."""

    @abstractmethod
    def stop(self) -> None:
        """Brake to a standstill now; returns at once."""

    @abstractmethod
    def close(self) -> None:
        """Stop, and let go of the drive. Twice is once."""

    @abstractmethod
    def _come_to_rest(self) -> None:
        """Wait until the stage stands after a stop, or long enough, and hold it no longer."""

    def disable(self) -> None:
        """Stop, switch the drive off and clear its alarm and whatever was latched.

        Raises
        ------
        DeviceError
            When the drive does not answer; its enable line is taken away all the same.
        """
        self.stop()
        with self._commands:
            try:
                self._come_to_rest()
                self._switched(on=False)
                self._power.off()
            finally:
                self._let_go()
                self._monitor.clear()
                self._monitor.look()

    def override_limit(self, side: TravelEnd) -> None:
        """Let a pressed limit switch forbid nothing until the next move has ended, which must lead slowly away from it.

        Raises
        ------
        DeviceError
            While the stage moves.
        """
        with self._commands:
            self._ready.refuse_moving()
            self._override = side
            self._monitor.tolerate(LIMIT_SWITCH_CAUSES[side])
            self._axis.forget_mishap(LIMIT_SWITCH_CAUSES[side])
            self._monitor.look()

    def _switched(self, on: bool) -> None:
        self._axis.switched(on)
        self._monitor.switched(on)

    def _let_go(self) -> None:
        self._override = None
        self._monitor.tolerate(None)

    def _allowed(self, profile: MotionProfile, origin_mm: float) -> StageLimits:
        """Return the limits of a profile from a position, with an override; raises `DeviceError` beyond them."""
        limits = limits_with_override(self._limits, self._override, origin_mm)
        if self._override is not None:
            refuse_towards_switch(profile, self._override, self._drive.homing_speed_mm_s)
        require_within_limits(profile, origin_mm, limits, POSITION_TOLERANCE_MM)
        return limits

    def _refuse_unready(self, *, enabled: bool, but: TripCause | None = None) -> None:
        self._ready.refuse_fault(but)
        if not enabled:
            raise DeviceError("the drive is off: enable the stage first.")
        self._ready.refuse_moving()
