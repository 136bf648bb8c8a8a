"""Work on files beside the screen's thread; the last piece of work that was asked for counts."""

from collections.abc import Callable
from typing import TypeVar

from PySide6.QtCore import QObject, QRunnable, QThreadPool, Signal

from dragrig.config.errors import DragrigError

ResultT = TypeVar("ResultT")


class _Told(QObject):
    done = Signal(int, object)
    failed = Signal(int, str)


class _Work(QRunnable):
    def __init__(self, number: int, work: Callable[[], object], told: _Told) -> None:
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


class Background(QObject):
    """Does one kind of work, one piece at a time; a newer piece makes the results of older ones unwanted."""

    def __init__(self, failed: Callable[[str], None], parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._pool = QThreadPool(self)
        # h5py works for one thread of a process at a time.
        self._pool.setMaxThreadCount(1)
        self._failed = failed
        self._number = 0
        self._taken: Callable[[object], None] | None = None
        self._told = _Told(self)
        self._told.done.connect(self._done)
        self._told.failed.connect(self._broke)

    @property
    def busy(self) -> bool:
        """Whether a result is still to come."""
        return self._taken is not None

    def do(self, work: Callable[[], object], taken: Callable[[object], None]) -> None:
        """Do some work; `taken` gets the result on the screen's thread, unless newer work was asked for meanwhile."""
        self._number += 1
        self._taken = taken
        self._pool.clear()
        self._pool.start(_Work(self._number, work, self._told))

    def wait(self) -> None:
        """Wait until nothing is being done."""
        self._pool.clear()
        self._pool.waitForDone()

    def _done(self, number: int, result: object) -> None:
        if number == self._number and self._taken is not None:
            taken, self._taken = self._taken, None
            taken(result)

    def _broke(self, number: int, sentence: str) -> None:
        if number == self._number:
            self._taken = None
            self._failed(sentence)
