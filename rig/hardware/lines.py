"""Digital lines beside the drive's serial link: enable, emergency stop, limit switches, heartbeat.

`DigitalLines` is the interface, `CardLines` its implementation on the card, `NoDigitalLines` that of a rig whose
switches are all wired to the drive. `ConditionalHeartbeat` stops the heartbeat while the program is not well.
"""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from threading import RLock
from typing import Protocol

import nidaqmx
import numpy as np
from nidaqmx.constants import LineGrouping
from nidaqmx.stream_readers import DigitalMultiChannelReader
from nidaqmx.stream_writers import DigitalSingleChannelWriter

from dragrig.rig.devices import Trip, TripCause
from dragrig.rig.hardware.card.connection import Connection, driver_errors_wrapped


@dataclass(frozen=True, slots=True)
class SwitchStates:
    """Which switches are pressed, in the stage's words: a broken wire counts as pressed, an unwired switch does not."""

    e_stop: bool = False
    limit_low: bool = False
    limit_high: bool = False

    def trip(self, *, but: TripCause | None = None) -> Trip | None:
        """Return what the switches forbid, the e-stop first; None when nothing, `but` not counted."""
        for pressed, cause, message in (
            (self.e_stop, TripCause.EMERGENCY_STOP, "the emergency stop is pressed or its wire is broken"),
            (
                self.limit_low,
                TripCause.LIMIT_SWITCH_LOW,
                "the stage is on its lower limit switch, or the wire is broken",
            ),
            (
                self.limit_high,
                TripCause.LIMIT_SWITCH_HIGH,
                "the stage is on its upper limit switch, or the wire is broken",
            ),
        ):
            if pressed and cause is not but:
                return Trip(cause, message)
        return None


class DigitalLines(Protocol):
    """The lines of one rig. Any thread may call any method; each raises `DeviceError` when the lines do not answer."""

    def pressed(self) -> SwitchStates:
        """Read all switches now. Asked at every block, so it has to answer within milliseconds."""
        ...

    def enable(self, on: bool) -> None:
        """Set the drive's enable line; no effect where it is not wired."""
        ...

    def beat(self) -> None:
        """Turn the heartbeat line over once; no effect where it is not wired."""
        ...


class NoDigitalLines:
    """A rig whose drive has all switches on its own terminals."""

    def pressed(self) -> SwitchStates:
        """Nothing is wired, so nothing is pressed."""
        return SwitchStates()

    def enable(self, on: bool) -> None:
        """Nothing is wired."""

    def beat(self) -> None:
        """Nothing is wired."""


class ConditionalHeartbeat:
    """A rig's lines, whose heartbeat is turned over only while all is well. Implements `DigitalLines`.

    Parameters
    ----------
    well
        Says whether the program may go on having the drive's power; asked at every beat.
    """

    def __init__(self, lines: DigitalLines, well: Callable[[], bool]) -> None:
        self._lines, self._well = lines, well

    def pressed(self) -> SwitchStates:
        """Read all switches now."""
        return self._lines.pressed()

    def enable(self, on: bool) -> None:
        """Set the drive's enable line."""
        self._lines.enable(on)

    def beat(self) -> None:
        """Turn the heartbeat line over, or leave it so that the relay opens."""
        if self._well():
            self._lines.beat()


_CALL_TIMEOUT_S = 0.1


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
        with driver_errors_wrapped(self._card, "its digital lines are reserved"), ExitStack() as stack:
            self._inputs = _switch_reader(connection, stack, [line for _, line in self._switches])
            self._enable = _line_writer(connection, stack, wired.enable, "enable")
            self._heartbeat = _line_writer(connection, stack, wired.heartbeat, "heartbeat")
            self._tasks = stack.pop_all()

    def pressed(self) -> SwitchStates:
        """Read all switches in one call of the driver."""
        if self._inputs is None:
            return SwitchStates()
        high = np.zeros(len(self._switches), dtype=np.bool_)
        with driver_errors_wrapped(self._card, "its switches are read"):
            self._inputs.read_one_sample_one_line(high, timeout=_CALL_TIMEOUT_S)
        return SwitchStates(**{name: not level for (name, _), level in zip(self._switches, high.tolist(), strict=True)})

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
        with driver_errors_wrapped(self._card, "its digital lines are released"), tasks:
            self._set(enable, False, "the enable line is taken away")

    def _set(self, line: DigitalSingleChannelWriter | None, high: bool, doing: str) -> None:
        if line is None:
            return
        with driver_errors_wrapped(self._card, doing), self._lock:
            line.write_one_sample_one_line(high, timeout=_CALL_TIMEOUT_S)


def _switch_reader(connection: Connection, stack: ExitStack, lines: list[str]) -> DigitalMultiChannelReader | None:
    if not lines:
        return None
    task = stack.enter_context(connection.task("switches"))
    for line in lines:
        task.di_channels.add_di_chan(connection.terminal(line), line_grouping=LineGrouping.CHAN_PER_LINE)
    task.start()
    reader = DigitalMultiChannelReader(task.in_stream)
    reader.verify_array_shape = False
    return reader


def _line_writer(connection: Connection, stack: ExitStack, line: str, role: str) -> DigitalSingleChannelWriter | None:
    if not line:
        return None
    task: nidaqmx.Task = stack.enter_context(connection.task(role))
    task.do_channels.add_do_chan(connection.terminal(line), line_grouping=LineGrouping.CHAN_PER_LINE)
    task.start()
    writer = DigitalSingleChannelWriter(task.out_stream, auto_start=False)
    writer.write_one_sample_one_line(False, timeout=_CALL_TIMEOUT_S)
    return writer
