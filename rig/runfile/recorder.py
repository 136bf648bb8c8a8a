"""The recorder: takes samples from the acquiring thread and has them on file within a flush interval.

A ring buffer hands the samples to a thread that owns the recording: SWMR, uncompressed, every dataset created
beforehand. At whatever moment its process dies, all flushed samples can be read up to `valid_samples`. Against a power
cut everything goes into a journal as well, which a second thread syncs to the disk; `rebuild` makes the recording of
it.
"""

import json
import os
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from io import BytesIO
from pathlib import Path
from threading import Condition, Thread
from typing import Self

import h5py
import numpy as np
import numpy.typing as npt

from dragrig.config import OutputError, RecordingError, RunFileError
from dragrig.rig.runfile import schema
from dragrig.rig.runfile.filesystem import (
    brief_error,
    free_bytes,
    lock_run,
    move_into_place,
    remove_quietly,
    rename_into_place,
    sync_file,
    sync_folder,
)
from dragrig.rig.runfile.hdf5 import abandon_hdf5_file
from dragrig.rig.runfile.journal import FrameKind, Journal, read_frames, split_samples
from dragrig.rig.runfile.model import Attribute, RecordedChannel, RunEnding, RunEvent, RunHeader, RunStatus
from dragrig.rig.runfile.reader import LayoutError, valid_count
from dragrig.rig.runfile.writer import (
    check_header,
    column_types,
    column_units,
    event_rows,
    write_dataset_attributes,
    write_header,
)

Columns = Mapping[str, npt.NDArray[np.generic]]


RECORDING_CHUNK = 4096
EVENTS_CHUNK = 64
VERSION_BOUNDS = ("v110", "v110")
"""The oldest layout of HDF5 that can be written while others read."""
MAX_CLOSE_S = 120.0
"""How long the end of a run waits for a disk that does not answer."""
FLUSH_S = 0.1
"""Wall time between flushes: what a killed process loses at most, besides the time that a flush takes."""
CONCURRENT_SYNCS = 5
"""Syncs under way at once: a disk that takes half a second for each still has one begin with each flush."""
RESERVE_BYTES = 64 << 20
RING_SAMPLES = 1 << 18


class SampleRing:
    """Preallocated columns of `capacity` samples between one producer and one consumer.

    The producer copies its samples in and waits while there is no room; nothing is dropped. The consumer sees the
    samples as views and frees their room once it has written them; it is woken when a quarter of the ring is filled.
    Each side touches only its own part of the columns; a lock guards the counters.
    """

    def __init__(self, types: Mapping[str, np.dtype[np.generic]], capacity: int) -> None:
        self._columns = {name: np.empty(capacity, dtype) for name, dtype in types.items()}
        self._capacity = capacity
        self._wake_at = capacity // 4
        self._put = 0
        self._taken = 0
        self._closed = False
        self._change = Condition()

    def put(self, columns: Columns) -> bool:
        """Copy samples in, in pieces where they do not fit at once; return False once the ring is closed."""
        count = len(next(iter(columns.values())))
        done = 0
        while done < count:
            with self._change:
                self._change.wait_for(lambda: self._closed or self._put - self._taken < self._capacity)
                if self._closed:
                    return False
                step = min(self._capacity - (self._put - self._taken), count - done)
            for slots, part in self._slots(self._put, step):
                for name, column in self._columns.items():
                    column[slots] = columns[name][done : done + step][part]
            done += step
            with self._change:
                self._put += step
                if self._put - self._taken >= self._wake_at:
                    self._change.notify_all()
        return True

    def wait(self, timeout_s: float) -> bool:
        """Wait until enough samples are there, at most `timeout_s`; return whether the ring is closed."""
        with self._change:
            self._change.wait_for(lambda: self._closed or self._put - self._taken >= self._wake_at, timeout_s)
            return self._closed

    def take(self) -> Iterator[Columns]:
        """Yield the samples put so far as views, each valid until the next one is taken."""
        with self._change:
            count = self._put - self._taken
        for slots, part in self._slots(self._taken, count):
            yield {name: column[slots] for name, column in self._columns.items()}
            with self._change:
                self._taken += part.stop - part.start
                self._change.notify_all()

    def close(self) -> None:
        """Wake both sides: no more samples are put, and a waiting producer returns."""
        with self._change:
            self._closed = True
            self._change.notify_all()

    def _slots(self, position: int, count: int) -> Iterator[tuple[slice, slice]]:
        """Yield where `count` samples from `position` on lie: slots of the ring, and which of the samples are there."""
        first = position % self._capacity
        ahead = min(count, self._capacity - first)
        if ahead:
            yield slice(first, first + ahead), slice(0, ahead)
        if count > ahead:
            yield slice(0, count - ahead), slice(ahead, count)


