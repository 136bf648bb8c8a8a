"""A look at an HDF5 file's heaps of text before the library follows them.

HDF5 keeps text of variable length in global heaps and refers to it by length, heap and index (HDF5 File
Format Specification, sections III.E and VIII). The library walks a heap without making sure that it gets
ahead, and asks for as much memory as a reference says: a damaged byte there hangs or kills the process.
"""

import mmap
from collections.abc import Iterator
from pathlib import Path

MARK = b"GCOL\x01\0\0\0"
HEADER_BYTES = 16
LEAST_BYTES = 4096
LONGEST_TEXT_BYTES = 1 << 24
SEARCHED_BYTES = 1 << 28
"""Text stands near the front; of larger files only this much is searched."""


def damaged_text(path: Path) -> int | None:
    """Return where the first damage to the heaps of text stands in the file, or None."""
    with path.open("rb") as file:
        if path.stat().st_size == 0:
            return None
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as view:
            start = view.find(MARK, 0, SEARCHED_BYTES)
            while start >= 0:
                sizes = _object_sizes(view, start)
                if sizes is None:
                    return start
                for place in _references(view, start, sizes):
                    return place
                start = view.find(MARK, start + LEAST_BYTES, SEARCHED_BYTES)
    return None


def _object_sizes(view: mmap.mmap, start: int) -> dict[int, int] | None:
    """Walk one heap and return the size of each object by its index; None when a length leads nowhere."""
    length = _number(view, start + 8, 8)
    end = start + length
    if length < LEAST_BYTES or end > len(view):
        return None
    sizes: dict[int, int] = {}
    place = start + HEADER_BYTES
    while place + HEADER_BYTES <= end:
        index, size = _number(view, place, 2), _number(view, place + 8, 8)
        step = size if index == 0 else HEADER_BYTES + -(-size // 8) * 8
        if step < HEADER_BYTES or place + step > end:
            return None
        sizes[index] = size
        place += step
    return sizes


def _references(view: mmap.mmap, heap: int, sizes: dict[int, int]) -> Iterator[int]:
    """Yield where a reference to an object of a heap asks for far more than the object holds."""
    address = heap.to_bytes(8, "little")
    place = view.find(address, 4, SEARCHED_BYTES)
    while place >= 0:
        length, index = _number(view, place - 4, 4), _number(view, place + 8, 4)
        if index and index in sizes and length > max(sizes[index], LONGEST_TEXT_BYTES):
            yield place - 4
        place = view.find(address, place + 1, SEARCHED_BYTES)


def _number(view: mmap.mmap, place: int, size: int) -> int:
    return int.from_bytes(view[place : place + size], "little")
