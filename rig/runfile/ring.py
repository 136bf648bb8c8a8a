"""The hand-over of samples from the acquiring thread to the writing one."""

from collections.abc import Iterator, Mapping
from threading import Condition

import numpy as np
import numpy.typing as npt

Columns = Mapping[str, npt.NDArray[np.generic]]


class SampleRing:
    """Preallocated columns of `capacity` samples between one giver and one taker.

    The giver copies its samples in and waits while there is no room; nothing is dropped. The taker sees
    what has gathered as views and hands their room back when it has written them. Each side touches only
    its own part of the columns; the counters are guarded by a lock.

    Parameters
    ----------
    types
        Type of each column by name.
    capacity
        Samples that fit; the taker is woken when a quarter of them has gathered.
    """

    def __init__(self, types: Mapping[str, np.dtype[np.generic]], capacity: int) -> None:
        self._columns = {name: np.empty(capacity, dtype) for name, dtype in types.items()}
        self._capacity = capacity
        self._gathered = capacity // 4
        self._given = 0
        self._taken = 0
        self._closed = False
        self._change = Condition()

    def give(self, columns: Columns) -> bool:
        """Copy samples in, in pieces where they do not fit at once; return False when the ring was closed."""
        count = len(next(iter(columns.values())))
        done = 0
        while done < count:
            room = self._wait_for_room()
            if room == 0:
                return False
            step = min(room, count - done)
            for slots, part in self._slots(self._given, step):
                for name, column in self._columns.items():
                    column[slots] = columns[name][done : done + step][part]
            done += step
            with self._change:
                self._given += step
                if self._given - self._taken >= self._gathered:
                    self._change.notify_all()
        return True

    def wait(self, timeout_s: float) -> bool:
        """Wait until enough has gathered, at most `timeout_s`; return whether the ring is closed."""
        with self._change:
            self._change.wait_for(lambda: self._closed or self._given - self._taken >= self._gathered, timeout_s)
            return self._closed

    def take(self) -> Iterator[Columns]:
        """Yield all that has gathered so far as views, each valid until the next is asked for."""
        with self._change:
            count = self._given - self._taken
        for slots, part in self._slots(self._taken, count):
            yield {name: column[slots] for name, column in self._columns.items()}
            with self._change:
                self._taken += part.stop - part.start
                self._change.notify_all()

    def close(self) -> None:
        """Wake both sides: nothing more is given, and a giver that waits goes on."""
        with self._change:
            self._closed = True
            self._change.notify_all()

    def _wait_for_room(self) -> int:
        with self._change:
            self._change.wait_for(lambda: self._closed or self._given - self._taken < self._capacity)
            return 0 if self._closed else self._capacity - (self._given - self._taken)

    def _slots(self, position: int, count: int) -> Iterator[tuple[slice, slice]]:
        """Yield where `count` samples from `position` on lie: slots of the ring, and which of them these are."""
        first = position % self._capacity
        ahead = min(count, self._capacity - first)
        if ahead:
            yield slice(first, first + ahead), slice(0, ahead)
        if count > ahead:
            yield slice(0, count - ahead), slice(ahead, count)
