"""A campaign: a folder of run files; beside them, marks that exclude bad runs, and the settings of each session."""

import errno
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import tomli_w
from pydantic import AwareDatetime

from dragrig.config import (
    UNSTATED,
    FrictionModelSettings,
    OutputError,
    Plan,
    RigSettings,
    RunFileError,
    Settings,
    SettingsError,
    Specimen,
    parse,
    parse_toml,
    read_settings_file,
    read_text,
    read_toml,
    reason_of,
    to_toml,
)
from dragrig.rig.runfile import read_info, schema
from dragrig.rig.runfile.filesystem import remove_file, replace_text
from dragrig.rig.runfile.model import RunInfo, as_html

RECORD_PATTERN = "session-*.toml"


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
        table = read_toml(target)
        return RunMark(str(table["bad"]), datetime.fromisoformat(str(table["marked_at"])))
    except (SettingsError, ValueError, KeyError) as error:
        why = str(error).removeprefix(f"{target}: ").rstrip(".")
        raise RunFileError(
            f"{target}: is not a mark ({why}); write it anew with `dragrig mark --bad REASON` or remove it"
        ) from error


def unmark(path: Path) -> bool:
    """Remove a mark; return whether there was one."""
    target = schema.mark_path(path)
    if not target.exists():
        return False
    remove_file(target)
    return True


def write_note(path: Path, text: str) -> None:
    """Write a note on a run beside its file, in place of an earlier one; an empty one removes it.

    Raises `OutputError` when the folder refuses, `RunFileError` when there is no such run file.
    """
    target = schema.note_path(path)
    if not schema.finished_path(path).exists():
        raise RunFileError(f"{path}: there is no such run to write a note on; give the path of a run file (.h5)")
    if text.strip():
        replace_text(target, f"{text.strip()}\n")
    else:
        remove_file(target)


def read_note(path: Path) -> str:
    """Return the note on a run, "" without one; raises `RunFileError` for a note that cannot be read."""
    target = schema.note_path(path)
    if not target.exists():
        return ""
    try:
        return read_text(target).strip()
    except (OSError, ValueError) as error:
        raise RunFileError(f"{target}: cannot be read as text ({error}); write the note anew or remove it") from error


@dataclass(frozen=True, slots=True, repr=False)
class Campaign:
    """The runs of a folder, in the order in which each specimen lived through them."""

    folder: Path
    runs: tuple[RunInfo, ...]
    """Sorted by specimen, start time and order."""
    marks: Mapping[Path, RunMark]
    """People's marks of bad runs, by the path of the run."""
    unreadable: tuple[tuple[Path, RunFileError], ...] = ()
    """Files that are foreign or damaged, with the error of each."""
    recordings: tuple[Path, ...] = ()
    """Runs that are being recorded or were cut off; `recover` finishes them."""

    def __repr__(self) -> str:
        kinds = ", ".join(f"{count} {kind}" for kind, count in Counter(run.kind for run in self.runs).items())
        specimens = " and ".join(sorted({specimen_key(run) for run in self.runs}))
        bad = f"{len(self.marks)} marked bad" if self.marks else ""
        return f"<campaign {self.folder}: {'; '.join(filter(None, (kinds, specimens, bad))) or 'no runs'}>"

    _repr_html_ = as_html

    @property
    def good(self) -> tuple[RunInfo, ...]:
        """The runs that are not marked as bad."""
        return tuple(run for run in self.runs if run.path not in self.marks)

    @property
    def next_order(self) -> int:
        """Order of a further run: no order is given again, those in names of unreadable files and recordings included.

        Such a file may be restored from a copy.
        """
        files = (*(path for path, _ in self.unreadable), *self.recordings)
        named = (order for path in files if (order := schema.order_in_name(path)) is not None)
        return max((*(run.header.order for run in self.runs), *named), default=-1) + 1


def read_campaign(folder: Path) -> Campaign:
    """Read every run file of a folder, attributes only; raises `RunFileError` when there is no such folder."""
    if not folder.is_dir():
        missing = "is a file" if folder.is_file() else "there is no such folder"
        raise RunFileError(f"{folder}: {missing}; give the folder that holds the run files")
    return campaign_of(folder, folder.glob(f"*{schema.FINISHED_SUFFIX}"), read_marked)


def read_marked(path: Path) -> tuple[RunInfo, RunMark | None]:
    """Read a run file's facts about its run, and the mark on it; raises `RunFileError`."""
    return read_info(path), read_mark(path)


