"""Digital lines beside the drive's serial link: enable, emergency stop, limit switches, heartbeat."""

from contextlib import ExitStack
from dataclasses import dataclass
from threading import RLock

import nidaqmx
import numpy as np
from nidaqmx.constants import LineGrouping
from nidaqmx.stream_readers import DigitalMultiChannelReader
from nidaqmx.stream_writers import DigitalSingleChannelWriter

from dragrig.rig import Trip, TripCause
from dragrig.rig.hardware.card import Connection, driver_errors_wrapped

_CALL_TIMEOUT_S = 0.1
_SWITCH_TRIPS = {
    "e_stop": Trip(TripCause.EMERGENCY_STOP, "the emergency stop is pressed or its wire is broken"),
    "limit_low": Trip(TripCause.LIMIT_SWITCH_LOW, "the stage is on its lower limit switch, or the wire is broken"),
    "limit_high": Trip(TripCause.LIMIT_SWITCH_HIGH, "the stage is on its upper limit switch, or the wire is broken"),
}
"""In order of precedence."""
_INPUT_TRIPS = {
    **_SWITCH_TRIPS,
    "encoder_error": Trip(
        TripCause.ENCODER_ERROR,
        "the encoder's read head reports an error, or its E line's wire is broken; clean the scale, and check the gap",
    ),
}


@dataclass(frozen=True, slots=True)
class SwitchStates:
    """Which switches are pressed, and whether the encoder reports an error.

    A broken wire counts as pressed, an unwired switch as released.
    """

    e_stop: bool = False
    limit_low: bool = False
    limit_high: bool = False
    encoder_error: bool = False

    @property
    def pressed(self) -> frozenset[str]:
        """Names of the switches that are pressed."""
        return frozenset(switch for switch in _SWITCH_TRIPS if getattr(self, switch))

    def trip(self, *, ignoring: TripCause | None = None) -> Trip | None:
        """Return the trip of the first pressed switch or error, the e-stop before all; `ignoring` is passed over."""
        for switch, trip in _INPUT_TRIPS.items():
            if getattr(self, switch) and trip.cause is not ignoring:
                return trip
        return None


class CardLines:
    """The lines of one rig, on the card. All tasks are reserved in the constructor; the caller closes them.

    Any thread may call any method. Each, and the constructor, raises `DeviceError` when the card refuses or does not
    answer. A line that is not wired is set and inverted without effect.
    """

    def __init__(self, connection: Connection) -> None:
        self._card = connection.card
        wired = self._card.lines
        self._inputs = [name for name in _INPUT_TRIPS if getattr(wired, name)]
        # Re-entrant, because a signal handler that stops the stage may interrupt the thread that holds it.
        self._lock = RLock()
        self._heartbeat_high = False
        with driver_errors_wrapped(self._card, "its digital lines are reserved"), ExitStack() as stack:
            switch_lines = [getattr(wired, name) for name in self._inputs]
            self._switch_reader = _switch_reader(connection, stack, switch_lines)
            self._enable = _line_writer(connection, stack, wired.enable, "enable")
            self._heartbeat = _line_writer(connection, stack, wired.heartbeat, "heartbeat")
            self._tasks = stack.pop_all()

    @property
    def wired_switches(self) -> tuple[str, ...]:
        """Switches that have a line."""
        return tuple(name for name in self._inputs if name in _SWITCH_TRIPS)

    @property
    def has_heartbeat(self) -> bool:
        """Whether a heartbeat relay is wired."""
        return self._heartbeat is not None

    def read_switches(self) -> SwitchStates:
        """Read all switches and the encoder's error line in one call of the driver.

        Called at every block, so it has to return within milliseconds.
        """
        if self._switch_reader is None:
            return SwitchStates()
        high = np.zeros(len(self._inputs), dtype=np.bool_)
        with driver_errors_wrapped(self._card, "its switches are read"):
            self._switch_reader.read_one_sample_one_line(high, timeout=_CALL_TIMEOUT_S)
        # Normally closed contacts: a pressed switch and a broken wire read low.
        return SwitchStates(**{name: not level for name, level in zip(self._inputs, high.tolist(), strict=True)})

    def set_enable(self, on: bool) -> None:
        """Set the drive's enable line."""
        self._write(self._enable, on, "the enable line is set")

    def toggle_heartbeat(self) -> None:
        """Invert the heartbeat line."""
        with self._lock:
            self._heartbeat_high = not self._heartbeat_high
            self._write(self._heartbeat, self._heartbeat_high, "the heartbeat line is inverted")

    def close(self) -> None:
        """Clear the enable line and release all lines. Safe to call twice.

        Raises `DeviceError` when the card refuses; it is released all the same.
        """
        with self._lock:
            tasks, self._tasks = self._tasks, ExitStack()
            enable, self._enable = self._enable, None
            self._switch_reader = self._heartbeat = None
        with driver_errors_wrapped(self._card, "its digital lines are released"), tasks:
            self._write(enable, False, "the enable line is cleared")

    def _write(self, line: DigitalSingleChannelWriter | None, high: bool, doing: str) -> None:
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
