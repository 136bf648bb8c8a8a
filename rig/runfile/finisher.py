"""Finishing: a recording becomes a compressed run file that is never changed again; in the background, or later.

`python -m dragrig.rig.runfile.finisher` is the background worker: it reads recordings from standard input, a line of
JSON each, answers each with a line of JSON and ends with its input. It is a process of its own because h5py works for
one thread of a process at a time: a repack would stall the recorder of the next run. `recover` finishes the recordings
that a crash left.
"""

import json
import os
import queue
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from threading import Condition, Thread
from typing import Self

import h5py

from dragrig.config import DragrigError, OutputError, RunFileError, errors
from dragrig.rig.runfile import schema
from dragrig.rig.runfile.filesystem import BusyError, brief_error, free_bytes, lock_run, remove_file
from dragrig.rig.runfile.journal import is_without_samples
from dragrig.rig.runfile.model import Attribute, RunEnding, RunStatus
from dragrig.rig.runfile.reader import (
    as_run_file_error,
    events_of,
    info_of,
    layout_of,
    open_run,
    read_info,
    valid_count,
)
from dragrig.rig.runfile.recorder import read_annotations, rebuild
from dragrig.rig.runfile.writer import (
    DIGEST_SAMPLES,
    TraceDigest,
    create_column,
    mark_format,
    new_file,
    trace_sha256,
    write_ending,
)

SPARE_BYTES = 1 << 20
"""Space that a finished file may need beyond its samples uncompressed."""


def finish(recording: Path, *, after_crash: bool = False) -> Path:
    """Turn a recording into its run file and remove it; return the run file.

    A recording whose end was never written is finished as recovered. Nothing is removed before the run file is synced,
    in place, and read back; a second call finds the work done. After a crash, which may have been a power cut, the
    recording is made anew from its journal first.

    Raises
    ------
    BusyError
        When its writer is alive, or another process is finishing it.
    OutputError
        When the disk refuses.
    RunFileError
        When the recording cannot be read, or another run has the name of its run file.
    """
    target, journal = schema.finished_path(recording), schema.journal_path(recording)
    with lock_run(recording):
        if not (recording.exists() or journal.exists()) and target.exists():
            return target
        if after_crash and journal.exists():
            _require_room(target, journal.stat().st_size)
            rebuild(recording)
        if target.exists():
            if not _is_whole(target) or read_info(recording).header.run_id != read_info(target).header.run_id:
                raise RunFileError(
                    f"{target}: has the name of {recording.name}'s run file, but is another run; move one"
                )
        else:
            _repack(recording, target)
            _expect_read_back(target, recording)
        try:
            remove_file(recording)
            remove_file(journal)
        except OSError as error:
            raise OutputError(
                f"{recording}: its run file {target.name} is whole and in place, but the disk refuses to remove the "
                f"recording ({brief_error(error)}); check the disk, then `dragrig recover`"
            ) from error
    return target


def _require_room(target: Path, needed_bytes: int) -> None:
    free = free_bytes(target.parent)
    if free < needed_bytes:
        raise OutputError(
            f"{target}: {free / 1e6:.1f} MB are free and up to {needed_bytes / 1e6:.1f} MB needed; make room, then"
            " `dragrig recover`"
        )


def _repack(recording: Path, target: Path) -> None:
    with open_run(recording) as source:
        with as_run_file_error(recording):
            layout = layout_of(source)
            late_attributes, ending = read_annotations(source, layout)
            if ending is None:
                # Nobody saw this run end, so its whole header is read, and refused if damaged, before it counts as a
                # run.
                samples = info_of(source, layout, recording).samples
                reason = f"the recording process ended before the run did; {samples} samples were recovered"
                ending = RunEnding(RunStatus.RECOVERED, reason)
            samples = valid_count(source, layout.valid_counts[0], len(source[schema.TRACE][schema.TIME]))
            events = events_of(source, layout)
        needed = sum(column.size * column.dtype.itemsize for column in source[schema.TRACE].values()) + SPARE_BYTES
        _require_room(target, needed)
        with new_file(target) as file:
            with as_run_file_error(recording):
                _copy_recorded_header(source, layout, file, {**late_attributes, "status": str(ending.status)})
            digest = _copy_recorded_trace(source, file, samples, recording)
            write_ending(file, events, ending, digest)


