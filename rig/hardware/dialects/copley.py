"""The ASCII interface of Copley Controls' drives, UNVERIFIED against a drive.

Checked against public documents: form of commands and replies, codes of errors, bits of the registers 0xa0, 0xa4 and
0xc9, numbers and units of the parameters used here (Copley ASCII Programmer's Guide 16-01196, Copley ASCII Interface
CC95-00404, and the examples that Copley publishes as CopleyControlsOfficial/Serial_Examples). Followed from them and
seen nowhere as such: the homing methods 545 and 561, put together from their bits, and the answer of a drive to a move
that it will not make.

::

    request   [node ] g r0xNN            CR      reply   v value   CR
    request   [node ] s r0xNN value      CR      reply   ok        CR
    request   [node ] t 0 | t 1 | t 2    CR      reply   ok        CR      abort, move, home
                                                 refusal e code    CR

A frame has no checksum, a reply names neither command nor node, and nothing stops the drive when its line falls silent:
`lacks` says so. A damaged digit of a reading is therefore not noticed; every written value, the target included, is
read back.

Values are whole numbers of counts of the drive's encoder, tenths of a count per second, tens of counts per second
squared and hundredths of an ampere. `hardware.drive.counts_per_mm` and `thrust_N_per_A` turn them into ours. The thrust
limit is the peak current (0x21); the continuous current (0x22), the homing acceleration (0xc5) and the home offset
(0xc6) keep their settings of the time when the drive was commissioned.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite, nan
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

_END = b"\r"
_MAX_FRAME_BYTES = 64
_MAX_VALUE = 2**31
_REPLY = re.compile(r"(?P<ok>ok)|v (?P<value>-?\d{1,10})|e (?P<error>\d{1,3})", re.ASCII)

_EVENTS, _FAULTS, _TRAJECTORY = 0xA0, 0xA4, 0xC9
_POSITION, _TARGET = 0x32, 0xCA
_DESIRED_STATE, _OFF, _POSITION_MODE = 0x24, 0, 21
_PROFILE, _ABSOLUTE_TRAPEZOID = 0xC8, 0
_HOMING_METHOD = 0xC2
# Bit 9 as in all of Copley's examples; function 1 is the limit switch, bit 4 the negative one, bit 5 then the index.
_HOMING_METHODS = {-1.0: 0x200 | 0x20 | 0x10 | 1, 1.0: 0x200 | 0x20 | 1}
_ALL_FAULTS = 0x7FFFF

_NO_ENABLE, _SWITCHED_OFF, _NO_OUTPUT, _HAS_FAULT, _MOVING = 1 << 11, 1 << 12, 1 << 15, 1 << 22, 1 << 27
_LIMIT_SWITCHES = 1 << 9 | 1 << 10
"""`_EVENTS`; `_TRAJECTORY` has these."""
_HOMED, _HOMING, _ABORTED, _GENERATING = 1 << 12, 1 << 13, 1 << 14, 1 << 15

_FORWARDED_IN_VAIN = 32
_REFUSALS: Mapping[int, Refusal] = MappingProxyType(
    {
        10: Refusal.BAD_VALUE,
        18: Refusal.MOVING,
        19: Refusal.BAD_VALUE,
        20: Refusal.BAD_VALUE,
        21: Refusal.BAD_VALUE,
        22: Refusal.BAD_VALUE,
    }
)
"""Errors by their code; any other is a command that the drive does not know in its state."""
_FAULT_NAMES = (
    "a damaged flash memory",
    "an internal error",
    "a short circuit",
    "a drive that is too hot",
    "a motor that is too hot",
    "overvoltage",
    "undervoltage",
    "a feedback fault",
    "a phasing error",
    "a following error",
    "overcurrent",
    "a failure of its FPGA",
    "a lost command input",
    "fault 13, which is reserved",
    "an inconsistent safety circuit",
    "a motor current that it cannot control",
    "a motor that is not connected",
    "fault 17, which is reserved",
    "safe torque off",
)
"""Bits of `_FAULTS`; the alarm of bit n is n + 1."""
_UNNAMED_FAULT = 255


@dataclass(frozen=True, slots=True)
class _Registers:
    """Where a parameter is held; `steps` are whole numbers per its unit, apart from the drive's own scale."""

    numbers: tuple[int, ...]
    steps: float
    per_ampere: bool = False


