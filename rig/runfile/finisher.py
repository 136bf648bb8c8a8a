"""Finishing: a recording becomes a compressed run file that is never changed again; in the background, or later.

`python -m dragrig.rig.runfile.finisher` is the background worker: it reads recordings from standard input, a line of
JSON each, answers each with a line of JSON and ends with its input. It is a process of its own because h5py works for
one thread of a process at a time: a repack would stall the recorder of the next run. `recover` finishes what a crash
left behind.
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
from types import TracebackType
from typing import Self

import h5py

from dragrig.config import errors
from dragrig.config.errors import DragrigError, OutputError, RunFileError
from dragrig.rig.runfile import filesystem as files
from dragrig.rig.runfile import reader, schema
from dragrig.rig.runfile import schema as naming
from dragrig.rig.runfile import writer as writing
from dragrig.rig.runfile.model import Attribute, RunEnding, RunStatus
from dragrig.rig.runfile.reader import read_info, valid_count
from dragrig.rig.runfile.recorder import read_annotations
from dragrig.rig.runfile.schema import is_recording
from dragrig.rig.runfile.writer import DIGEST_SAMPLES, TraceDigest, new_file, trace_sha256

SPARE_BYTES = 1 << 20
"""Room that a finished file may need beyond its samples uncompressed."""


def finish(recording: Path) -> Path:
    """Turn a recording into its run file and remove it; return the run file.

    A recording whose end was never written is finished as recovered. Nothing is removed before the run
    file is synced and in place, and a second call finds the work done.

    Raises
    ------
    BusyError
        When its writer is alive, or somebody else is finishing it.
    OutputError
        When the disk refuses.
    RunFileError
        When the recording cannot be read, or another run's file stands where this one's belongs.
    """
    target = naming.finished_path(recording)
    with files.lock_run(recording):
        if not recording.exists() and target.exists():
            return target
        if target.exists():
            _require_same_run(recording, target)
        else:
            _repack(recording, target)
        files.remove_file(recording)
    return target


def _repack(recording: Path, target: Path) -> None:
    with reader.open_run(recording) as source:
        with reader.as_run_file_error(recording):
            version = reader.layout_of(source)
            late, ending = read_annotations(source)
            if ending is None:
                ending = _recovered_ending(version.info(source, recording).samples)
            samples = valid_count(source, schema.VALID_SAMPLES, len(source[schema.TRACE][schema.TIME]))
            events = version.events(source)
        _require_disk_space(source, target)
        with new_file(target) as file:
            with reader.as_run_file_error(recording):
                _copy_recorded_header(source, file, {**late, "status": str(ending.status)})
            digest = _copy_recorded_trace(source, file, samples, recording)
            writing.write_ending(file, events, ending, digest)


def _recovered_ending(samples: int) -> RunEnding:
    # Nobody saw this one end, which is why its caller has read all of its header before.
    return RunEnding(
        RunStatus.RECOVERED, f"the recording process ended before the run did; {samples} samples were kept"
    )


def _copy_recorded_header(source: h5py.File, file: h5py.File, late: Mapping[str, Attribute]) -> None:
    """Copy what was known before the first sample, whole groups by HDF5 itself, and add to `/entry` what came late."""
    changed: dict[str, Mapping[str, Attribute]] = {"/": {}, schema.ENTRY: late, schema.TRACE: {}}
    for path, also in changed.items():
        copy = file.require_group(path)
        for name, value in {**source[path].attrs, **also}.items():
            copy.attrs[name] = value
    for path in (schema.PROTOCOL, schema.CAPSULE, schema.SPECIMEN, schema.SETTINGS):
        if path in source:
            source.copy(path, file, name=path)


def _copy_recorded_trace(source: h5py.File, file: h5py.File, samples: int, recording: Path) -> str:
    digest = TraceDigest()
    for name in sorted(source[schema.TRACE]):
        original = source[schema.TRACE][name]
        copy = writing.create_column(file[schema.TRACE], name, samples, original.dtype)
        for key, value in original.attrs.items():
            copy.attrs[key] = value
        digest.begin(name, original.dtype, samples)
        for start in range(0, samples, DIGEST_SAMPLES):
            with reader.as_run_file_error(recording):
                piece = original[start : min(start + DIGEST_SAMPLES, samples)]
            copy[start : start + len(piece)] = piece
            digest.update(piece)
    return digest.hexdigest()


def _require_disk_space(source: h5py.File, target: Path) -> None:
    needed = sum(dataset.size * dataset.dtype.itemsize for dataset in source[schema.TRACE].values()) + SPARE_BYTES
    free = files.free_bytes(target.parent)
    if free < needed:
        raise OutputError(
            f"{target}: {free / 1e6:.1f} MB are free and up to {needed / 1e6:.1f} MB needed; make room, then"
            " `dragrig recover`"
        )


def _require_same_run(recording: Path, target: Path) -> None:
    left, done = reader.read_info(recording), reader.read_info(target)
    with reader.open_run(target) as file, reader.as_run_file_error(target):
        whole = trace_sha256(file[schema.TRACE]) == done.raw_sha256
    if left.header.run_id != done.header.run_id or not whole:
        raise RunFileError(f"{target}: stands where {recording.name} belongs, but is another run; move one of them")


class RecoveryOutcome(StrEnum):
    """What became of a recording that was found."""

    FINISHED = "finished"
    IN_USE = "in use"
    LEFT = "left"


@dataclass(frozen=True, slots=True)
class RecoveredRecording:
    """A recording that was found and what became of it.

    Attributes
    ----------
    path
        The run file, where the recording was finished.
    message
        Why it was not, otherwise.
    """

    recording: Path
    outcome: RecoveryOutcome
    path: Path | None = None
    samples: int = 0
    message: str = ""


def left_recordings(place: Path) -> tuple[Path, ...]:
    """Return the recordings in a folder and those below it, in the order of their names; or the one given."""
    if is_recording(place):
        return (place,) if place.is_file() else ()
    return tuple(sorted(place.rglob(f"*{schema.RECORDING_SUFFIX}")))


def recover(place: Path, progress: Callable[[Path], object] = lambda _: None) -> list[RecoveredRecording]:
    """Finish every recording in a folder, or the one given, whose writer is not alive.

    A run that ended before its file was finished keeps its status; one that was cut off becomes
    `recovered`. Nothing is removed before its run file is whole, so that calling this again, or losing
    power meanwhile, does no harm. A recording that cannot be read stays as it is.

    Parameters
    ----------
    progress
        Called with each recording before it is finished.

    Raises
    ------
    RunFileError
        When there is no such folder or file.
    """
    if not place.exists():
        raise RunFileError(f"{place}: there is no such folder or recording; give the folder of a campaign")
    found: list[RecoveredRecording] = []
    for recording in left_recordings(place):
        progress(recording)
        found.append(_recover_recording(recording))
    if place.is_dir():
        _remove_leftovers(place)
    return found


def _recover_recording(recording: Path) -> RecoveredRecording:
    try:
        path = finish(recording)
        return RecoveredRecording(recording, RecoveryOutcome.FINISHED, path, read_info(path).samples)
    except files.BusyError as fault:
        return RecoveredRecording(recording, RecoveryOutcome.IN_USE, message=str(fault))
    except DragrigError as fault:
        return RecoveredRecording(recording, RecoveryOutcome.LEFT, message=str(fault))


def _remove_leftovers(folder: Path) -> None:
    """Remove half-made copies and locks of writers that are not alive; neither ever holds the only copy."""
    for part in folder.rglob(f"*{schema.FINISHED_SUFFIX}{schema.PART_SUFFIX}"):
        with suppress(OutputError), files.lock_run(part.with_suffix("")):
            part.unlink(missing_ok=True)
    for lock in folder.rglob(f"*{schema.LOCK_SUFFIX}"):
        with suppress(OutputError), files.lock_run(lock.with_suffix(schema.FINISHED_SUFFIX)):
            pass  # a lock is removed by whoever lets go of it


@dataclass(frozen=True, slots=True)
class FinishResult:
    """What became of a recording: the run file, or why it is still a recording."""

    recording: Path
    path: Path | None
    error: DragrigError | None = None


class Finisher:
    """Finishes recordings in a worker process that is started when first needed.

    When this process dies, the worker ends the recording at hand and exits. When the worker dies, `wait`
    finishes what it left in this process. An interrupt from the terminal does not reach the worker.
    As a context it waits at its end and raises the first error that no `wait` has returned.

    Parameters
    ----------
    told
        Called with each finished run file, on the finisher's thread or on that which waits; it must be quick.
    """

    def __init__(self, told: Callable[[Path], None] | None = None) -> None:
        self._told = told
        self._jobs: queue.SimpleQueue[Path | None] = queue.SimpleQueue()
        self._change = Condition()
        self._done: list[FinishResult] = []
        self._left: list[Path] = []
        self._asked = 0
        self._answered = 0
        self._thread: Thread | None = None
        self._worker: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            for done in self.wait() if fault is None else ():
                if done.error is not None:
                    raise done.error
        finally:
            self.close()

    @property
    def pending(self) -> int:
        """How many recordings are still to be finished."""
        with self._change:
            return self._asked - self._answered + len(self._left)

    @property
    def worker_pid(self) -> int | None:
        """Process id of the worker, once it has been started."""
        return self._worker.pid if self._worker is not None else None

    def submit(self, recording: Path) -> None:
        """Have a closed recording finished; returns at once."""
        with self._change:
            self._asked += 1
            if self._thread is None:
                self._thread = Thread(target=self._hand_out, name="finisher", daemon=True)
                self._thread.start()
        self._jobs.put(recording)

    def wait(self, timeout_s: float | None = None) -> tuple[FinishResult, ...]:
        """Wait until every recording submitted is finished, or the time is over.

        Returns
        -------
        What became of each recording since the last call, in the order of finishing.
        """
        with self._change:
            self._change.wait_for(lambda: self._asked == self._answered, timeout_s)
            left, self._left = self._left, []
        here = [finish_here(recording) for recording in left]
        for one in here:
            self._tell(one)
        with self._change:
            done, self._done = self._done, []
        return (*done, *here)

    def close(self) -> None:
        """Let the worker end the recording at hand and exit; what is still queued stays a recording."""
        with self._change:
            if self._thread is not None:
                self._jobs.put(None)

    def _hand_out(self) -> None:
        while (recording := self._jobs.get()) is not None:
            answer = self._ask(recording)
            self._tell(answer)
            with self._change:
                if answer is None:
                    self._left.append(recording)
                else:
                    self._done.append(answer)
                self._answered += 1
                self._change.notify_all()
        if self._worker is not None:
            self._worker.communicate()

    def _tell(self, done: FinishResult | None) -> None:
        if self._told is not None and done is not None and done.path is not None:
            self._told(done.path)

    def _ask(self, recording: Path) -> FinishResult | None:
        """Have the worker finish a recording; None when there is no worker any more."""
        try:
            if self._worker is None:
                self._worker = _start_worker()
            if self._worker.stdin is None or self._worker.stdout is None:
                return None
            self._worker.stdin.write(json.dumps(str(recording.absolute())) + "\n")
            self._worker.stdin.flush()
            answer = self._worker.stdout.readline()
        except OSError:
            return None
        return _parse_answer(recording, answer) if answer.endswith("\n") else None


def finish_here(recording: Path) -> FinishResult:
    """Finish a recording in this process; an error is part of the answer."""
    try:
        return FinishResult(recording, finish(recording))
    except DragrigError as fault:
        return FinishResult(recording, None, fault)


def _start_worker() -> subprocess.Popen[str]:
    flags = 0
    if sys.platform == "win32":
        flags = subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.BELOW_NORMAL_PRIORITY_CLASS
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "dragrig.rig.runfile.finisher"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        encoding="utf-8",
        start_new_session=True,
        creationflags=flags,
    )


def _parse_answer(recording: Path, line: str) -> FinishResult:
    answer = json.loads(line)
    if answer["path"]:
        return FinishResult(recording, Path(answer["path"]))
    kind = getattr(errors, answer["kind"], OutputError)
    return FinishResult(recording, None, kind(answer["message"]))


def run_worker() -> None:
    """Finish what standard input names, until it ends; nobody may be left to hear the answers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(10)
    for line in sys.stdin:
        done = finish_here(Path(json.loads(line)))
        answer = {
            "path": str(done.path) if done.path else "",
            "kind": type(done.error).__name__,
            "message": str(done.error),
        }
        with suppress(BrokenPipeError):
            sys.stdout.write(json.dumps(answer) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    run_worker()
