"""A session's runs as a folder of run files."""

from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

from dragrig.config.errors import OutputError, RecordingError
from dragrig.rig.runfile import schema as naming
from dragrig.rig.runfile.campaigns import mark_bad
from dragrig.rig.runfile.finisher import Finisher, FinishResult
from dragrig.rig.runfile.model import Attribute, RunEvent, RunHeader, RunStatus
from dragrig.rig.runfile.recorder import FLUSH_S, RESERVE_BYTES, Recorder


class FolderStore:
    """Records each run into a folder and has it finished in the background.

    Parameters
    ----------
    folder
        Where the run files go; made when it does not exist.
    flush_s
        Wall time between flushes of a recording.
    reserve_mb
        Free space [MB] that a run must leave besides twice its own size.
    told
        Called with each run file once it is in its place, on another thread; it must be quick.

    Raises
    ------
    OutputError
        When the folder cannot be made.
    """

    def __init__(
        self,
        folder: Path,
        *,
        flush_s: float = FLUSH_S,
        reserve_mb: float = RESERVE_BYTES / 2**20,
        told: Callable[[Path], None] | None = None,
    ) -> None:
        self._folder = folder
        self._flush_s = flush_s
        self._reserve_bytes = round(reserve_mb * 2**20)
        self._told = told
        self._finisher = Finisher(told)
        self._paths: dict[int, Path] = {}
        self.finished: list[FinishResult] = []
        """What became of the recordings, so far as `settle` has waited for them."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as fault:
            raise OutputError(f"{folder}: cannot be made ({fault.strerror}); choose another folder") from fault

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._finisher.close()

    def open(self, header: RunHeader, expected_samples: int) -> "FolderSink":
        """Begin a record; raises `RecordingError` or `OutputError` when it cannot be."""
        path = self._folder / naming.run_file_name(header.start_time, header.kind, header.order)
        recorder = Recorder(
            path,
            header,
            flush_s=self._flush_s,
            reserve_bytes=self._reserve_bytes,
            expected_samples=expected_samples,
        )
        self._paths[header.order] = path
        return FolderSink(recorder, self._finisher)

    def mark_bad(self, order: int, reason: str) -> None:
        """Note that a run of this session is not to be used."""
        mark_bad(self._paths[order], reason)

    def settle(self) -> None:
        """Wait until every closed run is in its final place, and let the finishing process go.

        Raises
        ------
        RecordingError
            When one cannot be put there; it stays a recording that `dragrig recover` finishes.
        """
        finisher, self._finisher = self._finisher, Finisher(self._told)
        done = finisher.wait()
        finisher.close()
        self.finished.extend(done)
        for one in done:
            if one.error is not None:
                raise RecordingError(str(one.error)) from one.error


class FolderSink:
    """One run on its way into a folder."""

    def __init__(self, recorder: Recorder, finisher: Finisher) -> None:
        self._recorder = recorder
        self._finisher = finisher

    def offer(self, first_index: int, arrays: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Take a reading's arrays; raises `RecordingError` once they cannot be kept."""
        self._recorder.offer(first_index, arrays)

    def event(self, event: RunEvent) -> None:
        """Take an event."""
        self._recorder.event(event)

    def annotate(self, entry: Mapping[str, Attribute]) -> None:
        """Take attributes of `/entry` that become known while the run goes on."""
        self._recorder.annotate(entry)

    def close(self, status: RunStatus, reason: str, end_time: datetime, checks: Mapping[str, Attribute]) -> Path:
        """Finish the record and hand it on; return where its file will stand, after `settle` at the latest."""
        recording = self._recorder.close(status, reason, end_time, checks)
        self._finisher.submit(recording)
        return naming.finished_path(recording)