class FileSyncer:
    """Calls `fsync` in threads of its own; an error is raised by the next request.

    Several may be under way at once: frames written just after a long sync began would otherwise wait for two.
    Requests that find all of them busy become a single one.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._change = Condition()
        self._requested = False
        self._closed = False
        self._error: OSError | None = None
        self._threads = [
            Thread(target=self._sync, name=f"sync of {path.name}", daemon=True) for _ in range(CONCURRENT_SYNCS)
        ]
        for thread in self._threads:
            thread.start()

    def request(self) -> None:
        """Request a sync of all that was written so far."""
        with self._change:
            if self._error is not None:
                raise self._error
            self._requested = True
            self._change.notify()

    def close(self) -> None:
        """End after the last requested sync."""
        with self._change:
            self._closed = True
            self._change.notify_all()
        for thread in self._threads:
            thread.join()

    def _sync(self) -> None:
        try:
            while self._await_request():
                sync_file(self._path)
        except OSError as error:
            with self._change:
                self._error = error

    def _await_request(self) -> bool:
        with self._change:
            self._change.wait_for(lambda: self._requested or self._closed)
            requested, self._requested = self._requested, False
            return requested


def create_recording(path: Path, header: RunHeader) -> Journal:
    """Make a recording without samples, and return its journal, synced; it gets its name once both are whole."""
    part, journal_path = schema.part_path(path), schema.journal_path(path)
    try:
        part.write_bytes(_empty_recording(header.channels))
        with h5py.File(part, "r+", libver=VERSION_BOUNDS, locking=False) as file:
            write_header(file, header, RunStatus.RECORDING)
        journal = Journal(journal_path, part.read_bytes())
        try:
            sync_file(journal_path)
            rename_into_place(part, path)
            sync_folder(path.parent)
        except BaseException:
            journal.close()
            remove_quietly(journal_path)
            raise
        return journal
    finally:
        remove_quietly(part)


def rebuild(recording: Path) -> None:
    """Make a recording anew from its journal, up to the first frame that the disk did not keep.

    Leaves the recording as it is where nothing of the journal can be read. Call it with the run locked. Raises
    `OSError` when the disk refuses.
    """
    journal = schema.journal_path(recording)
    frames = read_frames(journal)
    kind, image = next(frames, (None, b""))
    if kind is not FrameKind.EMPTY_RECORDING:
        return
    part = schema.part_path(recording)
    try:
        part.write_bytes(image)
        file = RecordingFile(part)
        for kind, body in frames:
            file.append_frame(kind, body)
        file.flush()
        file.close()
        move_into_place(part, recording)
    finally:
        remove_quietly(part)


@cache
def _empty_recording(channels: tuple[RecordedChannel, ...]) -> bytes:
    """Return the bytes of an empty recording with these channels; making them takes longer than writing a header."""
    image = BytesIO()
    with h5py.File(image, "w", libver=VERSION_BOUNDS) as file:
        units = column_units(channels)
        for name, dtype in column_types(channels).items():
            write_dataset_attributes(
                _growing_dataset(file, f"{schema.TRACE}/{name}", dtype, RECORDING_CHUNK), name, units
            )
        _growing_dataset(file, schema.LAYOUT.events, schema.event_dtype(), EVENTS_CHUNK)
        _growing_dataset(file, schema.LAYOUT.annotations, np.dtype("u1"), RECORDING_CHUNK)
        for name in schema.LAYOUT.valid_counts:
            file.create_dataset(name, data=np.zeros(1, dtype="<u8"))
    return image.getvalue()


def _growing_dataset(file: h5py.File, path: str, dtype: np.dtype[np.generic], chunk: int) -> h5py.Dataset:
    return file.create_dataset(path, shape=(0,), maxshape=(None,), chunks=(chunk,), dtype=dtype)


class RecordingFile:
    """An open recording, owned by one thread; appended blocks go to its journal first, where it has any."""

    def __init__(self, path: Path, journal: Journal | None = None) -> None:
        self.path = path
        self._journal = journal
        self._file = _open_for_swmr(path)
        self._trace = {name: self._file[schema.TRACE][name] for name in self._file[schema.TRACE]}
        self.types: Mapping[str, np.dtype[np.generic]] = {name: column.dtype for name, column in self._trace.items()}
        """Type of each column of the trace, by name."""
        self._sample_bytes = sum(dtype.itemsize for dtype in self.types.values())
        self._events = self._file[schema.LAYOUT.events]
        self._annotations = self._file[schema.LAYOUT.annotations]
        self._valid = tuple(self._file[name] for name in schema.LAYOUT.valid_counts)
        self.samples = 0
        """Samples written, flushed or not."""

    @property
    def written_bytes(self) -> int:
        """Size of the samples written."""
        return self.samples * self._sample_bytes

    def append(self, columns: Columns) -> None:
        """Append samples to every dataset of the trace."""
        self.append_frame(FrameKind.SAMPLES, b"".join(columns[name].tobytes() for name in sorted(columns)))

    def append_events(self, events: Sequence[RunEvent]) -> None:
        """Append events to their table."""
        self.append_frame(FrameKind.EVENTS, event_rows(events).tobytes())

    def append_annotations(self, annotations: Sequence[Mapping[str, object]]) -> None:
        """Append facts that became known during the run, one line of JSON each."""
        text = "".join(f"{json.dumps(line)}\n" for line in annotations)
        self.append_frame(FrameKind.ANNOTATIONS, text.encode())

    def append_frame(self, kind: FrameKind, body: bytes) -> None:
        """Append the content of a journal's frame."""
        if self._journal is not None:
            self._journal.append(kind, body)
        match kind:
            case FrameKind.SAMPLES:
                for name, column in split_samples(body, self.types).items():
                    _extend(self._trace[name], column)
                self.samples = len(self._trace[schema.TIME])
            case FrameKind.EVENTS:
                _extend(self._events, np.frombuffer(body, schema.event_dtype()))
            case FrameKind.ANNOTATIONS:
                _extend(self._annotations, np.frombuffer(body, "u1"))

    def flush(self) -> None:
        """Hand everything to the operating system, then record how much of it is valid."""
        self._file.flush()
        counts = (self.samples, len(self._events), len(self._annotations))
        for dataset, count in zip(self._valid, counts, strict=True):
            dataset[0] = count
        self._file.flush()

    def close(self) -> None:
        """Close the file; samples not flushed before do not count as valid."""
        self._file.close()
        if self._journal is not None:
            self._journal.close()

    def discard(self) -> None:
        """Let go of the file without writing to it again, after the disk refused data."""
        abandon_hdf5_file(self._file)
        if self._journal is not None:
            self._journal.close()


