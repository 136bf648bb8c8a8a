"""Finishing: a recording becomes a compressed run file that is never changed again."""

from collections.abc import Mapping
from pathlib import Path

import h5py

from dragrig.config.errors import OutputError, RunFileError
from dragrig.rig.runfile import files, naming, reader, schema, writing
from dragrig.rig.runfile.digest import PIECE, TraceDigest, trace_sha256
from dragrig.rig.runfile.layout import valid_count
from dragrig.rig.runfile.model import Attribute, Ending, Status
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
            late, ending = annotations_in(source)
            if ending is None:
                ending = _recovered(version.info(source, recording).samples)
            samples = valid_count(source, schema.VALID_SAMPLES, len(source[schema.TRACE][schema.TIME]))
            events = version.events(source)
        _make_sure_of_room(source, target)
        with new_file(target) as file:
            with reader.refused(recording):
                _copy_header(source, file, {**late, "status": str(ending.status)})
            digest = _copy_trace(source, file, samples, recording)
            writing.write_ending(file, events, ending, digest)


def _recovered(samples: int) -> Ending:
    # Nobody saw this one end, which is why its caller has read all of its header before.
    return Ending(Status.RECOVERED, f"the recording process ended before the run did; {samples} samples were kept")


def _copy_header(source: h5py.File, file: h5py.File, late: Mapping[str, Attribute]) -> None:
    """Copy what was known before the first sample, whole groups by HDF5 itself, and add to `/entry` what came late."""
    changed: dict[str, Mapping[str, Attribute]] = {"/": {}, schema.ENTRY: late, schema.TRACE: {}}
    for path, also in changed.items():
        copy = file.require_group(path)
        for name, value in {**source[path].attrs, **also}.items():
            copy.attrs[name] = value
    for path in (schema.PROTOCOL, schema.CAPSULE, schema.SPECIMEN, schema.SETTINGS):
        if path in source:
            source.copy(path, file, name=path)


def _copy_trace(source: h5py.File, file: h5py.File, samples: int, recording: Path) -> str:
    digest = TraceDigest()
    for name in sorted(source[schema.TRACE]):
        original = source[schema.TRACE][name]
        copy = writing.create_column(file[schema.TRACE], name, samples, original.dtype)
        for key, value in original.attrs.items():
            copy.attrs[key] = value
        digest.begin(name, original.dtype, samples)
        for start in range(0, samples, PIECE):
            with reader.refused(recording):
                piece = original[start : min(start + PIECE, samples)]
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
