"""Time as the wall has it."""

import time
from datetime import datetime, timedelta
from threading import Event as Signal


def aware(origin: datetime | None) -> datetime:
    """Return `origin`, or now, as a time with its offset from UTC; a time without one is local."""
    if origin is None:
        return datetime.now().astimezone()
    return origin if origin.tzinfo is not None else origin.astimezone()


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
