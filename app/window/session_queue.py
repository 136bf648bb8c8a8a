"""The queue of sessions: waiting, running with its progress, finished; independent of Qt."""

from dataclasses import dataclass, field
from enum import StrEnum

from dragrig.engine_host.messages import (
    MirrorStatus,
    QueuedRun,
    RunFinished,
    RunStarted,
    RunStatus,
    SessionFinished,
    SessionJob,
    SessionStarted,
)


class QueueState(StrEnum):
    """Where a session of the queue is."""

    WAITING = "waiting"
    RUNNING = "running"
    COMPLETE = "complete"
    ABORTED = "aborted"
    TRIPPED = "tripped"
    FAILED = "failed"
    REFUSED = "not begun"


_STATE_OF_STATUS = {
    RunStatus.COMPLETE: QueueState.COMPLETE,
    RunStatus.ABORTED: QueueState.ABORTED,
    RunStatus.TRIPPED: QueueState.TRIPPED,
}


@dataclass(slots=True)
class QueuedSession:
    """One session of the queue.

    Attributes
    ----------
    seconds
        How long it takes with all its rests.
    runs, ended
        Its runs once it has begun, and how those that are over ended, by their index.
    under_way
        The run that moves, and `elapsed_s` how far it is [s].
    at
        Index of the run that began last; those before it were made or skipped, and those after it are to come.
    mirror
        What is in the mirror once it is over; none without one.
    """

    job: SessionJob
    title: str
    seconds: float
    count: int
    stage: QueueState = QueueState.WAITING
    reason: str = ""
    folder: str = ""
    runs: tuple[QueuedRun, ...] = ()
    ended: dict[int, RunFinished] = field(default_factory=dict)
    under_way: QueuedRun | None = None
    at: int = -1
    elapsed_s: float = 0.0
    real_time: bool = True
    mirror: MirrorStatus | None = None

    def took(self, run: QueuedRun) -> float:
        """Time that a run takes, its rest before it included where that takes its time."""
        return run.duration_s + (run.wait_s if self.real_time else 0.0)

    @property
    def total_s(self) -> float:
        """Time of all runs."""
        return sum(map(self.took, self.runs)) if self.runs else self.seconds

    @property
    def left_s(self) -> float:
        """Time of the runs that are still to be made."""
        if self.stage is not QueueState.RUNNING:
            return self.seconds if self.stage is QueueState.WAITING else 0.0
        if not self.runs:
            return self.seconds
        left = sum(self.took(one) for one in self.runs if one.index > self.at)
        if self.under_way is not None:
            left += self.under_way.duration_s - min(self.elapsed_s, self.under_way.duration_s)
        return max(left, 0.0)

    @property
    def place(self) -> int:
        """Which of its runs it is at, from 1: the one that moves, or the one that is next."""
        begun = sum(one.index <= self.at for one in self.runs)
        return min(begun + (self.under_way is None), max(self.count, 1))

    @property
    def share(self) -> float:
        """How much of it is done, from 0 to 1."""
        if self.stage is QueueState.COMPLETE:
            return 1.0
        return 1.0 - self.left_s / self.total_s if self.total_s > 0 and self.runs else 0.0


class SessionQueue:
    """Sessions in the order they are to be made; at most one is under way."""

    def __init__(self) -> None:
        self.entries: list[QueuedSession] = []
        self._number = 0

    def number(self) -> int:
        """Return a number for the next job."""
        self._number += 1
        return self._number

    @property
    def current(self) -> QueuedSession | None:
        """The session under way."""
        return next((one for one in self.entries if one.stage is QueueState.RUNNING), None)

    @property
    def next(self) -> QueuedSession | None:
        """The session that waits first."""
        return next((one for one in self.entries if one.stage is QueueState.WAITING), None)

    @property
    def left_s(self) -> float:
        """Time that everything still takes."""
        return sum(one.left_s for one in self.entries)

    def add(self, entry: QueuedSession) -> None:
        """Put a session at the end."""
        self.entries.append(entry)

    def remove(self, entry: QueuedSession) -> None:
        """Take a session out, unless it is under way."""
        if entry.stage is not QueueState.RUNNING:
            self.entries.remove(entry)

    def move(self, entry: QueuedSession, by: int) -> None:
        """Move a waiting session among the waiting ones."""
        waiting = [one for one in self.entries if one.stage is QueueState.WAITING]
        if entry not in waiting:
            return
        place = min(max(waiting.index(entry) + by, 0), len(waiting) - 1)
        other = waiting[place]
        at, to = self.entries.index(entry), self.entries.index(other)
        self.entries.insert(to, self.entries.pop(at))

    def clear_finished(self) -> None:
        """Forget what is over."""
        self.entries = [one for one in self.entries if one.stage in {QueueState.WAITING, QueueState.RUNNING}]

    def begins(self, event: SessionStarted) -> None:
        """Note a session's runs."""
        entry = self.current
        if entry is not None and entry.job.number == event.job:
            entry.runs, entry.real_time, entry.count = event.runs, event.real_time, len(event.runs)

    def run_begins(self, event: RunStarted) -> None:
        """Note which run moves."""
        if (entry := self.current) is not None:
            entry.under_way, entry.at, entry.elapsed_s = event.run, event.run.index, 0.0
            entry.ended.pop(event.run.index, None)

    def run_ends(self, event: RunFinished) -> None:
        """Note how a run ended."""
        if (entry := self.current) is not None:
            entry.ended[event.run.index] = event
            entry.under_way = None

    def ends(self, event: SessionFinished) -> None:
        """Note how a session ended."""
        for entry in self.entries:
            if entry.job.number == event.job and entry.stage is QueueState.RUNNING:
                entry.stage = (
                    QueueState.REFUSED
                    if event.status is None
                    else _STATE_OF_STATUS.get(event.status, QueueState.FAILED)
                )
                entry.reason, entry.under_way, entry.mirror = event.reason, None, event.mirror
                entry.folder = "" if event.folder is None else str(event.folder)

    def is_lost(self, reason: str) -> None:
        """Note that the engine is gone."""
        if (entry := self.current) is not None:
            entry.stage, entry.reason, entry.under_way = QueueState.FAILED, reason, None