def _extend(dataset: h5py.Dataset, rows: np.ndarray[tuple[int], np.dtype[np.generic]]) -> None:
    start = len(dataset)
    dataset.resize((start + len(rows),))
    dataset[start:] = rows


def _open_for_swmr(path: Path) -> h5py.File:
    """Open for writing and for reading by others in one step, so that the file is readable at any moment.

    The chunk cache is off: HDF5 writes each piece straight to its place instead of a whole chunk per flush. HDF5's own
    lock is off: `lock_run` replaces it, and a child process that is just being started would hold it a moment longer.
    """
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_libver_bounds(h5py.h5f.LIBVER_V110, h5py.h5f.LIBVER_V110)
    access.set_file_locking(False, True)
    elements, slots, _, preemption = access.get_cache()
    access.set_cache(elements, slots, 0, preemption)
    flags = h5py.h5f.ACC_RDWR | h5py.h5f.ACC_SWMR_WRITE
    return h5py.File(h5py.h5f.open(os.fsencode(path), flags, fapl=access))


def entry_annotation(entry: Mapping[str, Attribute]) -> dict[str, object]:
    """Return the annotation that adds attributes to the run."""
    return {"entry": dict(entry)}


def ending_annotation(ending: RunEnding) -> dict[str, object]:
    """Return the annotation that states how the run ended."""
    end_time = ending.end_time.isoformat() if ending.end_time else ""
    values = {"status": str(ending.status), "reason": ending.reason, "end_time": end_time, "checks": {**ending.checks}}
    return {"ending": values}


def read_annotations(file: h5py.File, layout: schema.Layout) -> tuple[dict[str, Attribute], RunEnding | None]:
    """Read the facts that became known during the run: its attributes, and its end where that is written."""
    entry: dict[str, Attribute] = {}
    ending: RunEnding | None = None
    if layout.annotations in file:
        _, _, valid_bytes = layout.valid_counts
        valid = valid_count(file, valid_bytes, len(file[layout.annotations]))
        for line in file[layout.annotations][:valid].tobytes().splitlines():
            annotation = json.loads(line)
            entry.update(annotation.get("entry", {}))
            if values := annotation.get("ending"):
                end_time = datetime.fromisoformat(values["end_time"]) if values["end_time"] else None
                ending = RunEnding(RunStatus(values["status"]), values["reason"], end_time, values["checks"])
    return entry, ending


