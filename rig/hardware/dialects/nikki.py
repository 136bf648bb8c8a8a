"""A dialect for the NLA-7SL's NIKKI DENSO drive, UNVERIFIED: it was never used with a drive.

No public description of the drive's serial link was found, so that frame, checksum, command names, parameter numbers,
units and codes below are placeholders of a usual kind, all in this one module. docs/drive-dialect.md has the list of
changes once the drive's manual is at hand.

::

    request   STX  station(2)  command(2)  [parameter(2)] [±digits]              ETX  CRC(4)
    reply     STX  station(2)  command(2)  [parameter(2)] = [±digits | status]   ETX  CRC(4)
    refusal   STX  station(2)  command(2)  [parameter(2)] ! code(2)              ETX  CRC(4)

Everything is ASCII; the CRC is CRC-16/XMODEM from STX to ETX in capital hexadecimal digits. Values are whole numbers of
the steps in `_PARAMETERS`. A status is flags(2) alarm(2) halt(1), hexadecimal.
"""

import re
from binascii import crc_hqx
from math import isfinite

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

_STX, _ETX = b"\x02", b"\x03"
_CRC_LENGTH = 4
_MAX_FRAME_BYTES = 64

_COMMANDS = {
    "ST": Command.STATUS,
    "PO": Command.POSITION,
    "WR": Command.SET,
    "RD": Command.READ,
    "SV": Command.ENABLE,
    "SF": Command.DISABLE,
    "AC": Command.CLEAR_ALARM,
    "HM": Command.HOME,
    "GO": Command.GO,
    "SP": Command.STOP,
}
_PARAMETERS = {  # number, and steps per unit: 1 mN, 0.1 µm, 10 nm/s, 1 µm/s², 1 ms
    Parameter.THRUST_LIMIT_N: ("01", 1000),
    Parameter.LOWEST_MM: ("02", 10_000),
    Parameter.HIGHEST_MM: ("03", 10_000),
    Parameter.SPEED_MM_S: ("04", 100_000),
    Parameter.ACCELERATION_MM_S2: ("05", 1000),
    Parameter.STOP_ACCELERATION_MM_S2: ("06", 1000),
    Parameter.HOMING_SPEED_MM_S: ("07", 1000),
    Parameter.SILENCE_S: ("08", 1000),
}
_POSITION_STEPS = 10_000
_REFUSALS = {f"{code:02d}": refusal for code, refusal in enumerate(Refusal, 1)}
_ALARMS = {
    0x01: "overcurrent",
    0x02: "overload of the motor",
    0x03: "a broken encoder signal",
    0x04: "overspeed",
    0x05: "a following error",
    0x06: "overvoltage",
    0x07: "overheating",
}
_HALTS = dict(enumerate(Halt))

_COMMAND_NAMES = {command: name for name, command in _COMMANDS.items()}
_PARAMETERS_BY_NUMBER = {number: parameter for parameter, (number, _) in _PARAMETERS.items()}
_ENABLED, _HOMED, _MOVING = 1, 2, 4

_BODY = re.compile(
    r"(?P<station>\d\d)(?P<command>[A-Z]{2})(?P<parameter>\d\d)?"
    r"(?:(?P<mark>=)(?:(?P<status>[0-9A-F]{5})|(?P<answer>[+-]\d{1,10}))?|!(?P<refusal>\d\d)|(?P<value>[+-]\d{1,10}))?",
    re.ASCII,
)


