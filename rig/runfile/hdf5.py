"""HDF5 files in a bad state: damaged, open for writing, or on a full disk; HDF5 itself would hang or crash on them.

Damaged text heaps: HDF5 stores text of variable length in global heaps and refers to it by length, heap and index
(HDF5 File Format Specification, sections III.E and VIII). The library walks a heap without checking that it advances,
and allocates as much memory as a reference says: a damaged byte there hangs or kills the process.

Files open for writing, or left open by a killed writer: HDF5's own way, `swmr=True`, retries damaged metadata with
pauses that double, so that a recording cut by a power failure would hang the reader. A SWMR writer orders its writes
so that the file on disk is consistent at any moment; so the file is presented to HDF5 as a closed one, and damage is an
error at once. Only the superblock differs: no writer, and an end of file as large as anything in it may claim (HDF5
File Format Specification, section II.A, version 3).
"""

import contextlib
import math
import mmap
import os
import tempfile
from collections.abc import Iterator
from io import FileIO, RawIOBase
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import h5py
    from _typeshed import WriteableBuffer

HEAP_SIGNATURE = b"GCOL\x01\0\0\0"
HEAP_HEADER_BYTES = 16
MIN_HEAP_BYTES = 4096
MAX_TEXT_BYTES = 1 << 24
MAX_SEARCHED_BYTES = 1 << 28
"""Text stands near the front; of larger files only this much is searched."""
MAX_SEARCHED_FOR_HEAPS_BYTES = 1 << 34
"""A file is searched once for each of its heaps; a run file has a handful."""
MAX_DEPTH, MAX_LINKS = 32, 10_000
"""Of the groups of a file, and of all that is in them; a run file has three levels and some fifty names."""

_TEXT_TYPES = (
    (b"\x10\0\0\0\x10\0\0\0\x01\0\0\0\0\0\x08\0", 16),
    *((b"\x10\0\0\0\x13" + bytes([padding]) + b"\0\0\x01\0\0\0", 12) for padding in range(3)),
)
"""Datatypes of text of variable length from their sizes on, of 8-bit numbers or of characters, and how long that is
(section IV.A.2.d)."""

_DATASPACE_HEADER_BYTES, _MAX_RANK = {1: 8, 2: 4}, 32
"""By version of the dataspace, which follows the datatype (section IV.A.2.b)."""
_MAX_REFERENCES = 10_000
_POINTER_BYTES = 8

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
SUPERBLOCK_BYTES = 48
_VERSION_OFFSET, _FLAGS_OFFSET, _EOF_OFFSET, _CHECKSUM_OFFSET = 8, 11, 28, 44
_UNWRITTEN_BYTES = 1 << 26
"""Room behind the end of the file for chunks that were claimed and not yet written; it reads as zeros."""


def find_damaged_text(path: Path) -> int | None:
    """Return the offset [bytes] of the first damage to the file's text heaps, or None."""
    with path.open("rb") as file:
        if path.stat().st_size == 0:
            return None
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as view:
            heap = view.find(HEAP_SIGNATURE, 0, MAX_SEARCHED_BYTES)
            heaps_left = MAX_SEARCHED_FOR_HEAPS_BYTES // min(len(view), MAX_SEARCHED_BYTES)
            while heap >= 0:
                heaps_left -= 1
                if heaps_left < 0:
                    return heap
                sizes = _object_sizes(view, heap)
                if sizes is None:
                    return heap
                for reference in _oversized_references(view, heap, sizes):
                    return reference
                heap = view.find(HEAP_SIGNATURE, heap + MIN_HEAP_BYTES, MAX_SEARCHED_BYTES)
            return next(_oversized_attributes(view), None)