_PARAMETERS: Mapping[Parameter, _Registers] = MappingProxyType(
    {
        Parameter.THRUST_LIMIT_N: _Registers((0x21,), 100, per_ampere=True),
        Parameter.LOWEST_MM: _Registers((0xB9,), 1),
        Parameter.HIGHEST_MM: _Registers((0xB8,), 1),
        Parameter.SPEED_MM_S: _Registers((0xCB,), 10),
        Parameter.ACCELERATION_MM_S2: _Registers((0xCC, 0xCD), 0.1),
        Parameter.STOP_ACCELERATION_MM_S2: _Registers((0xCF,), 0.1),
        Parameter.HOMING_SPEED_MM_S: _Registers((0xC3, 0xC4), 10),
    }
)


class CopleyDialect(Dialect):
    """The codec; see the module. It holds nothing."""

    required_settings = ("counts_per_mm", "thrust_N_per_A")
    modes = ("position",)

    @property
    def lacks(self) -> frozenset[Lack]:
        """All that can be lacking; see the module."""
        return frozenset(Lack)

    def frame_length(self, received: bytes) -> int:
        """Length up to and with the carriage return; a frame without end is given up after 64 bytes."""
        end = received.find(_END) + 1
        return end or (_MAX_FRAME_BYTES if len(received) >= _MAX_FRAME_BYTES else 0)

    def encode(self, request: Request, drive: DriveSettings) -> tuple[bytes, ...]:
        """Return the commands of a request."""
        return tuple(_framed(command, drive) for command in _commands(request, drive))

    def decode(self, request: Request, replies: tuple[bytes, ...], drive: DriveSettings) -> Reply | bytes | None:
        """Return the drive's answer once it has all that the request needs."""
        commands = _commands(request, drive)
        kind = commands[len(replies) - 1][0] if len(replies) <= len(commands) else "g"
        value = _parse(replies[-1], with_value=kind == "g")
        if isinstance(value, Refusal):
            return Reply(refusal=value)
        values = [number for reply in replies if isinstance(number := _parse(reply), int)]
        if request.command is Command.STATUS and len(values) == len(commands) and values[0] & _HAS_FAULT:
            return _framed(_get(_FAULTS), drive)
        if request.command in {Command.GO, Command.HOME} and kind == "g" and value != int(commands[0].split()[-1]):
            return Reply(refusal=Refusal.BAD_VALUE)
        return _result(request, values, drive) if len(replies) >= len(commands) else None

    def resolution(self, parameter: Parameter, drive: DriveSettings) -> float:
        """One step of the parameter's whole numbers."""
        return 1.0 / _steps_per_unit(parameter, drive)

    def alarm(self, code: int) -> str:
        """Words for the bits of the fault register."""
        return _FAULT_NAMES[code - 1] if 0 < code <= len(_FAULT_NAMES) else "a fault that it does not name"


def _result(request: Request, values: list[int], drive: DriveSettings) -> Reply:
    """Return the answer that all the values of a request's replies make."""
    if request.command is Command.STATUS:
        return Reply(status=_decode_status(*values))
    if request.command is Command.ENABLE:
        alarmed, off = values[-1] & _HAS_FAULT, values[-1] & _NO_ENABLE
        return Reply(refusal=Refusal.ALARM if alarmed else Refusal.DISABLED if off else None)
    if request.command is Command.POSITION:
        return Reply(values[-1] / drive.counts_per_mm)
    if request.command is Command.READ and request.parameter is not None:
        # Registers that belong together must agree; no number verifies when they do not.
        steps = _steps_per_unit(request.parameter, drive)
        return Reply(values[-1] / steps if len(set(values)) == 1 else nan)
    return Reply()


