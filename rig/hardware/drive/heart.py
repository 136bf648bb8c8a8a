"""The heartbeat that stands still when the program is not well."""

from collections.abc import Callable

from dragrig.rig.hardware.lines import Lines, Pressed


class Heart:
    """A rig's lines, whose heartbeat is turned over only while all is well. Implements `Lines`.

    Parameters
    ----------
    well
        Says whether the program may go on having the drive's power; asked at every beat.
    """

    def __init__(self, lines: Lines, well: Callable[[], bool]) -> None:
        self._lines, self._well = lines, well

    def pressed(self) -> Pressed:
        """Read all switches now."""
        return self._lines.pressed()

    def enable(self, on: bool) -> None:
        """Set the drive's enable line."""
        self._lines.enable(on)

    def beat(self) -> None:
        """Turn the heartbeat line over, or leave it so that the relay opens."""
        if self._well():
            self._lines.beat()
