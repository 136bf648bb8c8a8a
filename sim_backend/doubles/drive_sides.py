"""The drive's side of the dialects: the requests and replies of a drive's double.

Each is written from the description of the protocol and not from the program's codec, so that the two do not agree on a
mistake; only numbers that a manual would give (register map, units) are shared. A dialect of one's own brings its
drive's side along as `DRIVE_SIDE` in its module.
"""

import importlib
import re
import struct
from binascii import crc_hqx
from collections.abc import Callable
from types import MappingProxyType
from typing import Protocol, runtime_checkable

from dragrig.config import DriveSettings, SettingsError
from dragrig.rig.hardware.dialects import (
    Command,
    CopleyDialect,
    Dialect,
    Halt,
    ModbusDialect,
    NikkiDialect,
    Parameter,
    Refusal,
    RegisterMap,
    Reply,
    Request,
    Status,
)

Act = Callable[[Request], Reply]
"""Has the drive carry out a request."""


@runtime_checkable
class DriveSide(Protocol):
    """One drive at the far end of the line."""

    def frame_length(self, received: bytes) -> int:
        """Length of the program's first whole frame among the bytes received so far; 0 while there is none."""

    def answer(self, frame: bytes, act: Act) -> bytes:
        """Carry a frame out and return the reply; nothing for a damaged frame or another station's."""


def find_drive_side(dialect: Dialect, drive: DriveSettings) -> DriveSide:
    """Return the drive's side of a dialect: a shipped one, or the `DRIVE_SIDE` of the module that the settings name.

    Raises `SettingsError` when it has none.
    """
    if isinstance(dialect, NikkiDialect):
        return NikkiDrive(drive)
    if isinstance(dialect, CopleyDialect):
        return CopleyDrive(drive)
    if isinstance(dialect, ModbusDialect):
        return ModbusDrive(drive, dialect.registers)
    make = getattr(importlib.import_module(drive.dialect), "DRIVE_SIDE", None)
    side = make(drive) if callable(make) else None
    if not isinstance(side, DriveSide):
        raise SettingsError(
            f"hardware.drive.dialect = '{drive.dialect}' names a module without a DRIVE_SIDE, so that no double can "
            "answer in it: add one (docs/drive-dialect.md), or try another dialect."
        )
    return side


class NikkiDrive:
    """STX, station, command, parameter, number, ETX and a CRC-16/XMODEM in hexadecimal digits."""

    _FRAME = re.compile(rb"\x02(\d\d)([A-Z]{2})(\d\d)?([+-]\d+)?\x03([0-9A-F]{4})")
    _NAMES = ("ST", "PO", "WR", "RD", "SV", "SF", "AC", "HM", "GO", "SP")
    _STEPS = (1e3, 1e4, 1e4, 1e5, 1e3, 1e3, 1e3, 1e3)

    def __init__(self, drive: DriveSettings) -> None:
        self._station = b"%02d" % drive.station

    def frame_length(self, received: bytes) -> int:
        """Length up to and with the four digits of the CRC."""
        end = received.find(b"\x03")
        return end + 5 if 0 <= end <= len(received) - 5 else 0

    def answer(self, frame: bytes, act: Act) -> bytes:
        """Answer with the request, "=" and the result, or "!" and why not."""
        match = self._FRAME.fullmatch(frame)
        if match is None or match[1] != self._station or b"%04X" % crc_hqx(frame[:-4], 0) != match[5]:
            return b""
        number, digits = match[3], match[4]
        try:
            command = list(Command)[self._NAMES.index(match[2].decode())]
            parameter = None if number is None else list(Parameter)[int(number) - 1]
            steps = 1.0 if command is Command.HOME else 1e4 if number is None else self._STEPS[int(number) - 1]
            reply = act(Request(command, parameter, None if digits is None else int(digits) / steps))
        except (IndexError, ValueError):
            return self._framed(match, b"!09")
        if reply.refusal is not None:
            return self._framed(match, b"!%02d" % (list(Refusal).index(reply.refusal) + 1))
        if (state := reply.status) is not None:
            flags = state.enabled + 2 * state.homed + 4 * state.moving
            return self._framed(match, b"=%02X%02X%X" % (flags, state.alarm, list(Halt).index(state.halt)))
        return self._framed(match, b"=" if reply.value is None else b"=%+d" % round(reply.value * steps))

    def _framed(self, asked: re.Match[bytes], text: bytes) -> bytes:
        covered = b"\x02" + asked[1] + asked[2] + (asked[3] or b"") + text + b"\x03"
        return covered + b"%04X" % crc_hqx(covered, 0)


