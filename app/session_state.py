"""The state file that a running session keeps in its campaign folder, and the lock that shows it is running."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Literal

from pydantic import AwareDatetime, Field, ValidationError

from dragrig.config import OutputError, Settings
from dragrig.rig import (
    HOMING,
    AcquisitionOutcome,
    Answer,
    Drift,
    Operator,
    PlannedRun,
    Programme,
    Prompt,
    Reading,
    SessionObserver,
    file_lock,
    rename_into_place,
)

STATE_FILE = "session-state.json"
LOCK_FILE = "session.lock"
"""Locked by the process of the session; the system unlocks it when that dies."""
LOCK_TIMEOUT_S = 2.0
"""A watcher holds the lock for a moment too."""

Activity = Literal["preparing", "asking", "waiting", "recording", "between", "ended"]


def _now() -> datetime:
    return datetime.now().astimezone()


class SessionState(Settings):
    """The present work of a session."""

    format_version: Literal[1] = 1
    plan: str
    backend: str
    double: bool = False
    since: AwareDatetime = Field(default_factory=_now)
    """Start of this activity, wall-clock time."""
    doing: Activity = "preparing"
    said: str = ""
    """The open prompt, or the reason of the wait."""
    wait_s: float = 0.0
    """Length of the wait; 0 where time is simulated."""
    real_time: bool = False
    runs: int = 0
    """Number of runs of this session, return strokes included."""
    made: int = 0
    """Number of the run started last, from 1."""
    order: int = -1
    run: str = ""
    """Summary of that run."""
    run_s: float = 0.0
    """Its recording time."""
    after_s: float = 0.0
    """Duration of all later runs, without prompts; with waits where time is real."""
    total_s: float = 0.0
    """The same of all runs of this session."""
    busy_s: float = 0.0
    """Wall-clock time from the first run to the start of this activity, without prompts."""
    sentinel: str = ""
    """How far the specimen had drifted at the last sentinel, in a sentence."""
    status: str = ""
    """How the session ended."""
    reason: str = ""


def read_state(folder: Path) -> SessionState | None:
    """Read the state of the latest session of a campaign; None without a valid one."""
    with contextlib.suppress(OSError, ValidationError):
        return SessionState.model_validate_json((folder / STATE_FILE).read_bytes())
    return None


def is_session_running(folder: Path) -> bool:
    """Return whether a session of this campaign is running; writes nothing.

    True where the file system has no locks, or a lock was left behind; the state file then decides.
    """
    try:
        descriptor = os.open(folder / LOCK_FILE, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    except OSError:
        return False
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except (ImportError, OSError):
        return True
    finally:
        os.close(descriptor)
    return False


@contextlib.contextmanager
def session_lock(folder: Path) -> Iterator[None]:
    """Hold the lock of a campaign until the block ends or the process dies.

    Raises
    ------
    BusyError
        When another session holds it.
    OutputError
        When the folder cannot be written.
    """
    busy = f"{folder}: another session of this campaign is running; wait until it ends."
    with file_lock(folder / LOCK_FILE, busy, LOCK_TIMEOUT_S):
        yield


class StatePublisher:
    """Operator and observer of a session that also writes its state file.

    The file is small, replaced atomically, and written when an activity starts, never while samples are taken; errors
    of writing do not disturb the session.
    """

    def __init__(
        self,
        operator: Operator,
        observer: SessionObserver,
        folder: Path,
        state: SessionState,
        prompting: Callable[[str], contextlib.AbstractContextManager[None]],
    ) -> None:
        self._operator, self._observer, self._folder = operator, observer, folder
        self._prompting = prompting
        self._state = state
        self._runs: tuple[PlannedRun, ...] = ()
        self._started = self._prepared = False
        self._earlier: bytes | None = None
        """State of the session before, where this one goes on with its campaign."""

    @property
    def attended(self) -> bool:
        """Whether a person answers prompts that need no hands."""
        return self._operator.attended

    def ask(self, prompt: Prompt) -> Answer:
        """Publish the prompt while it is open."""
        self._publish("asking", said=prompt.text)
        with self._prompting(prompt.text):
            answer = self._operator.ask(prompt)
        self._publish("between", said="")
        return answer

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Publish the number and duration of the runs."""
        self._started = True
        self._runs = tuple(pending)
        total_s = _planned_duration_s(self._runs, real_time=real_time)
        self._publish("preparing", runs=len(pending), real_time=real_time, after_s=total_s, total_s=total_s)
        self._observer.begins(programme, pending, real_time=real_time)

    def homes(self, *, over: bool) -> None:
        """Publish that the stage finds its origin."""
        self._publish("preparing", said="" if over else HOMING)
        self._operator.homes(over=over)

    def waits(self, run: PlannedRun, duration_s: float) -> None:
        """Publish a rest."""
        self._publish("waiting", said=f"rest before {run.summary}", wait_s=duration_s if self._state.real_time else 0.0)
        self._observer.waits(run, duration_s)

    def run_begins(self, run: PlannedRun, order: int) -> None:
        """Publish the run that is recorded."""
        # By index, because a run may be made again: those before it were made or skipped.
        later = [planned for planned in self._runs if planned.index > run.index]
        self._publish(
            "recording",
            made=len(self._runs) - len(later),
            order=order,
            run=run.summary,
            run_s=run.duration_s,
            after_s=_planned_duration_s(later, real_time=self._state.real_time),
        )
        self._observer.run_begins(run, order)

    def reads(self, reading: Reading) -> None:
        """Pass the block on; watchers read the recording itself."""
        self._observer.reads(reading)

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Publish that no run is recorded."""
        self._publish("between")
        self._observer.run_ends(run, outcome)

    def sentinel_compared(self, drift: Drift) -> None:
        """Pass a sentinel's drift on, and publish it."""
        self._publish(self._state.doing, sentinel=str(drift))
        self._observer.sentinel_compared(drift)

    def prepares(self) -> None:
        """Publish that a campaign goes on, whose state is that of its session before."""
        with contextlib.suppress(OSError):
            self._earlier = (self._folder / STATE_FILE).read_bytes()
        self._prepared = True
        self._publish("preparing")

    def ends(self, status: str, reason: str) -> None:
        """Publish how the session ended, if it started; otherwise the session before it is still the latest."""
        if self._started:
            self._publish("ended", status=status, reason=reason)
        elif self._earlier is not None:
            self._write(self._earlier)
        elif self._prepared:
            with contextlib.suppress(OSError):
                (self._folder / STATE_FILE).unlink(missing_ok=True)

    def _publish(self, doing: Activity, **changes: object) -> None:
        now, before = _now(), self._state
        # Preparing is over once; a person takes any time. Neither says how fast runs are made.
        counts = before.doing not in {"preparing", "asking"}
        busy_s = before.busy_s + ((now - before.since).total_seconds() if counts else 0.0)
        update = {"said": "", "wait_s": 0.0, **changes, "doing": doing, "since": now, "busy_s": busy_s}
        self._state = self._state.model_copy(update=update)
        self._write(self._state.model_dump_json(indent=1).encode())

    def _write(self, content: bytes) -> None:
        part = self._folder / f".{STATE_FILE}.part"
        with contextlib.suppress(OSError, OutputError):
            part.write_bytes(content)
            rename_into_place(part, self._folder / STATE_FILE)


def _planned_duration_s(runs: Sequence[PlannedRun], *, real_time: bool) -> float:
    return sum(run.tare_s + run.duration_s + (run.wait_s if real_time else 0.0) for run in runs)
