"""The stage's position by a counter of its own, read whenever it is asked for."""

from contextlib import ExitStack

import nidaqmx

from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.faults import told_in_words
from dragrig.rig.hardware.card.tasks import add_encoder

_TIMEOUT_S = 0.1


class PositionCounter:
    """A counter on the encoder that runs from `begin` to `close`, beside the one that is sampled.

    Parameters
    ----------
    counter
        Such as ctr1.
    mm_per_count
        Signed: negative where the encoder counts down while the stage goes up.
    """

    def __init__(self, connection: Connection, counter: str, mm_per_count: float) -> None:
        self._connection = connection
        self._counter = counter
        self._metres_per_count = abs(mm_per_count) / 1000.0
        self._mm_per_metre = 1000.0 if mm_per_count > 0 else -1000.0
        self._task: nidaqmx.Task | None = None

    def begin(self, at_mm: float, *, index: bool = False) -> None:
        """Count on from a position, which the stage is at now; the index pulse makes it 0 if it is to.

        Raises
        ------
        DeviceError
            When the card refuses.
        """
        self.close()
        card = self._connection.card
        with told_in_words(card, "the position counter is started"), ExitStack() as stack:
            task = stack.enter_context(self._connection.task("position counter"))
            start_m = at_mm / self._mm_per_metre
            add_encoder(task, card, self._metres_per_count, self._counter, start_m=start_m, index=index)
            task.start()
            stack.pop_all()
        self._task = task

    def read(self) -> float:
        """Return the position now [mm]; raises `DeviceError` when the card refuses."""
        task = self._task
        with told_in_words(self._connection.card, "the position is read"):
            return 0.0 if task is None else float(task.read(timeout=_TIMEOUT_S)) * self._mm_per_metre

    def close(self) -> None:
        """Release the counter; twice is once."""
        task, self._task = self._task, None
        if task is not None:
            with told_in_words(self._connection.card, "the position counter is released"):
                task.close()