def _is_whole(target: Path) -> bool:
    """Tell whether a run file's samples have the checksum that it states; raises `RunFileError`."""
    with open_run(target) as file, as_run_file_error(target):
        return trace_sha256(file[schema.TRACE]) == info_of(file, layout_of(file), target).raw_sha256


def _expect_read_back(target: Path, recording: Path) -> None:
    """Read a finished file back from the disk; remove it and raise `OutputError` where its samples have changed."""
    try:
        if hasattr(os, "posix_fadvise"):
            with target.open("rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        whole = _is_whole(target)
    except RunFileError:
        whole = False
    if not whole:
        remove_file(target)
        raise OutputError(
            f"{target}: the disk does not return what was written; {recording.name} is kept: check the disk, copy the "
            "folder to another, then `dragrig recover`"
        )


def _copy_recorded_header(
    source: h5py.File, layout: schema.Layout, file: h5py.File, late_attributes: Mapping[str, Attribute]
) -> None:
    """Copy the facts known before the first sample, whole groups by HDF5 itself, and add those known later.

    A recording of an older layout becomes a file of today's.
    """
    for path in ("/", schema.ENTRY, schema.TRACE):
        fixed = schema.FIXED_ATTRIBUTES[path]
        copy = file.require_group(path)
        for name, value in source[path].attrs.items():
            if path == schema.TRACE or name in fixed:
                copy.attrs[name] = value
    run = file.require_group(schema.RUN)
    recorded = {name: value for name, value in source[layout.run].attrs.items() if name != "default"}
    for name, value in {**recorded, **late_attributes}.items():
        run.attrs[name] = value
    mark_format(run)
    for path in (schema.PROTOCOL, schema.CAPSULE, schema.SPECIMEN):
        if path in source:
            source.copy(path, file, name=path)
    if layout.settings in source:
        source.copy(layout.settings, file, name=schema.LAYOUT.settings)


def _copy_recorded_trace(source: h5py.File, file: h5py.File, samples: int, recording: Path) -> str:
    digest = TraceDigest()
    for name in sorted(source[schema.TRACE]):
        original = source[schema.TRACE][name]
        copy = create_column(file[schema.TRACE], name, samples, original.dtype)
        for key, value in original.attrs.items():
            copy.attrs[key] = value
        digest.begin(name, original.dtype, samples)
        for start in range(0, samples, DIGEST_SAMPLES):
            with as_run_file_error(recording):
                piece = original[start : min(start + DIGEST_SAMPLES, samples)]
            copy[start : start + len(piece)] = piece
            digest.update(piece)
    return digest.hexdigest()


class RecoveryOutcome(StrEnum):
    """The fate of a recording that a crash left."""

    FINISHED = "finished"
    EMPTY = "empty"
    """A power cut came before its first sample: there was nothing to finish, and what was left of it is removed."""
    IN_USE = "in use"
    LEFT = "left"


@dataclass(frozen=True, slots=True)
class RecoveredRecording:
    """A recording that a crash left: its run file where it was finished, otherwise why it was not."""

    recording: Path
    outcome: RecoveryOutcome
    path: Path | None = None
    samples: int = 0
    message: str = ""


def left_recordings(place: Path) -> tuple[Path, ...]:
    """Return the recordings in a folder and those below it, sorted by name; or `place`, if it is a recording."""
    if schema.is_recording(place):
        return (place,) if place.is_file() else ()
    left = {*place.rglob(f"*{schema.RECORDING_SUFFIX}")}
    # A power cut may have kept the journal alone.
    return tuple(sorted({*left, *map(schema.recording_path, place.rglob(f"*{schema.JOURNAL_SUFFIX}"))}))


def recover(place: Path, progress: Callable[[Path], object] = lambda _: None) -> list[RecoveredRecording]:
    """Finish every recording in a folder, or the one at `place`, whose writer is not alive.

    A run that ended before its file was finished keeps its status; one that was cut off becomes `recovered`. Nothing
    with samples is removed before its run file is whole, so that calling this again, or losing power meanwhile, does no
    harm. A recording that cannot be read stays as it is. `progress` is called with each recording before that.

    Raises `RunFileError` when there is no such folder or file.
    """
    if place.is_file() and not schema.is_recording(place):
        raise RunFileError(f"{place}: is no recording (NAME{schema.RECORDING_SUFFIX}); give the folder of a campaign")
    if not place.exists():
        raise RunFileError(f"{place}: there is no such folder or recording; give the folder of a campaign")
    recovered: list[RecoveredRecording] = []
    for recording in left_recordings(place):
        progress(recording)
        try:
            if _removed_empty(recording):
                message = f"{recording}: the power went before a sample of it was taken; its empty journal is removed"
                result = RecoveredRecording(recording, RecoveryOutcome.EMPTY, message=message)
            else:
                path = finish(recording, after_crash=True)
                result = RecoveredRecording(recording, RecoveryOutcome.FINISHED, path, read_info(path).samples)
        except BusyError as error:
            result = RecoveredRecording(recording, RecoveryOutcome.IN_USE, message=str(error))
        except (DragrigError, OSError) as error:
            message = str(error) if isinstance(error, DragrigError) else f"{recording}: {brief_error(error)}"
            result = RecoveredRecording(recording, RecoveryOutcome.LEFT, message=message)
        recovered.append(result)
    if place.is_dir():
        _remove_leftovers(place)
    return recovered


def _removed_empty(recording: Path) -> bool:
    """Remove a journal that holds nothing of a recording that never got its name; return whether there was one."""
    journal = schema.journal_path(recording)
    with lock_run(recording):
        # A recording gets its name once the first frame of its journal is synced, and samples after that.
        if recording.exists() or not is_without_samples(journal):
            return False
        remove_file(journal)
    return True


def _remove_leftovers(folder: Path) -> None:
    """Remove half-made copies and locks of dead writers; neither ever holds the only copy of a run."""
    for part in folder.rglob(f"*{schema.FINISHED_SUFFIX}{schema.PART_SUFFIX}"):
        with suppress(OutputError), lock_run(part.with_suffix("")):
            part.unlink(missing_ok=True)
    for lock in folder.rglob(f"*{schema.LOCK_SUFFIX}"):
        with suppress(OutputError), lock_run(lock.with_suffix(schema.FINISHED_SUFFIX)):
            pass  # Whoever releases a lock removes it.


@dataclass(frozen=True, slots=True)
class FinishResult:
    """The fate of a recording: its run file, or why it is still a recording."""

    recording: Path
    path: Path | None
    error: DragrigError | None = None


class Finisher:
    """Finishes recordings in a worker process that is started when first needed.

    When this process dies, the worker finishes its current recording and exits. When the worker dies, `wait` finishes
    its recordings in this process. An interrupt from the terminal does not reach the worker. As a context it waits at
    its end and raises the first error that no `wait` has returned.

    Parameters
    ----------
    on_finished
        Called with each finished run file, on the finisher's thread or on the one that waits; it must be quick.
    """

    def __init__(self, on_finished: Callable[[Path], None] | None = None) -> None:
        self._on_finished = on_finished
        self._jobs: queue.SimpleQueue[Path | None] = queue.SimpleQueue()
        self._change = Condition()
        self._results: list[FinishResult] = []
        self._left: list[Path] = []
        self._submitted = 0
        self._answered = 0
        self._thread: Thread | None = None
        self._worker: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        try:
            for result in self.wait() if error is None else ():
                if result.error is not None:
                    raise result.error
        finally:
            self.close()

    @property
    def pending(self) -> int:
        """Recordings still to be finished."""
        with self._change:
            return self._submitted - self._answered + len(self._left)

    @property
    def worker_pid(self) -> int | None:
        """Process id of the worker, once it has been started."""
        return self._worker.pid if self._worker is not None else None

    def submit(self, recording: Path) -> None:
        """Have a closed recording finished; returns at once."""
        with self._change:
            self._submitted += 1
            if self._thread is None:
                self._thread = Thread(target=self._dispatch, name="finisher", daemon=True)
                self._thread.start()
        self._jobs.put(recording)

    def wait(self, timeout_s: float | None = None) -> tuple[FinishResult, ...]:
        """Wait until every submitted recording is finished, or the time is over.

        Returns the results since the last call, in the order of finishing.
        """
        with self._change:
            self._change.wait_for(lambda: self._submitted == self._answered, timeout_s)
            left, self._left = self._left, []
        finished_here = [finish_here(recording) for recording in left]
        for result in finished_here:
            self._notify(result)
        with self._change:
            results, self._results = self._results, []
        return (*results, *finished_here)

    def close(self) -> None:
        """Let the worker finish its current recording and exit; a queued one stays a recording."""
        with self._change:
            if self._thread is not None:
                self._jobs.put(None)

    def _dispatch(self) -> None:
        while (recording := self._jobs.get()) is not None:
            result = self._finish_in_worker(recording)
            if result is not None:
                self._notify(result)
            with self._change:
                if result is None:
                    self._left.append(recording)
                else:
                    self._results.append(result)
                self._answered += 1
                self._change.notify_all()
        if self._worker is not None:
            self._worker.communicate()

    def _notify(self, result: FinishResult) -> None:
        if self._on_finished is not None and result.path is not None:
            self._on_finished(result.path)

    def _finish_in_worker(self, recording: Path) -> FinishResult | None:
        """Have the worker finish a recording; None when the worker is dead."""
        try:
            if self._worker is None:
                self._worker = _start_worker()
            if self._worker.stdin is None or self._worker.stdout is None:
                return None
            self._worker.stdin.write(json.dumps(str(recording.absolute())) + "\n")
            self._worker.stdin.flush()
            line = self._worker.stdout.readline()
        except OSError:
            return None
        if not line.endswith("\n"):
            return None
        answer = json.loads(line)
        if answer["path"]:
            return FinishResult(recording, Path(answer["path"]))
        kind = getattr(errors, answer["kind"], OutputError)
        return FinishResult(recording, None, kind(answer["message"]))


def finish_here(recording: Path) -> FinishResult:
    """Finish a recording in this process; an error is part of the result."""
    try:
        return FinishResult(recording, finish(recording))
    except DragrigError as error:
        return FinishResult(recording, None, error)
    except OSError as error:
        what = f"{recording}: cannot be finished ({brief_error(error)}); check the disk, then `dragrig recover`"
        return FinishResult(recording, None, OutputError(what))


def _start_worker() -> subprocess.Popen[str]:
    flags = 0
    if sys.platform == "win32":
        # Without the console of this program, whose end would be the worker's.
        flags = subprocess.CREATE_NO_WINDOW | subprocess.BELOW_NORMAL_PRIORITY_CLASS
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "dragrig.rig.runfile.finisher"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        encoding="utf-8",
        start_new_session=True,
        creationflags=flags,
    )


def run_worker() -> None:
    """Finish the recordings that standard input names, until it ends; its reader may be dead by then."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(10)
    for line in sys.stdin:
        result = finish_here(Path(json.loads(line)))
        answer = {
            "path": str(result.path) if result.path else "",
            "kind": type(result.error).__name__,
            "message": str(result.error),
        }
        with suppress(BrokenPipeError):
            sys.stdout.write(json.dumps(answer) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    run_worker()
