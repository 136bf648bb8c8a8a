"""The queue of sessions: waiting, running with its progress, finished; independent of Qt."""

from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path

from pydantic import TypeAdapter

from dragrig import engine_host
from dragrig.config import Plan


class QueueState(StrEnum):
    """State of a queued session."""

    WAITING = "waiting"
    RUNNING = "running"
    COMPLETE = "complete"
    ABORTED = "aborted"
    TRIPPED = "tripped"
    FAILED = "failed"
    REFUSED = "not started"
    CUT_OFF = "cut off"
    """The window before this one died meanwhile."""


_LASTING = frozenset({QueueState.WAITING, QueueState.RUNNING, QueueState.CUT_OFF})
"""States of sessions that are still to be decided or made."""


ENGINE_LOST = "the engine ended unexpectedly"
_STATE_OF_STATUS = {
    None: QueueState.REFUSED,
    engine_host.RunStatus.COMPLETE: QueueState.COMPLETE,
    engine_host.RunStatus.ABORTED: QueueState.ABORTED,
    engine_host.RunStatus.TRIPPED: QueueState.TRIPPED,
}


@dataclass(slots=True)
class QueuedSession:
    """A queued session."""

    job: engine_host.SessionJob
    title: str
    planned_s: float
    run_count: int
    """`planned_s`, `run_count`: duration by the plan, with its waits, and number of runs."""
    stage: QueueState = QueueState.WAITING
    reason: str = ""
    folder: str = ""
    runs: tuple[engine_host.QueuedRun, ...] = ()
    ended: dict[int, engine_host.RunFinished] = field(default_factory=dict)
    """`runs`, `ended`: its runs, where they are known, and the results of those that ended, by index."""
    current_run: engine_host.QueuedRun | None = None
    """The run in progress, `elapsed_s` after its start."""
    resting: engine_host.QueuedRun | None = None
    rest_left_s: float = 0.0
    """`resting`, `rest_left_s`: the run before which the contact rests, and for how long still."""
    last_index: int = -1
    """Index of the run that started last; runs before it were made or skipped."""
    numbers: dict[int, int] = field(default_factory=dict)
    """Number that each run was made under, by index; a run that is made again has another."""
    elapsed_s: float = 0.0
    real_time: bool = True
    mirror: engine_host.MirrorStatus | None = None
    """Result of mirroring once the session has ended; None without a mirror."""

    def time_of(self, run: engine_host.QueuedRun) -> float:
        """Return the duration of a run, in real time with the wait before it."""
        return run.duration_s + (run.wait_s if self.real_time else 0.0)

    @property
    def missing(self) -> tuple[engine_host.QueuedRun, ...]:
        """The runs that an ended session left to be made, as far as this window knows; none without a campaign."""
        early = {QueueState.ABORTED, QueueState.TRIPPED, QueueState.FAILED, QueueState.CUT_OFF}
        done = {index for index, run in self.ended.items() if run.status is engine_host.RunStatus.COMPLETE}
        is_left = bool(self.folder) and self.stage in early
        return tuple(run for run in self.runs if run.index not in done) if is_left else ()

    @property
    def why(self) -> str:
        """Why a session that goes on with a campaign is made; empty for one of its own."""
        return "" if self.job.campaign is None else self.job.note

    @property
    def total_s(self) -> float:
        """Duration of all runs."""
        return sum(map(self.time_of, self.runs)) if self.runs else self.planned_s

    @property
    def left_s(self) -> float:
        """Duration of the runs still to make."""
        if self.stage is not QueueState.RUNNING:
            return self.planned_s if self.stage is QueueState.WAITING else 0.0
        if not self.runs:
            return self.planned_s
        left = sum(self.time_of(run) for run in self.runs if run.index > self.last_index)
        if self.resting is not None and self.resting.index > self.last_index and self.real_time:
            left -= self.resting.wait_s - self.rest_left_s
        if self.current_run is not None:
            left += self.current_run.duration_s - min(self.elapsed_s, self.current_run.duration_s)
        return max(left, 0.0)

    @property
    def last_before_pause(self) -> engine_host.QueuedRun | None:
        """The run after which a pause would begin: the one in progress or prepared, or its way back."""
        now = self.current_run or self.resting
        if now is None:
            return None
        after = next((run for run in self.runs if run.index > now.index), None)
        return after if after is not None and after.is_way_back else now

    @property
    def over_count(self) -> int:
        """Number of the runs that are over, made or skipped."""
        return sum(run.index <= self.last_index for run in self.runs) - (self.current_run is not None)

    def number_of(self, run: engine_host.QueuedRun) -> int | None:
        """Return the number of a run, as in the name of its file; None for a run that was skipped."""
        if run.index in self.numbers:
            return self.numbers[run.index]
        if run.index <= self.last_index:
            return None
        return run.index + self.numbers.get(self.last_index, self.last_index) - self.last_index

    @property
    def progress(self) -> float:
        """Fraction done."""
        if self.stage is QueueState.COMPLETE:
            return 1.0
        return 1.0 - self.left_s / self.total_s if self.total_s > 0 and self.runs else 0.0


