"""A store that holds runs in memory: for notebooks, benchmarks and whatever needs no files."""

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import AnyFloatArray, PhaseArray, read_only
from dragrig.rig.runfile.model import Attribute, Run, RunEvent, RunHeader, RunInfo, RunStatus, Trace
from dragrig.rig.runfile.schema import FORMAT_VERSION

ScalarT = TypeVar("ScalarT", bound=np.generic)


class MemoryStore:
    """Holds every run of a session as a `Run` in `runs`, in order."""

    def __init__(self) -> None:
        self.runs: list[Run] = []
        self.bad: dict[int, str] = {}

    def open(self, header: RunHeader, expected_samples: int) -> "MemorySink":
        """Begin a record."""
        del expected_samples
        return MemorySink(header, self.runs)

    def mark_bad(self, order: int, reason: str) -> None:
        """Mark a run as bad."""
        self.bad[order] = reason

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
        """Take attributes of `/entry` that become known during the run."""
        self._header = replace(self._header, entry={**self._header.entry, **entry})

    def close(self, status: RunStatus, reason: str, end_time: datetime, checks: Mapping[str, Attribute]) -> Path:
        """Finish the record; the path is a name without a file."""
        time = _joined([np.asarray(piece["time"], np.float64) for piece in self._pieces], np.float64)
        path = Path(f"{self._header.run_id}.h5")
        info = RunInfo(
            path=path,
            format_version=FORMAT_VERSION,
            status=status,
            header=self._header,
            samples=len(time),
            reason=reason,
            end_time=end_time,
            checks=checks,
        )
        trace = Trace(
            sample_rate_hz=self._header.sample_rate_hz,
            signal="force",
            time=time,
            command=self._column("command"),
            phase=_joined([np.asarray(piece["phase"], np.uint8) for piece in self._pieces], np.uint8),
            channels={channel.name: self._column(channel.name) for channel in self._header.channels},
            units={channel.name: channel.units for channel in self._header.channels},
        )
        self._runs.append(Run(info, trace, tuple(self._events)))
        return path

    def _column(self, name: str) -> npt.NDArray[np.float32]:
        return _joined([np.asarray(piece[name], np.float32) for piece in self._pieces], np.float32)


def _joined(pieces: list[npt.NDArray[ScalarT]], dtype: type[ScalarT]) -> npt.NDArray[ScalarT]:
    joined = np.concatenate(pieces) if pieces else np.zeros(0, dtype)
    read_only(joined)
    return joined