def _commands(request: Request, drive: DriveSettings) -> tuple[str, ...]:
    """Return the commands of a request without node and end."""
    value, parameter = request.value, request.parameter
    if parameter is not None:
        steps = _steps_per_unit(parameter, drive)
        numbers = _PARAMETERS[parameter].numbers
        if value is None:
            return tuple(_get(number) for number in numbers)
        return tuple(_set(number, _whole(value * steps)) for number in numbers)
    if request.command is Command.GO and value is not None:
        # Read back, for no checksum covers the target.
        return _set(_TARGET, _whole(value * drive.counts_per_mm)), _get(_TARGET), "t 1"
    if request.command is Command.HOME and value is not None:
        return _set(_HOMING_METHOD, _HOMING_METHODS[value]), _get(_HOMING_METHOD), "t 2"
    return {
        Command.STATUS: (_get(_EVENTS), _get(_TRAJECTORY)),
        Command.POSITION: (_get(_POSITION),),
        Command.ENABLE: (_set(_PROFILE, _ABSOLUTE_TRAPEZOID), _set(_DESIRED_STATE, _POSITION_MODE), _get(_EVENTS)),
        Command.DISABLE: (_set(_DESIRED_STATE, _OFF),),
        Command.CLEAR_ALARM: (_set(_FAULTS, _ALL_FAULTS),),
        Command.STOP: ("t 0",),
    }[request.command]


def _framed(command: str, drive: DriveSettings) -> bytes:
    node = f"{drive.station} " if drive.station else ""
    return f"{node}{command}".encode("ascii") + _END


def _get(number: int) -> str:
    return f"g r0x{number:02x}"


def _set(number: int, value: int) -> str:
    return f"s r0x{number:02x} {value}"


def _whole(steps: float) -> int:
    if not isfinite(steps) or not abs(steps) < _MAX_VALUE:
        raise FrameError(f"{steps:g} steps do not fit into a register")
    return round(steps)


def _steps_per_unit(parameter: Parameter, drive: DriveSettings) -> float:
    if parameter not in _PARAMETERS:
        raise FrameError(f"a drive of this dialect has no {parameter}")
    registers = _PARAMETERS[parameter]
    return registers.steps / drive.thrust_N_per_A if registers.per_ampere else registers.steps * drive.counts_per_mm


def _parse(frame: bytes, *, with_value: bool | None = None) -> int | Refusal | None:
    """Return a reply's value, its refusal, or None for "ok"; raises `FrameError` for anything else or not due."""
    match = _REPLY.fullmatch(frame.removesuffix(_END).decode("ascii", errors="replace").strip())
    if match is None or not frame.endswith(_END):
        raise FrameError("neither ok nor a value nor an error")
    if match["error"] is not None:
        if int(match["error"]) == _FORWARDED_IN_VAIN:
            raise FrameError("the drive on the cable passed it on to the station, which did not answer")
        return _REFUSALS.get(int(match["error"]), Refusal.UNKNOWN)
    value = None if match["value"] is None else int(match["value"])
    if with_value is not None and with_value != (value is not None):
        raise FrameError("a value where none was due, or none where one was")
    return value


def _decode_status(events: int, trajectory: int, faults: int = 0) -> Status:
    alarm = 0
    if events & _HAS_FAULT:
        bits = faults & _ALL_FAULTS
        alarm = (bits & -bits).bit_length() or _UNNAMED_FAULT
    moving = bool(events & _MOVING or trajectory & (_HOMING | _GENERATING))
    enabled = not events & (_NO_ENABLE | _SWITCHED_OFF | _NO_OUTPUT | _HAS_FAULT)
    halt = Halt.TARGET
    if moving:
        halt = Halt.NONE
    elif alarm:
        halt = Halt.ALARM
    elif events & _NO_ENABLE:
        halt = Halt.DISABLED
    elif trajectory & _ABORTED:
        halt = Halt.LIMIT_SWITCH if events & _LIMIT_SWITCHES else Halt.STOP
    return Status(enabled, bool(trajectory & _HOMED), moving, alarm, halt)


DIALECT = CopleyDialect()
