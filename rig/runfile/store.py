"""Where a session's runs are stored: a folder of run files with a verified copy on another disk, or memory."""

import contextlib
import errno
import hashlib
import os
import queue
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Self, TypeVar

import numpy as np
import numpy.typing as npt

from dragrig.config import OutputError, RecordingError
from dragrig.rig import AnyFloatArray, PhaseArray, read_only, read_run
from dragrig.rig.runfile import schema
from dragrig.rig.runfile.campaigns import is_same_recording, mark_bad, write_note
from dragrig.rig.runfile.filesystem import brief_error, move_into_place, remove_quietly
from dragrig.rig.runfile.finisher import Finisher, FinishResult
from dragrig.rig.runfile.model import Attribute, Run, RunEnding, RunEvent, RunHeader, RunInfo, Trace
from dragrig.rig.runfile.recorder import FLUSH_S, RESERVE_BYTES, Recorder

COPY_BYTES = 1 << 20
_LONGEST_NAME = 64
"""A recording's name with the suffix of its lock or part has some fifty characters."""
MAX_STALL_S = 120.0
"""How long the end of a session waits for a disk or a mirror that makes no progress."""
MAX_MIRROR_S = 300.0
"""How long it waits for a mirror that does."""


class FolderStore:
    """Records each run into a folder and has it finished in the background.

    Parameters
    ----------
    folder
        Folder of the run files; made when it does not exist.
    flush_s
        Wall time between flushes of a recording.
    reserve_mb
        Free space [MB] that a run must leave besides twice its own size.
    on_finished
        Called with each run file once it is in its place, on another thread; it must be quick.
    max_stall_s
        How long `settle` waits for a disk that makes no progress.

    Raises
    ------
    OutputError
        When the folder cannot be made, or its path leaves no room for names.
    """

    def __init__(
        self,
        folder: Path,
        *,
        flush_s: float = FLUSH_S,
        reserve_mb: float = RESERVE_BYTES / 2**20,
        on_finished: Callable[[Path], None] | None = None,
        max_stall_s: float = MAX_STALL_S,
    ) -> None:
        self._folder, self._max_stall_s = folder, max_stall_s
        self._sink = partial(FolderSink, flush_s=flush_s, reserve_bytes=round(reserve_mb * 2**20))
        self._on_finished = on_finished
        self._finisher = Finisher(on_finished)
        self._paths: dict[int, Path] = {}
        self.finished: list[FinishResult] = []
        """Results of the recordings that `settle` has waited for."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be made ({error.strerror}); choose another folder") from error
        _require_room_for_names(folder)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._finisher.close()

    def open(self, header: RunHeader, expected_samples: int) -> "FolderSink":
        """Begin a record; raises `RecordingError` or `OutputError` when it cannot be."""
        path = self._folder / schema.run_file_name(header.start_time, header.kind, header.order)
        sink = self._sink(path, header, expected_samples=expected_samples)
        sink.finisher, self._paths[header.order] = self._finisher, path
        return sink

    def mark_bad(self, order: int, reason: str) -> None:
        """Mark a run of this session as bad."""
        mark_bad(self._paths[order], reason)

    def write_note(self, order: int, text: str) -> None:
        """Write a note on a finished run of this campaign."""
        path = self._paths.get(order) or next(self._folder.glob(f"*-{order:03d}{schema.FINISHED_SUFFIX}"))
        write_note(path, text)

    def read(self, order: int) -> Run:
        """Return a run of this session, once every closed run is in its final place; raises as `settle`."""
        self._await_finished(self._finisher)
        return read_run(self._paths[order])

    def settle(self) -> None:
        """Wait until every closed run is in its final place, and end the finishing process.

        Raises `RecordingError` when a run cannot be put there, or the disk makes no progress for `MAX_STALL_S`; it
        stays a recording that `dragrig recover` finishes.
        """
        finisher, self._finisher = self._finisher, Finisher(self._on_finished)
        with contextlib.closing(finisher):
            self._await_finished(finisher)

    def _await_finished(self, finisher: Finisher) -> None:
        results: tuple[FinishResult, ...] = ()
        progress = (-1, -1)
        while (now := (finisher.pending, self._part_bytes())) != progress and finisher.pending:
            progress = now
            results += finisher.wait(self._max_stall_s)
        self.finished.extend(results)
        for result in results:
            if result.error is not None:
                raise RecordingError(str(result.error)) from result.error
        if finisher.pending:
            raise RecordingError(
                f"{self._folder}: the disk has made no progress for {self._max_stall_s:g} s; still recordings: "
                f"{finisher.pending} runs, whole as they are; check the disk, then `dragrig recover`"
            )

    def _part_bytes(self) -> int:
        """Return the size of the run files in the making: it grows as long as the disk takes data."""
        size = 0
        for path in self._paths.values():
            with contextlib.suppress(OSError):  # not begun, or in its place by now
                size += schema.part_path(path).stat().st_size
        return size


def _require_room_for_names(folder: Path) -> None:
    """Refuse a folder whose path is so long that a run's files could not be made in it, before anything moves."""
    probe = folder / f".{'x' * (_LONGEST_NAME - 1)}"
    try:
        probe.touch()
        probe.unlink()
    except OSError as error:
        # Windows says of a path beyond 259 characters that it is not there; what else is wrong shows elsewhere.
        if error.errno in {errno.ENAMETOOLONG, errno.ENOENT}:
            length = len(str(folder.absolute()))
            raise OutputError(
                f"{folder}: its path of {length} characters leaves no room for the names of run files; choose a "
                "shorter one."
            ) from error


