"""Samples on their way to a screen: a ring in shared memory that its writer never waits for.

Whoever writes overwrites what is oldest; whoever reads too late has missed it, and is told. Only the screen loses
anything: run files are written by the recorder, which this has no part in.
"""

import ctypes
from dataclasses import dataclass
from multiprocessing.context import SpawnContext

import numpy as np
import numpy.typing as npt

from dragrig.rig.reading import Reading

SAMPLES = 1 << 20
"""Of the ring: over 17 min at 1 kHz, 4 s at 250 kHz."""
_MARGIN = 1 << 14
"""What may be written while a reader copies; it keeps so far away from the oldest samples."""
_FIELDS = 4
_WRITTEN, _SERIAL, _BASE, _RATE_MHZ = range(_FIELDS)
_BYTES_PER_SAMPLE = 4 + 4 + 1

Memory = ctypes.Array[ctypes.c_byte]
Floats = npt.NDArray[np.float32]
Phases = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Fresh:
    """Samples that were not read before, arrays of shape `(n,)`.

    Attributes
    ----------
    serial
        Tells one run from the next.
    first_index
        Of the first sample, from the run's start, lost samples counted.
    missed
        Samples right before these that were overwritten before anybody read them.
    force, position
        In mN and mm; NaN where the sampler lost samples.
    """

    serial: int
    rate_hz: float
    first_index: int
    missed: int
    force: Floats
    position: Floats
    phase: Phases


def shared_memory(context: SpawnContext, samples: int = SAMPLES) -> Memory:
    """Return memory for a ring, to be handed to a process that is about to be started; it lives as long as they do."""
    return context.RawArray(ctypes.c_byte, 8 * _FIELDS + _BYTES_PER_SAMPLE * samples)


class _Ring:
    def __init__(self, memory: Memory) -> None:
        self.samples = (len(memory) - 8 * _FIELDS) // _BYTES_PER_SAMPLE
        at, held = 8 * _FIELDS, memoryview(memory).cast("B")
        self.head: npt.NDArray[np.int64] = np.frombuffer(held, np.int64, _FIELDS)
        self.force: Floats = np.frombuffer(held, np.float32, self.samples, at)
        self.position: Floats = np.frombuffer(held, np.float32, self.samples, at + 4 * self.samples)
        self.phase: Phases = np.frombuffer(held, np.uint8, self.samples, at + 8 * self.samples)


class LiveWriter:
    """Puts readings into the ring; belongs to one thread."""

    def __init__(self, memory: Memory) -> None:
        self._ring = _Ring(memory)
        self._begins = False

    def begin(self) -> None:
        """Say that what comes next belongs to another run."""
        self._begins = True

    def put(self, reading: Reading) -> None:
        """Put a reading in; takes as long as copying it."""
        head = self._ring.head
        if self._begins:
            self._open_run(reading)
        written, base = int(head[_WRITTEN]), int(head[_BASE])
        gap = base + reading.first_index - written
        if gap > 0:
            written = self._write(written, gap, np.float32(np.nan), np.float32(np.nan), reading.phase[:1])
        force, position = reading.channels["force"], reading.channels["position"]
        head[_WRITTEN] = self._write(written, len(force), force, position, reading.phase)

    def _open_run(self, reading: Reading) -> None:
        head, self._begins = self._ring.head, False
        # Odd while the fields do not belong together.
        head[_SERIAL] += 1
        head[_BASE] = head[_WRITTEN]
        head[_RATE_MHZ] = round(1000 * _rate_of(reading))
        head[_SERIAL] += 1

    def _write(
        self, written: int, count: int, force: npt.ArrayLike, position: npt.ArrayLike, phase: npt.ArrayLike
    ) -> int:
        ring = self._ring
        kept = min(count, ring.samples)
        places = _places(written + count - kept, kept, ring.samples)
        done = count - kept
        for place in places:
            length = place.stop - place.start
            for target, values in ((ring.force, force), (ring.position, position), (ring.phase, phase)):
                source = np.asarray(values)
                target[place] = source[done : done + length] if source.ndim and len(source) == count else source
            done += length
        return written + count


class LiveReader:
    """Reads what was put into the ring since it was last asked; any number of them, each in one thread."""

    def __init__(self, memory: Memory) -> None:
        self._ring = _Ring(memory)
        self._cursor = 0
        self._serial = 0

    def read(self) -> Fresh | None:
        """Return what is new; none when nothing is."""
        head = self._ring.head
        serial, base, rate, written = int(head[_SERIAL]), int(head[_BASE]), int(head[_RATE_MHZ]), int(head[_WRITTEN])
        if serial % 2 or serial == 0:
            return None
        if serial != self._serial:
            self._serial, self._cursor = serial, base
        oldest = written - self._ring.samples + _margin(self._ring.samples)
        start = max(self._cursor, oldest, base)
        if written <= start:
            return None
        ring, places = self._ring, _places(start, written - start, self._ring.samples)
        force = np.concatenate([ring.force[place] for place in places])
        position = np.concatenate([ring.position[place] for place in places])
        phase = np.concatenate([ring.phase[place] for place in places])
        if int(head[_SERIAL]) != serial:
            return None
        # What was overwritten while it was copied is dropped.
        torn = max(0, int(head[_WRITTEN]) - self._ring.samples - start)
        if torn >= written - start:
            return None
        missed = start + torn - self._cursor
        self._cursor = written
        return Fresh(serial, rate / 1000, start + torn - base, missed, force[torn:], position[torn:], phase[torn:])


def _places(start: int, count: int, samples: int) -> list[slice]:
    first = start % samples
    if first + count <= samples:
        return [slice(first, first + count)]
    return [slice(first, samples), slice(0, first + count - samples)]


def _margin(samples: int) -> int:
    return min(_MARGIN, samples // 4)


def _rate_of(reading: Reading) -> float:
    last = reading.end_index - 1
    return last / float(reading.time[-1]) if last > 0 and reading.time[-1] > 0 else 1000.0
