"""The file of a run that is being recorded: SWMR, uncompressed, every dataset created beforehand.

Whatever moment its process dies at, what was flushed can be read with `swmr=True` up to `valid_samples`.
"""

import json
import os
from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import cache
from io import BytesIO
from pathlib import Path

import h5py
import numpy as np

from dragrig.rig.runfile import files, layout, naming, schema, writing
from dragrig.rig.runfile.model import Attribute, Channel, Ending, Event, RunHeader, Status
from dragrig.rig.runfile.ring import Columns

CHUNK = 4096
EVENTS_CHUNK = 64
VALID_COUNTS = (schema.VALID_SAMPLES, schema.VALID_EVENTS, schema.VALID_ANNOTATION_BYTES)
VERSION_BOUNDS = ("v110", "v110")
"""The oldest layout of HDF5 that can be written while others read."""


def create_recording(path: Path, header: RunHeader) -> None:
    """Make a recording without samples; it has its name only once it is whole."""
    part = naming.part_path(path)
    try:
        part.write_bytes(_without_header(header.channels))
        with h5py.File(part, "r+", libver=VERSION_BOUNDS, locking=False) as file:
            writing.write_header(file, header, Status.RECORDING)
        part.replace(path)
    finally:
        files.drop(part)


@cache
def _without_header(channels: tuple[Channel, ...]) -> bytes:
    """Return what the recordings of all runs with these channels begin as; making it takes longer than a header."""
    image = BytesIO()
    with h5py.File(image, "w", libver=VERSION_BOUNDS) as file:
        units = writing.units_of(channels)
        for name, dtype in writing.column_types(channels).items():
            writing.describe(_rows(file, f"{schema.TRACE}/{name}", dtype, CHUNK), name, units)
        _rows(file, schema.EVENTS, schema.event_dtype(), EVENTS_CHUNK)
        _rows(file, schema.ANNOTATIONS, np.dtype("u1"), CHUNK)
        for name in VALID_COUNTS:
            file.create_dataset(name, data=np.zeros(1, dtype="<u8"))
    return image.getvalue()


def _rows(file: h5py.File, path: str, dtype: np.dtype[np.generic], chunk: int) -> h5py.Dataset:
    return file.create_dataset(path, shape=(0,), maxshape=(None,), chunks=(chunk,), dtype=dtype)


class RecordingFile:
    """An open recording. One thread owns it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = _open_for_swmr(path)
        self._trace = {name: self._file[schema.TRACE][name] for name in self._file[schema.TRACE]}
        self._sample_bytes = sum(int(dataset.dtype.itemsize) for dataset in self._trace.values())
        self._events = self._file[schema.EVENTS]
        self._annotations = self._file[schema.ANNOTATIONS]
        self._valid = tuple(self._file[name] for name in VALID_COUNTS)
        self.samples = 0
        """Samples written, flushed or not."""

    @property
    def written_bytes(self) -> int:
        """Size of the samples written."""
        return self.samples * self._sample_bytes

    def append(self, columns: Columns) -> None:
        """Append samples to every dataset of the trace."""
        end = self.samples + len(columns[schema.TIME])
        for name, dataset in self._trace.items():
            dataset.resize((end,))
            dataset[self.samples : end] = columns[name]
        self.samples = end

    def append_events(self, events: Sequence[Event]) -> None:
        """Append rows to the table of events."""
        _extend(self._events, writing.event_rows(events))

    def append_annotations(self, annotations: Sequence[Mapping[str, object]]) -> None:
        """Append what became known late, a line of JSON each."""
        text = "".join(f"{json.dumps(line)}\n" for line in annotations)
        _extend(self._annotations, np.frombuffer(text.encode(), dtype="u1"))

    def flush(self) -> None:
        """Hand everything to the operating system, then say how much of it is whole."""
        self._file.flush()
        whole = (self.samples, len(self._events), len(self._annotations))
        for dataset, count in zip(self._valid, whole, strict=True):
            dataset[0] = count
        self._file.flush()

    def close(self) -> None:
        """Close the file; what was not flushed before is not counted as whole."""
        self._file.close()

    def discard(self) -> None:
        """Let go of the file without writing to it again, after the disk refused data."""
        files.discard(self._file)


def _extend(dataset: h5py.Dataset, rows: np.ndarray[tuple[int], np.dtype[np.generic]]) -> None:
    start = len(dataset)
    dataset.resize((start + len(rows),))
    dataset[start:] = rows


def _open_for_swmr(path: Path) -> h5py.File:
    """Open for writing and for others' reading in one step, so that no moment leaves an unreadable file.

    The chunk cache is off: HDF5 writes each piece straight to its place instead of a whole chunk per flush.
    HDF5's own lock is off: `files.writing` stands for it, and a child process that is just being started
    would hold it a moment longer than we do.
    """
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_libver_bounds(h5py.h5f.LIBVER_V110, h5py.h5f.LIBVER_V110)
    access.set_file_locking(False, True)
    elements, slots, _, preemption = access.get_cache()
    access.set_cache(elements, slots, 0, preemption)
    flags = h5py.h5f.ACC_RDWR | h5py.h5f.ACC_SWMR_WRITE
    return h5py.File(h5py.h5f.open(os.fsencode(path), flags, fapl=access))


def annotate_entry(entry: Mapping[str, Attribute]) -> dict[str, object]:
    """Return the annotation that adds attributes to `/entry`."""
    return {"entry": dict(entry)}


def annotate_ending(ending: Ending) -> dict[str, object]:
    """Return the annotation that says how the run ended."""
    end_time = ending.end_time.isoformat() if ending.end_time else ""
    said = {"status": str(ending.status), "reason": ending.reason, "end_time": end_time, "checks": dict(ending.checks)}
    return {"ending": said}


def annotations_in(file: h5py.File) -> tuple[dict[str, Attribute], Ending | None]:
    """Read what became known late: attributes of `/entry`, and how the run ended if that was written."""
    entry: dict[str, Attribute] = {}
    ending: Ending | None = None
    if schema.ANNOTATIONS in file:
        valid = layout.valid_count(file, schema.VALID_ANNOTATION_BYTES, len(file[schema.ANNOTATIONS]))
        for line in file[schema.ANNOTATIONS][:valid].tobytes().splitlines():
            found = json.loads(line)
            entry.update(found.get("entry", {}))
            if said := found.get("ending"):
                end_time = datetime.fromisoformat(said["end_time"]) if said["end_time"] else None
                ending = Ending(Status(said["status"]), said["reason"], end_time, said["checks"])
    return entry, ending
