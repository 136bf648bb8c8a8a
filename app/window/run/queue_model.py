"""The queue of sessions: what waits, what runs and how far it is, what is over; knows no screen."""

from dataclasses import dataclass, field
from enum import StrEnum

from dragrig.engine_host.messages import Began, Ended, InMirror, Job, RunBegan, RunEnded, RunLine, Status


class Stage(StrEnum):
    """Where a session of the queue is."""

    WAITING = "waiting"
    RUNNING = "running"
    COMPLETE = "complete"
    ABORTED = "aborted"
    TRIPPED = "tripped"
    FAILED = "failed"
    REFUSED = "not begun"


_STAGES = {Status.COMPLETE: Stage.COMPLETE, Status.ABORTED: Stage.ABORTED, Status.TRIPPED: Stage.TRIPPED}


@dataclass(slots=True)
class Entry:
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

    job: Job
    title: str
    seconds: float
    count: int
    stage: Stage = Stage.WAITING
    reason: str = ""
    folder: str = ""
    runs: tuple[RunLine, ...] = ()
    ended: dict[int, RunEnded] = field(default_factory=dict)
    under_way: RunLine | None = None
    at: int = -1
    elapsed_s: float = 0.0
    real_time: bool = True
    mirror: InMirror | None = None

    def took(self, run: RunLine) -> float:
        """Time that a run takes, its rest before it included where that takes its time."""
        return run.duration_s + (run.wait_s if self.real_time else 0.0)

    @property
    def total_s(self) -> float:
        """Time of all runs."""
        return sum(map(self.took, self.runs)) if self.runs else self.seconds

    @property
    def left_s(self) -> float:
        """Time of the runs that are still to be made."""
        if self.stage is not Stage.RUNNING:
            return self.seconds if self.stage is Stage.WAITING else 0.0
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
        if self.stage is Stage.COMPLETE:
            return 1.0
        return 1.0 - self.left_s / self.total_s if self.total_s > 0 and self.runs else 0.0


class Queue:
    """Sessions in the order they are to be made; at most one is under way."""

    def __init__(self) -> None:
        self.entries: list[Entry] = []
        self._number = 0

    def number(self) -> int:
        """Return a number for the next job."""
        self._number += 1
        return self._number

    @property
    def current(self) -> Entry | None:
        """The session under way."""
        return next((one for one in self.entries if one.stage is Stage.RUNNING), None)

    @property
    def next(self) -> Entry | None:
        """The session that waits first."""
        return next((one for one in self.entries if one.stage is Stage.WAITING), None)

    @property
    def left_s(self) -> float:
        """Time that everything still takes."""
        return sum(one.left_s for one in self.entries)

    def add(self, entry: Entry) -> None:
        """Put a session at the end."""
        self.entries.append(entry)

    def remove(self, entry: Entry) -> None:
        """Take a session out, unless it is under way."""
        if entry.stage is not Stage.RUNNING:
            self.entries.remove(entry)

    def move(self, entry: Entry, by: int) -> None:
        """Move a waiting session among the waiting ones."""
        waiting = [one for one in self.entries if one.stage is Stage.WAITING]
        if entry not in waiting:
            return
        place = min(max(waiting.index(entry) + by, 0), len(waiting) - 1)
        other = waiting[place]
        at, to = self.entries.index(entry), self.entries.index(other)
        self.entries.insert(to, self.entries.pop(at))

    def clear_finished(self) -> None:
        """Forget what is over."""
        self.entries = [one for one in self.entries if one.stage in {Stage.WAITING, Stage.RUNNING}]

    def begins(self, event: Began) -> None:
        """Note a session's runs."""
        entry = self.current
        if entry is not None and entry.job.number == event.job:
            entry.runs, entry.real_time, entry.count = event.runs, event.real_time, len(event.runs)

    def run_begins(self, event: RunBegan) -> None:
        """Note which run moves."""
        if (entry := self.current) is not None:
            entry.under_way, entry.at, entry.elapsed_s = event.run, event.run.index, 0.0
            entry.ended.pop(event.run.index, None)

    def run_ends(self, event: RunEnded) -> None:
        """Note how a run ended."""
        if (entry := self.current) is not None:
            entry.ended[event.run.index] = event
            entry.under_way = None

    def ends(self, event: Ended) -> None:
        """Note how a session ended."""
        for entry in self.entries:
            if entry.job.number == event.job and entry.stage is Stage.RUNNING:
                entry.stage = Stage.REFUSED if event.status is None else _STAGES.get(event.status, Stage.FAILED)
                entry.reason, entry.under_way, entry.mirror = event.reason, None, event.mirror
                entry.folder = "" if event.folder is None else str(event.folder)

    def is_lost(self, reason: str) -> None:
        """Note that the engine is gone."""
        if (entry := self.current) is not None:
            entry.stage, entry.reason, entry.under_way = Stage.FAILED, reason, None
