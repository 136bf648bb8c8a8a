"""Switching the drive on and off: its enable line, its own switch, and its alarm."""

import time

from dragrig.rig.hardware.dialects.base import Command, Refusal, Request
from dragrig.rig.hardware.drive.link import DriveLink, RefusedError
from dragrig.rig.hardware.lines import Lines

_ENABLING_S = 0.5
_AGAIN_S = 0.01


class Power:
    """The drive's power stage. Every method raises `DeviceError` when drive or line refuse or do not answer."""

    def __init__(self, link: DriveLink, lines: Lines) -> None:
        self._link, self._lines = link, lines

    def on(self) -> None:
        """Set the enable line and switch the drive on."""
        self._lines.enable(True)
        until_s = time.monotonic() + _ENABLING_S
        while not self._is_on(last=time.monotonic() > until_s):
            time.sleep(_AGAIN_S)

    def off(self) -> None:
        """Switch the drive off, clear its alarm, and take the enable line away, even from a drive that is silent."""
        try:
            self._link.exchange(Request(Command.DISABLE))
            self._link.exchange(Request(Command.CLEAR_ALARM))
        finally:
            self._lines.enable(False)

    def _is_on(self, *, last: bool) -> bool:
        try:
            self._link.exchange(Request(Command.ENABLE))
        except RefusedError as error:
            # A drive takes a while to see its enable line.
            if last or error.refusal is not Refusal.DISABLED:
                raise
            return False
        return True
