"""Time for a simulated rig that lives as fast as it can."""

import threading
from datetime import datetime, timedelta
from threading import Event as Signal

from dragrig.rig.clock import aware


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
