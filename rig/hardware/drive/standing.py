"""When a stage that was told to stand does, as its encoder sees it."""

import threading

from dragrig.config.errors import DeviceError
from dragrig.rig.devices import Clock
from dragrig.rig.hardware.card.position import PositionCounter

LONGEST_S = 0.5
"""So long a stage may take to stand after its voltage is 0."""
_COUNTS = 1.5


class Standing:
    """Two looks, a while apart, that see the same position.

    Parameters
    ----------
    count_mm
        Length of a count.
    apart, longest
        How far two looks are apart, and how long it may take to stand: both in samples of the output.
    """

    def __init__(self, count_mm: float, apart: int, longest: int) -> None:
        self._still_mm = _COUNTS * count_mm
        self._apart, self._longest = apart, longest
        self._since = self._seen = 0
        self._before_mm: float | None = None

    def forget(self) -> None:
        """Begin anew."""
        self._before_mm = None

    def is_seen(self, generated: int, zero_from: int, position_mm: float) -> bool:
        """Look at the position while `generated` samples were put out; those from `zero_from` on are 0.

        Raises
        ------
        DeviceError
            When it does not stand after all the time that it may take.
        """
        if self._before_mm is None:
            self._since = self._seen = zero_from
            self._before_mm = position_mm
        if generated < self._seen + self._apart:
            return False
        if abs(position_mm - self._before_mm) <= self._still_mm:
            return True
        if generated - self._since > self._longest:
            raise DeviceError("the stage did not stop at 0 V, so that the drive was switched off: look at the drive.")
        self._seen, self._before_mm = generated, position_mm
        return False

    def is_awaited(self, counter: PositionCounter, clock: Clock, apart_s: float) -> bool:
        """Look at a counter until it stands or had all the time for it; raises `DeviceError` when it cannot be read."""
        until_s = clock.monotonic() + LONGEST_S
        before_mm = counter.read()
        while clock.monotonic() < until_s:
            clock.sleep(apart_s, threading.Event())
            now_mm = counter.read()
            if abs(now_mm - before_mm) <= self._still_mm:
                return True
            before_mm = now_mm
        return False
