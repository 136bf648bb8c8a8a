"""The buffer between card and program: where a read begins, how long it waits, what is lost."""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.doubles.card.daqmx import CardError, Code, RelativeTo

_AT_LEAST_S = 2e-4


class Source(Protocol):
    """What fills a buffer."""

    @property
    def rate_hz(self) -> float:
        """Samples per second that come at present; 0 when none come."""
        ...

    def total(self) -> int:
        """Return how many samples per channel were taken."""
        ...

    def fetch(self, first: int, end: int) -> list[FloatArray]:
        """Return these samples of each channel."""
        ...


@dataclass(slots=True)
class Position:
    """Where a read begins; `overwrite` says whether unread samples may be lost without an end of the acquisition."""

    relative_to: int = RelativeTo.CURRENT_READ_POSITION
    offset: int = 0
    overwrite: bool = False


@dataclass(frozen=True, slots=True)
class Span:
    """Samples that a read may have, and why it is not all that was asked."""

    first: int
    end: int
    failure: CardError | None = None


class Stream:
    """One running task's buffer. Whoever owns it holds `changed` while calling anything.

    Parameters
    ----------
    size
        Samples per channel that the buffer holds.
    limit
        Samples per channel after which a finite task ends; None for a continuous one.
    pace
        Seconds of the source's time in one of the wall's.
    changed
        Notified whenever something happens that a waiting read must look at.
    still_there
        Raises what keeps the read from going on: the card is gone, the task was stopped.
    """

    def __init__(
        self,
        source: Source,
        size: int,
        limit: int | None,
        pace: float,
        changed: threading.Condition,
        still_there: Callable[[], None],
    ) -> None:
        self.source = source
        self.size = size
        self.limit = limit
        self.position = 0
        self._pace = pace
        self._changed = changed
        self._still_there = still_there
        self._stalled_at: int | None = None
        self._lost_before = 0
        self._overrun = False
        self._short_reads = 0

    @property
    def done(self) -> bool:
        """Whether a finite task has taken all its samples."""
        return self.limit is not None and self.total() >= self.limit

    def total(self) -> int:
        """Return how many samples per channel reached the buffer."""
        total = self.source.total() if self._stalled_at is None else self._stalled_at
        return total if self.limit is None else min(total, self.limit)

    def oldest(self) -> int:
        """Return the first sample that the buffer still holds."""
        return max(self.total() - self.size, self._lost_before, 0)

    def begins(self, position: Position) -> int:
        """Return the first sample of the next read."""
        match position.relative_to:
            case RelativeTo.FIRST_SAMPLE:
                return position.offset
            case RelativeTo.MOST_RECENT_SAMPLE:
                return self.total() + position.offset
            case _:
                return self.position + position.offset

    def stall(self, stalled: bool) -> None:
        """Let no further sample reach the buffer, or all that were taken meanwhile at once."""
        if stalled != (self._stalled_at is not None):
            self._stalled_at = self.total() if stalled else None

    def forget_before(self, index: int) -> None:
        """Let everything before a sample be lost."""
        self._lost_before = max(self._lost_before, index)

    def lose(self, samples: int) -> None:
        """Let so many samples that were not read be lost."""
        self.forget_before(self.position + samples)

    def wait(self, samples: int, timeout_s: float, position: Position, short_reads: int) -> Span:
        """Wait for samples from the position on; advance it by those that are there in the end.

        Raises
        ------
        CardError
            When there is nothing to be had: overwritten (−200279), beyond the end (−200278), the card gone.
        """
        self._still_there()
        first = self.begins(position)
        wanted = self._shortened(samples, short_reads)
        deadline_s = math.inf if timeout_s < 0 else time.perf_counter() + timeout_s
        while True:
            self._refuse_overwritten(first, position.overwrite)
            total = self.total()
            if total >= first + wanted:
                break
            if self.done:
                return self._part(first, total, _never())
            left_s = deadline_s - time.perf_counter()
            if left_s <= 0:
                return self._part(first, total, _late(samples, total - first))
            self._sleep(min(left_s, self._due_s(first + wanted - total)))
            self._still_there()
        return self._part(first, first + wanted, None if wanted == samples else _late(samples, wanted))

    def _part(self, first: int, end: int, failure: CardError | None) -> Span:
        end = max(end, first)
        self.position = end
        if failure is not None:
            failure.samples = end - first
        return Span(first, end, failure)

    def _shortened(self, samples: int, short_reads: int) -> int:
        if self._short_reads >= short_reads:
            return samples
        self._short_reads += 1
        return samples // 2

    def _refuse_overwritten(self, first: int, overwrite: bool) -> None:
        if first < 0 or self._overrun or first < self.oldest():
            # Without leave to overwrite, the acquisition ends where it meets a sample that was not read.
            self._overrun = not overwrite
            raise CardError(
                Code.SAMPLES_OVERWRITTEN,
                "The application is not able to keep up with the hardware acquisition: the sample to be read was "
                f"overwritten.\n\nSample: {first}\nOldest Sample in Buffer: {self.oldest()}",
            )

    def _due_s(self, samples: int) -> float:
        rate_hz = self.source.rate_hz if self._stalled_at is None else 0.0
        return max(samples / (rate_hz * self._pace), _AT_LEAST_S) if rate_hz > 0 else math.inf

    def _sleep(self, duration_s: float) -> None:
        self._changed.wait(None if math.isinf(duration_s) else duration_s)


def _late(samples: int, there: int) -> CardError:
    return CardError(
        Code.SAMPLES_NOT_YET_AVAILABLE,
        "Some or all of the samples requested have not yet been acquired.\n\n"
        f"Samples Requested: {samples}\nSamples There: {max(there, 0)}",
    )


def _never() -> CardError:
    return CardError(
        Code.SAMPLES_WILL_NEVER_BE_AVAILABLE,
        "Attempted to read a sample beyond the final sample acquired.",
    )
