"""Has what was flushed reach the disk itself, in a thread that nobody waits for."""

import os
from pathlib import Path
from threading import Condition, Thread


class Syncer:
    """Calls `fsync` on a file when asked; requests that come while one is under way become one.

    A refusal is raised by the next `request`.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0))
        self._change = Condition()
        self._asked = False
        self._closed = False
        self._fault: OSError | None = None
        self._thread = Thread(target=self._sync, name=f"sync of {path.name}", daemon=True)
        self._thread.start()

    def request(self) -> None:
        """Ask for a sync of all that was written so far."""
        with self._change:
            if self._fault is not None:
                raise self._fault
            self._asked = True
            self._change.notify()

    def close(self) -> None:
        """End after the last sync asked for."""
        with self._change:
            self._closed = True
            self._change.notify()
        self._thread.join()

    def _sync(self) -> None:
        try:
            while self._wait():
                os.fsync(self._descriptor)
        except OSError as fault:
            with self._change:
                self._fault = fault
        finally:
            os.close(self._descriptor)

    def _wait(self) -> bool:
        with self._change:
            self._change.wait_for(lambda: self._asked or self._closed)
            asked, self._asked = self._asked, False
            return asked
