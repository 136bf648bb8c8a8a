"""The state file that a running session keeps in its campaign folder, and the lock that shows it is running."""

import contextlib
import os
import sys
import time
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Literal

from pydantic import AwareDatetime, Field, ValidationError

from dragrig.config.errors import OutputError
from dragrig.config.settings import Settings
from dragrig.rig.engine import AcquisitionOutcome
from dragrig.rig.operator import Answer, Operator, Prompt, SessionObserver
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.reading import Reading
from dragrig.rig.runfile.filesystem import BusyError, file_lock, rename_into_place

STATE_FILE = "session-state.json"
LOCK_FILE = "session.lock"
"""Held by the process that carries the session out, and let go by the system when that dies."""
_LOCK_TIMEOUT_S, _LOCK_POLL_S = 2.0, 0.02
"""Who watches holds the lock too, for a moment."""

Activity = Literal["preparing", "asking", "waiting", "recording", "between", "ended"]


def _now() -> datetime:
    return datetime.now().astimezone()


class SessionState(Settings):
    """What a session is doing."""

    format_version: Literal[1] = 1
    plan: str
    backend: str
    double: bool = False
    since: AwareDatetime = Field(default_factory=_now)
    """When it began to do so, by the wall's clock."""
    doing: Activity = "preparing"
    said: str = ""
    """The prompt that waits for an answer, or what is waited for."""
    wait_s: float = 0.0
    """Length of the wait; none where time is not real."""
    real_time: bool = False
    runs: int = 0
    """Runs that this session has to make, ways back included."""
    made: int = 0
    """Which of these began last, from 1."""
    order: int = -1
    run: str = ""
    """The run that was begun last, in a few words."""
    run_s: float = 0.0
    """How long that one records."""
    after_s: float = 0.0
    """How long all runs after it take, rests included, people's hands not."""
    status: str = ""
    """How the session ended."""
    reason: str = ""


def read_state(folder: Path) -> SessionState | None:
    """Read what the latest session of a campaign says of itself; None where there is nothing, or nothing readable."""
    with contextlib.suppress(OSError, ValidationError):
        return SessionState.model_validate_json((folder / STATE_FILE).read_bytes())
    return None


def is_session_running(folder: Path) -> bool:
    """Tell whether a process is carrying out a session of this campaign; nothing is written to find out.

    Where the file system has no locks nobody can tell, and a lock that was left counts as held: what the session said
    last is then believed.
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
    except ImportError:
        return True
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


@contextlib.contextmanager
def session_lock(folder: Path) -> Iterator[None]:
    """Be the only session of a campaign, of all processes, until the block ends or the process dies.

    Raises
    ------
    BusyError
        When another one is at work.
    OutputError
        When the folder refuses.
    """
    busy = f"{folder}: another session of this campaign is at work; go on once it is over."
    until = time.monotonic() + _LOCK_TIMEOUT_S
    with contextlib.ExitStack() as held:
        while True:
            try:
                held.enter_context(file_lock(folder / LOCK_FILE, busy))
                break
            except BusyError:
                if time.monotonic() > until:
                    raise
            time.sleep(_LOCK_POLL_S)
        yield


class StatePublisher:
    """A person, and beside them the file that says what the session is doing.

    The file is small, replaced at once, and written when something begins or ends, never while samples are taken; a
    folder that refuses it is of no account to the session.

    Parameters
    ----------
    state
        What is said from the beginning.
    """

    def __init__(self, person: Operator, watcher: SessionObserver, folder: Path, state: SessionState) -> None:
        self._person, self._watcher, self._folder = person, watcher, folder
        self._state = state
        self._runs: tuple[PlannedRun, ...] = ()
        self._begun = False

    def ask(self, prompt: Prompt) -> Answer:
        """Put the prompt, and say that somebody is waited for."""
        self._says("asking", said=prompt.text)
        answer = self._person.ask(prompt)
        self._says("between", said="")
        return answer

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Say what is to be done."""
        self._begun = True
        self._runs = tuple(pending)
        self._says(
            "preparing", runs=len(pending), real_time=real_time, after_s=sum(map(_planned_duration_s, self._runs))
        )
        self._watcher.begins(programme, pending, real_time=real_time)

    def waits(self, duration_s: float, why: str) -> None:
        """Say what is waited for."""
        self._says("waiting", said=why, wait_s=duration_s if self._state.real_time else 0.0)
        self._watcher.waits(duration_s, why)

    def run_begins(self, run: PlannedRun, order: int) -> None:
        """Say which run is recorded."""
        # Runs before it were made or skipped, and those after it are still to come, also when it is made again.
        later = [one for one in self._runs if one.index > run.index]
        self._says(
            "recording",
            made=len(self._runs) - len(later),
            order=order,
            run=run.protocol.summary(),
            run_s=run.duration_s,
            after_s=sum(map(_planned_duration_s, later)),
        )
        self._watcher.run_begins(run, order)

    def reads(self, reading: Reading) -> None:
        """Hand the block on; the recording itself is what others look at."""
        self._watcher.reads(reading)

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Say that nothing is recorded for the moment."""
        self._says("between")
        self._watcher.run_ends(run, outcome)

    def ends(self, status: str, reason: str) -> None:
        """Say how the session ended; nothing where it never began."""
        if self._begun:
            self._says("ended", status=status, reason=reason)

    def _says(self, doing: Activity, **further: object) -> None:
        told = {"said": "", "wait_s": 0.0, **further}
        self._state = self._state.model_copy(update={"doing": doing, "since": _now(), **told})
        part = self._folder / f".{STATE_FILE}.part"
        with contextlib.suppress(OSError, OutputError):
            part.write_text(self._state.model_dump_json(indent=1), "utf-8")
            rename_into_place(part, self._folder / STATE_FILE)


def _planned_duration_s(run: PlannedRun) -> float:
    return run.wait_s + run.tare_s + run.duration_s
