"""Reading an HDF5 file that its writer has open, or left open when it was killed.

HDF5's own way, `swmr=True`, tries damaged metadata again and again with pauses that double: a recording cut
by a power failure would hang the reader. A SWMR writer orders its writes so that what is on disk is whole at
any moment; so the file is shown to HDF5 as a closed one, and damage is an error at once. Only the superblock
differs: no writer, and an end of file as large as anything in it may claim (HDF5 File Format Specification,
section II.A, version 3).
"""

import os
from io import FileIO
from pathlib import Path

SIGNATURE = b"\x89HDF\r\n\x1a\n"
SUPERBLOCK_BYTES = 48
_VERSION, _FLAGS, _EOF, _CHECKSUM = 8, 11, 28, 44
_UNWRITTEN_BYTES = 1 << 26
"""Room behind the end of the file for chunks that were claimed and not yet written; it reads as zeros."""


class UnfinishedFile:
    """A read-only view of such a file, as h5py's file-object driver wants it."""

    def __init__(self, file: FileIO) -> None:
        self._file = file
        self._end = os.fstat(file.fileno()).st_size + _UNWRITTEN_BYTES
        self._superblock = _closed(file.read(SUPERBLOCK_BYTES), self._end)
        self._place = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a place."""
        self._place = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._end}[whence]
        return self._place

    def tell(self) -> int:
        """Return the place."""
        return self._place

    def read(self, size: int = -1) -> bytes:
        """Return bytes from the place on."""
        into = bytearray(max(0, self._end - self._place) if size < 0 else size)
        self.readinto(into)
        return bytes(into)

    def readinto(self, into: bytearray | memoryview) -> int:
        """Fill a buffer from the place on, with zeros where nothing was written."""
        view = memoryview(into).cast("B")
        self._file.seek(self._place)
        filled = 0
        while filled < len(view) and (count := self._file.readinto(view[filled:])):
            filled += count
        view[filled:] = bytes(len(view) - filled)
        front = self._superblock[self._place : self._place + len(view)]
        view[: len(front)] = front
        self._place += len(view)
        return len(view)


def left_open(path: Path) -> bool:
    """Tell whether an HDF5 file says that it is, or was when its writer died, open for writing."""
    with path.open("rb") as file:
        front = file.read(SUPERBLOCK_BYTES)
    return (
        len(front) == SUPERBLOCK_BYTES and front.startswith(SIGNATURE) and front[_VERSION] == 3 and front[_FLAGS] != 0
    )


def _closed(superblock: bytes, end: int) -> bytes:
    patched = bytearray(superblock)
    patched[_FLAGS] = 0
    patched[_EOF : _EOF + 8] = end.to_bytes(8, "little")
    patched[_CHECKSUM:] = lookup3(bytes(patched[:_CHECKSUM])).to_bytes(4, "little")
    return bytes(patched)


def lookup3(data: bytes) -> int:
    """Bob Jenkins' hash `lookup3` (`hashlittle`, public domain) that HDF5 guards its metadata with."""
    words = [int.from_bytes(data[i : i + 4], "little") for i in range(0, len(data), 4)]
    a = b = c = 0xDEADBEEF + len(data) & 0xFFFFFFFF
    while len(words) > 3:
        a, b, c = (x + y & 0xFFFFFFFF for x, y in zip((a, b, c), words[:3], strict=True))
        a, b, c = _mix(a, b, c)
        words = words[3:]
    a, b, c = (x + y & 0xFFFFFFFF for x, y in zip((a, b, c), [*words, 0, 0, 0][:3], strict=True))
    for rotation, (x, y) in zip((14, 11, 25, 16, 4, 14, 24), _FINAL, strict=True):
        state = [a, b, c]
        state[x] = (state[x] ^ state[y]) - _rotated(state[y], rotation) & 0xFFFFFFFF
        a, b, c = state
    return c


_FINAL = ((2, 1), (0, 2), (1, 0), (2, 1), (0, 2), (1, 0), (2, 1))


def _mix(a: int, b: int, c: int) -> tuple[int, int, int]:
    for rotation in (4, 6, 8, 16, 19, 4):
        a = ((a - c) ^ _rotated(c, rotation)) & 0xFFFFFFFF
        c = c + b & 0xFFFFFFFF
        a, b, c = b, c, a
    return a, b, c


def _rotated(word: int, by: int) -> int:
    return (word << by | word >> (32 - by)) & 0xFFFFFFFF
