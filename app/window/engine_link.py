"""The engine's host as a Qt object: what it says and samples become signals, on the screen's own time."""

import time

from PySide6.QtCore import QObject, QTimer, Signal

from dragrig.engine_host.client import EngineClient
from dragrig.engine_host.messages import BEAT_S, SILENCE_S, Lost, Request, RigTerms

_LOOK_MS = 33


class EngineLink(QObject):
    """Starts a host, asks it, and tells what it said; `restart` after it was lost."""

    said = Signal(object)
    """An event of the host's."""
    sampled = Signal(object)
    """Live samples."""

    def __init__(self, rig: RigTerms, parent: QObject | None = None, silence_s: float = SILENCE_S) -> None:
        super().__init__(parent)
        self._rig, self._silence_s = rig, silence_s
        self._client = EngineClient(rig, silence_s)
        self._beat_at = 0.0
        self._timer = QTimer(self)
        self._timer.timeout.connect(self._look)
        self._timer.start(_LOOK_MS)

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
        if now - self._beat_at >= BEAT_S:
            self._beat_at = now
            self._client.beat()
        # Events first: a run's beginning has to be known before its samples.
        for event in self._client.events():
            self.said.emit(event)
            if isinstance(event, Lost):
                return
        fresh = self._client.live.read()
        if fresh is not None:
            self.sampled.emit(fresh)
