"""Conditions that forbid motion: what the guard trips on, and what devices report."""

from dataclasses import dataclass
from enum import StrEnum


class Cause(StrEnum):
    """What the guard can trip on."""

    START_UP = "start-up"
    POSITION = "position"
    SPEED = "speed"
    FORCE = "force"
    FOLLOWING_ERROR = "following error"
    STALE_DATA = "stale data"
    NOT_A_NUMBER = "not a number"
    DRIVE_FAULT = "drive fault"
    CARD_FAULT = "card fault"
    EMERGENCY_STOP = "emergency stop"
    LIMIT_SWITCH_LOW = "lower limit switch"
    LIMIT_SWITCH_HIGH = "upper limit switch"
    SENSOR_OVERLOAD = "sensor overload"
    SENSOR_OPEN = "sensor open circuit"
    ENCODER_SILENT = "encoder silent"
    OVERRUN = "overrun"
    WATCHDOG = "watchdog"


@dataclass(frozen=True, slots=True)
class Trip:
    """A condition that forbids motion: its kind, and a person's words for it, without a full stop."""

    cause: Cause
    message: str