class NikkiDialect(Dialect):
    """The codec; see the module. It holds nothing."""

    @property
    def lacks(self) -> frozenset[Lack]:
        """Nothing: the drive is taken to stop by itself, and its replies repeat the command under a checksum."""
        return frozenset()

    def frame_length(self, received: bytes) -> int:
        """Length up to and with the checksum; a frame without end is given up after 64 bytes."""
        end = received.find(_ETX)
        if end < 0:
            return _MAX_FRAME_BYTES if len(received) >= _MAX_FRAME_BYTES else 0
        length = end + 1 + _CRC_LENGTH
        return length if len(received) >= length else 0

    def encode(self, request: Request, drive: DriveSettings) -> tuple[bytes, ...]:
        """Return the one frame of a request."""
        text = ""
        if request.value is not None:
            number = request.value * _steps_per_unit(request.command, request.parameter)
            if not isfinite(number) or abs(round(number)) >= 10**10:
                raise FrameError(f"{request.value:g} does not fit into a frame")
            text = f"{round(number):+d}"
        return (_build_frame(drive.station, request.command, request.parameter, text),)

    def decode(self, request: Request, replies: tuple[bytes, ...], drive: DriveSettings) -> Reply:
        """Return the drive's answer."""
        part, command, parameter = _parse_frame(replies[-1], drive.station)
        if (command, parameter) != (request.command, request.parameter):
            raise FrameError(f"it answered '{command}' instead")
        if part["refusal"] is not None:
            if part["refusal"] not in _REFUSALS:
                raise FrameError(f"refusal {part['refusal']} is not known")
            return Reply(refusal=_REFUSALS[part["refusal"]])
        if part["mark"] is None:
            raise FrameError("a request where a reply was due")
        value = None if part["answer"] is None else int(part["answer"]) / _steps_per_unit(command, parameter)
        status = None if part["status"] is None else _decode_status(part["status"])
        if (status is not None) != (command is Command.STATUS):
            raise FrameError("a status where none was due, or none where one was")
        if (value is not None) != (command in {Command.POSITION, Command.READ}):
            raise FrameError("a value where none was due, or none where one was")
        return Reply(value, status)

    def resolution(self, parameter: Parameter, drive: DriveSettings) -> float:
        """One step of the parameter's whole numbers."""
        del drive
        return 1.0 / _PARAMETERS[parameter][1]

    def alarm(self, code: int) -> str:
        """Words for the codes of `_ALARMS`, the number for any other."""
        return _ALARMS.get(code, f"alarm {code:02X}, which the dialect does not know")


def _build_frame(station: int, command: Command, parameter: Parameter | None, text: str) -> bytes:
    if not 0 <= station <= 99:
        raise FrameError(f"station {station} is not between 0 and 99")
    number = "" if parameter is None else _PARAMETERS[parameter][0]
    covered = _STX + f"{station:02d}{_COMMAND_NAMES[command]}{number}{text}".encode("ascii") + _ETX
    return covered + f"{crc_hqx(covered, 0):04X}".encode("ascii")


def _parse_frame(frame: bytes, station: int) -> tuple[dict[str, str | None], Command, Parameter | None]:
    covered, checksum = frame[:-_CRC_LENGTH], frame[-_CRC_LENGTH:]
    if not (covered.startswith(_STX) and covered.endswith(_ETX)):
        raise FrameError("no start or end of a frame")
    if checksum != f"{crc_hqx(covered, 0):04X}".encode("ascii"):
        raise FrameError("the checksum does not fit")
    match = _BODY.fullmatch(covered[1:-1].decode("ascii", errors="replace"))
    if match is None or match["command"] not in _COMMANDS:
        raise FrameError("no known command")
    if int(match["station"]) != station:
        raise FrameError(f"station {match['station']} speaks where {station:02d} was asked")
    parameter = None if match["parameter"] is None else _PARAMETERS_BY_NUMBER.get(match["parameter"])
    command = _COMMANDS[match["command"]]
    if (parameter is not None) != (command in {Command.SET, Command.READ}):
        raise FrameError("a parameter that is not known, or where none was due")
    return match.groupdict(), command, parameter


def _steps_per_unit(command: Command, parameter: Parameter | None) -> int:
    if parameter is not None:
        return _PARAMETERS[parameter][1]
    return 1 if command is Command.HOME else _POSITION_STEPS


def _decode_status(text: str) -> Status:
    flags, alarm, halt = int(text[:2], 16), int(text[2:4], 16), int(text[4], 16)
    if flags > _ENABLED | _HOMED | _MOVING or halt not in _HALTS:
        raise FrameError(f"status {text} has bits that are not known")
    return Status(bool(flags & _ENABLED), bool(flags & _HOMED), bool(flags & _MOVING), alarm, _HALTS[halt])


DIALECT = NikkiDialect()
