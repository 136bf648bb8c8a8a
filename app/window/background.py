"""Work beside the GUI thread: engine events and live samples as Qt signals, and file work in a worker thread."""

import time
from collections.abc import Callable
from typing import TypeVar

from PySide6.QtCore import QObject, QRunnable, QThreadPool, QTimer, Signal

from dragrig.config.errors import DragrigError
from dragrig.engine_host.client import EngineClient
from dragrig.engine_host.messages import HEARTBEAT_S, SILENCE_TIMEOUT_S, HostLost, Request, RigSelection

ResultT = TypeVar("ResultT")


class _WorkSignals(QObject):
    done = Signal(int, object)
    failed = Signal(int, str)


class _WorkItem(QRunnable):
    def __init__(self, number: int, work: Callable[[], object], told: _WorkSignals) -> None:
        super().__init__()
        self._number, self._work, self._told = number, work, told

    def run(self) -> None:
        try:
            result = self._work()
        except DragrigError as error:
            self._told.failed.emit(self._number, str(error))
        except Exception as error:  # noqa: BLE001  # a thread's error has to be told on the screen's
            self._told.failed.emit(self._number, f"a bug ({type(error).__name__}: {error}); please report it")
        else:
            self._told.done.emit(self._number, result)


class FileWorker(QObject):
    """Does one kind of work, one piece at a time, and hands results over on the screen's thread."""

    def __init__(self, failed: Callable[[str], None], parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._pool = QThreadPool(self)
        # h5py works for one thread of a process at a time.
        self._pool.setMaxThreadCount(1)
        self._failed = failed
        self._number = 0
        self._wanted: dict[int, Callable[[object], None]] = {}
        self._told = _WorkSignals(self)
        self._told.done.connect(self._done)
        self._told.failed.connect(self._broke)

    @property
    def busy(self) -> bool:
        """Whether a result is still to come."""
        return bool(self._wanted)

    def do(self, work: Callable[[], object], taken: Callable[[object], None]) -> None:
        """Do some work in place of all that was asked for before, whose results are not wanted any more."""
        self._pool.clear()
        self._wanted.clear()
        self.do_too(work, taken)

    def do_too(self, work: Callable[[], object], taken: Callable[[object], None]) -> None:
        """Do some work after what was asked for before; `taken` gets its result."""
        self._number += 1
        self._wanted[self._number] = taken
        self._pool.start(_WorkItem(self._number, work, self._told))

    def drop(self) -> None:
        """Leave what has not begun, and wait for what has."""
        self._pool.clear()
        self._pool.waitForDone()

    def finish(self) -> None:
        """Wait until all is done."""
        self._pool.waitForDone()

    def _done(self, number: int, result: object) -> None:
        taken = self._wanted.pop(number, None)
        if taken is not None:
            taken(result)

    def _broke(self, number: int, sentence: str) -> None:
        if self._wanted.pop(number, None) is not None:
            self._failed(sentence)


_ENGINE_POLL_MS = 33


class EngineLink(QObject):
    """Starts a host, asks it, and tells what it said; `restart` after it was lost."""

    said = Signal(object)
    """An event of the host's."""
    sampled = Signal(object)
    """Live samples."""

    def __init__(self, rig: RigSelection, parent: QObject | None = None, silence_s: float = SILENCE_TIMEOUT_S) -> None:
        super().__init__(parent)
        self._rig, self._silence_s = rig, silence_s
        self._client = EngineClient(rig, silence_s)
        self._beat_at = 0.0
        self._timer = QTimer(self)
        self._timer.timeout.connect(self._look)
        self._timer.start(_ENGINE_POLL_MS)

    @property
    def pid(self) -> int | None:
        """Process id of the host."""
        return self._client.pid

    @property
    def lost(self) -> bool:
        """Whether the host is gone."""
        return self._client.lost

    def ask(self, request: Request) -> None:
        """Send a request."""
        self._client.ask(request)

    def restart(self) -> None:
        """Start another host in place of one that is gone."""
        self._client.close(0.0)
        self._client = EngineClient(self._rig, self._silence_s)

    def close(self) -> None:
        """End the host; a session under way is stopped and its run finished first."""
        self._timer.stop()
        self._client.close()

    def _look(self) -> None:
        now = time.monotonic()
        if now - self._beat_at >= HEARTBEAT_S:
            self._beat_at = now
            self._client.beat()
        # Events first: a run's beginning has to be known before its samples.
        for event in self._client.events():
            self.said.emit(event)
            if isinstance(event, HostLost):
                return
        fresh = self._client.live.read()
        if fresh is not None:
            self.sampled.emit(fresh)
