"""HDF5 files that are damaged, or still open for writing: inspected byte by byte before the library follows them.

Damaged text heaps: HDF5 stores text of variable length in global heaps and refers to it by length, heap and index
(HDF5 File Format Specification, sections III.E and VIII). The library walks a heap without checking that it advances,
and allocates as much memory as a reference says: a damaged byte there hangs or kills the process.

Files open for writing, or left open by a killed writer: HDF5's own way, `swmr=True`, retries damaged metadata with
pauses that double, so that a recording cut by a power failure would hang the reader. A SWMR writer orders its writes
so that what is on disk is consistent at any moment; so the file is presented to HDF5 as a closed one, and damage is an
error at once. Only the superblock differs: no writer, and an end of file as large as anything in it may claim (HDF5
File Format Specification, section II.A, version 3).
"""

import mmap
import os
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

HEAP_SIGNATURE = b"GCOL\x01\0\0\0"
HEAP_HEADER_BYTES = 16
MIN_HEAP_BYTES = 4096
MAX_TEXT_BYTES = 1 << 24
MAX_SEARCHED_BYTES = 1 << 28
"""Text stands near the front; of larger files only this much is searched."""


def find_damaged_text(path: Path) -> int | None:
    """Return where the first damage to the heaps of text stands in the file, or None."""
    with path.open("rb") as file:
        if path.stat().st_size == 0:
            return None
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as view:
            start = view.find(HEAP_SIGNATURE, 0, MAX_SEARCHED_BYTES)
            while start >= 0:
                sizes = _object_sizes(view, start)
                if sizes is None:
                    return start
                for place in _oversized_references(view, start, sizes):
                    return place
                start = view.find(HEAP_SIGNATURE, start + MIN_HEAP_BYTES, MAX_SEARCHED_BYTES)
    return None


def _object_sizes(view: mmap.mmap, start: int) -> dict[int, int] | None:
    """Walk one heap and return the size of each object by its index; None when a length leads nowhere."""
    length = _little_endian(view, start + 8, 8)
    end = start + length
    if length < MIN_HEAP_BYTES or end > len(view):
        return None
    sizes: dict[int, int] = {}
    place = start + HEAP_HEADER_BYTES
    while place + HEAP_HEADER_BYTES <= end:
        index, size = _little_endian(view, place, 2), _little_endian(view, place + 8, 8)
        step = size if index == 0 else HEAP_HEADER_BYTES + -(-size // 8) * 8
        if step < HEAP_HEADER_BYTES or place + step > end:
            return None
        sizes[index] = size
        place += step
    return sizes


def _oversized_references(view: mmap.mmap, heap: int, sizes: dict[int, int]) -> Iterator[int]:
    """Yield where a reference to an object of a heap asks for far more than the object holds."""
    address = heap.to_bytes(8, "little")
    place = view.find(address, 4, MAX_SEARCHED_BYTES)
    while place >= 0:
        length, index = _little_endian(view, place - 4, 4), _little_endian(view, place + 8, 4)
        if index and index in sizes and length > max(sizes[index], MAX_TEXT_BYTES):
            yield place - 4
        place = view.find(address, place + 1, MAX_SEARCHED_BYTES)


def _little_endian(view: mmap.mmap, place: int, size: int) -> int:
    return int.from_bytes(view[place : place + size], "little")


HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
SUPERBLOCK_BYTES = 48
_VERSION_OFFSET, _FLAGS_OFFSET, _EOF_OFFSET, _CHECKSUM_OFFSET = 8, 11, 28, 44
_UNWRITTEN_BYTES = 1 << 26
"""Room behind the end of the file for chunks that were claimed and not yet written; it reads as zeros."""


class UnfinishedFile:
    """A read-only view of such a file, as h5py's file-object driver wants it."""

    def __init__(self, file: FileIO) -> None:
        self._file = file
        self._end = os.fstat(file.fileno()).st_size + _UNWRITTEN_BYTES
        self._superblock = _closed_superblock(file.read(SUPERBLOCK_BYTES), self._end)
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


def is_open_for_writing(path: Path) -> bool:
    """Tell whether an HDF5 file says that it is, or was when its writer died, open for writing."""
    with path.open("rb") as file:
        front = file.read(SUPERBLOCK_BYTES)
    return (
        len(front) == SUPERBLOCK_BYTES
        and front.startswith(HDF5_SIGNATURE)
        and front[_VERSION_OFFSET] == 3
        and front[_FLAGS_OFFSET] != 0
    )


def _closed_superblock(superblock: bytes, end: int) -> bytes:
    patched = bytearray(superblock)
    patched[_FLAGS_OFFSET] = 0
    patched[_EOF_OFFSET : _EOF_OFFSET + 8] = end.to_bytes(8, "little")
    patched[_CHECKSUM_OFFSET:] = lookup3(bytes(patched[:_CHECKSUM_OFFSET])).to_bytes(4, "little")
    return bytes(patched)


def lookup3(data: bytes) -> int:
    """Bob Jenkins' hash `lookup3` (`hashlittle`, public domain) that HDF5 guards its metadata with."""
    words = [int.from_bytes(data[i : i + 4], "little") for i in range(0, len(data), 4)]
    a = b = c = 0xDEADBEEF + len(data) & 0xFFFFFFFF
    while len(words) > 3:
        a, b, c = (x + y & 0xFFFFFFFF for x, y in zip((a, b, c), words[:3], strict=True))
        a, b, c = _lookup3_mix(a, b, c)
        words = words[3:]
    a, b, c = (x + y & 0xFFFFFFFF for x, y in zip((a, b, c), [*words, 0, 0, 0][:3], strict=True))
    for rotation, (x, y) in zip((14, 11, 25, 16, 4, 14, 24), _LOOKUP3_FINAL, strict=True):
        state = [a, b, c]
        state[x] = (state[x] ^ state[y]) - _rotate_left(state[y], rotation) & 0xFFFFFFFF
        a, b, c = state
    return c


_LOOKUP3_FINAL = ((2, 1), (0, 2), (1, 0), (2, 1), (0, 2), (1, 0), (2, 1))


def _lookup3_mix(a: int, b: int, c: int) -> tuple[int, int, int]:
    for rotation in (4, 6, 8, 16, 19, 4):
        a = ((a - c) ^ _rotate_left(c, rotation)) & 0xFFFFFFFF
        c = c + b & 0xFFFFFFFF
        a, b, c = b, c, a
    return a, b, c


def _rotate_left(word: int, by: int) -> int:
    return (word << by | word >> (32 - by)) & 0xFFFFFFFF
