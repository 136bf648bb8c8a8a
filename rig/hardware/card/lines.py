"""The card's digital lines: switches in, enable and heartbeat out, each read or set the moment it is asked for."""

from contextlib import ExitStack
from threading import RLock

import nidaqmx
import numpy as np
from nidaqmx.constants import LineGrouping
from nidaqmx.stream_readers import DigitalMultiChannelReader
from nidaqmx.stream_writers import DigitalSingleChannelWriter

from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.faults import told_in_words
from dragrig.rig.hardware.lines import Pressed

_TIMEOUT_S = 0.1


class CardLines:
    """Implements `Lines` on the card. All tasks are reserved from the beginning; whoever makes it closes it.

    Raises
    ------
    DeviceError
        When the card refuses.
    """

    def __init__(self, connection: Connection) -> None:
        self._card = connection.card
        wired = self._card.lines
        self._switches = tuple(
            (name, line)
            for name, line in (
                ("e_stop", wired.e_stop),
                ("limit_low", wired.limit_low),
                ("limit_high", wired.limit_high),
            )
            if line
        )
        # Re-entrant, for a signal handler that stops the stage may interrupt the thread that holds it.
        self._lock = RLock()
        self._beat_high = False
        with told_in_words(self._card, "its digital lines are reserved"), ExitStack() as stack:
            self._inputs = _inputs(connection, stack, [line for _, line in self._switches])
            self._enable = _output(connection, stack, wired.enable, "enable")
            self._heartbeat = _output(connection, stack, wired.heartbeat, "heartbeat")
            self._tasks = stack.pop_all()

    def pressed(self) -> Pressed:
        """Read all switches in one call of the driver."""
        if self._inputs is None:
            return Pressed()
        high = np.zeros(len(self._switches), dtype=np.bool_)
        with told_in_words(self._card, "its switches are read"):
            self._inputs.read_one_sample_one_line(high, timeout=_TIMEOUT_S)
        return Pressed(**{name: not level for (name, _), level in zip(self._switches, high.tolist(), strict=True)})

    def enable(self, on: bool) -> None:
        """Set the drive's enable line."""
        self._set(self._enable, on, "the enable line is set")

    def beat(self) -> None:
        """Turn the heartbeat line over."""
        with self._lock:
            self._beat_high = not self._beat_high
            self._set(self._heartbeat, self._beat_high, "the heartbeat line is turned over")

    def close(self) -> None:
        """Take the enable away and release the lines; twice is once.

        Raises
        ------
        DeviceError
            When the card refuses; it is released all the same.
        """
        with self._lock:
            tasks, self._tasks = self._tasks, ExitStack()
            enable, self._enable = self._enable, None
            self._inputs = self._heartbeat = None
        with told_in_words(self._card, "its digital lines are released"), tasks:
            self._set(enable, False, "the enable line is taken away")

    def _set(self, line: DigitalSingleChannelWriter | None, high: bool, doing: str) -> None:
        if line is None:
            return
        with told_in_words(self._card, doing), self._lock:
            line.write_one_sample_one_line(high, timeout=_TIMEOUT_S)


def _inputs(connection: Connection, stack: ExitStack, lines: list[str]) -> DigitalMultiChannelReader | None:
    if not lines:
        return None
    task = stack.enter_context(connection.task("switches"))
    for line in lines:
        task.di_channels.add_di_chan(connection.terminal(line), line_grouping=LineGrouping.CHAN_PER_LINE)
    task.start()
    reader = DigitalMultiChannelReader(task.in_stream)
    reader.verify_array_shape = False
    return reader


def _output(connection: Connection, stack: ExitStack, line: str, role: str) -> DigitalSingleChannelWriter | None:
    if not line:
        return None
    task: nidaqmx.Task = stack.enter_context(connection.task(role))
    task.do_channels.add_do_chan(connection.terminal(line), line_grouping=LineGrouping.CHAN_PER_LINE)
    task.start()
    writer = DigitalSingleChannelWriter(task.out_stream, auto_start=False)
    writer.write_one_sample_one_line(False, timeout=_TIMEOUT_S)
    return writer
