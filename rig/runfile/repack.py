"""Finishing: a recording becomes a compressed run file that is never changed again."""

from dataclasses import replace
from pathlib import Path

import h5py

from dragrig.config.errors import OutputError, RunFileError
from dragrig.rig.runfile import files, naming, reader, schema, writing
from dragrig.rig.runfile.digest import PIECE, TraceDigest, trace_sha256
from dragrig.rig.runfile.model import Ending, RunInfo, Status
from dragrig.rig.runfile.recording import annotations_in
from dragrig.rig.runfile.whole import new_file

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
    with files.writing(recording):
        if not recording.exists() and target.exists():
            return target
        if target.exists():
            _make_sure_finished(recording, target)
        else:
            _repack(recording, target)
        files.remove(recording)
    return target


def _repack(recording: Path, target: Path) -> None:
    with reader.opened(recording) as source:
        with reader.refused(recording):
            version = reader.layout_of(source)
            info = version.info(source, recording)
            events = version.events(source)
            late, ending = annotations_in(source)
        header = replace(info.header, entry={**info.header.entry, **late})
        ending = ending or Ending(
            Status.RECOVERED, f"the recording process ended before the run did; {info.samples} samples were kept"
        )
        _make_sure_of_room(source, target)
        with new_file(target) as file:
            writing.write_header(file, header, ending.status)
            digest = _copy_trace(source, file, info)
            writing.write_ending(file, events, ending, digest)


def _copy_trace(source: h5py.File, file: h5py.File, info: RunInfo) -> str:
    units, digest = writing.units_of(info.header.channels), TraceDigest()
    for name in sorted(source[schema.TRACE]):
        original = source[schema.TRACE][name]
        copy = writing.create_column(file[schema.TRACE], name, info.samples, original.dtype)
        writing.describe(copy, name, units)
        digest.begin(name, original.dtype, info.samples)
        for start in range(0, info.samples, PIECE):
            with reader.refused(info.path):
                piece = original[start : min(start + PIECE, info.samples)]
            copy[start : start + len(piece)] = piece
            digest.update(piece)
    return digest.hexdigest()


def _make_sure_of_room(source: h5py.File, target: Path) -> None:
    needed = sum(dataset.size * dataset.dtype.itemsize for dataset in source[schema.TRACE].values()) + SPARE_BYTES
    free = files.free_bytes(target.parent)
    if free < needed:
        raise OutputError(
            f"{target}: {free / 1e6:.1f} MB are free and up to {needed / 1e6:.1f} MB needed; make room, then"
            " `dragrig recover`"
        )


def _make_sure_finished(recording: Path, target: Path) -> None:
    left, done = reader.read_info(recording), reader.read_info(target)
    with reader.opened(target) as file, reader.refused(target):
        whole = trace_sha256(file[schema.TRACE]) == done.raw_sha256
    if left.header.run_id != done.header.run_id or not whole:
        raise RunFileError(f"{target}: stands where {recording.name} belongs, but is another run; move one of them")
