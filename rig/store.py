"""Where a session's runs go: a folder of run files, or memory."""

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Protocol

from dragrig.rig.arrays import AnyFloatArray, PhaseArray
from dragrig.rig.runfile.model import Attribute, Event, RunHeader, Status


class Sink(Protocol):
    """Where readings are recorded."""

    def offer(self, first_index: int, arrays: Mapping[str, AnyFloatArray | PhaseArray]) -> None:
        """Take a reading's arrays; raises `RecordingError` once they cannot be kept."""
        ...

    def event(self, event: Event) -> None:
        """Take an event."""
        ...

    def annotate(self, entry: Mapping[str, Attribute]) -> None:
        """Take attributes of `/entry` that become known while the run goes on."""
        ...

    def close(self, status: Status, reason: str, end_time: datetime, checks: Mapping[str, Attribute]) -> Path:
        """Finish the record; return its file."""
        ...


class Store(Protocol):
    """Opens a record for each run and looks after the finished ones."""

    def open(self, header: RunHeader, expected_samples: int) -> Sink:
        """Begin a record; raises `RecordingError` or `OutputError` when it cannot be."""
        ...

    def mark_bad(self, order: int, reason: str) -> None:
        """Note that a run of this session is not to be used."""
        ...

    def settle(self) -> None:
        """Wait until every finished run is in its final place; raises `RecordingError` when one cannot be put there."""
        ...
