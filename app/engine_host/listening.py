"""The host's ear and mouth: two threads, so that the engine neither waits for its client nor misses its death."""

import queue
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from threading import Event as Signal
from threading import Lock, Thread

from dragrig.engine_host.messages import SILENCE_S, Abort, Answer, Event, Leave, Reply, Request, Start

_WAKE_S = 0.25
GONE = "the window is gone"
SILENT = "the window has been silent for too long"


class Mouth:
    """Sends events in order from a thread of its own; `say` returns at once."""

    def __init__(self, connection: "Connection[Event, Request]") -> None:
        self._connection = connection
        self._events: queue.SimpleQueue[Event | None] = queue.SimpleQueue()
        self._thread = Thread(target=self._send_all, name="mouth", daemon=True)
        self._thread.start()

    def say(self, event: Event) -> None:
        """Have an event sent."""
        self._events.put(event)

    def close(self, within_s: float = 2.0) -> None:
        """Wait until all is sent, or nobody listens."""
        self._events.put(None)
        self._thread.join(within_s)

    def _send_all(self) -> None:
        while (event := self._events.get()) is not None:
            try:
                self._connection.send(event)
            except OSError:
                return


class Ear:
    """Hears requests on a thread of its own: stops and answers at once, the others in order from `next`.

    Attributes
    ----------
    gone
        Set once there is no client any more, or it wants the host to end.
    """

    def __init__(self, connection: "Connection[Event, Request]", silence_s: float = SILENCE_S) -> None:
        self._connection = connection
        self._silence_s = silence_s
        self._requests: queue.SimpleQueue[Request | None] = queue.SimpleQueue()
        self._lock = Lock()
        self._stop: Callable[[str], None] | None = None
        self._stop_reason = ""
        self._questions: dict[int, queue.SimpleQueue[Answer]] = {}
        self.gone = Signal()
        Thread(target=self._listen, name="ear", daemon=True).start()

    def next(self) -> Request | None:
        """Wait for a request; none once the client is gone."""
        return None if self.gone.is_set() else self._requests.get()

    def stops(self, stop: Callable[[str], None] | None) -> None:
        """Name what stops the session under way; a stop that came before it is passed on now."""
        with self._lock:
            self._stop, reason = stop, self._stop_reason
        if stop is not None and reason:
            stop(reason)

    def await_answer(self, question: int) -> Answer:
        """Wait for the answer to a question; abort where the session is to end."""
        box: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        with self._lock:
            self._questions[question] = box
            ending = bool(self._stop_reason)
        if ending:
            box.put(Answer.ABORT)
        try:
            return box.get()
        finally:
            with self._lock:
                del self._questions[question]

    def _listen(self) -> None:
        reason = GONE
        heard = time.monotonic()
        with suppress(EOFError, OSError):
            while True:
                if self._connection.poll(_WAKE_S):
                    request = self._connection.recv()
                    heard = time.monotonic()
                    self._hear(request)
                    if isinstance(request, Leave):
                        reason = "the window was closed"
                        break
                elif time.monotonic() - heard > self._silence_s:
                    reason = SILENT
                    break
        self.gone.set()
        self._end(reason)
        self._requests.put(None)

    def _hear(self, request: Request) -> None:
        match request:
            case Abort(reason):
                self._end(reason)
            case Reply(question, answer):
                with self._lock:
                    box = self._questions.get(question)
                if box is not None:
                    box.put(answer)
            case Start():
                with self._lock:
                    self._stop_reason = ""
                self._requests.put(request)
            case Leave():
                pass
            case _:
                self._requests.put(request)

    def _end(self, reason: str) -> None:
        with self._lock:
            self._stop_reason = self._stop_reason or reason
            stop, boxes = self._stop, tuple(self._questions.values())
        if stop is not None:
            stop(reason)
        for box in boxes:
            box.put(Answer.ABORT)
