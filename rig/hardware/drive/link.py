"""The serial link to the drive: one request and its reply at a time, and a stop before all other requests.

The port is opened with pyserial; a pulled cable raises errors of several kinds, which are all caught here.
"""

import itertools
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from queue import SimpleQueue
from statistics import median

import serial

from dragrig.config.errors import DeviceError
from dragrig.config.hardware import DriveSettings
from dragrig.rig.hardware.dialects.base import Command, Dialect, FrameError, Parameter, Refusal, Reply, Request

if sys.platform != "win32":
    import termios

    CABLE_ERRORS: tuple[type[Exception], ...] = (OSError, termios.error)
else:
    CABLE_ERRORS = (OSError,)
"""What a pulled cable raises: SerialException is an OSError, a terminal's error is not."""

_OPENING_ERRORS: tuple[type[Exception], ...] = (*CABLE_ERRORS, ValueError)
WRITE_TIMEOUT_ERROR = serial.SerialTimeoutException
"""What a write raises that took too long; to a socket, even though all of it was sent."""
_PARITIES = {"none": serial.PARITY_NONE, "even": serial.PARITY_EVEN, "odd": serial.PARITY_ODD}
_STOP_BITS = {1: serial.STOPBITS_ONE, 2: serial.STOPBITS_TWO}
_READS_PER_REPLY = 5


def open_port(settings: DriveSettings) -> serial.Serial:
    """Open the drive's port for this program alone, where the system can do that.

    Raises
    ------
    DeviceError
        When there is no such port, or another program has it.
    """
    try:
        return serial.serial_for_url(
            settings.port,
            baudrate=settings.baud,
            bytesize=serial.EIGHTBITS,
            parity=_PARITIES[settings.parity],
            stopbits=_STOP_BITS[settings.stop_bits],
            timeout=settings.reply_s / _READS_PER_REPLY,
            write_timeout=settings.reply_s,
            exclusive=True,
        )
    except _OPENING_ERRORS as error:
        number = error.errno if isinstance(error, OSError) else None
        why = os.strerror(number) if number else str(error)
        raise DeviceError(
            f"the drive's port {settings.port} cannot be opened ({why}): connect it, close other programs that use "
            "it, or correct hardware.drive.port of the rig file."
        ) from error


def close_port(port: serial.Serial) -> None:
    """Close a port, whose cable may be gone."""
    # pyserial forgets to close its socket when the other side was first.
    connection = getattr(port, "_socket", None)
    port.close()
    if connection is not None:
        connection.close()


_ROUND_TRIPS_KEPT = 15
_STOP = Request(Command.STOP)


class RefusedError(DeviceError):
    """The drive answered, and did not do what it was told."""

    def __init__(self, message: str, refusal: Refusal) -> None:
        super().__init__(message)
        self.refusal = refusal


class CancelledByStopError(DeviceError):
    """A request was dropped, because a stop was asked for after it was planned."""


class NoReplyError(DeviceError):
    """The drive did not answer in time, or not in its dialect."""


