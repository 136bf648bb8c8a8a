"""A folder of run files is a campaign."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from dragrig.config.errors import RunFileError
from dragrig.rig.runfile import schema
from dragrig.rig.runfile.marks import Mark, read_mark
from dragrig.rig.runfile.model import RunInfo
from dragrig.rig.runfile.naming import is_recording
from dragrig.rig.runfile.reader import read_info


@dataclass(frozen=True, slots=True)
class Campaign:
    """The runs of a folder, in the order in which each specimen lived through them.

    Attributes
    ----------
    runs
        By specimen, then start time, then order.
    marks
        Verdicts of people, by the path of the run.
    unreadable
        Files that are no run files or damaged ones, with what is wrong with each.
    recordings
        Runs that are being recorded or were left so; `recover` finishes them.
    """

    folder: Path
    runs: tuple[RunInfo, ...]
    marks: Mapping[Path, Mark]
    unreadable: tuple[tuple[Path, RunFileError], ...] = ()
    recordings: tuple[Path, ...] = ()

    @property
    def good(self) -> tuple[RunInfo, ...]:
        """The runs that nobody marked as bad."""
        return tuple(run for run in self.runs if run.path not in self.marks)


def campaign(folder: Path) -> Campaign:
    """Look at every run file of a folder, attributes only.

    Raises
    ------
    RunFileError
        When there is no such folder.
    """
    if not folder.is_dir():
        raise RunFileError(f"{folder}: there is no such folder; give the folder that holds the run files")
    runs: list[RunInfo] = []
    marks: dict[Path, Mark] = {}
    unreadable: list[tuple[Path, RunFileError]] = []
    files = sorted(folder.glob(f"*{schema.FINISHED_SUFFIX}"))
    for path in files:
        if is_recording(path):
            continue
        try:
            info = read_info(path)
            mark = read_mark(path)
        except RunFileError as fault:
            unreadable.append((path, fault))
            continue
        runs.append(info)
        if mark is not None:
            marks[path] = mark
    recordings = tuple(path for path in files if is_recording(path))
    return Campaign(folder, tuple(sorted(runs, key=_place)), marks, tuple(unreadable), recordings)


def specimen_key(info: RunInfo) -> str:
    """Return what tells one specimen from another: its id, or its name where it has none."""
    return str(info.header.specimen.get("id") or info.header.specimen["name"])


def _place(info: RunInfo) -> tuple[str, datetime, int]:
    return specimen_key(info), info.header.start_time, info.header.order