class CopleyDrive:
    """A drive with Copley's ASCII interface, from its Programmer's Guide; on the cable itself, or a node behind it.

    It says "ok" to a move that it does not make, as the guide names no error for that.
    """

    _LINE = re.compile(r"(?:(\d+) )?([a-z])(?: (.*))?", re.ASCII)
    _NUMBER = re.compile(r"-?\d+|0x[0-9a-f]+")
    _ERRORS = MappingProxyType({Refusal.MOVING: 18, Refusal.BAD_VALUE: 10})
    _PROGRAMMED_POSITION, _MOVE_TO_LIMIT_AND_INDEX, _NEGATIVE = 21, 0x21, 0x10

    def __init__(self, drive: DriveSettings) -> None:
        self._node = drive.station
        per_mm, per_N = drive.counts_per_mm, 100 / drive.thrust_N_per_A
        self._parameters = {
            0x21: (Parameter.THRUST_LIMIT_N, per_N),
            0xB8: (Parameter.HIGHEST_MM, per_mm),
            0xB9: (Parameter.LOWEST_MM, per_mm),
            0xCB: (Parameter.SPEED_MM_S, 10 * per_mm),
            0xCC: (Parameter.ACCELERATION_MM_S2, per_mm / 10),
            0xCF: (Parameter.STOP_ACCELERATION_MM_S2, per_mm / 10),
            0xC3: (Parameter.HOMING_SPEED_MM_S, 10 * per_mm),
        }
        self._per_mm = per_mm
        self._held = {0x24: 0, 0xC2: 0x220, 0xC4: 0, 0xC8: 256, 0xCA: 0, 0xCD: 0}

    def frame_length(self, received: bytes) -> int:
        """Length up to and with the carriage return."""
        return received.find(b"\r") + 1

    def answer(self, frame: bytes, act: Act) -> bytes:
        """Answer "ok", "v number" or "e code"."""
        match = self._LINE.fullmatch(frame[:-1].decode("ascii", errors="replace"))
        if match is None:
            return b"e 33\r"
        if int(match[1] or self._node) != self._node:
            return b"e 32\r"
        answers = {"g": self._get, "s": self._set, "t": self._trajectory}
        if match[2] not in answers:
            return b"e 3\r"
        try:
            result = answers[match[2]]((match[3] or "").split(), act)
        except (ValueError, IndexError):
            return b"e 33\r"
        return result.encode() + b"\r"

    def _get(self, words: list[str], act: Act) -> str:
        number = self._register(words[0])
        if number in self._parameters:
            parameter, steps = self._parameters[number]
            return f"v {round((act(Request(Command.READ, parameter)).value or 0.0) * steps)}"
        if number == 0x32:
            return f"v {round((act(Request(Command.POSITION)).value or 0.0) * self._per_mm)}"
        if number in self._held:
            return f"v {self._held[number]}"
        state = act(Request(Command.STATUS)).status
        if state is None or number not in {0xA0, 0xA4, 0xC9}:
            return "e 9"
        return f"v {self._bits(number, state)}"

    def _bits(self, number: int, state: Status) -> int:
        wanted = self._held[0x24] == self._PROGRAMMED_POSITION
        on_switch = state.halt is Halt.LIMIT_SWITCH
        aborted = not state.moving and state.halt not in {Halt.TARGET, Halt.NONE}
        set_bits = {
            0xA0: {
                9: on_switch,
                11: wanted and not state.enabled and not state.alarm,
                12: not wanted,
                15: not state.enabled,
                22: bool(state.alarm),
                27: state.moving,
            },
            0xA4: {state.alarm - 1: bool(state.alarm)},
            0xC9: {12: state.homed, 14: aborted, 15: state.moving},
        }[number]
        return sum(1 << bit for bit, is_set in set_bits.items() if is_set)

    def _set(self, words: list[str], act: Act) -> str:
        number = self._register(words[0])
        if self._NUMBER.fullmatch(words[1]) is None:
            raise ValueError
        value = int(words[1], 0)
        if not -(2**31) <= value < 2**31:
            return "e 10"
        if number in self._parameters:
            parameter, steps = self._parameters[number]
            return self._said(act(Request(Command.SET, parameter, value / steps)))
        if number == 0xA4:
            return self._said(act(Request(Command.CLEAR_ALARM)))
        if number in {0x32, 0xA0, 0xC9}:
            return "e 11"
        if number not in self._held:
            return "e 9"
        self._held[number] = value
        if number == 0x24:
            act(Request(Command.ENABLE if value == self._PROGRAMMED_POSITION else Command.DISABLE))
        return "ok"

    def _trajectory(self, words: list[str], act: Act) -> str:
        if words == ["0"]:
            return self._said(act(Request(Command.STOP)))
        if words == ["1"]:
            if self._held[0xC8] != 0:
                return "e 25"
            return self._said(act(Request(Command.GO, value=self._held[0xCA] / self._per_mm)))
        method = self._held[0xC2]
        if words != ["2"] or method & 0x2F != self._MOVE_TO_LIMIT_AND_INDEX:
            return "e 25"
        return self._said(act(Request(Command.HOME, value=-1.0 if method & self._NEGATIVE else 1.0)))

    def _said(self, reply: Reply) -> str:
        code = None if reply.refusal is None else self._ERRORS.get(reply.refusal)
        return "ok" if code is None else f"e {code}"

    @staticmethod
    def _register(word: str) -> int:
        if not word.startswith("r"):
            raise ValueError
        return int(word[1:], 0)


