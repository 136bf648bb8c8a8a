"""The serial port of the drive's double, which pyserial opens by an address `double://…`, with the faults of a cable.

pyserial finds this module by its name: the scheme's, after `protocol_`, in one of its `protocol_handler_packages`.
"""

import time
from collections import deque
from typing import Self

import serial

from dragrig.sim_backend.doubles.drive_double import DriveDouble

_POLL_S = 0.001
_DRIVES: dict[str, DriveDouble] = {}
"""What is plugged in, by address."""


class DoublePort:
    """Plugs the cable of a drive's double in, from entering to leaving the context."""

    def __init__(self, drive: DriveDouble) -> None:
        self._drive = drive
        self.address = f"double://drive-{id(drive):x}"
        """What pyserial opens."""

    def __enter__(self) -> Self:
        if __package__ not in serial.protocol_handler_packages:
            serial.protocol_handler_packages.append(__package__)
        _DRIVES[self.address] = self._drive
        return self

    def __exit__(self, *_: object) -> None:
        del _DRIVES[self.address]


class Serial:
    """The program's end of the cable, as pyserial makes it.

    Its faults are the bench's: replies come late, garbled or not at all; an unplugged cable is dead until it is opened
    again.
    """

    def __init__(self, _port: None, *, timeout: float, **_settings: object) -> None:
        self.port = ""
        self._timeout_s = timeout
        self._drive: DriveDouble | None = None
        self._sent = self._received = b""
        self._replies: deque[tuple[float, bytes]] = deque()

    def open(self) -> None:
        """Open the port; raises `SerialException` when nothing is plugged in."""
        self._drive = _DRIVES.get(self.port)
        self._plugged_in()

    def close(self) -> None:
        """Close the port. Safe to call twice."""
        self._drive = None

    @property
    def in_waiting(self) -> int:
        """Number of bytes that have arrived."""
        self._plugged_in()
        while self._replies and self._replies[0][0] <= time.monotonic():
            self._received += self._replies.popleft()[1]
        return len(self._received)

    def reset_input_buffer(self) -> None:
        """Drop the bytes that have arrived."""
        if self.in_waiting:
            self._received = b""

    def read(self, size: int = 1) -> bytes:
        """Return `size` bytes, or fewer after the timeout."""
        until_s = time.monotonic() + self._timeout_s
        while self.in_waiting < size and time.monotonic() < until_s:
            time.sleep(_POLL_S)
        data, self._received = self._received[:size], self._received[size:]
        return data

    def write(self, data: bytes) -> int:
        """Send to the drive, which carries out every whole frame at once."""
        drive = self._plugged_in()
        if drive.bench.faults.active.drive_cut_off:
            return len(data)
        self._sent += data
        while length := drive.frame_length(self._sent):
            frame, self._sent = self._sent[:length], self._sent[length:]
            if reply := drive.answer(frame):
                self._reply(drive, reply)
        return len(data)

    def _plugged_in(self) -> DriveDouble:
        if self._drive is not None and self._drive.bench.faults.active.drive_unplugged:
            self._drive = None
        if self._drive is None:
            raise serial.SerialException("no cable is plugged in")
        return self._drive

    def _reply(self, drive: DriveDouble, reply: bytes) -> None:
        faults = drive.bench.faults.active
        if faults.drive_silent:
            return
        if faults.drive_garbled:
            middle = len(reply) // 2
            reply = reply[:middle] + bytes([reply[middle] ^ 0x15]) + reply[middle + 1 :]
        due_s = drive.reply_due_s()
        # A serial line keeps the order of replies.
        self._replies.append((max(due_s, self._replies[-1][0]) if self._replies else due_s, reply))
