"""The journal of a recording: the synced part of a run survives a power cut, in any order of the disk's writes.

HDF5 changes its tables in place while a recording grows, and relies on the order of its writes. A power cut keeps no
order: pages that were written later may be on the disk while earlier ones are not, and the file cannot be read or
holds samples that were never taken. So everything that goes into a recording is also appended to a journal,
`NAME.recording.journal`: frames of a head (magic number, kind, length, checksum) and a body. A checksum is the CRC-32
of kind, length and body, continued from the frame before, so that neither a missing page nor the remains of an older
file on the disk passes for a frame. The first frame is the recording as HDF5 made it, without samples.
"""

import struct
import zlib
from collections.abc import Iterator, Mapping
from enum import IntEnum
from io import FileIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

_HEAD = struct.Struct("<4sIQI")
_MAGIC = b"DRJ1"
MAX_FIRST_FRAME_BYTES = 1 << 20
"""More than a recording without samples ever has."""
MAX_BODY_BYTES = 1 << 30
"""More than a frame ever holds: the ring passes on at most `RING_SAMPLES` samples at once."""


class FrameKind(IntEnum):
    """The additions of a frame to the recording."""

    EMPTY_RECORDING = 0
    SAMPLES = 1
    """Every column of the trace, in the order of their names and the type that it is recorded in."""
    EVENTS = 2
    """Rows of the table of events."""
    ANNOTATIONS = 3
    """Lines of JSON that became known during the run."""


def _checksum(kind: int, body: "bytes | memoryview", before: int) -> int:
    return zlib.crc32(body, zlib.crc32(struct.pack("<IQ", kind, len(body)), before))


class Journal:
    """Appends frames to a new journal, owned by one thread; nothing is held back from the operating system.

    Raises `OSError` when the disk refuses, at each call.
    """

    def __init__(self, path: Path, empty_recording: bytes) -> None:
        self._file = FileIO(path, "x")
        self._checksum = 0
        try:
            self.append(FrameKind.EMPTY_RECORDING, empty_recording)
        except OSError:
            self._file.close()
            path.unlink()
            raise

    def append(self, kind: FrameKind, body: bytes) -> None:
        """Append a frame."""
        self._checksum = _checksum(kind, body, self._checksum)
        frame = memoryview(_HEAD.pack(_MAGIC, kind, len(body), self._checksum) + body)
        while frame:
            frame = frame[self._file.write(frame) :]

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_frames(path: Path) -> Iterator[tuple[FrameKind, bytes]]:
    """Yield the frames of a journal up to the first that is missing, cut short or damaged.

    Raises `OSError` when the file cannot be read.
    """
    checksum = 0
    with path.open("rb") as file:
        while (frame := _read_frame(file, checksum)) is not None:
            kind, body, checksum = frame
            yield kind, body


def is_without_samples(path: Path) -> bool:
    """Tell whether a power cut came before a journal's first frame was on the disk, so that nothing follows it.

    Raises `OSError` when the file cannot be read.
    """
    if any(True for _ in read_frames(path)):
        return False
    with path.open("rb") as file:
        content = file.read(MAX_FIRST_FRAME_BYTES)
        # A journal's length may be on the disk before its content: it reads as zeros.
        return content.find(_MAGIC, 1) < 0 and not any(any(piece) for piece in iter(lambda: file.read(1 << 20), b""))


def _read_frame(file: BinaryIO, before: int) -> tuple[FrameKind, bytes, int] | None:
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    magic, kind, length, checksum = _HEAD.unpack(head)
    if magic != _MAGIC or length > MAX_BODY_BYTES or kind not in list(FrameKind):
        return None
    body = file.read(length)
    if len(body) < length or _checksum(kind, body, before) != checksum:
        return None
    return FrameKind(kind), body, checksum


def split_samples(body: bytes, types: Mapping[str, np.dtype[np.generic]]) -> dict[str, npt.NDArray[np.generic]]:
    """Return the columns of a frame of samples; `types` are those of the trace, by name."""
    samples = len(body) // sum(dtype.itemsize for dtype in types.values())
    columns: dict[str, npt.NDArray[np.generic]] = {}
    start = 0
    for name in sorted(types):
        columns[name] = np.frombuffer(body, types[name], samples, start)
        start += samples * types[name].itemsize
    return columns