class ModbusDrive:
    """A Modbus RTU server of a positioning drive with a map of registers."""

    def __init__(self, drive: DriveSettings, registers: RegisterMap) -> None:
        self._station, self._map = drive.station, registers
        self._parameters = {at: (parameter, steps) for parameter, (at, steps) in registers.parameters.items()}
        self._target = self._refusal = 0

    def frame_length(self, received: bytes) -> int:
        """8 bytes for a reading; for a writing, as its byte count says."""
        if len(received) < 8:
            return 0
        length = 9 + received[6] if received[1] == 16 else 8
        return length if len(received) >= length else 0

    def answer(self, frame: bytes, act: Act) -> bytes:
        """Answer with the registers that were read or written, or an exception."""
        if frame[0] != self._station or self._crc(frame[:-2]) != int.from_bytes(frame[-2:], "little"):
            return b""
        function, address, count = struct.unpack(">BHH", frame[1:6])
        if function == 3:
            answer = self.read(address, count, act)
            body = (
                bytes([3, 2 * count]) + b"".join(word.to_bytes(2, "big") for word in answer) if answer else b"\x83\x02"
            )
        elif function == 16:
            words = [int.from_bytes(frame[at : at + 2], "big") for at in range(7, len(frame) - 2, 2)]
            exception = self.write(address, words, act)
            body = bytes([0x90, exception]) if exception else frame[1:6]
        else:
            body = bytes([function | 0x80, 1])
        reply = bytes([self._station]) + body
        return reply + self._crc(reply).to_bytes(2, "little")

    def read(self, address: int, count: int, act: Act) -> list[int]:
        """Return registers as 16-bit numbers; none where there are no such registers."""
        registers = self._map
        if (address, count) == (registers.status, 3):
            state = act(Request(Command.STATUS)).status
            if state is None:
                return []
            bits = ((registers.enabled_bit, state.enabled), (registers.homed_bit, state.homed),
                    (registers.moving_bit, state.moving))  # fmt: skip
            halt = next(code for code, halt in registers.halts.items() if halt is state.halt)
            return [sum(is_set << bit for bit, is_set in bits), state.alarm, halt]
        if (address, count) == (registers.position, 2):
            return self._words((act(Request(Command.POSITION)).value or 0.0) * registers.steps_per_mm)
        if (address, count) == (registers.refusal, 1):
            return [self._refusal]
        if address in self._parameters and count == 2:
            parameter, steps = self._parameters[address]
            return self._words((act(Request(Command.READ, parameter)).value or 0.0) * steps)
        return []

    def write(self, address: int, words: list[int], act: Act) -> int:
        """Write 16-bit numbers to registers and return the exception's code; 0 for none."""
        registers, value = self._map, 0
        if len(words) == 2:
            value = struct.unpack(">i", struct.pack(">HH", *words))[0]
        if address == registers.target and len(words) == 2:
            self._target = value
            return 0
        if address in self._parameters and len(words) == 2:
            parameter, steps = self._parameters[address]
            return 3 if act(Request(Command.SET, parameter, value / steps)).refusal else 0
        request = self._request(words[0]) if address == registers.command and len(words) == 1 else None
        if request is None:
            return 2
        refusal = act(request).refusal
        self._refusal = next((code for code, why in registers.refusals.items() if why is refusal), 0)
        return 4 if refusal is not None else 0

    def _request(self, code: int) -> Request | None:
        registers = self._map
        if code in {registers.home_low, registers.home_high}:
            return Request(Command.HOME, value=-1.0 if code == registers.home_low else 1.0)
        command = next((command for command, number in registers.commands.items() if number == code), None)
        if command is Command.GO:
            return Request(command, value=self._target / registers.steps_per_mm)
        return None if command is None else Request(command)

    @staticmethod
    def _words(steps: float) -> list[int]:
        return list(struct.unpack(">HH", struct.pack(">i", round(steps))))

    @staticmethod
    def _crc(data: bytes) -> int:
        # The bits of the polynomial from the high end, of mirrored bytes: the program's codec has it from the low end.
        crc = 0xFFFF
        for byte in data:
            crc ^= int(f"{byte:08b}"[::-1], 2) << 8
            for _ in range(8):
                crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
        return int(f"{crc:016b}"[::-1], 2)
