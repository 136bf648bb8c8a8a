"""Garbage is collected on the screen's thread alone, while a window is open."""

import gc

from PySide6.QtCore import QObject, QTimer

LOOK_MS = 200


class Tidying(QObject):
    """Collects cyclic garbage now and then, in place of the interpreter.

    The interpreter collects on whichever thread happens to allocate. On a thread that reads files it would take plots
    apart that the screen's thread is drawing: each then waits for the other's lock for ever, and the window, with its
    stop button, stands still.
    """

    def __init__(self, parent: QObject) -> None:
        super().__init__(parent)
        self._timer = QTimer(self)
        self._timer.setInterval(LOOK_MS)
        self._timer.timeout.connect(self._collect)

    def begin(self) -> None:
        """Take garbage over from the interpreter."""
        gc.disable()
        self._timer.start()

    def end(self) -> None:
        """Leave it to the interpreter again."""
        self._timer.stop()
        gc.enable()

    def _collect(self) -> None:
        gc.disable()  # another window, closed meanwhile, has given it back
        counts, limits = gc.get_count(), gc.get_threshold()
        for generation in (2, 1, 0):
            if counts[generation] > limits[generation]:
                gc.collect(generation)
                return