class FolderSink(Recorder):
    """One run on its way into a folder."""

    finisher: Finisher
    """Finishes the recording once it is closed."""

    def close(self, ending: RunEnding) -> Path:
        """Finish the record and hand it on; return its run file, which exists after `settle` at the latest."""
        recording = super().close(ending)
        self.finisher.submit(recording)
        return schema.finished_path(recording)


@dataclass(frozen=True, slots=True)
class MirrorReport:
    """The files in the mirror, and those not there."""

    folder: Path
    """Folder of the copies."""
    copied: tuple[str, ...] = ()
    """Names of files whose copy was read back and is equal."""
    missing: Mapping[str, str] = field(default_factory=dict)
    """Names of files without such a copy, with the reason."""

    @property
    def whole(self) -> bool:
        """Whether nothing is missing."""
        return not self.missing


class Mirror:
    """Copies files into a folder of the mirror, one after the other, on a thread of its own.

    Marks and notes follow a person's word: they are replaced, and removed at the end where they were withdrawn.

    Parameters
    ----------
    root
        The mirror, an existing folder; none is made, because where a disk is not mounted an empty folder would be
        filled.
    name
        Of the folder in it.
    report
        Called, on the mirror's thread, with a sentence about each file that could not be copied.
    """

    def __init__(self, root: Path, name: str, report: Callable[[str], None]) -> None:
        self.folder = root / name
        self._root, self._report = root, report
        self._device: int | None = None
        self._jobs: queue.SimpleQueue[Path | None] = queue.SimpleQueue()
        self._submitted: dict[str, Path] = {}
        self._earlier: dict[str, Callable[[Path], bool]] = {}
        self._copied: dict[str, None] = {}
        self._missing: dict[str, str] = {}
        self._steps = 0
        self._thread = Thread(target=self._work, name="mirror", daemon=True)
        self._thread.start()

    def submit(self, file: Path, is_earlier: Callable[[Path], bool] | None = None) -> None:
        """Have a file copied; returns at once.

        Parameters
        ----------
        is_earlier
            Of a file that is written again and again: whether a copy that differs is an earlier state of it, so that it
            is replaced. Called on the mirror's thread.
        """
        self._submitted[file.name] = file
        if is_earlier is not None:
            self._earlier[file.name] = is_earlier
        self._jobs.put(file)

    def close(self, max_stall_s: float = MAX_STALL_S, max_s: float = MAX_MIRROR_S) -> MirrorReport:
        """Copy once more the files that failed, and report the state of the mirror.

        A mirror that hangs for `max_stall_s`, or is not done after `max_s`, is given up.
        """
        self._jobs.put(None)
        steps_before, until_s = -1, time.monotonic() + max_s
        while self._thread.is_alive() and steps_before != self._steps and time.monotonic() < until_s:
            steps_before = self._steps
            self._thread.join(min(max_stall_s, max(until_s - time.monotonic(), 0.0)))
        why = "the mirror does not respond" if steps_before == self._steps else f"the mirror took more than {max_s:g} s"
        hung = self._submitted.keys() - self._copied.keys() - self._missing.keys()
        missing = {**self._missing, **dict.fromkeys(hung, why)}
        return MirrorReport(self.folder, tuple(self._copied), missing)

    def _work(self) -> None:
        try:
            self._require_mirror()
        except (OSError, OutputError) as error:
            self._report(f"NOT MIRRORED: {self.folder}: {brief_error(error)}; the runs are recorded all the same.")
        while (file := self._jobs.get()) is not None:
            if self._copy(file):
                self._retry_missing()
        self._retry_missing()
        with contextlib.suppress(OSError):  # said of the files by then
            self._remove_withdrawn()

    def _remove_withdrawn(self) -> None:
        """Remove marks and notes on mirrored runs that are no longer beside their originals."""
        for suffix in (schema.MARK_SUFFIX, schema.NOTE_SUFFIX):
            for copy in self.folder.glob(f"*{suffix}"):
                run = self._submitted.get(copy.name.removesuffix(suffix) + schema.FINISHED_SUFFIX)
                if run is not None and run.exists() and not run.with_name(copy.name).exists():
                    copy.unlink()

    def _retry_missing(self) -> None:
        for name in tuple(self._missing):
            self._copy(self._submitted[name])

    def _copy(self, file: Path) -> bool:
        try:
            self._require_mirror()
            copy = self.folder / file.name
            copy_verified(file, copy, self._count_step, replaces=self._replaces(file, copy))
        except (OSError, OutputError) as error:
            reason = brief_error(error)
            if self._missing.get(file.name) != reason:
                self._missing[file.name] = reason
                self._report(
                    f"NOT MIRRORED: {file.name} is not in {self.folder}: {reason}; it stays where it was made."
                )
            return False
        self._missing.pop(file.name, None)
        self._copied[file.name] = None
        return True

    def _replaces(self, file: Path, copy: Path) -> bool:
        if (is_earlier := self._earlier.get(file.name)) is not None:
            return copy.exists() and is_earlier(copy)
        said = file.name.endswith((schema.MARK_SUFFIX, schema.NOTE_SUFFIX))
        return said or is_same_recording(file, copy)

    def _require_mirror(self) -> None:
        if not self._root.is_dir():
            raise OutputError("there is no such folder; make it, or mount the disk")
        device = self._root.stat().st_dev
        if self._device is None:
            self._device = device
        elif device != self._device:
            raise OutputError("another disk is there than at the beginning; mount the right one")
        self.folder.mkdir(exist_ok=True)

    def _count_step(self) -> None:
        self._steps += 1


