"""What is said between program and drive, and what a dialect has to do: turn it into bytes and back.

A dialect is a value with pure functions; it knows no port, no time and no thread. The emulator of the drive speaks
through the same dialect from the other side. How to fit another one: docs/drive-dialect.md.
"""

import importlib
import importlib.util
import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

from dragrig.config import SettingsError


class Command(StrEnum):
    """What a drive can be asked for."""

    STATUS = "status"
    POSITION = "position"
    SET = "set parameter"
    READ = "read parameter"
    ENABLE = "enable"
    DISABLE = "disable"
    CLEAR_ALARM = "clear alarm"
    HOME = "home"
    """Value −1 or +1: towards the lower or the upper limit switch, then off it to the index pulse, which is 0."""
    GO = "go to position"
    """Value: absolute position [mm], with the speed and acceleration set before."""
    STOP = "stop"


class Parameter(StrEnum):
    """What is set in a drive and read back; the unit is part of the name."""

    THRUST_LIMIT_N = "thrust limit"
    LOWEST_MM = "lower soft limit"
    HIGHEST_MM = "upper soft limit"
    SPEED_MM_S = "speed"
    ACCELERATION_MM_S2 = "acceleration"
    STOP_ACCELERATION_MM_S2 = "deceleration of a stop"
    HOMING_SPEED_MM_S = "homing speed"
    SILENCE_S = "silence timeout"
    """A drive that moves and hears nothing for so long brakes by itself."""


class Refusal(StrEnum):
    """Why a drive does not do what it is told, in words that go on after "the drive refuses, for"."""

    DISABLED = "it is switched off"
    NOT_HOMED = "it does not know where it is"
    MOVING = "it is moving"
    SOFT_LIMIT = "that lies beyond its soft limits"
    ALARM = "it has an alarm"
    EMERGENCY_STOP = "its emergency stop is pressed"
    LIMIT_SWITCH = "its limit switch is pressed"
    BAD_VALUE = "the value is out of its range"
    UNKNOWN = "it does not know the command"


class Halt(StrEnum):
    """Why the last motion ended."""

    NONE = "nothing has moved yet"
    TARGET = "the target was reached"
    STOP = "it was told to stop"
    SILENCE = "it heard nothing from the program"
    DISABLED = "its enable was taken away"
    EMERGENCY_STOP = "its emergency stop was pressed"
    LIMIT_SWITCH = "it ran onto a limit switch"
    ALARM = "it had an alarm"
    UNKNOWN = "it does not say why"


_WITH_PARAMETER = {Command.SET, Command.READ}
_WITH_VALUE = {Command.SET, Command.HOME, Command.GO}
_NOT_REPEATABLE = {Command.HOME, Command.GO}


@dataclass(frozen=True, slots=True)
class Request:
    """One request; `parameter` with SET and READ, `value` with SET, HOME and GO, in the parameter's unit or mm."""

    command: Command
    parameter: Parameter | None = None
    value: float | None = None

    def __post_init__(self) -> None:
        if (self.parameter is not None) != (self.command in _WITH_PARAMETER):
            raise ValueError(f"'{self.command}' comes {'with' if self.parameter is None else 'without'} a parameter")
        if (self.value is not None) != (self.command in _WITH_VALUE):
            raise ValueError(f"'{self.command}' comes {'with' if self.value is None else 'without'} a value")

    @property
    def repeatable(self) -> bool:
        """Whether it may be sent again when no reply came: it does no more the second time."""
        return self.command not in _NOT_REPEATABLE


@dataclass(frozen=True, slots=True)
class Status:
    """What a drive says of itself."""

    enabled: bool
    homed: bool
    moving: bool
    alarm: int = 0
    """0 when it has none; `Dialect.alarm` puts it into words."""
    halt: Halt = Halt.UNKNOWN
    """Why the last motion ended; `Halt.UNKNOWN` from a drive that does not say."""


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to one request, whose command and parameter it repeats."""

    command: Command
    parameter: Parameter | None = None
    value: float | None = None
    """With POSITION [mm] and READ."""
    status: Status | None = None
    """With STATUS."""
    refusal: Refusal | None = None
    """Why the request was not carried out; then there is neither value nor status."""

    def answers(self, request: Request) -> bool:
        """Whether it belongs to a request; a late reply to the request before does not."""
        return (self.command, self.parameter) == (request.command, request.parameter)


class FrameError(Exception):
    """Bytes that are no frame of this dialect, or a value that a frame cannot hold."""


@runtime_checkable
class Dialect(Protocol):
    """How one make of drive is spoken to. Every method raises `FrameError` and nothing else."""

    @property
    def verified(self) -> bool:
        """Whether it was ever used with a real drive."""
        ...

    def frame_length(self, received: bytes) -> int:
        """Length of the first whole frame in what was received so far; 0 while there is none."""
        ...

    def encode(self, request: Request, station: int) -> bytes:
        """Return the frame of a request."""
        ...

    def decode(self, frame: bytes, station: int) -> Reply:
        """Return what a frame of the drive says; damaged ones and those of other stations are refused."""
        ...

    def decode_request(self, frame: bytes, station: int) -> Request:
        """Return what a frame of the program says: the drive's side, for the emulator."""
        ...

    def encode_reply(self, reply: Reply, station: int) -> bytes:
        """Return the frame of a reply: the drive's side, for the emulator."""
        ...

    def resolution(self, parameter: Parameter) -> float:
        """Smallest step of a parameter, in its unit: what is read back may differ by so much from what was set."""
        ...

    def alarm(self, code: int) -> str:
        """Put an alarm into words."""
        ...


def find_dialect(name: str) -> Dialect:
    """Return the `DIALECT` of a module: of one beside this, or of any other that Python can import.

    Raises `SettingsError` when there is no such module, or it holds no dialect.
    """
    if not re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*", name):
        raise SettingsError(f"drive.dialect = '{name}' is no module's name: use nikki, or a module of your own.")
    beside = f"{__package__}.{name}"
    try:
        module = importlib.import_module(beside if "." not in name and importlib.util.find_spec(beside) else name)
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"drive.dialect = '{name}' is not known ({error}): use nikki, or put your own where Python finds it."
        ) from error
    dialect = getattr(module, "DIALECT", None)
    if not isinstance(dialect, Dialect):
        raise SettingsError(f"drive.dialect = '{name}' names a module without a DIALECT that can do all of `Dialect`.")
    return dialect
