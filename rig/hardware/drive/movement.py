"""What the drive is doing at present, judged by what it says of itself."""

import time

from dragrig.rig.hardware.dialects.base import Halt, Status
from dragrig.rig.hardware.drive.link import DriveLink
from dragrig.rig.trips import Cause, Trip

_SETTING_OUT_S = 0.1
"""So long a drive that has taken a command may go on saying that it stands, and why it stood before."""
_CAUSES = {Halt.SILENCE: Cause.WATCHDOG, Halt.EMERGENCY_STOP: Cause.EMERGENCY_STOP}


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
        cause = _CAUSES.get(status.halt, Cause.DRIVE_FAULT)
        if status.halt is Halt.LIMIT_SWITCH and self.direction:
            cause = Cause.LIMIT_SWITCH_LOW if self.direction < 0 else Cause.LIMIT_SWITCH_HIGH
        return Trip(cause, f"the drive stopped by itself, because {status.halt}")

    def _has_set_out(self, asked_s: float) -> bool:
        if self._began_s is None or asked_s < self._began_s:
            return False
        return self._seen_moving or self.is_stopped or asked_s >= self._began_s + _SETTING_OUT_S