def copy_verified(
    source: Path, target: Path, progress: Callable[[], None] = lambda: None, *, replaces: bool = False
) -> None:
    """Copy a file, read the copy back from its disk, compare, and give it its name atomically.

    An equal copy that exists already is left; one that differs is replaced only where `replaces` says that it is an
    older state of the same file. `progress` is called after each piece.

    Raises
    ------
    OutputError
        When a different file of this name exists, or the copy differs when it is read back.
    OSError
        When a disk refuses.
    """
    if target.exists():
        if _file_sha256(target, progress) == _file_sha256(source, progress):
            return
        if not replaces:
            raise OutputError("a file of this name is there and differs; it is left as it is")
    part = schema.part_path(target)
    try:
        digest = hashlib.sha256()
        with source.open("rb") as original, part.open("wb") as copy:
            while piece := original.read(COPY_BYTES):
                digest.update(piece)
                copy.write(piece)
                progress()
            copy.flush()
            os.fsync(copy.fileno())
        if _file_sha256(part, progress) != digest.digest():
            raise OutputError("the copy differs from the original when read back; replace that disk")
        move_into_place(part, target)
    finally:
        remove_quietly(part)


def _file_sha256(path: Path, progress: Callable[[], None]) -> bytes:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        if hasattr(os, "posix_fadvise"):
            # Otherwise the system reads its cache back instead of the disk.
            with contextlib.suppress(OSError):
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        while piece := file.read(COPY_BYTES):
            digest.update(piece)
            progress()
    return digest.digest()