_KEPT = TypeAdapter(list[QueuedSession])


class SessionQueue:
    """Sessions in order; at most one is running."""

    def __init__(self) -> None:
        self.entries: list[QueuedSession] = []
        self._number = 0
        self._removed: list[list[tuple[int, QueuedSession]]] = []

    def next_number(self) -> int:
        """Return a number for the next job."""
        self._number += 1
        return self._number

    @property
    def current(self) -> QueuedSession | None:
        """The running session."""
        return next((entry for entry in self.entries if entry.stage is QueueState.RUNNING), None)

    @property
    def next(self) -> QueuedSession | None:
        """The first waiting session."""
        return next((entry for entry in self.entries if entry.stage is QueueState.WAITING), None)

    @property
    def cut_off(self) -> QueuedSession | None:
        """The session that was cut off and is to be decided on."""
        return next((entry for entry in self.entries if entry.stage is QueueState.CUT_OFF), None)

    @property
    def left_s(self) -> float:
        """Time left for all sessions."""
        return sum(entry.left_s for entry in self.entries)

    def of_campaign(self, folder: Path, plan: Plan) -> QueuedSession | None:
        """Return the session that waits or runs and goes on with a campaign by this plan."""
        lasting = (entry for entry in self.entries if entry.stage in {QueueState.WAITING, QueueState.RUNNING})
        return next((entry for entry in lasting if (entry.job.campaign, entry.job.plan) == (folder, plan)), None)

    def add(self, entry: QueuedSession, *, before: QueuedSession | None = None) -> None:
        """Append a session, or put it before another."""
        self.entries.insert(len(self.entries) if before is None else self.entries.index(before), entry)

    def remove(self, entry: QueuedSession) -> None:
        """Remove a session that is not running."""
        if entry.stage is not QueueState.RUNNING:
            self._take_out([entry])

    @property
    def can_put_back(self) -> bool:
        """Whether sessions were removed that can be put back."""
        return bool(self._removed)

    def as_text(self) -> str:
        """Return what waits, runs or was cut off, as JSON, for the next start of the window."""
        return _KEPT.dump_json(
            [entry for entry in self.entries if entry.stage in _LASTING], exclude_unset=True
        ).decode()

    def restore(self, text: str) -> None:
        """Append the sessions that `as_text` returned, none where it cannot be read; one that ran was cut off."""
        with suppress(ValueError):
            for entry in _KEPT.validate_json(text):
                entry.job = replace(entry.job, number=self.next_number())
                entry.current_run = entry.resting = None
                if entry.stage is QueueState.RUNNING:
                    entry.stage = QueueState.CUT_OFF if entry.folder else QueueState.WAITING
                self.add(entry)

    def put_back(self) -> None:
        """Put back what was removed last, where it was."""
        for place, entry in self._removed.pop() if self._removed else ():
            self.entries.insert(min(place, len(self.entries)), entry)

    def _take_out(self, entries: list[QueuedSession]) -> None:
        if entries:
            self._removed.append([(place, entry) for place, entry in enumerate(self.entries) if entry in entries])
            self.entries = [entry for entry in self.entries if entry not in entries]

    def move(self, entry: QueuedSession, by: int) -> None:
        """Move a waiting session among the waiting ones."""
        waiting = [queued for queued in self.entries if queued.stage is QueueState.WAITING]
        if entry not in waiting:
            return
        place = min(max(waiting.index(entry) + by, 0), len(waiting) - 1)
        neighbour = waiting[place]
        at, to = self.entries.index(entry), self.entries.index(neighbour)
        self.entries.insert(to, self.entries.pop(at))

    def clear_finished(self) -> None:
        """Remove the sessions that have ended."""
        self._take_out([entry for entry in self.entries if entry.stage not in _LASTING])

    def take(self, event: engine_host.Event) -> None:
        """Store what an event says of the running session."""
        if (entry := self.current) is None:
            return
        match event:
            case engine_host.SessionStarted(entry.job.number, runs, real_time, folder):
                entry.runs, entry.real_time, entry.run_count = runs, real_time, len(runs)
                entry.folder = str(folder)
            case engine_host.SessionWaiting(run, duration_s):
                entry.resting, entry.rest_left_s = run, duration_s
            case engine_host.RunStarted(run, order):
                entry.resting = None
                entry.current_run, entry.last_index, entry.elapsed_s = run, run.index, 0.0
                entry.numbers[run.index] = order
                entry.ended.pop(run.index, None)
            case engine_host.RunFinished(run):
                entry.ended[run.index] = event
                entry.current_run = None
            case engine_host.SessionFinished(entry.job.number, status, reason, folder, mirror):
                entry.stage = _STATE_OF_STATUS.get(status, QueueState.FAILED)
                entry.reason, entry.mirror = reason, mirror
                entry.current_run = entry.resting = None
                entry.folder = "" if folder is None else str(folder)
            case engine_host.HostLost():
                entry.stage, entry.reason = QueueState.FAILED, ENGINE_LOST
                entry.current_run = entry.resting = None
            case _:
                pass
