"""Time for a simulated rig: at once, or at the pace of the wall's clock."""

import threading
import time
from datetime import datetime, timedelta
from threading import Event as Signal


def aware(origin: datetime | None) -> datetime:
    """Return `origin`, or now, as a time with its offset from UTC; a time without one is local."""
    if origin is None:
        return datetime.now().astimezone()
    return origin if origin.tzinfo is not None else origin.astimezone()


class VirtualClock:
    """A clock that advances when somebody sleeps, and only then, without waiting.

    It may be read and advanced from any thread.
    """

    def __init__(self, origin: datetime | None = None) -> None:
        self._origin = aware(origin)
        self._elapsed_s = 0.0
        self._lock = threading.Lock()

    def now(self) -> datetime:
        """Time of day, with offset."""
        return self._origin + timedelta(seconds=self._elapsed_s)

    def monotonic(self) -> float:
        """Seconds since the clock was made."""
        return self._elapsed_s

    def sleep(self, duration_s: float, cancel: Signal) -> bool:
        """Advance by `duration_s` at once; return False, not advanced, when `cancel` is set."""
        if cancel.is_set():
            return False
        if duration_s > 0:
            with self._lock:
                self._elapsed_s += duration_s
        return True


class WallClock:
    """A clock at the pace of the wall's, whose time of day may begin elsewhere."""

    def __init__(self, origin: datetime | None = None) -> None:
        self._origin = aware(origin)
        self._begun_s = time.perf_counter()

    def now(self) -> datetime:
        """Time of day, with offset."""
        return self._origin + timedelta(seconds=self.monotonic())

    def monotonic(self) -> float:
        """Seconds since the clock was made."""
        return time.perf_counter() - self._begun_s

    def sleep(self, duration_s: float, cancel: Signal) -> bool:
        """Wait; return False within milliseconds when `cancel` is set before the time is over."""
        return not (cancel.wait(duration_s) if duration_s > 0 else cancel.is_set())
