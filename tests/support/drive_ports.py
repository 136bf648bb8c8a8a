"""Serial ports of the drive's double outside its process: a TCP socket and a pseudo-terminal, with a cable's faults."""

import os
import selectors
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from contextlib import suppress
from types import TracebackType
from typing import Self

from dragrig.sim_backend.doubles.drive_double import DriveDouble

_CHUNK_BYTES = 4096


class DrivePort(ABC):
    """A cable to a drive's double, served by a thread of its own from entering to leaving the context.

    Its faults are the bench's: replies come late, garbled or not at all, or the cable is unplugged.
    """

    def __init__(self, drive: DriveDouble) -> None:
        self._drive = drive
        self._received = b""
        self._replies: deque[tuple[float, bytes]] = deque()
        self._selector = selectors.DefaultSelector()
        self._woken, self._waker = socket.socketpair()
        self._waker.setblocking(False)
        self._ended = False
        self._thread = threading.Thread(target=self._serve, name="drive double's port", daemon=True)

    @property
    @abstractmethod
    def address(self) -> str:
        """What pyserial opens."""

    def __enter__(self) -> Self:
        self._selector.register(self._woken, selectors.EVENT_READ, lambda: self._woken.recv(_CHUNK_BYTES))
        self._drive.bench.faults.subscribe(self._wake)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._ended = True
        self._wake()
        self._thread.join()
        self._hang_up()
        self._selector.close()
        self._woken.close()
        self._waker.close()

    @property
    def has_sent_all(self) -> bool:
        """Whether no reply is still on its way."""
        return not self._replies

    @abstractmethod
    def _hang_up(self) -> None:
        """Unplug the cable; again changes nothing."""

    def _plug_in(self) -> None:
        """Plug the cable in again, where that brings back the same port; again changes nothing."""
        return

    @abstractmethod
    def _write(self, data: bytes) -> None:
        """Send to the program; nothing when it is not connected."""

    def _receive(self, received: bytes) -> None:
        if self._drive.bench.faults.active.drive_cut_off:
            return
        self._received += received
        while length := self._drive.frame_length(self._received):
            frame, self._received = self._received[:length], self._received[length:]
            if reply := self._drive.answer(frame):
                self._answer(reply)

    def _answer(self, reply: bytes) -> None:
        faults = self._drive.bench.faults.active
        if faults.drive_silent:
            return
        if faults.drive_garbled:
            middle = len(reply) // 2
            reply = reply[:middle] + bytes([reply[middle] ^ 0x15]) + reply[middle + 1 :]
        due_s = self._drive.reply_due_s()
        # A serial line keeps the order of replies.
        self._replies.append((max(due_s, self._replies[-1][0]) if self._replies else due_s, reply))
        self._send_due()

    def _send_due(self) -> None:
        while self._replies and self._replies[0][0] <= time.monotonic():
            self._write(self._replies[0][1])
            self._replies.popleft()

    def _wake(self) -> None:
        with suppress(OSError):
            self._waker.send(b"!")

    def _serve(self) -> None:
        while not self._ended:
            soon_s = max(self._replies[0][0] - time.monotonic(), 0.0) if self._replies else None
            for key, _ in self._selector.select(soon_s):
                key.data()
            self._send_due()
            if self._drive.bench.faults.active.drive_unplugged:
                self._hang_up()
            elif not self._ended:
                self._plug_in()


class SocketPort(DrivePort):
    """A TCP server on loopback, for one program at a time, as a serial device server is.

    Parameters
    ----------
    number
        The TCP port; 0 for any that is free.
    """

    def __init__(self, drive: DriveDouble, number: int = 0) -> None:
        super().__init__(drive)
        self._listener = socket.create_server(("127.0.0.1", number))
        self._number: int = self._listener.getsockname()[1]
        self._client: socket.socket | None = None
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)

    @property
    def address(self) -> str:
        """Address as pyserial takes it."""
        return f"socket://127.0.0.1:{self._number}"

    def _accept(self) -> None:
        self._drop()
        client, _ = self._listener.accept()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setblocking(False)
        self._client, self._received = client, b""
        self._replies.clear()  # those for the previous client
        self._selector.register(client, selectors.EVENT_READ, self._read)

    def _read(self) -> None:
        if self._client is None:
            return
        try:
            data = self._client.recv(_CHUNK_BYTES)
        except BlockingIOError:
            return
        except ConnectionError:
            data = b""
        if data:
            self._receive(data)
        else:
            self._drop()

    def _write(self, data: bytes) -> None:
        # A late reply may find the client gone, which does not concern the drive.
        with suppress(OSError):
            if self._client is not None:
                self._client.sendall(data)

    def _drop(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            self._selector.unregister(client)
            client.close()

    def _hang_up(self) -> None:
        self._drop()
        if self._listener.fileno() >= 0:
            self._selector.unregister(self._listener)
            self._listener.close()

    def _plug_in(self) -> None:
        if self._listener.fileno() < 0:
            self._listener = socket.create_server(("127.0.0.1", self._number))
            self._selector.register(self._listener, selectors.EVENT_READ, self._accept)


class PtyPort(DrivePort):
    """A pseudo-terminal, which is gone for good once unplugged. Not on Windows, which has none."""

    def __init__(self, drive: DriveDouble) -> None:
        import tty

        super().__init__(drive)
        # The program's end stays open here too, or the terminal would hang up whenever the program closes its own.
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        self._address = os.ttyname(self._theirs)
        self._open = True
        self._selector.register(self._ours, selectors.EVENT_READ, self._read)

    @property
    def address(self) -> str:
        """Path of the terminal."""
        return self._address

    def _read(self) -> None:
        self._receive(os.read(self._ours, _CHUNK_BYTES))

    def _write(self, data: bytes) -> None:
        if self._open:
            os.write(self._ours, data)

    def _hang_up(self) -> None:
        if not self._open:
            return
        self._open = False
        self._selector.unregister(self._ours)
        os.close(self._ours)
        os.close(self._theirs)
