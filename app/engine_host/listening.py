"""The host's ear and mouth: two threads, so that the engine neither waits for its client nor misses its death."""

import queue
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from threading import Event as Signal
from threading import Lock, Thread

from dragrig.engine_host.messages import SILENCE_S, Abort, Answer, Beat, Event, Leave, Reply, Request

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

    A stop is for what had been asked before it came, under way or still to be begun, and for nothing asked later.

    Attributes
    ----------
    gone
        Set once there is no client any more, or it wants the host to end.
    """

    def __init__(self, connection: "Connection[Event, Request]", silence_s: float = SILENCE_S) -> None:
        self._connection = connection
        self._silence_s = silence_s
        self._requests: queue.SimpleQueue[tuple[int, Request] | None] = queue.SimpleQueue()
        self._lock = Lock()
        self._heard = self._at_hand = self._stopped = 0
        self._stop: Callable[[str], None] | None = None
        self._stop_reason = ""
        self._questions: dict[int, queue.SimpleQueue[Answer]] = {}
        self.gone = Signal()
        Thread(target=self._listen, name="ear", daemon=True).start()

    def next(self) -> Request | None:
        """Wait for a request; none once the client is gone."""
        found = None if self.gone.is_set() else self._requests.get()
        if found is None:
            return None
        with self._lock:
            self._at_hand, request = found
        return request

    def stops(self, stop: Callable[[str], None] | None) -> None:
        """Name what stops the request at hand; a stop that came before it is passed on now."""
        with self._lock:
            self._stop, reason = stop, self._stop_reason if self._ending else ""
        if stop is not None and reason:
            stop(reason)

    def await_answer(self, question: int, put: Callable[[], None]) -> Answer:
        """Put a question and wait for its answer; abort where the request at hand is to end."""
        box: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        with self._lock:
            self._questions[question] = box
            if self._ending:
                box.put(Answer.ABORT)
        try:
            # Not before there is a box for the answer, which may be quick.
            put()
            return box.get()
        finally:
            with self._lock:
                del self._questions[question]

    @property
    def _ending(self) -> bool:
        """Whether the request at hand is to end; asked with the lock held."""
        return self._at_hand <= self._stopped

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
            case Beat() | Leave():
                pass
            case _:
                with self._lock:
                    self._heard += 1
                    self._requests.put((self._heard, request))

    def _end(self, reason: str) -> None:
        with self._lock:
            if self._stopped < self._heard:  # else all that was asked is to end already, for the reason given first
                self._stopped, self._stop_reason = self._heard, reason
            stop, reason, boxes = self._stop, self._stop_reason, tuple(self._questions.values())
        if stop is not None:
            stop(reason)
        for box in boxes:
            box.put(Answer.ABORT)