@dataclass(frozen=True, slots=True)
class DiskSpace:
    """Disk space that a run needs: its samples still to come, twice (journal), its finished copy, and a reserve."""

    folder: Path
    reserve_bytes: int
    run_bytes: int

    def shortage(self, written_bytes: int) -> str | None:
        """Return a sentence about the missing space, or None while there is enough."""
        total = max(self.run_bytes, written_bytes)
        needed = 2 * (total - written_bytes) + total + self.reserve_bytes
        free = free_bytes(self.folder)
        if free >= needed:
            return None
        return f"{self.folder}: {free / 1e6:.1f} MB are free and {needed / 1e6:.1f} MB needed; make room"


class WriterThread(Thread):
    """Writes until the ring is closed or the disk refuses.

    Only this thread sets `failure`, the error that ended it, and `shortage`, a sentence about missing disk space while
    it still writes. Any thread may append to `events` and `annotations`, which go to the file with the next flush.
    """

    def __init__(self, file: RecordingFile, ring: SampleRing, space: DiskSpace, flush_s: float) -> None:
        super().__init__(name=f"recorder of {file.path.name}", daemon=True)
        self.failure: Exception | None = None
        self.shortage: str | None = None
        self.events: deque[RunEvent] = deque()
        self.annotations: deque[Mapping[str, object]] = deque()
        self._file, self._ring, self._space, self._flush_s = file, ring, space, flush_s
        self._syncer = FileSyncer(schema.journal_path(file.path))

    def run(self) -> None:
        """Write, flush, close."""
        try:
            flushed_s = time.monotonic()
            closed = False
            while not closed:
                closed = self._ring.wait(flushed_s + self._flush_s - time.monotonic())
                now_s = time.monotonic()
                for columns in self._ring.take():
                    self._file.append(columns)
                    self.shortage = self._space.shortage(self._file.written_bytes)
                if closed or now_s >= flushed_s + self._flush_s:
                    self._flush()
                    flushed_s = now_s
            self._file.close()
        except Exception as error:  # noqa: BLE001 - the acquiring thread raises it
            self.failure = error
            self._file.discard()
        finally:
            self._ring.close()
            self._syncer.close()

    def _flush(self) -> None:
        if events := [self.events.popleft() for _ in range(len(self.events))]:
            self._file.append_events(events)
        if annotations := [self.annotations.popleft() for _ in range(len(self.annotations))]:
            self._file.append_annotations(annotations)
        self._file.flush()
        self._syncer.request()


