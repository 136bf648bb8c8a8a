"""Digital lines beside the drive's own link: enable, e-stop, limit switches, heartbeat."""

from dataclasses import dataclass
from typing import Protocol

from dragrig.rig.trips import Cause, Trip


@dataclass(frozen=True, slots=True)
class Pressed:
    """Which switches are pressed, in the stage's words: a broken wire counts as pressed, an unwired switch does not."""

    e_stop: bool = False
    limit_low: bool = False
    limit_high: bool = False

    def trip(self, *, but: Cause | None = None) -> Trip | None:
        """Return what the switches forbid, the e-stop first; None when nothing, `but` not counted."""
        for pressed, cause, message in (
            (self.e_stop, Cause.EMERGENCY_STOP, "the emergency stop is pressed or its wire is broken"),
            (self.limit_low, Cause.LIMIT_SWITCH_LOW, "the stage is on its lower limit switch, or the wire is broken"),
            (self.limit_high, Cause.LIMIT_SWITCH_HIGH, "the stage is on its upper limit switch, or the wire is broken"),
        ):
            if pressed and cause is not but:
                return Trip(cause, message)
        return None


class Lines(Protocol):
    """The lines of one rig. Any thread may call any method; each raises `DeviceError` when the lines do not answer."""

    def pressed(self) -> Pressed:
        """Read all switches now. Asked at every block, so it has to answer within milliseconds."""
        ...

    def enable(self, on: bool) -> None:
        """Set the drive's enable line; no effect where it is not wired."""
        ...

    def beat(self) -> None:
        """Turn the heartbeat line over once; no effect where it is not wired."""
        ...


class NoLines:
    """A rig whose drive has all switches on its own terminals."""

    def pressed(self) -> Pressed:
        """Nothing is wired, so nothing is pressed."""
        return Pressed()

    def enable(self, on: bool) -> None:
        """Nothing is wired."""

    def beat(self) -> None:
        """Nothing is wired."""
