"""A campaign: a folder of run files, and the marks that exclude bad runs, kept beside the files."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import tomli_w

from dragrig.config.errors import OutputError, RunFileError
from dragrig.rig.runfile import filesystem as files
from dragrig.rig.runfile import schema
from dragrig.rig.runfile import schema as naming
from dragrig.rig.runfile.model import RunInfo
from dragrig.rig.runfile.reader import read_info
from dragrig.rig.runfile.schema import is_recording


@dataclass(frozen=True, slots=True)
class RunMark:
    """Says that a run is bad, why, and when that was said."""

    reason: str
    marked_at: datetime


def mark_bad(path: Path, reason: str) -> RunMark:
    """Mark a run as bad; everything later leaves it out. A mark made before is replaced.

    Raises
    ------
    OutputError
        When the reason is empty or the folder refuses.
    RunFileError
        When there is no such run file.
    """
    if not reason.strip():
        raise OutputError(f"{path}: is not marked because no reason is given; say why the run is bad")
    if not naming.finished_path(path).exists() and not naming.recording_path(path).exists():
        raise RunFileError(f"{path}: there is no such run to mark; give the path of a run file (.h5)")
    mark = RunMark(reason.strip(), datetime.now(UTC).astimezone())
    target = naming.mark_path(path)
    text = tomli_w.dumps({"bad": mark.reason, "marked_at": mark.marked_at})
    part = naming.part_path(target)
    try:
        part.write_text(text, "utf-8")
        files.move_into_place(part, target)
    except OSError as fault:
        raise OutputError(f"{target}: could not be written ({fault.strerror}); ask for permission") from fault
    return mark


def read_mark(path: Path) -> RunMark | None:
    """Return the mark on a run, or None.

    Raises
    ------
    RunFileError
        When there is a mark that cannot be read.
    """
    target = naming.mark_path(path)
    if not target.exists():
        return None
    try:
        found = tomllib.loads(target.read_text("utf-8"))
        return RunMark(str(found["bad"]), datetime.fromisoformat(str(found["marked_at"])))
    except (OSError, ValueError, KeyError) as fault:
        raise RunFileError(
            f"{target}: is not a mark ({fault}); write it anew with `dragrig mark --bad REASON` or remove it"
        ) from fault


def unmark(path: Path) -> bool:
    """Take a mark away; return whether there was one."""
    target = naming.mark_path(path)
    if not target.exists():
        return False
    files.remove_file(target)
    return True


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
    marks: Mapping[Path, RunMark]
    unreadable: tuple[tuple[Path, RunFileError], ...] = ()
    recordings: tuple[Path, ...] = ()

    @property
    def good(self) -> tuple[RunInfo, ...]:
        """The runs that nobody marked as bad."""
        return tuple(run for run in self.runs if run.path not in self.marks)


def read_campaign(folder: Path) -> Campaign:
    """Look at every run file of a folder, attributes only.

    Raises
    ------
    RunFileError
        When there is no such folder.
    """
    if not folder.is_dir():
        raise RunFileError(f"{folder}: there is no such folder; give the folder that holds the run files")
    runs: list[RunInfo] = []
    marks: dict[Path, RunMark] = {}
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
    return Campaign(folder, tuple(sorted(runs, key=_sort_key)), marks, tuple(unreadable), recordings)


def specimen_key(info: RunInfo) -> str:
    """Return what tells one specimen from another: its id, or its name where it has none."""
    return str(info.header.specimen.get("id") or info.header.specimen["name"])


def _sort_key(info: RunInfo) -> tuple[str, datetime, int]:
    return specimen_key(info), info.header.start_time, info.header.order