class Recorder:
    """Records one run into `NAME.recording.h5` in a thread of its own; others may read it meanwhile.

    `offer` and `close` belong to one thread, the acquiring one; `event` and `annotate` to any.

    Parameters
    ----------
    path
        The finished file, `NAME.h5`; the recording is written beside it. Neither may exist.
    flush_s
        Wall time between flushes, also while no samples come.
    reserve_bytes
        Free space that must be left besides the room of the run and its finished copy.
    expected_samples
        Planned length of the run, for the check of free space.

    Raises
    ------
    OutputError
        When the run exists already or the folder refuses.
    RecordingError
        When the disk has too little space for the run.
    RunFileError
        When the header breaks the format.
    """

    def __init__(
        self,
        path: Path,
        header: RunHeader,
        *,
        flush_s: float = FLUSH_S,
        reserve_bytes: int = RESERVE_BYTES,
        expected_samples: int = 0,
    ) -> None:
        self.path = schema.recording_path(path)
        """The recording's file."""
        self._rate = header.sample_rate_hz
        try:
            check_header(header)
        except LayoutError as error:
            raise RunFileError(f"{path}: cannot be recorded because {error}; correct the settings") from error
        self._types = column_types(header.channels)
        self._next_index = 0
        self._closed = False
        self._shortage_raised = False
        sample_bytes = sum(dtype.itemsize for dtype in self._types.values())
        space = DiskSpace(path.parent, reserve_bytes, expected_samples * sample_bytes)
        with ExitStack() as stack:
            stack.enter_context(lock_run(path))
            file = _create_recording_file(self.path, header, space)
            self._ring = SampleRing(self._types, RING_SAMPLES)
            self._thread = WriterThread(file, self._ring, space, flush_s)
            self._thread.start()
            self._lock = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, fault: BaseException | None, _trace: object) -> None:
        if not self._closed:
            status = RunStatus.ABORTED if isinstance(fault, KeyboardInterrupt) else RunStatus.FAILED
            reason = str(fault) if fault else "the recorder was left before the run was closed"
            self.close(RunEnding(status, reason))

    @property
    def failure(self) -> RecordingError | None:
        """Why recording cannot go on, or None: the disk refused data or has too little space."""
        if self._thread.failure is not None:
            return RecordingError(
                f"{self.path}: the disk refused data ({brief_error(self._thread.failure)}); make room, then"
                " `dragrig recover` finishes what was recorded"
            )
        return RecordingError(self._thread.shortage) if self._thread.shortage else None

    def offer(self, first_index: int, arrays: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Take samples; copies them, and waits while the disk lags behind instead of dropping any.

        Parameters
        ----------
        first_index
            Index of the first sample, lost ones counted. Beyond the end of the samples before, it means lost samples:
            an event `gap` says so, and `time` jumps.
        arrays
            command, phase and every channel of the header, each of shape `(n,)`; time as well, or it is index / rate.

        Raises
        ------
        RecordingError
            When the disk refused data or has too little space.
        ValueError
            When arrays are missing, differ in length, are no real numbers, or come twice.
        """
        if self._thread.failure is not None and (failure := self.failure) is not None:
            raise failure
        if self._closed or first_index < self._next_index:
            raise ValueError(f"samples from {first_index} on are not expected, {self._next_index} comes next")
        columns = self._columns(first_index, arrays)
        if first_index > self._next_index:
            self.event(RunEvent.gap(self._next_index, first_index, self._rate))
        if not self._ring.put(columns) and (failure := self.failure) is not None:
            raise failure
        self._next_index = first_index + len(columns[schema.TIME])
        if self._thread.shortage and not self._shortage_raised and (failure := self.failure) is not None:
            # Raised once: the reserve is for what is still sampled until the stage stands.
            self._shortage_raised = True
            raise failure

    def event(self, event: RunEvent) -> None:
        """Record an event; it is on file with the next flush."""
        self._thread.events.append(event)

    def annotate(self, entry: Mapping[str, Attribute]) -> None:
        """Add attributes of the run that become known while the run goes on."""
        self._thread.annotations.append(entry_annotation(entry))

    def close(self, ending: RunEnding) -> Path:
        """Write the rest and how the run ended; return the recording, ready to be finished.

        Raises `RecordingError` when the disk refused data; samples flushed before stay recoverable at `path`.
        """
        if not self._closed:
            self._closed = True
            self._thread.annotations.append(ending_annotation(ending))
            self._ring.close()
            self._thread.join(MAX_CLOSE_S)
            if self._thread.is_alive():
                raise RecordingError(
                    f"{self.path}: the disk has not taken the last samples for {MAX_CLOSE_S:g} s; what it has taken is "
                    "kept: check the disk, then `dragrig recover`"
                )
            self._lock.close()
        if self._thread.failure is not None and self.failure is not None:
            raise self.failure
        return self.path

    def _columns(
        self, first_index: int, arrays: Mapping[str, npt.NDArray[np.generic]]
    ) -> dict[str, npt.NDArray[np.generic]]:
        columns = dict(arrays)
        count = len(columns[schema.PHASE]) if schema.PHASE in columns else 0
        if schema.TIME not in columns:
            columns[schema.TIME] = np.arange(first_index, first_index + count) / self._rate
        if columns.keys() != self._types.keys():
            raise ValueError(f"got {', '.join(sorted(columns))} instead of {', '.join(sorted(self._types))}")
        for name, dtype in self._types.items():
            column = columns[name]
            if column.shape != (count,):
                raise ValueError(f"{name} has shape {column.shape} instead of {(count,)}")
            if column.dtype != dtype and not np.can_cast(column.dtype, dtype, "same_kind"):
                raise ValueError(f"{name} is {column.dtype}, which {dtype} cannot hold")
        return columns


def _create_recording_file(recording: Path, header: RunHeader, space: DiskSpace) -> RecordingFile:
    for path in (recording, schema.journal_path(recording), schema.finished_path(recording)):
        if path.exists():
            raise OutputError(f"{path}: there is a run file already; choose another name")
    if (shortage := space.shortage(0)) is not None:
        raise RecordingError(shortage)
    try:
        return RecordingFile(recording, create_recording(recording, header))
    except (OSError, RuntimeError) as error:
        raise OutputError(f"{recording}: could not be made ({brief_error(error)}); choose another folder") from error
