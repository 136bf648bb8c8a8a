"""Where a session's runs go: a folder of run files, or memory."""

from typing import Protocol

from dragrig.rig.acquiring import Sink
from dragrig.rig.runfile.model import RunHeader


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
