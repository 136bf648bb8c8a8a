"""Later writers: a finished file is never changed in place, only replaced whole by a synced copy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from dragrig.config.errors import RunFileError
from dragrig.rig.runfile import files, layout, reader, schema, writing
from dragrig.rig.runfile.digest import trace_sha256
from dragrig.rig.runfile.model import Event, FilteredTrace
from dragrig.rig.runfile.naming import is_recording
from dragrig.rig.runfile.whole import new_file


@dataclass(frozen=True, slots=True)
class VerifyResult:
    """Whether a trace still is what was recorded; `stored` is empty where no checksum was ever stored."""

    path: Path
    stored: str
    computed: str

    @property
    def holds(self) -> bool:
        """Whether there is a checksum and it is the trace's."""
        return self.stored == self.computed


def verify(path: Path) -> VerifyResult:
    """Read a run file whole and compare its trace with `raw_sha256`.

    Raises
    ------
    RunFileError
        As `read_run` does.
    """
    run = reader.read_run(path)
    with reader.opened(path) as file, reader.refused(path):
        return VerifyResult(path, run.info.raw_sha256, trace_sha256(file[schema.TRACE]))


def rewrite(path: Path, edit: Callable[[h5py.File], None], *, without: Sequence[str] = ()) -> None:
    """Replace a finished file by a copy that was edited; readers see the old one or the new one whole.

    Parameters
    ----------
    edit
        Changes the copy. The trace must stay as it is.
    without
        Children of `/entry` that are not copied, so that their room is not kept.

    Raises
    ------
    BusyError
        When another process is writing this run.
    OutputError
        When the disk refuses.
    RunFileError
        When the file is still being recorded or cannot be read.
    """
    if is_recording(path):
        raise RunFileError(f"{path}: is still a recording; finish it with `dragrig recover` first")
    with files.writing(path):
        reader.read_info(path)
        with new_file(path) as file:
            # Closed before the copy takes its place: Windows replaces no file that is open.
            with reader.opened(path) as source:
                _copy(source, file, frozenset(without))
            edit(file)


def store_filtered(path: Path, filtered: FilteredTrace, events: Sequence[Event] = ()) -> None:
    """Store a filtered trace beside the raw one as `/entry/filtered`, in place of one stored before.

    Parameters
    ----------
    events
        What the filter has to say, such as pieces too short for it; what it said before is replaced.

    Raises
    ------
    BusyError, OutputError, RunFileError
        As `rewrite` does.
    """

    def edit(file: h5py.File) -> None:
        group = file.create_group(schema.FILTERED)
        signal = str(file[schema.TRACE].attrs["signal"])
        names = list(filtered.channels)
        group.attrs.update(NX_class="NXdata", axes=schema.TIME)
        group.attrs["signal"] = signal if signal in names else names[0]
        writing.write_attributes(group, filtered.parameters)
        units = {schema.TIME: "s", **schema.UNITS, **filtered.units}
        for name, column in {schema.TIME: filtered.time, **filtered.channels}.items():
            dataset = writing.create_column(group, name, len(column), np.dtype("<f8"))
            dataset.attrs["units"] = units.get(name, "")
            dataset[:] = column
        kept = [event for event in layout.read_events(file) if event.kind != schema.FILTER_EVENT]
        said = [Event(event.time_s, schema.FILTER_EVENT, event.message) for event in events]
        if schema.EVENTS in file:
            del file[schema.EVENTS]
        file.create_dataset(schema.EVENTS, data=writing.event_rows([*kept, *said]))

    rewrite(path, edit, without=("filtered",))


def _copy(source: h5py.File, file: h5py.File, without: frozenset[str]) -> None:
    file.attrs.update(source.attrs)
    for name in source:
        if name != "entry":
            source.copy(name, file)
    entry = file.create_group(schema.ENTRY)
    for name, value in source[schema.ENTRY].attrs.items():
        entry.attrs[name] = value
    for name in source[schema.ENTRY]:
        if name not in without:
            source[schema.ENTRY].copy(name, entry)
