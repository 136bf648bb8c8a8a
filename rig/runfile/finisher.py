"""Finishing in the background: a worker process repacks while the next run is recorded.

`python -m dragrig.rig.runfile.finisher` is the worker: it reads recordings from standard input, a line of
JSON each, answers each with a line of JSON and ends with its input. It is a process of its own because
h5py works for one thread of a process at a time: a repack would stall the recorder of the next run.
"""

import json
import os
import queue
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Condition, Thread
from types import TracebackType
from typing import Self

from dragrig.config import errors
from dragrig.config.errors import DragrigError, OutputError


@dataclass(frozen=True, slots=True)
class Finished:
    """What became of a recording: the run file, or why it is still a recording."""

    recording: Path
    path: Path | None
    error: DragrigError | None = None


class Finisher:
    """Finishes recordings in a worker process that is started when first needed.

    When this process dies, the worker ends the recording at hand and exits. When the worker dies, `wait`
    finishes what it left in this process. An interrupt from the terminal does not reach the worker.
    As a context it waits at its end and raises the first error that no `wait` has returned.

    Parameters
    ----------
    told
        Called with each finished run file, on the finisher's thread or on that which waits; it must be quick.
    """

    def __init__(self, told: Callable[[Path], None] | None = None) -> None:
        self._told = told
        self._jobs: queue.SimpleQueue[Path | None] = queue.SimpleQueue()
        self._change = Condition()
        self._done: list[Finished] = []
        self._left: list[Path] = []
        self._asked = 0
        self._answered = 0
        self._thread: Thread | None = None
        self._worker: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            for done in self.wait() if fault is None else ():
                if done.error is not None:
                    raise done.error
        finally:
            self.close()

    @property
    def pending(self) -> int:
        """How many recordings are still to be finished."""
        with self._change:
            return self._asked - self._answered + len(self._left)

    @property
    def worker_pid(self) -> int | None:
        """Process id of the worker, once it has been started."""
        return self._worker.pid if self._worker is not None else None

    def submit(self, recording: Path) -> None:
        """Have a closed recording finished; returns at once."""
        with self._change:
            self._asked += 1
            if self._thread is None:
                self._thread = Thread(target=self._hand_out, name="finisher", daemon=True)
                self._thread.start()
        self._jobs.put(recording)

    def wait(self, timeout_s: float | None = None) -> tuple[Finished, ...]:
        """Wait until every recording submitted is finished, or the time is over.

        Returns
        -------
        What became of each recording since the last call, in the order of finishing.
        """
        with self._change:
            self._change.wait_for(lambda: self._asked == self._answered, timeout_s)
            left, self._left = self._left, []
        here = [finished(recording) for recording in left]
        for one in here:
            self._tell(one)
        with self._change:
            done, self._done = self._done, []
        return (*done, *here)

    def close(self) -> None:
        """Let the worker end the recording at hand and exit; what is still queued stays a recording."""
        with self._change:
            if self._thread is not None:
                self._jobs.put(None)

    def _hand_out(self) -> None:
        while (recording := self._jobs.get()) is not None:
            answer = self._ask(recording)
            self._tell(answer)
            with self._change:
                if answer is None:
                    self._left.append(recording)
                else:
                    self._done.append(answer)
                self._answered += 1
                self._change.notify_all()
        if self._worker is not None:
            self._worker.communicate()

    def _tell(self, done: Finished | None) -> None:
        if self._told is not None and done is not None and done.path is not None:
            self._told(done.path)

    def _ask(self, recording: Path) -> Finished | None:
        """Have the worker finish a recording; None when there is no worker any more."""
        try:
            if self._worker is None:
                self._worker = _start_worker()
            if self._worker.stdin is None or self._worker.stdout is None:
                return None
            self._worker.stdin.write(json.dumps(str(recording.absolute())) + "\n")
            self._worker.stdin.flush()
            answer = self._worker.stdout.readline()
        except OSError:
            return None
        return _parsed(recording, answer) if answer.endswith("\n") else None


def finished(recording: Path) -> Finished:
    """Finish a recording in this process; an error is part of the answer."""
    from dragrig.rig.runfile.repack import finish

    try:
        return Finished(recording, finish(recording))
    except DragrigError as fault:
        return Finished(recording, None, fault)


def _start_worker() -> subprocess.Popen[str]:
    flags = 0
    if sys.platform == "win32":
        flags = subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.BELOW_NORMAL_PRIORITY_CLASS
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "dragrig.rig.runfile.finisher"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        encoding="utf-8",
        start_new_session=True,
        creationflags=flags,
    )


def _parsed(recording: Path, line: str) -> Finished:
    answer = json.loads(line)
    if answer["path"]:
        return Finished(recording, Path(answer["path"]))
    kind = getattr(errors, answer["kind"], OutputError)
    return Finished(recording, None, kind(answer["message"]))


def work() -> None:
    """Finish what standard input names, until it ends; nobody may be left to hear the answers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(10)
    for line in sys.stdin:
        done = finished(Path(json.loads(line)))
        answer = {
            "path": str(done.path) if done.path else "",
            "kind": type(done.error).__name__,
            "message": str(done.error),
        }
        with suppress(BrokenPipeError):
            sys.stdout.write(json.dumps(answer) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    work()