ScalarT = TypeVar("ScalarT", bound=np.generic)


class MemoryStore:
    """Holds every run of a session as a `Run` in `runs`, in order."""

    def __init__(self) -> None:
        self.runs: list[Run] = []
        self.bad: dict[int, str] = {}
        self.notes: dict[int, str] = {}

    def open(self, header: RunHeader, expected_samples: int) -> "MemorySink":
        """Begin a record."""
        del expected_samples
        return MemorySink(header, self.runs)

    def mark_bad(self, order: int, reason: str) -> None:
        """Mark a run as bad."""
        self.bad[order] = reason

    def write_note(self, order: int, text: str) -> None:
        """Write a note on a run."""
        self.notes[order] = text

    def read(self, order: int) -> Run:
        """Return a run."""
        return next(run for run in self.runs if run.info.header.order == order)

    def settle(self) -> None:
        """Do nothing."""


class MemorySink:
    """Collects the blocks of one run."""

    def __init__(self, header: RunHeader, runs: list[Run]) -> None:
        self._header, self._runs = header, runs
        self._pieces: list[Mapping[str, AnyFloatArray | PhaseArray]] = []
        self._events: list[RunEvent] = []
        self._next_index = 0

    def offer(self, first_index: int, arrays: Mapping[str, AnyFloatArray | PhaseArray]) -> None:
        """Take a reading's arrays."""
        if first_index > self._next_index:
            self._events.append(RunEvent.gap(self._next_index, first_index, self._header.sample_rate_hz))
        self._next_index = first_index + len(arrays["time"])
        self._pieces.append(arrays)

    def event(self, event: RunEvent) -> None:
        """Take an event."""
        self._events.append(event)

    def annotate(self, entry: Mapping[str, Attribute]) -> None:
        """Take attributes of `/entry/run` that become known during the run."""
        self._header = replace(self._header, entry={**self._header.entry, **entry})

    def close(self, ending: RunEnding) -> Path:
        """Finish the record; the path is a name without a file."""
        time = self._column("time", np.float64)
        path = Path(f"{self._header.run_id}.h5")
        info = RunInfo(
            path=path,
            format_version=schema.FORMAT_VERSION,
            status=ending.status,
            header=self._header,
            samples=len(time),
            reason=ending.reason,
            end_time=ending.end_time,
            checks=ending.checks,
        )
        trace = Trace(
            sample_rate_hz=self._header.sample_rate_hz,
            signal="force",
            time=time,
            command=self._column("command", np.float32),
            phase=self._column("phase", np.uint8),
            channels={channel.name: self._column(channel.name, np.float32) for channel in self._header.channels},
            units={channel.name: channel.units for channel in self._header.channels},
        )
        self._runs.append(Run(info, trace, tuple(self._events)))
        return path

    def _column(self, name: str, dtype: type[ScalarT]) -> npt.NDArray[ScalarT]:
        pieces = [np.asarray(piece[name], dtype) for piece in self._pieces]
        joined = np.concatenate([np.zeros(0, dtype), *pieces])
        read_only(joined)
        return joined
