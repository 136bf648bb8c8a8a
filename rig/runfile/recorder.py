"""The recorder: takes samples from the acquiring thread and has them on file within a flush interval."""

from collections.abc import Mapping
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

from dragrig.config.errors import OutputError, RecordingError, RunFileError
from dragrig.rig.runfile import files, naming, schema, writing
from dragrig.rig.runfile.attributes import LayoutError
from dragrig.rig.runfile.model import Attribute, Ending, Event, RunHeader, Status
from dragrig.rig.runfile.recording import RecordingFile, annotate_ending, annotate_entry, create_recording
from dragrig.rig.runfile.ring import SampleRing
from dragrig.rig.runfile.writer_thread import DiskRoom, NoteBox, WriterThread

FLUSH_S = 0.1
"""Wall time between flushes: what a killed process loses at most, but for the time that a flush takes."""
RESERVE_BYTES = 64 << 20
RING_SAMPLES = 1 << 18


class Recorder:
    """Records one run into `NAME.recording.h5` in a thread of its own; others may read it meanwhile.

    `offer` and `close` belong to one thread, the acquiring one; `event` and `annotate` to any.

    Parameters
    ----------
    path
        Where the finished file will stand, `NAME.h5`; the recording stands beside it. Neither may exist.
    header
        Everything known before the first sample.
    flush_s
        Wall time between flushes, also while no samples come.
    reserve_bytes
        Free space that must be left besides what the run and its finished copy need.
    expected_samples
        Length of the run as planned, for the watch over free space.

    Raises
    ------
    OutputError
        When the run exists already or the folder refuses.
    RecordingError
        When the disk has too little room for the run.
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
        self.path = naming.recording_path(path)
        """The recording."""
        self.lost_samples = 0
        """Samples that never came, so far."""
        self._rate = header.sample_rate_hz
        self._types = _checked_types(path, header)
        self._next_index = 0
        self._closed = False
        self._shortage_told = False
        sample_bytes = sum(dtype.itemsize for dtype in self._types.values())
        room = DiskRoom(path.parent, reserve_bytes, expected_samples * sample_bytes)
        with ExitStack() as stack:
            stack.enter_context(files.writing(path))
            file = _created(self.path, header, room)
            self._notes = NoteBox()
            self._ring = SampleRing(self._types, RING_SAMPLES)
            self._thread = WriterThread(file, self._ring, self._notes, room, flush_s)
            self._thread.start()
            self._lock = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._closed:
            status = Status.ABORTED if isinstance(fault, KeyboardInterrupt) else Status.FAILED
            self.close(status, str(fault) if fault else "the recorder was left without a finish reason")

    @property
    def failure(self) -> RecordingError | None:
        """Why recording cannot go on, or None: the disk refused data or has too little room."""
        if self._thread.failure is not None:
            return RecordingError(
                f"{self.path}: the disk refused data ({files.said(self._thread.failure)}); make room, then"
                " `dragrig recover` finishes what was recorded"
            )
        return RecordingError(self._thread.shortage) if self._thread.shortage else None

    def offer(self, first_index: int, arrays: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Take samples; copies them, and waits while the disk lags behind instead of dropping any.

        Parameters
        ----------
        first_index
            Index of the first sample, lost ones counted. Larger than where the samples before ended means
            lost samples: an event `gap` says so, and `time` jumps.
        arrays
            command, phase and every channel of the header, each of shape `(n,)`, and time unless it is to
            be index / rate.

        Raises
        ------
        RecordingError
            When the disk refused data or has too little room.
        ValueError
            When arrays are missing, differ in length, are no real numbers, or come twice.
        """
        if self._thread.failure is not None and (failure := self.failure) is not None:
            raise failure
        if self._closed or first_index < self._next_index:
            raise ValueError(f"samples from {first_index} on are not expected, {self._next_index} comes next")
        columns = self._columns(first_index, arrays)
        if first_index > self._next_index:
            self._note_gap(first_index)
        if not self._ring.give(columns) and (failure := self.failure) is not None:
            raise failure
        self._next_index = first_index + len(columns[schema.TIME])
        if self._thread.shortage and not self._shortage_told and (failure := self.failure) is not None:
            # Told once: the reserve is there for what is still sampled until the stage stands.
            self._shortage_told = True
            raise failure

    def event(self, event: Event) -> None:
        """Note something that happened; it is on file with the next flush."""
        self._notes.event(event)

    def annotate(self, entry: Mapping[str, Attribute]) -> None:
        """Add attributes of `/entry` that become known while the run goes on."""
        self._notes.annotation(annotate_entry(entry))

    def close(
        self,
        status: Status,
        reason: str = "",
        end_time: datetime | None = None,
        checks: Mapping[str, Attribute] | None = None,
    ) -> Path:
        """Write what is left and how the run ended; return the recording, ready to be finished.

        Raises
        ------
        RecordingError
            When the disk refused data; what was flushed before stays recoverable at `path`.
        """
        if not self._closed:
            self._closed = True
            self._notes.annotation(annotate_ending(Ending(status, reason, end_time, checks or {})))
            self._ring.close()
            self._thread.join()
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

    def _note_gap(self, first_index: int) -> None:
        lost = first_index - self._next_index
        self.lost_samples += lost
        time_s = self._next_index / self._rate
        self.event(Event(time_s, "gap", f"{lost} samples lost, {lost / self._rate:.6g} s"))


def _checked_types(path: Path, header: RunHeader) -> dict[str, np.dtype[np.generic]]:
    try:
        writing.check_header(header)
    except LayoutError as fault:
        raise RunFileError(f"{path}: cannot be recorded because {fault}; correct the settings") from fault
    return writing.column_types(header.channels)


def _created(recording: Path, header: RunHeader, room: DiskRoom) -> RecordingFile:
    for path in (recording, naming.finished_path(recording)):
        if path.exists():
            raise OutputError(f"{path}: there is a run file already; choose another name")
    if (shortage := room.shortage(0)) is not None:
        raise RecordingError(shortage)
    try:
        create_recording(recording, header)
        return RecordingFile(recording)
    except (OSError, RuntimeError) as fault:
        raise OutputError(f"{recording}: could not be made ({files.said(fault)}); choose another folder") from fault
