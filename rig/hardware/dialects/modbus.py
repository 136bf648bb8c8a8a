"""Modbus RTU for a positioning drive, UNVERIFIED against a drive: the registers have to be set to the drive's manual.

Frames, CRC, function codes 3 (read holding registers) and 16 (write multiple registers), exceptions and the pause of
3.5 characters follow the public standard (MODBUS Application Protocol V1.1b3; MODBUS over Serial Line V1.02). The
meaning of the registers is in no standard: `RegisterMap` is that table, and `DIALECT` one with a map of a usual kind. A
module of one's own fits another drive in a few lines::

    from dragrig.rig.hardware.dialects import ModbusDialect, RegisterMap

    DIALECT = ModbusDialect(RegisterMap(position=0x0204, ...))

The codec is 40 lines of its own: Modbus libraries own the port and its timing, which the link does here.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from types import MappingProxyType

from dragrig.config import DriveSettings
from dragrig.rig.hardware.dialects.base import (
    Command,
    Dialect,
    FrameError,
    Halt,
    Lack,
    Parameter,
    Refusal,
    Reply,
    Request,
    Status,
)

_READ, _WRITE, _EXCEPTION = 0x03, 0x10, 0x80
_CRC_BYTES = 2
_EXCEPTION_BYTES, _WRITTEN_BYTES, _READ_HEADER_BYTES = 5, 8, 3
_MAX_FRAME_BYTES = 256
_BITS_PER_CHARACTER = 11
_SHORTEST_PAUSE_S = 1.75e-3
"""Pause between frames at more than 19,200 baud, whatever the rate."""
_FAILURE = 4
_EXCEPTIONS: Mapping[int, Refusal] = MappingProxyType({3: Refusal.BAD_VALUE, 6: Refusal.MOVING})
"""Exceptions by their code (illegal value, device busy); any other is a command that the drive does not know."""


@dataclass(frozen=True, slots=True)
class RegisterMap:
    """The registers of a drive; 32-bit numbers are signed, high word first, and take two registers.

    To be set to the drive's manual: the defaults are no product's.
    """

    status: int = 0x0000
    """Three registers: bits, number of the alarm, why the last motion ended."""
    enabled_bit: int = 0
    homed_bit: int = 1
    moving_bit: int = 2
    halts: Mapping[int, Halt] = field(default_factory=lambda: dict(enumerate(Halt)))
    alarms: Mapping[int, str] = field(
        default_factory=lambda: {
            1: "overcurrent",
            2: "overload of the motor",
            3: "a broken encoder signal",
            4: "overspeed",
            5: "a following error",
            6: "overvoltage",
            7: "overheating",
        }
    )
    refusal: int = 0x0003
    """One register: why the last command was not carried out, which is asked for after a "device failure"."""
    refusals: Mapping[int, Refusal] = field(default_factory=lambda: dict(enumerate(Refusal, 1)))
    position: int = 0x0010
    """32 bit."""
    steps_per_mm: float = 10_000.0
    """Of position and target."""
    command: int = 0x0020
    """One register, whose value starts what it stands for."""
    commands: Mapping[Command, int] = field(
        default_factory=lambda: {
            Command.ENABLE: 1,
            Command.DISABLE: 2,
            Command.CLEAR_ALARM: 3,
            Command.GO: 4,
            Command.STOP: 5,
        }
    )
    home_low: int = 6
    home_high: int = 7
    """`home_low`, `home_high`: values of the command register that home to the lower and to the upper limit switch."""
    target: int = 0x0022
    """32 bit, written before the command to go there."""
    parameters: Mapping[Parameter, tuple[int, float]] = field(
        default_factory=lambda: {
            Parameter.THRUST_LIMIT_N: (0x0030, 1000.0),
            Parameter.LOWEST_MM: (0x0032, 10_000.0),
            Parameter.HIGHEST_MM: (0x0034, 10_000.0),
            Parameter.SPEED_MM_S: (0x0036, 100_000.0),
            Parameter.ACCELERATION_MM_S2: (0x0038, 1000.0),
            Parameter.STOP_ACCELERATION_MM_S2: (0x003A, 1000.0),
            Parameter.HOMING_SPEED_MM_S: (0x003C, 1000.0),
            Parameter.SILENCE_S: (0x003E, 1000.0),
        }
    )
    """Address and steps per unit; 32 bit each. Without `Parameter.SILENCE_S` for a drive that has no such timeout."""


class ModbusDialect(Dialect):
    """The codec for one map of registers."""

    def __init__(self, registers: RegisterMap) -> None:
        self.registers = registers

    @property
    def lacks(self) -> frozenset[Lack]:
        """The registers' address in the reply to a reading, and a silence timeout where the map has none."""
        silent = Parameter.SILENCE_S not in self.registers.parameters
        return frozenset({Lack.REPEATED_COMMAND} | ({Lack.SILENCE_TIMEOUT} if silent else set()))

    def frame_length(self, received: bytes) -> int:
        """Length as the function code says; a frame with none of the known codes is given up as a whole."""
        if len(received) < _READ_HEADER_BYTES:
            return 0
        function = received[1]
        if function == _READ:
            length = _READ_HEADER_BYTES + received[2] + _CRC_BYTES
        elif function == _WRITE:
            length = _WRITTEN_BYTES
        elif function in {_READ | _EXCEPTION, _WRITE | _EXCEPTION}:
            length = _EXCEPTION_BYTES
        else:
            length = min(len(received), _MAX_FRAME_BYTES)
        return length if len(received) >= length else 0

    def encode(self, request: Request, drive: DriveSettings) -> tuple[bytes, ...]:
        """Return the frames of a request: a reading, or values to write, a target before the command to go there."""
        return tuple(_framed(body, drive.station) for body in self._bodies(request))

    def decode(self, request: Request, replies: tuple[bytes, ...], drive: DriveSettings) -> Reply | bytes | None:
        """Return the drive's answer; after a "device failure" of a command, ask why."""
        bodies, reply = self._bodies(request), _body(replies[-1], drive.station)
        if len(replies) > len(bodies):
            _require_answer(_read(self.registers.refusal, 1), reply)
            return Reply(refusal=self.registers.refusals.get(int.from_bytes(reply[2:], "big"), Refusal.UNKNOWN))
        asked, is_last = bodies[len(replies) - 1], len(replies) == len(bodies)
        if reply[0] == asked[0] | _EXCEPTION:
            if reply[1] == _FAILURE and asked[0] == _WRITE and is_last:
                return _framed(_read(self.registers.refusal, 1), drive.station)
            return Reply(refusal=_EXCEPTIONS.get(reply[1], Refusal.UNKNOWN))
        _require_answer(asked, reply)
        return self._result(request, reply) if is_last else None

    def resolution(self, parameter: Parameter, drive: DriveSettings) -> float:
        """One step of the parameter's register."""
        del drive
        return 1.0 / self._parameter(parameter)[1]

    def alarm(self, code: int) -> str:
        """Words of the map, the number for any other."""
        return self.registers.alarms.get(code, f"alarm {code}, which the dialect does not know")

    def pause_s(self, drive: DriveSettings) -> float:
        """3.5 characters, and the standard's fixed time at a high rate."""
        return max(3.5 * _BITS_PER_CHARACTER / drive.baud, _SHORTEST_PAUSE_S)

    def _bodies(self, request: Request) -> tuple[bytes, ...]:
        """Return the frames of a request without station and CRC."""
        registers, command, value = self.registers, request.command, request.value
        if command is Command.STATUS:
            return (_read(registers.status, 3),)
        if command is Command.POSITION:
            return (_read(registers.position, 2),)
        if request.parameter is not None:
            address, steps = self._parameter(request.parameter)
            return (_read(address, 2) if value is None else _write(address, _long(value * steps)),)
        code = registers.commands[command] if command is not Command.HOME else 0
        if command is Command.HOME:
            code = registers.home_low if value is not None and value < 0 else registers.home_high
        start = _write(registers.command, struct.pack(">H", code))
        if command is Command.GO and value is not None:
            return _write(registers.target, _long(value * registers.steps_per_mm)), start
        return (start,)

    def _result(self, request: Request, reply: bytes) -> Reply:
        if request.command is Command.STATUS:
            return Reply(status=self._status(reply[2:]))
        if request.command is Command.POSITION:
            return Reply(struct.unpack(">i", reply[2:])[0] / self.registers.steps_per_mm)
        if request.command is Command.READ and request.parameter is not None:
            return Reply(struct.unpack(">i", reply[2:])[0] / self._parameter(request.parameter)[1])
        return Reply()

    def _parameter(self, parameter: Parameter) -> tuple[int, float]:
        if parameter not in self.registers.parameters:
            raise FrameError(f"the register map has no {parameter}")
        return self.registers.parameters[parameter]

    def _status(self, data: bytes) -> Status:
        registers = self.registers
        bits, alarm, halt = struct.unpack(">HHH", data)
        if halt not in registers.halts:
            raise FrameError(f"reason {halt} for the end of a motion is not known")
        enabled, homed, moving = (
            bool(bits >> bit & 1) for bit in (registers.enabled_bit, registers.homed_bit, registers.moving_bit)
        )
        return Status(enabled, homed, moving, alarm, registers.halts[halt])


