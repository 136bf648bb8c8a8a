"""The serial link to the drive: one request and its reply at a time, and a stop before all other requests.

The port is opened with pyserial; a pulled cable raises errors of several kinds, which are all caught here. A reply that
comes too late must not be taken for the next one's: where replies do not repeat the request, the link is silent after a
missing one until nothing more comes.

A busy computer hands a reply over late. It is awaited, and the request put again halfway, for nearly as long as the
drive goes on without hearing one; then the link counts as lost, in time for a stop before the drive's own.
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

from dragrig.config import DeviceError, DriveSettings
from dragrig.rig.hardware.dialects import Command, Dialect, FrameError, Lack, Parameter, Refusal, Reply, Request

if sys.platform != "win32":
    import termios

    _CABLE_ERRORS: tuple[type[Exception], ...] = (OSError, termios.error)
else:
    _CABLE_ERRORS = (OSError,)
"""What a pulled cable raises: SerialException is an OSError, a terminal's error is not."""

_OPENING_ERRORS: tuple[type[Exception], ...] = (*_CABLE_ERRORS, ValueError)
_PARITIES = {"none": serial.PARITY_NONE, "even": serial.PARITY_EVEN, "odd": serial.PARITY_ODD}
_STOP_BITS = {1: serial.STOPBITS_ONE, 2: serial.STOPBITS_TWO}
_READS_PER_REPLY = 5
"""Read timeouts within one reply timeout, so that a reply timeout is noticed about when it ends."""
_ROUND_TRIPS_KEPT = 15
_MAX_QUIET_REPLIES = 10
"""Reply timeouts for which a drive that goes on sending is waited for."""
_STOP = Request(Command.STOP)


class RefusedError(DeviceError):
    """The drive answered that it does not carry out the request."""

    def __init__(self, message: str, refusal: Refusal) -> None:
        super().__init__(message)
        self.refusal = refusal


class CancelledByStopError(DeviceError):
    """A request was dropped, because a stop was requested after it was planned."""


class NoReplyError(DeviceError):
    """The drive did not answer in time, or not in its dialect."""


class _StopFirstError(Exception):
    """A stop was requested between two frames of a request."""


