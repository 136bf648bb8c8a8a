"""The deadman: what tells a program that looks at its data from one that hangs."""

import time


class Deadman:
    """Remembers when it was fed last; whoever reads the data feeds it, the monitor's thread looks.

    Its time is the wall's, whatever clock the rig lives by: a hung program is a matter of this computer.
    """

    def __init__(self) -> None:
        self._fed_s = time.monotonic()

    def feed(self) -> None:
        """Say that the program is well. Costs nothing and waits for nobody."""
        self._fed_s = time.monotonic()

    @property
    def unfed_s(self) -> float:
        """Seconds since it was fed."""
        return time.monotonic() - self._fed_s