def _read(address: int, count: int) -> bytes:
    return struct.pack(">BHH", _READ, address, count)


def _write(address: int, data: bytes) -> bytes:
    return struct.pack(">BHHB", _WRITE, address, len(data) // 2, len(data)) + data


def _long(steps: float) -> bytes:
    if not isfinite(steps) or not abs(round(steps)) < 2**31:
        raise FrameError(f"{steps:g} steps do not fit into two registers")
    return struct.pack(">i", round(steps))


def _crc(data: bytes) -> bytes:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 * (crc & 1)
    return struct.pack("<H", crc)


def _framed(body: bytes, station: int) -> bytes:
    if not 1 <= station <= 247:
        raise FrameError(f"station {station} is not between 1 and 247")
    covered = bytes([station]) + body
    return covered + _crc(covered)


def _body(frame: bytes, station: int) -> bytes:
    """Return a frame without station and CRC; raises `FrameError` when it is damaged or another station's."""
    covered, crc = frame[:-_CRC_BYTES], frame[-_CRC_BYTES:]
    if len(covered) < _READ_HEADER_BYTES or crc != _crc(covered):
        raise FrameError("the checksum does not fit")
    if covered[0] != station:
        raise FrameError(f"station {covered[0]} speaks where {station} was asked")
    return covered[1:]


def _require_answer(asked: bytes, reply: bytes) -> None:
    """Refuse a reply to another function, of another size, or to another writing."""
    if reply[0] != asked[0]:
        raise FrameError(f"function {reply[0]} answers where {asked[0]} was asked")
    if asked[0] == _READ and (reply[1], len(reply)) != (2 * asked[4], 2 + 2 * asked[4]):
        raise FrameError(f"{reply[1]} bytes where {2 * asked[4]} were asked for")
    if asked[0] == _WRITE and reply[1:5] != asked[1:5]:
        raise FrameError("other registers were written than those that were sent")


DIALECT = ModbusDialect(RegisterMap())