class _TurnLock:
    """A re-entrant lock that threads get in the order in which they asked for it.

    Python's own goes to the thread that asks first once it is free. A thread with many requests in a row asks again at
    once, and would keep the monitor from polling for as long as they take.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition(threading.Lock())
        self._waiting: deque[object] = deque()
        self._owner: int | None = None
        self._depth = 0

    def __enter__(self) -> None:
        thread = threading.get_ident()
        if self._owner != thread:
            ticket = object()
            with self._changed:
                self._waiting.append(ticket)
                try:
                    self._changed.wait_for(lambda: self._owner is None and self._waiting[0] is ticket)
                    self._owner = thread
                finally:
                    self._waiting.remove(ticket)
                    self._changed.notify_all()
        self._depth += 1

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if not self._depth:
            with self._changed:
                self._owner = None
                self._changed.notify_all()


class DriveLink:
    """A drive on a serial port, opened at once. Any thread may call any method.

    Raises `DeviceError` when the port cannot be opened.
    """

    def __init__(self, settings: DriveSettings, dialect: Dialect) -> None:
        self._settings = settings
        self.dialect = dialect
        self._serial = _open_port(settings)
        # Re-entrant, because a thread that has reserved the link also sends on it.
        self._lock = _TurnLock()
        self._failure = ""
        self._closed = False
        self._round_trips_s: deque[float] = deque(maxlen=_ROUND_TRIPS_KEPT)
        self._unheard_since_s: float | None = None
        self._late_replies = 0
        # A counter and a SimpleQueue may be used by a signal handler that interrupts their own user; an Event may not.
        self._counter = itertools.count(1)
        # Replies of an earlier program's requests may still come.
        self._out_of_step = untold = Lack.REPEATED_COMMAND in dialect.lacks
        # What is left is for a stop, and for the quiet line between two tries.
        self._patience_s = settings.silence_s - (2 if untold else 1) * settings.reply_s
        self._used_s = 0.0
        # A request whose last frame alone is still to be sent, and the replies to the others.
        self._prepared: tuple[Request, tuple[bytes, ...]] | None = None
        self._stop_count = self._acknowledged_stops = 0
        self._wake_queue: SimpleQueue[bool] = SimpleQueue()
        self._stop_listeners: list[Callable[[], None]] = []
        self._stop_thread = threading.Thread(target=self._serve_stops, name="drive stopper", daemon=True)
        self._stop_thread.start()

    @property
    def port(self) -> str:
        """The port, as the settings name it."""
        return self._settings.port

    @property
    def round_trip_s(self) -> float:
        """Median of the latest times between a request and its reply, in wall time; 0 before the first."""
        return median(self._round_trips_s) if self._round_trips_s else 0.0

    @property
    def late_replies(self) -> int:
        """How many replies came after `hardware.drive.reply_s`, and were good all the same. Never blocks."""
        return self._late_replies

    @property
    def unheard_s(self) -> float:
        """Time since the first request that has no reply, in wall time; 0 while the latest one was answered.

        Never blocks. It goes on when the port has failed.
        """
        since_s = self._unheard_since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    @property
    def stop_count(self) -> int:
        """Number of stops requested so far: `exchange` drops requests planned at a lower count."""
        return self._stop_count

    def on_stop(self, listener: Callable[[], None]) -> None:
        """Call `listener` from the link's own thread whenever a stop is requested, before it is sent."""
        self._stop_listeners.append(listener)

    def stop(self) -> None:
        """Request a stop and return at once; it is sent as soon as the reply in progress has arrived.

        Safe in any thread and in signal handlers, at any time, repeatedly too. Until the drive has acknowledged it,
        every other request sends it first.
        """
        self._stop_count = next(self._counter)
        self._wake_queue.put(True)

    def exchange(self, request: Request, planned_at: int | None = None) -> Reply:
        """Send a request and return its reply.

        Parameters
        ----------
        planned_at
            `stop_count` when the request was planned: it is dropped when a stop was requested since.

        Raises
        ------
        RefusedError
            When the drive refuses.
        CancelledByStopError
            When a stop came first.
        NoReplyError
            When no readable and matching reply came in the drive's silence timeout, less a reply's time: halfway the
            request is sent once more, unless it must not be repeated.
        DeviceError
            When the port fails.
        """
        with self._lock:
            repeated = False
            while True:
                try:
                    self._send_stop_if_due()
                    if planned_at is not None and planned_at != self._stop_count:
                        raise CancelledByStopError(
                            f"'{request.command}' was dropped, because the stage was stopped first."
                        )
                    reply = self._exchange_once(request)
                except _StopFirstError:
                    continue
                except NoReplyError:
                    if repeated or not request.repeatable:
                        raise
                    repeated = True
                else:
                    # The reply to the other try may still come, and would be out of date.
                    self._out_of_step = self._out_of_step or repeated
                    return reply

    def prepare(self, request: Request, planned_at: int) -> None:
        """Send all frames of a request but the last, so that its `exchange`, if it is the next, is short.

        Nothing moves by it. A refusal is left for the exchange to tell; raises the other errors of `exchange`.
        """
        with self._lock:
            self._send_stop_if_due()
            if planned_at == self._stop_count:
                with suppress(_StopFirstError, RefusedError):
                    self._exchange_once(request, only_prepare=True)

    def set(self, parameter: Parameter, value: float) -> None:
        """Set a parameter; raises as `exchange` does."""
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
            When the drive holds another value than the one that was written, and as `exchange` does.
        """
        self.set(parameter, value)
        held = self.exchange(Request(Command.READ, parameter)).value
        if held is None or not abs(held - value) <= self.dialect.resolution(parameter, self._settings):
            raise DeviceError(
                f"the drive on {self.port} holds {held} as its {parameter} ({parameter.name}) where {value:g} was "
                f"written: nothing moves until it takes {key}."
            )

    @contextmanager
    def reserved(self) -> Iterator[None]:
        """Reserve the link for this thread, so that its next request waits for no other thread's reply."""
        with self._lock:
            yield

    def close(self) -> None:
        """Send a stop that is still due, and close the port. Safe to call twice."""
        if self._closed:
            return
        self._closed = True
        self._wake_queue.put(False)
        self._stop_thread.join()
        with self._lock:
            self._failure = f"the drive's port {self.port} was closed: open the rig again."
            # pyserial does not close its socket when the other side closed first.
            connection = getattr(self._serial, "_socket", None)
            self._serial.close()
            if connection is not None:
                connection.close()

    def _serve_stops(self) -> None:
        served = 0
        while self._wake_queue.get():
            if self._stop_count == served:
                continue
            served = self._stop_count
            for listener in self._stop_listeners:
                listener()
            # After an error it stays due: the next request of any thread sends it again and reports what is wrong. If
            # the drive cannot be reached any more, it stops by its own silence timeout.
            with suppress(DeviceError), self._lock:
                self._send_stop_if_due()

    def _send_stop_if_due(self) -> None:
        requested = self._stop_count
        if requested == self._acknowledged_stops:
            return
        try:
            self._exchange_once(_STOP)
        except NoReplyError:
            self._exchange_once(_STOP)
        except RefusedError as error:
            # A drive that is off has nothing to stop.
            if error.refusal is not Refusal.DISABLED:
                raise
        self._acknowledged_stops = requested

    def _exchange_once(self, request: Request, *, only_prepare: bool = False) -> Reply:
        if self._failure:
            raise DeviceError(self._failure)
        try:
            self._get_in_step(request)
            reply = self._converse(request, only_prepare=only_prepare)
        except NoReplyError:
            self._out_of_step = Lack.REPEATED_COMMAND in self.dialect.lacks
            raise
        except FrameError as error:
            raise DeviceError(f"'{request.command}' cannot be sent to the drive: {error}.") from error
        except _CABLE_ERRORS as error:
            self._failure = (
                f"the drive's port {self.port} failed ({error.args[-1] if error.args else error}): check the cable, "
                "then start again (hardware.drive.port of the rig file)."
            )
            raise DeviceError(self._failure) from error
        if reply.refusal is not None:
            raise RefusedError(
                f"the drive on {self.port} refuses '{request.command}', because {reply.refusal}.", reply.refusal
            )
        return reply

    def _converse(self, request: Request, *, only_prepare: bool) -> Reply:
        began_s = time.perf_counter()
        prepared, self._prepared = self._prepared, None
        replies = prepared[1] if prepared is not None and prepared[0] == request else ()
        frames = deque(self.dialect.encode(request, self._settings)[len(replies) :])
        while frames:
            if only_prepare and len(frames) == 1:
                self._prepared = request, replies
                break
            if replies and request != _STOP and self._stop_count != self._acknowledged_stops:
                raise _StopFirstError
            replies, answer = self._transceive(frames.popleft(), request, replies)
            if isinstance(answer, bytes):
                frames = deque([answer])
            elif answer is not None:
                self._round_trips_s.append(time.perf_counter() - began_s)
                return answer
        if only_prepare:
            return Reply()
        raise DeviceError(f"the dialect of the drive on {self.port} found no end of '{request.command}': correct it.")

    def _transceive(
        self, frame: bytes, request: Request, replies: tuple[bytes, ...]
    ) -> tuple[tuple[bytes, ...], Reply | bytes | None]:
        """Send a frame; return the replies with the one to it, and their content."""
        if self._unheard_since_s is None:
            self._unheard_since_s = time.monotonic()
        # A reply that came too late for its own request would be taken for the reply to this one.
        self._serial.reset_input_buffer()
        self._write(frame)
        patience_s = self._patience_s if self.unheard_s < self._patience_s else 0.0
        wait_s = max(patience_s / (2 if request.repeatable else 1), self._settings.reply_s)
        began_s = time.perf_counter()
        received, count, problem, timed_out = b"", 0, "no whole frame among them", False
        while not timed_out:
            waited_s = time.perf_counter() - began_s
            stop_is_due = request != _STOP and self._stop_count != self._acknowledged_stops
            timed_out = waited_s >= (self._settings.reply_s if stop_is_due else wait_s)
            arrived = self._read_available() if timed_out else self._serial.read(max(self._serial.in_waiting, 1))
            received, count = received + arrived, count + len(arrived)
            while length := self.dialect.frame_length(received):
                frame, received = received[:length], received[length:]
                try:
                    reply = self.dialect.decode(request, (*replies, frame), self._settings)
                except FrameError as error:
                    problem = str(error)
                    continue
                self._note_heard()
                return (*replies, frame), reply
        raise NoReplyError(
            f"the drive on {self.port} did not answer '{request.command}' within {self.unheard_s:.2g} s "
            f"({self._describe_failure(count, problem)}"
        )

    def _note_heard(self) -> None:
        # What comes after the drive's own silence timeout ends a lost link, and is no late reply.
        self._late_replies += self._settings.reply_s < self.unheard_s <= self._settings.silence_s
        self._unheard_since_s = None
        self._used_s = time.perf_counter()

    def _describe_failure(self, count: int, problem: str) -> str:
        """Return the bytes that came in place of a reply, and the checks to make, in order."""
        drive, understood_before = self._settings, bool(self._round_trips_s)
        if not count and understood_before:
            return "nothing came): check its power, cable and settings (hardware.drive.reply_s of the rig file)."
        if not count:
            return (
                "nothing came): check its power and cable, then hardware.drive.port, baud, station and dialect of the "
                "rig file."
            )
        came = f"{count} byte{'s' * (count > 1)} came, but no answer could be read: {problem})"
        if understood_before:
            return f"{came}: check cable, shield and ground, for it was understood before."
        return (
            f"{came}: check, in this order, hardware.drive.baud = {drive.baud}, parity = '{drive.parity}', station = "
            f"{drive.station} and dialect = '{drive.dialect}' of the rig file against the drive's own settings."
        )

    def _write(self, frame: bytes) -> None:
        if (pause_s := self.dialect.pause_s(self._settings)) > 0:
            time.sleep(max(self._used_s + pause_s - time.perf_counter(), 0.0))
        # To a socket, a write may time out although all of it was sent; the reply shows whether it arrived.
        with suppress(serial.SerialTimeoutException):
            self._serial.write(frame)
        self._used_s = time.perf_counter()

    def _get_in_step(self, request: Request) -> None:
        """Let replies that are still due pass by, however late they are read; a stop goes out at once, unconfirmed."""
        if not self._out_of_step:
            return
        sent_stops = self._acknowledged_stops
        began_s = quiet_s = time.perf_counter()
        while time.perf_counter() - quiet_s < self._settings.reply_s or self._serial.in_waiting:
            if self._stop_count != sent_stops:
                sent_stops = self._stop_count
                self._write(self.dialect.encode(_STOP, self._settings)[0])
                quiet_s = time.perf_counter()
            if self._serial.read(max(self._serial.in_waiting, 1)):
                quiet_s = time.perf_counter()
            if quiet_s - began_s > _MAX_QUIET_REPLIES * self._settings.reply_s:
                raise NoReplyError(
                    f"the drive on {self.port} goes on sending without being asked, so that no answer of it can be "
                    "told from the rest: switch that off in the drive, and end other programs on its line."
                )
        self._out_of_step = False
        if request != _STOP and sent_stops != self._acknowledged_stops:
            raise _StopFirstError

    def _read_available(self) -> bytes:
        # On a busy computer this thread may look late at bytes that came in time.
        received = b""
        while waiting := self._serial.in_waiting:
            received += self._serial.read(waiting)
        return received


def _open_port(settings: DriveSettings) -> serial.Serial:
    """Open the drive's port, exclusively where the system supports that; raises `DeviceError` when it cannot be."""
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
            f"it, or correct hardware.drive.port of the rig file{_other_ports_text(settings.port)}."
        ) from error


def serial_ports() -> dict[str, str]:
    """Return the serial ports of this computer and their own descriptions, by name."""
    from serial.tools.list_ports import comports

    return {found.device: found.description for found in sorted(comports(), key=lambda found: str(found.device))}


def _other_ports_text(port: str) -> str:
    """Name the serial ports of this computer, where it is its port that was looked for."""
    if "://" in port:
        return ""
    ports = [f"{name} ({what})" for name, what in serial_ports().items() if name != port]
    return f"; this computer has {', '.join(ports)}" if ports else "; this computer has no other serial port"
