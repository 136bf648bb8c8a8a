"""The thread that owns a recording: it gathers, writes, flushes, and watches the disk's room."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Thread

from dragrig.rig.runfile import files
from dragrig.rig.runfile.model import Event
from dragrig.rig.runfile.recording import RecordingFile
from dragrig.rig.runfile.ring import SampleRing
from dragrig.rig.runfile.syncer import Syncer


@dataclass(frozen=True, slots=True)
class DiskRoom:
    """How much room a run needs: what is still to come of it, its finished copy, and a reserve."""

    folder: Path
    reserve_bytes: int
    run_bytes: int

    def shortage(self, written_bytes: int) -> str | None:
        """Say what is missing on the disk, or None while there is room."""
        whole = max(self.run_bytes, written_bytes)
        needed = whole - written_bytes + whole + self.reserve_bytes
        free = files.free_bytes(self.folder)
        if free >= needed:
            return None
        return f"{self.folder}: {free / 1e6:.1f} MB are free and {needed / 1e6:.1f} MB needed; make room"


class NoteBox:
    """Events and annotations on their way to the writing thread; every method may be called from any."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._events: list[Event] = []
        self._annotations: list[Mapping[str, object]] = []

    def event(self, event: Event) -> None:
        """Add an event."""
        with self._lock:
            self._events.append(event)

    def annotation(self, line: Mapping[str, object]) -> None:
        """Add what became known late."""
        with self._lock:
            self._annotations.append(line)

    def drain(self) -> tuple[list[Event], list[Mapping[str, object]]]:
        """Return what was added since the last call."""
        with self._lock:
            drained = self._events, self._annotations
            self._events, self._annotations = [], []
        return drained


class WriterThread(Thread):
    """Writes until the ring is closed or the disk refuses.

    `failure` and `shortage` are written by this thread alone: the fault that ended it, and what is missing
    on the disk while it still writes.
    """

    def __init__(self, file: RecordingFile, ring: SampleRing, notes: NoteBox, room: DiskRoom, flush_s: float) -> None:
        super().__init__(name=f"recorder of {file.path.name}", daemon=True)
        self.failure: Exception | None = None
        self.shortage: str | None = None
        self._file = file
        self._ring = ring
        self._notes = notes
        self._room = room
        self._flush_s = flush_s
        self._syncer = Syncer(file.path)

    def run(self) -> None:
        """Write, flush, close."""
        try:
            self._write_until_closed()
            self._file.close()
        except Exception as fault:  # noqa: BLE001 - kept for the acquiring thread, which raises it
            self.failure = fault
            self._file.discard()
        finally:
            self._ring.close()
            self._syncer.close()

    def _write_until_closed(self) -> None:
        flushed = time.monotonic()
        closed = False
        while not closed:
            closed = self._ring.wait(flushed + self._flush_s - time.monotonic())
            now = time.monotonic()
            for columns in self._ring.take():
                self._file.append(columns)
                self.shortage = self._room.shortage(self._file.written_bytes)
            if closed or now >= flushed + self._flush_s:
                self._flush()
                flushed = now

    def _flush(self) -> None:
        events, annotations = self._notes.drain()
        if events:
            self._file.append_events(events)
        if annotations:
            self._file.append_annotations(annotations)
        self._file.flush()
        self._syncer.request()
