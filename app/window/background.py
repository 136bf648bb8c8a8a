"""Work beside the GUI thread: engine events and live samples as Qt signals, and file work in a worker thread."""

import time
from collections.abc import Callable
from typing import Any, TypeVar

from PySide6.QtCore import QObject, QRunnable, QThreadPool, QTimer, Signal

from dragrig import engine_host
from dragrig.config import DragrigError

ResultT = TypeVar("ResultT")


class _WorkSignals(QObject):
    done = Signal(int, object)
    failed = Signal(int, str)


class _WorkItem(QRunnable):
    def __init__(self, number: int, work: Callable[[], object], signals: _WorkSignals) -> None:
        super().__init__()
        self._number, self._work, self._signals = number, work, signals

    def run(self) -> None:
        try:
            result = self._work()
        except DragrigError as error:
            self._signals.failed.emit(self._number, str(error))
        except Exception as error:  # noqa: BLE001  # shown by the GUI thread
            self._signals.failed.emit(self._number, f"a bug ({type(error).__name__}: {error}); please report it")
        else:
            self._signals.done.emit(self._number, result)


class FileWorker(QObject):
    """Runs functions one after another in a worker thread; results arrive on the GUI thread."""

    def __init__(self, failed: Callable[[str], None], parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._pool = QThreadPool(self)
        # h5py runs one thread of a process at a time.
        self._pool.setMaxThreadCount(1)
        self._failed = failed
        self._number = 0
        self._receivers: dict[int, Callable[[Any], None]] = {}
        self._signals = _WorkSignals(self)
        self._signals.done.connect(self._done)
        self._signals.failed.connect(self._report_failure)

    @property
    def busy(self) -> bool:
        """Whether a result is pending."""
        return bool(self._receivers)

    def do(self, work: Callable[[], ResultT], receive: Callable[[ResultT], None]) -> None:
        """Run a function in place of those submitted before, whose results are dropped."""
        self._pool.clear()
        self._receivers.clear()
        self.do_too(work, receive)

    def do_too(self, work: Callable[[], ResultT], receive: Callable[[ResultT], None]) -> None:
        """Run a function after those submitted before; `receive` is called with its result."""
        self._number += 1
        self._receivers[self._number] = receive
        self._pool.start(_WorkItem(self._number, work, self._signals))

    def drop(self) -> None:
        """Cancel what has not started, and wait for what has."""
        self._pool.clear()
        self._pool.waitForDone()

    def finish(self) -> None:
        """Wait until everything is done."""
        self._pool.waitForDone()

    def _done(self, number: int, result: object) -> None:
        receive = self._receivers.pop(number, None)
        if receive is not None:
            receive(result)

    def _report_failure(self, number: int, sentence: str) -> None:
        if self._receivers.pop(number, None) is not None:
            self._failed(sentence)


_ENGINE_POLL_MS = 33


class EngineLink(QObject):
    """An engine host, with its events and samples as signals; `restart` replaces it.

    Signs of life come from this thread's event loop, as a stop would: a window that takes no key gives none either.
    """

    event_received = Signal(object)
    """An event of the host."""
    sampled = Signal(object)
    """Live samples."""

    def __init__(
        self,
        rig: engine_host.RigSelection,
        parent: QObject | None = None,
        silence: engine_host.SilenceLimits = engine_host.SILENCE_LIMITS,
    ) -> None:
        super().__init__(parent)
        self._rig, self._silence = rig, silence
        self._client = engine_host.EngineClient(rig, silence)
        self._heartbeat_at = 0.0
        self._timer = QTimer(self)
        self._timer.timeout.connect(self._poll)
        self._timer.start(_ENGINE_POLL_MS)

    @property
    def pid(self) -> int | None:
        """Process id of the host."""
        return self._client.pid

    @property
    def lost(self) -> bool:
        """Whether the host is gone."""
        return self._client.lost

    def ask(self, request: engine_host.Request) -> None:
        """Send a request."""
        self._client.ask(request)

    def restart(self) -> None:
        """Start another host in place of a lost one, or of one that does nothing now; it reads the settings anew."""
        self._client.close()
        self._client = engine_host.EngineClient(self._rig, self._silence)

    def close(self) -> None:
        """End the host, after stopping a running session."""
        self._timer.stop()
        self._client.close()

    def _poll(self) -> None:
        now = time.monotonic()
        if now - self._heartbeat_at >= engine_host.HEARTBEAT_S:
            self._heartbeat_at = now
            self._client.beat()
        # Events first: a run's start comes before its samples.
        for event in self._client.events():
            self.event_received.emit(event)
            if isinstance(event, engine_host.HostLost):
                return
        fresh = self._client.live.read()
        if fresh is not None:
            self.sampled.emit(fresh)