class DriveLink:
    """A drive on a serial port, opened at once. Any thread may call anything.

    Raises
    ------
    DeviceError
        When the port cannot be opened.
    """

    def __init__(self, settings: DriveSettings, dialect: Dialect) -> None:
        self._settings = settings
        self._dialect = dialect
        self._serial = open_port(settings)
        # Re-entrant, for whoever has reserved the line also talks on it.
        self._lock = threading.RLock()
        self._broken = ""
        self._closed = False
        self._round_trips_s: deque[float] = deque(maxlen=_ROUND_TRIPS_KEPT)
        # A counter and a SimpleQueue may be used by a signal handler that interrupts their own user; an Event may not.
        self._counter = itertools.count(1)
        self._stops = self._stopped = 0
        self._wakings: SimpleQueue[bool] = SimpleQueue()
        self._listeners: list[Callable[[], None]] = []
        self._stopper = threading.Thread(target=self._serve_stops, name="drive stopper", daemon=True)
        self._stopper.start()

    @property
    def port(self) -> str:
        """The port, as the settings name it."""
        return self._settings.port

    @property
    def dialect(self) -> Dialect:
        """How the drive is spoken to."""
        return self._dialect

    @property
    def round_trip_s(self) -> float:
        """Median of the latest times between a request and its reply, of the wall's clock; 0 before the first."""
        return median(self._round_trips_s) if self._round_trips_s else 0.0

    @property
    def stops(self) -> int:
        """Which stop was asked for last: a mark for `exchange`."""
        return self._stops

    def on_stop(self, listener: Callable[[], None]) -> None:
        """Call `listener` from a thread of the link's whenever a stop was asked for, before it is sent."""
        self._listeners.append(listener)

    def stop(self) -> None:
        """Ask for a stop and return at once; it is sent as soon as the reply that is awaited is in.

        Safe in any thread and in signal handlers, at any time, twice too. Until the drive has answered it, every other
        request sends it first.
        """
        self._stops = next(self._counter)
        self._wakings.put(True)

    def exchange(self, request: Request, as_of: int | None = None) -> Reply:
        """Send a request and return its reply.

        Parameters
        ----------
        as_of
            What `stops` was when this was planned: it is dropped when a stop was asked for since.

        Raises
        ------
        RefusedError
            When the drive refuses.
        StoppedFirstError
            When a stop came first.
        NoReplyError
            When no reply came that is whole and fits; sent again once, unless it must not be done twice.
        DeviceError
            When the port fails.
        """
        with self._lock:
            self._send_stop_if_due()
            if as_of is not None and as_of != self._stops:
                raise CancelledByStopError(f"'{request.command}' was dropped, because the stage was stopped first.")
            try:
                return self._ask(request)
            except NoReplyError:
                if not request.repeatable:
                    raise
            self._send_stop_if_due()
            return self._ask(request)

    def set(self, parameter: Parameter, value: float) -> None:
        """Set a parameter; raises what `exchange` does."""
        self.exchange(Request(Command.SET, parameter, value))

    def set_and_verify(self, parameter: Parameter, value: float, key: str) -> None:
        """Set a parameter and read it back.

        Parameters
        ----------
        key
            Where the value comes from, for the message.

        Raises
        ------
        DeviceError
            When the drive holds another value than the one that was written, and whatever `exchange` raises.
        """
        self.set(parameter, value)
        held = self.exchange(Request(Command.READ, parameter)).value
        if held is None or not abs(held - value) <= self._dialect.resolution(parameter):
            raise DeviceError(
                f"the drive on {self.port} holds {held} as its {parameter} ({parameter.name}) where {value:g} was "
                f"written: nothing moves until it takes {key}."
            )

    @contextmanager
    def reserved(self) -> Iterator[None]:
        """Keep the line free for oneself, so that the next request goes out without waiting for another's reply."""
        with self._lock:
            yield

    def close(self) -> None:
        """Send a stop that is still due, and close the port. Twice is once."""
        if self._closed:
            return
        self._closed = True
        self._wakings.put(False)
        self._stopper.join()
        with self._lock:
            self._broken = f"the drive's port {self.port} was closed: open the rig again."
            close_port(self._serial)

    def _serve_stops(self) -> None:
        served = 0
        while self._wakings.get():
            if self._stops == served:
                continue
            served = self._stops
            for listener in self._listeners:
                listener()
            try:
                with self._lock:
                    self._send_stop_if_due()
            except DeviceError:
                # It stays due: the next request of anybody sends it again and reports what is wrong. If nobody
                # reaches the drive any more, it stops by its own silence timeout.
                continue

    def _send_stop_if_due(self) -> None:
        asked = self._stops
        if asked == self._stopped:
            return
        try:
            self._ask(_STOP)
        except NoReplyError:
            self._ask(_STOP)
        except RefusedError as error:
            # A drive that is off has nothing to stop.
            if error.refusal is not Refusal.DISABLED:
                raise
        self._stopped = asked

    def _ask(self, request: Request) -> Reply:
        if self._broken:
            raise DeviceError(self._broken)
        try:
            reply = self._talk(self._dialect.encode(request, self._settings.station), request)
        except FrameError as error:
            raise DeviceError(f"'{request.command}' cannot be told to the drive: {error}.") from error
        except CABLE_ERRORS as error:
            self._broken = (
                f"the drive's port {self.port} failed ({error.args[-1] if error.args else error}): check the cable, "
                "then start again (hardware.drive.port of the rig file)."
            )
            raise DeviceError(self._broken) from error
        if reply.refusal is not None:
            raise RefusedError(
                f"the drive on {self.port} refuses '{request.command}', for {reply.refusal}.", reply.refusal
            )
        return reply

    def _talk(self, frame: bytes, request: Request) -> Reply:
        # A reply that came too late for its own request would be taken for this one's.
        self._serial.reset_input_buffer()
        began_s = time.perf_counter()
        with suppress(WRITE_TIMEOUT_ERROR):  # whether the drive has heard it shows in its reply
            self._serial.write(frame)
        received, complaint, is_late = b"", "nothing came", False
        while not is_late:
            is_late = time.perf_counter() - began_s >= self._settings.reply_s
            received += self._what_is_there() if is_late else self._serial.read(max(self._serial.in_waiting, 1))
            while length := self._dialect.frame_length(received):
                first, received = received[:length], received[length:]
                try:
                    reply = self._dialect.decode(first, self._settings.station)
                except FrameError as error:
                    complaint = str(error)
                    continue
                if reply.answers(request):
                    self._round_trips_s.append(time.perf_counter() - began_s)
                    return reply
                complaint = f"it answered '{reply.command}' instead"
        raise NoReplyError(
            f"the drive on {self.port} did not answer '{request.command}' within {self._settings.reply_s:g} s "
            f"({complaint}): check its power, cable and settings (hardware.drive.reply_s of the rig file)."
        )

    def _what_is_there(self) -> bytes:
        # A busy computer may look late at what came in time.
        received = b""
        while waiting := self._serial.in_waiting:
            received += self._serial.read(waiting)
        return received
