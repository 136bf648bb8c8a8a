"""Work on files beside the screen's thread."""

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
    """Does one kind of work, one piece at a time, and hands results over on the screen's thread."""

    def __init__(self, failed: Callable[[str], None], parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._pool = QThreadPool(self)
        # h5py works for one thread of a process at a time.
        self._pool.setMaxThreadCount(1)
        self._failed = failed
        self._number = 0
        self._wanted: dict[int, Callable[[object], None]] = {}
        self._told = _Told(self)
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
        self._pool.start(_Work(self._number, work, self._told))

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
