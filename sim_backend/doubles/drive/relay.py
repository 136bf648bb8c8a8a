"""The heartbeat relay beside the drive: it takes the drive's power when the program's line stands still."""

import time

MISSED = 3
"""So many beats late is one too many."""


class Relay:
    """A relay that is closed while edges come, in the wall's time; one that is not wired is always closed.

    Parameters
    ----------
    line
        The heartbeat's line, as PORT/LINE; empty when there is none.
    beat_s
        Time between two edges.
    """

    def __init__(self, line: str, beat_s: float) -> None:
        self._line = line
        self._longest_s = MISSED * beat_s
        self._high = False
        self._edge_s = float("-inf")

    @property
    def closed(self) -> bool:
        """Whether the drive has power."""
        return not self._line or time.monotonic() - self._edge_s < self._longest_s

    def hear(self, line: str, high: bool) -> None:
        """Notice a level that was written to a line."""
        if line == self._line and high is not self._high:
            self._high = high
            self._edge_s = time.monotonic()