def campaign_of(
    folder: Path, files: Iterable[Path], read: Callable[[Path], tuple[RunInfo, RunMark | None]]
) -> Campaign:
    """Return the campaign that these files of a folder are.

    Parameters
    ----------
    read
        As `read_marked`; a file for which it raises `RunFileError` is among the unreadable ones.
    """
    runs: list[RunInfo] = []
    marks: dict[Path, RunMark] = {}
    unreadable: list[tuple[Path, RunFileError]] = []
    recordings: list[Path] = []
    for path in sorted(files):
        if schema.is_recording(path):
            recordings.append(path)
            continue
        try:
            info, mark = read(path)
        except RunFileError as error:
            unreadable.append((path, error))
            continue
        runs.append(info)
        if mark is not None:
            marks[path] = mark
    runs.sort(key=lambda run: (specimen_key(run), run.header.start_time, run.header.order))
    return Campaign(folder, tuple(runs), marks, tuple(unreadable), tuple(recordings))


def is_same_recording(file: Path, copy: Path) -> bool:
    """Whether a copy that differs holds the same samples of the same run, filtered or annotated since."""
    try:
        ours, theirs = read_info(file), read_info(copy)
    except RunFileError:
        return False
    return bool(ours.raw_sha256) and (ours.header.run_id, ours.raw_sha256) == (theirs.header.run_id, theirs.raw_sha256)


def specimen_key(info: RunInfo) -> str:
    """Return the identity of a specimen: its id, or its name where it has none."""
    identity = info.header.specimen.get("id") or UNSTATED
    return str(info.header.specimen.get("name", "") if identity == UNSTATED else identity)


class SessionRecord(Settings):
    """The full settings of a session."""

    begun_at: AwareDatetime
    backend: str
    double: bool = False
    """Whether it is the backend's double."""
    operator: str = ""
    note: str = ""
    calibration_id: str = ""
    """Of the force sensor."""
    encoder_calibration_id: str = ""
    contact_mm: float | None = None
    """Absolute position of the contact that touch-off found; None where it is not known."""
    beside: Path | None = None
    """Folder that files named in the plan are relative to."""
    first_order: int = 0
    """Order of its plan's first run in the campaign: an appended plan begins after the runs of those before it."""
    plan: Plan
    specimen: Specimen
    model: FrictionModelSettings
    rig: RigSettings

    def file_name(self) -> str:
        """Return the file name, with a time in UTC, so that names stay in order when clocks are put back."""
        return f"session-{self.begun_at.astimezone(UTC):%Y%m%d-%H%M%SZ}.toml"


def write_session_record(record: SessionRecord, folder: Path) -> Path:
    """Write the record into the campaign's folder, synced.

    Raises `FileExistsError` where there is a record of that second, `OutputError` where the disk refuses.
    """
    path = folder / record.file_name()
    if path.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    replace_text(path, to_toml(record))
    return path


def session_record_of_run(run_file: Path) -> SessionRecord:
    """Return the record of the session that a run belongs to, from its run file.

    Raises
    ------
    RunFileError
        When the file is no run file, or was not made by this software.
    SettingsError
        When its settings cannot be used.
    """
    settings = read_info(run_file).header.settings_toml
    if not settings:
        raise RunFileError(
            f"{run_file}: was not made by a session of dragrig, so no session can be repeated from it; name a plan."
        )
    source = f"settings in {run_file}"
    return parse(SessionRecord, parse_toml(settings, source), source)


def read_session_records(folder: Path) -> tuple[tuple[SessionRecord, ...], tuple[str, ...]]:
    """Return every record of a campaign, the earliest first, and the errors of damaged ones."""
    records: list[SessionRecord] = []
    errors: list[str] = []
    for path in sorted(folder.glob(RECORD_PATTERN)):
        try:
            records.append(read_settings_file(SessionRecord, path))
        except SettingsError as error:
            errors.append(reason_of(error))
    return tuple(records), tuple(errors)


def latest_session_record(folder: Path) -> tuple[SessionRecord, tuple[str, ...]]:
    """Return a campaign's newest record that can be read, and the faults of newer ones.

    Raises `RunFileError` when there is no record, `SettingsError` when none can be read.
    """
    paths = sorted(folder.glob(RECORD_PATTERN), reverse=True)
    if not paths:
        raise RunFileError(f"{folder}: contains no session-….toml, so it is no campaign that could go on.")
    damaged: list[str] = []
    for path in paths:
        try:
            return read_settings_file(SessionRecord, path), tuple(damaged)
        except SettingsError as error:
            damaged.append(reason_of(error))
    raise SettingsError(damaged[0])