def _object_sizes(view: mmap.mmap, heap: int) -> dict[int, int] | None:
    """Walk a heap and return the size of each object by its index; None when a length leads nowhere."""
    length = _little_endian(view, heap + 8, 8)
    end = heap + length
    if length < MIN_HEAP_BYTES or end > len(view):
        return None
    sizes: dict[int, int] = {}
    position = heap + HEAP_HEADER_BYTES
    while position + HEAP_HEADER_BYTES <= end:
        index, size = _little_endian(view, position, 2), _little_endian(view, position + 8, 8)
        step = size if index == 0 else HEAP_HEADER_BYTES + -(-size // 8) * 8
        if step < HEAP_HEADER_BYTES or position + step > end:
            return None
        sizes[index] = size
        position += step
    return sizes


def _oversized_references(view: mmap.mmap, heap: int, sizes: dict[int, int]) -> Iterator[int]:
    """Yield where a reference to an object of a heap asks for far more than the object holds."""
    address = heap.to_bytes(8, "little")
    position = view.find(address, 4, MAX_SEARCHED_BYTES)
    while position >= 0:
        length, index = _little_endian(view, position - 4, 4), _little_endian(view, position + 8, 4)
        if index and index in sizes and length > max(sizes[index], MAX_TEXT_BYTES):
            yield position - 4
        position = view.find(address, position + 1, MAX_SEARCHED_BYTES)


def _oversized_attributes(view: mmap.mmap) -> Iterator[int]:
    """Yield where an attribute asks for far more text than there may be, in a heap that is none."""
    for encoded, length in _TEXT_TYPES:
        position = view.find(encoded, 0, MAX_SEARCHED_BYTES)
        while position >= 0:
            for text in _references_after(view, position + length, padded=length % 8 == 0):
                if _little_endian(view, text, 4) > MAX_TEXT_BYTES and 0 < _little_endian(view, text + 12, 4) < 1 << 16:
                    yield text
            position = view.find(encoded, position + 1, MAX_SEARCHED_BYTES)


def _references_after(view: mmap.mmap, space: int, *, padded: bool) -> range:
    """Return where the references of an attribute stand whose dataspace begins at `space`, right after its datatype."""
    # The first version of attributes pads each part to 8 bytes; a datatype that needs none tells nothing.
    padded = padded and view[space : space + 4] == bytes(4)
    space += 4 * padded
    version, rank, flags = view[space : space + 3].ljust(3, b"\0")
    if version not in _DATASPACE_HEADER_BYTES or rank > _MAX_RANK:
        return range(0)
    header = _DATASPACE_HEADER_BYTES[version]
    size = header + 8 * rank * (1 + (flags & 1))
    count = math.prod(_little_endian(view, space + header + 8 * axis, 8) for axis in range(rank))
    first = space + (-(-size // 8) * 8 if padded else size)
    return range(first, first + 16 * min(count, _MAX_REFERENCES), 16)


def _little_endian(view: mmap.mmap, offset: int, size: int) -> int:
    return int.from_bytes(view[offset : offset + size], "little")


class UnfinishedFile(RawIOBase):
    """A read-only view of a file that is open for writing, for h5py's file-object driver."""

    def __init__(self, file: FileIO) -> None:
        self._file = file
        self._end = os.fstat(file.fileno()).st_size + _UNWRITTEN_BYTES
        superblock = bytearray(file.read(SUPERBLOCK_BYTES))
        superblock[_FLAGS_OFFSET] = 0
        superblock[_EOF_OFFSET : _EOF_OFFSET + 8] = self._end.to_bytes(8, "little")
        superblock[_CHECKSUM_OFFSET:] = lookup3(bytes(superblock[:_CHECKSUM_OFFSET])).to_bytes(4, "little")
        self._superblock = bytes(superblock)
        self._position = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a position."""
        self._position = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._end}[whence]
        return self._position

    def readinto(self, buffer: "WriteableBuffer") -> int:
        """Fill a buffer from the position on, with zeros where nothing was written."""
        view = memoryview(buffer).cast("B")
        self._file.seek(self._position)
        filled = 0
        while filled < len(view) and (count := self._file.readinto(view[filled:])):
            filled += count
        view[filled:] = bytes(len(view) - filled)
        front = self._superblock[self._position : self._position + len(view)]
        view[: len(front)] = front
        self._position += len(view)
        return len(view)


def find_excess(file: "h5py.File", max_links: int = MAX_LINKS) -> str | None:
    """Say where groups are nested too deep or hold too much to be gone through, or return None."""
    links = 0

    def excess(name: bytes) -> str | None:
        nonlocal links
        links += 1
        if name.count(b"/") >= MAX_DEPTH:
            return f"groups are nested more than {MAX_DEPTH} deep in it"
        return f"its groups hold more than {max_links} names" if links > max_links else None

    found: str | None = file.id.links.visit(excess)
    return found


class ForeignStorageError(Exception):
    """A file takes its content from other files."""


def refuse_foreign_storage(file: "h5py.File") -> None:
    """Refuse a file with links to or data in other files, with which it could hand over any file of this computer.

    Raises `ForeignStorageError` for external links, external storage and virtual datasets.
    """
    import h5py

    def foreign(name: bytes, link: h5py.h5l.LinkInfo) -> str | None:
        if link.type == h5py.h5l.TYPE_EXTERNAL:
            return f"{name.decode('utf-8', 'replace')} is a link into another file"
        item = h5py.h5o.open(file.id, name) if link.type == h5py.h5l.TYPE_HARD else None
        if isinstance(item, h5py.h5d.DatasetID):
            made = item.get_create_plist()
            if made.get_external_count() or made.get_layout() == h5py.h5d.VIRTUAL:
                return f"{name.decode('utf-8', 'replace')} is stored in another file"
        return None

    if (found := file.id.links.visit(foreign, info=True)) is not None:
        raise ForeignStorageError(found)


def find_oversized_text(file: "h5py.File", path: Path) -> int | None:
    """Return the offset [bytes] of a text in a dataset that claims more than there may be, or None.

    Datasets that are compact, chunked or filtered are not searched, nor rows beyond the first 16 MiB.
    """
    import h5py

    with path.open("rb") as raw:

        def oversized(name: bytes, link: h5py.h5l.LinkInfo) -> int | None:
            item = h5py.h5o.open(file.id, name) if link.type == h5py.h5l.TYPE_HARD else None
            if not isinstance(item, h5py.h5d.DatasetID):
                return None
            texts, offset = _text_offsets(item.get_type()), item.get_offset()
            rows = math.prod(item.shape)
            if offset is None or not texts or not rows:
                return None
            # In memory a text is a pointer, in the file a reference of twice its size.
            stored = [at + before * _POINTER_BYTES for before, at in enumerate(sorted(texts))]
            row_bytes = item.get_storage_size() // rows
            raw.seek(offset)
            # The sizes are the file's own word: what is read is bounded whatever it says.
            data = raw.read(min(rows * row_bytes, MAX_TEXT_BYTES))
            for text in (row + at for row in range(0, len(data), max(1, row_bytes)) for at in stored):
                if int.from_bytes(data[text : text + 4], "little") > MAX_TEXT_BYTES:
                    return int(offset + text)
            return None

        found: int | None = file.id.links.visit(oversized, info=True)
    return found


def _text_offsets(kind: "h5py.h5t.TypeID") -> list[int]:
    """Return where text of variable length stands in a row, in memory."""
    import h5py

    if isinstance(kind, h5py.h5t.TypeCompoundID):
        members = [(kind.get_member_offset(at), kind.get_member_type(at)) for at in range(kind.get_nmembers())]
        return [offset + inner for offset, member in members for inner in _text_offsets(member)]
    return [0] if isinstance(kind, h5py.h5t.TypeStringID) and kind.is_variable_str() else []


def is_open_for_writing(path: Path) -> bool:
    """Tell whether an HDF5 file says that it is, or was when its writer died, open for writing."""
    with path.open("rb") as file:
        front = file.read(SUPERBLOCK_BYTES)
    whole = len(front) == SUPERBLOCK_BYTES and front.startswith(HDF5_SIGNATURE)
    return whole and front[_VERSION_OFFSET] == 3 and front[_FLAGS_OFFSET] != 0


def lookup3(data: bytes) -> int:
    """Bob Jenkins' hash `lookup3` (`hashlittle`, public domain) that HDF5 guards its metadata with."""
    words = [int.from_bytes(data[i : i + 4], "little") for i in range(0, len(data), 4)]
    a = b = c = 0xDEADBEEF + len(data) & 0xFFFFFFFF
    while len(words) > 3:
        a, b, c = (x + y & 0xFFFFFFFF for x, y in zip((a, b, c), words[:3], strict=True))
        for rotation in (4, 6, 8, 16, 19, 4):
            a = ((a - c) ^ _rotate_left(c, rotation)) & 0xFFFFFFFF
            a, b, c = b, c + b & 0xFFFFFFFF, a
        words = words[3:]
    state = [x + y & 0xFFFFFFFF for x, y in zip((a, b, c), [*words, 0, 0, 0][:3], strict=True)]
    for rotation, x, y in ((14, 2, 1), (11, 0, 2), (25, 1, 0), (16, 2, 1), (4, 0, 2), (14, 1, 0), (24, 2, 1)):
        state[x] = (state[x] ^ state[y]) - _rotate_left(state[y], rotation) & 0xFFFFFFFF
    return state[2]


def _rotate_left(word: int, bits: int) -> int:
    return (word << bits | word >> (32 - bits)) & 0xFFFFFFFF


def abandon_hdf5_file(file: "h5py.File") -> None:
    """Let go of an HDF5 file whose disk refuses data, leaving it on disk as it is.

    HDF5 flushes on closing and, refused, crashes the interpreter at its end. So its descriptor is first pointed at
    memory (or a temporary file), where the last flush may go.
    """
    descriptor = file.id.get_vfd_handle()
    if hasattr(os, "memfd_create"):
        memory = os.memfd_create("dragrig")
        os.dup2(memory, descriptor, inheritable=False)
        os.close(memory)
    else:
        with tempfile.TemporaryFile() as temporary:
            os.dup2(temporary.fileno(), descriptor, inheritable=False)
    with contextlib.suppress(OSError, RuntimeError, ValueError):
        file.close()
