"""Requests and replies between program and drive, and the task of a dialect: to turn them into bytes and back.

A dialect is a value with pure functions; it knows no port, no time and no thread. It declares the functions that its
drive lacks, and the settings are refused when nothing on the rig stands in for it. How to fit another one:
docs/drive-dialect.md.
"""

import importlib
import importlib.util
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

from dragrig.config import DriveSettings, HardwareSettings, SettingsError


class Command(StrEnum):
    """The requests to a drive."""

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
    """The settings of a drive, written and read back; the unit is part of the name."""

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
    """Why a drive refuses a command, in words that go on after "the drive refuses, for"."""

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
    """A drive's own state."""

    enabled: bool
    homed: bool
    moving: bool
    alarm: int = 0
    """0 when it has none; `Dialect.alarm` puts it into words."""
    halt: Halt = Halt.UNKNOWN
    """Why the last motion ended; `Halt.UNKNOWN` from a drive that does not say."""


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to one request."""

    value: float | None = None
    """With POSITION [mm] and READ."""
    status: Status | None = None
    """With STATUS."""
    refusal: Refusal | None = None
    """Why the request was not carried out; then there is neither value nor status."""


class FrameError(Exception):
    """Bytes that are no frame of this dialect, or a value that a frame cannot hold."""


class Lack(StrEnum):
    """Functions that a drive or its protocol may lack, in words that go on after "the drive"."""

    SILENCE_TIMEOUT = "does not stop by itself when it hears nothing"
    """`Parameter.SILENCE_S` is then neither written nor read."""
    CHECKSUM = "cannot tell a damaged command from another one without a checksum"
    REPEATED_COMMAND = "does not say in its reply which request it answers"
    """After a missing reply, the link waits until the line is quiet before it asks for anything else."""


_STAND_IN_LINES: Mapping[Lack, tuple[str, ...]] = MappingProxyType(
    {Lack.SILENCE_TIMEOUT: ("heartbeat", "enable"), Lack.CHECKSUM: ("heartbeat", "enable")}
)
"""Digital lines of the card that have to be wired where a drive lacks something: a way to stop it past its link."""


class Dialect(ABC):
    """How one make of drive is spoken to. A method raises `FrameError` and nothing else."""

    verified: bool = False
    """Whether it was ever used with a real drive."""
    required_settings: tuple[str, ...] = ()
    """Keys of `DriveSettings` that it cannot do without, and whose default is 0: the drive's units."""
    modes: tuple[str, ...] = ("position", "velocity")
    """Modes of `DriveSettings` in which it can switch the drive on."""

    @property
    @abstractmethod
    def lacks(self) -> frozenset[Lack]:
        """The functions that the drive lacks."""

    @abstractmethod
    def frame_length(self, received: bytes) -> int:
        """Length of the drive's first whole frame among the bytes received so far; 0 while there is none."""

    @abstractmethod
    def encode(self, request: Request, drive: DriveSettings) -> tuple[bytes, ...]:
        """Return the frames of a request, each to be sent once the one before is answered.

        The frame that starts a motion is the last.
        """

    @abstractmethod
    def decode(self, request: Request, replies: tuple[bytes, ...], drive: DriveSettings) -> Reply | bytes | None:
        """Return the content of the drive's replies to a request's frames so far.

        None when the next frame is due, and a frame of its own when that has to be asked first, such as why the drive
        refuses.

        The last of `replies` may be anything that came over the line: a reply that is damaged, comes from another
        station or answers something else is refused.
        """

    @abstractmethod
    def resolution(self, parameter: Parameter, drive: DriveSettings) -> float:
        """Smallest step of a parameter, in its unit: a setting read back may differ by so much from the written one."""

    @abstractmethod
    def alarm(self, code: int) -> str:
        """Put an alarm into words."""

    def pause_s(self, drive: DriveSettings) -> float:
        """Shortest time of a quiet line before a frame; most drives need none."""
        del drive
        return 0.0


SHIPPED_DIALECTS = ("nikki", "copley", "modbus")
_KNOWN = f"{', '.join(SHIPPED_DIALECTS[:-1])} or {SHIPPED_DIALECTS[-1]}"


def find_dialect(name: str) -> Dialect:
    """Return the `DIALECT` of a module: of one beside this, or of any other that Python can import.

    Raises `SettingsError` when there is no such module, or it holds no dialect.
    """
    if not re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*", name):
        raise SettingsError(
            f"hardware.drive.dialect = '{name}' is no module's name: use {_KNOWN}, or a module of your own."
        )
    beside = f"{__package__}.{name}"
    try:
        module = importlib.import_module(beside if "." not in name and importlib.util.find_spec(beside) else name)
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"hardware.drive.dialect = '{name}' is not known ({error}): use {_KNOWN}, or put your own where "
            "Python finds it."
        ) from error
    dialect = getattr(module, "DIALECT", None)
    if not isinstance(dialect, Dialect):
        raise SettingsError(f"hardware.drive.dialect = '{name}' names a module whose DIALECT is no `Dialect`.")
    return dialect


def fitting_dialect(hardware: HardwareSettings) -> Dialect:
    """Return the dialect that the settings name.

    Raises `SettingsError` when there is none, when it does not know the drive's mode or needs a setting that is not
    made, or when the drive lacks something and the rig has nothing that stands in for it.
    """
    drive = hardware.drive
    dialect = find_dialect(drive.dialect)
    if drive.mode not in dialect.modes:
        raise SettingsError(
            f"hardware.drive.mode = '{drive.mode}' is not possible with the dialect {drive.dialect}: use "
            f"'{dialect.modes[0]}', or another dialect."
        )
    for key in dialect.required_settings:
        if not getattr(drive, key):
            raise SettingsError(f"hardware.drive.{key} is not set: the dialect {drive.dialect} cannot do without it.")
    for lack in Lack:
        needed = _STAND_IN_LINES.get(lack, ()) if lack in dialect.lacks else ()
        missing = [name for name in needed if not getattr(hardware.card.lines, name)]
        if missing:
            keys = " and ".join(f"hardware.card.lines.{name}" for name in missing)
            raise SettingsError(
                f"{keys} must be wired and set, because a drive of the dialect {drive.dialect} {lack}: only a "
                "heartbeat relay and its enable line can then stop it when the link or the program fails."
            )
    return dialect
