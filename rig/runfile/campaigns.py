"""A campaign: a folder of run files, and the marks that exclude bad runs, kept beside the files."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import tomli_w

from dragrig.config.errors import OutputError, RunFileError
from dragrig.rig.runfile import schema
from dragrig.rig.runfile.filesystem import remove_file, replace_text
from dragrig.rig.runfile.model import RunInfo
from dragrig.rig.runfile.reader import read_info


@dataclass(frozen=True, slots=True)
class RunMark:
    """A person's mark that a run is bad: why, and when it was made."""

    reason: str
    marked_at: datetime


def mark_bad(path: Path, reason: str) -> RunMark:
    """Mark a run as bad, so that evaluations leave it out; an earlier mark is replaced.

    Raises `OutputError` when the reason is empty or the folder refuses, `RunFileError` when there is no such run file.
    """
    if not reason.strip():
        raise OutputError(f"{path}: is not marked because no reason is given; say why the run is bad")
    if not schema.finished_path(path).exists() and not schema.recording_path(path).exists():
        raise RunFileError(f"{path}: there is no such run to mark; give the path of a run file (.h5)")
    mark = RunMark(reason.strip(), datetime.now(UTC).astimezone())
    replace_text(schema.mark_path(path), tomli_w.dumps({"bad": mark.reason, "marked_at": mark.marked_at}))
    return mark


def read_mark(path: Path) -> RunMark | None:
    """Return the mark on a run, or None; raises `RunFileError` for a mark that cannot be read."""
    target = schema.mark_path(path)
    if not target.exists():
        return None
    try:
        table = tomllib.loads(target.read_text("utf-8"))
        return RunMark(str(table["bad"]), datetime.fromisoformat(str(table["marked_at"])))
    except (OSError, ValueError, KeyError) as error:
        raise RunFileError(
            f"{target}: is not a mark ({error}); write it anew with `dragrig mark --bad REASON` or remove it"
        ) from error


def unmark(path: Path) -> bool:
    """Remove a mark; return whether there was one."""
    target = schema.mark_path(path)
    if not target.exists():
        return False
    remove_file(target)
    return True


@dataclass(frozen=True, slots=True)
class Campaign:
    """The runs of a folder, in the order in which each specimen lived through them.

    Attributes
    ----------
    runs
        Sorted by specimen, start time and order.
    marks
        People's marks of bad runs, by the path of the run.
    unreadable
        Files that are foreign or damaged, with the error of each.
    recordings
        Runs that are being recorded or were cut off; `recover` finishes them.
    """

    folder: Path
    runs: tuple[RunInfo, ...]
    marks: Mapping[Path, RunMark]
    unreadable: tuple[tuple[Path, RunFileError], ...] = ()
    recordings: tuple[Path, ...] = ()

    @property
    def good(self) -> tuple[RunInfo, ...]:
        """The runs that are not marked as bad."""
        return tuple(run for run in self.runs if run.path not in self.marks)


def read_campaign(folder: Path) -> Campaign:
    """Read every run file of a folder, attributes only; raises `RunFileError` when there is no such folder."""
    if not folder.is_dir():
        raise RunFileError(f"{folder}: there is no such folder; give the folder that holds the run files")
    runs: list[RunInfo] = []
    marks: dict[Path, RunMark] = {}
    unreadable: list[tuple[Path, RunFileError]] = []
    recordings: list[Path] = []
    for path in sorted(folder.glob(f"*{schema.FINISHED_SUFFIX}")):
        if schema.is_recording(path):
            recordings.append(path)
            continue
        try:
            info, mark = read_info(path), read_mark(path)
        except RunFileError as error:
            unreadable.append((path, error))
            continue
        runs.append(info)
        if mark is not None:
            marks[path] = mark
    runs.sort(key=lambda run: (specimen_key(run), run.header.start_time, run.header.order))
    return Campaign(folder, tuple(runs), marks, tuple(unreadable), tuple(recordings))


def specimen_key(info: RunInfo) -> str:
    """Return what identifies a specimen: its id, or its name where it has none."""
    return str(info.header.specimen.get("id") or info.header.specimen["name"])
