"""The drive's double on a pseudo-terminal."""

import os
import selectors

from dragrig.sim_backend.doubles.drive_double import DriveDouble, DrivePort

_CHUNK_BYTES = 4096


class PtyPort(DrivePort):
    """A pseudo-terminal, which is gone for good once unplugged. Not on Windows, which has none."""

    def __init__(self, drive: DriveDouble) -> None:
        import tty

        super().__init__(drive)
        # The program's end stays open here too, or the terminal would hang up whenever the program closes its own.
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        self._address = os.ttyname(self._theirs)
        self._open = True
        self._selector.register(self._ours, selectors.EVENT_READ, self._read)

    @property
    def address(self) -> str:
        """Path of the terminal."""
        return self._address

    def _read(self) -> None:
        self._receive(os.read(self._ours, _CHUNK_BYTES))

    def _write(self, data: bytes) -> None:
        if self._open:
            os.write(self._ours, data)

    def _hang_up(self) -> None:
        if not self._open:
            return
        self._open = False
        self._selector.unregister(self._ours)
        os.close(self._ours)
        os.close(self._theirs)
