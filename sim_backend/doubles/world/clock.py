"""Time for doubles: the wall's, a fixed number of times faster, with long waits passed over while nothing happens."""

import threading
import time
from collections.abc import Callable
from datetime import datetime, timedelta
from threading import Event as Signal

from dragrig.rig.clock import aware

_WORTH_PASSING_OVER_S = 0.5


def never() -> bool:
    """Return False: for a clock that never passes over anything."""
    return False


class DoubleClock:
    """A clock `pace` times as fast as the wall's. Any thread may use it.

    Parameters
    ----------
    pace
        Seconds of this clock in one of the wall's.
    origin
        Time of day at its start; now unless given.
    """

    def __init__(self, pace: float = 1.0, origin: datetime | None = None) -> None:
        self.pace = pace
        self._origin = aware(origin)
        self._begun_s = time.perf_counter()
        self._passed_over_s = 0.0
        self._idle: Callable[[], bool] = never
        self._lock = threading.Lock()

    def pass_over_when(self, idle: Callable[[], bool]) -> None:
        """Let long waits take no time while `idle` says that nothing happens: no sample is taken, nothing moves."""
        self._idle = idle

    def now(self) -> datetime:
        """Time of day, with offset."""
        return self._origin + timedelta(seconds=self.monotonic())

    def monotonic(self) -> float:
        """Seconds of this clock since it was made."""
        return self._passed_over_s + self.pace * (time.perf_counter() - self._begun_s)

    def sleep(self, duration_s: float, cancel: Signal) -> bool:
        """Wait; return False within milliseconds when `cancel` is set before the time is over."""
        if cancel.is_set():
            return False
        if duration_s > _WORTH_PASSING_OVER_S and self._idle():
            with self._lock:
                self._passed_over_s += duration_s
            return True
        return not (cancel.wait(duration_s / self.pace) if duration_s > 0 else cancel.is_set())
