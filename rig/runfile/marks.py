"""A person's verdict on a run, kept beside its file so that the file stays as it is."""

import tomllib
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import tomli_w

from dragrig.config.errors import OutputError, RunFileError
from dragrig.rig.runfile import files, naming


@dataclass(frozen=True, slots=True)
class Mark:
    """Says that a run is bad, why, and when that was said."""

    reason: str
    marked_at: datetime


def mark_bad(path: Path, reason: str) -> Mark:
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
    mark = Mark(reason.strip(), datetime.now(UTC).astimezone())
    target = naming.mark_path(path)
    text = tomli_w.dumps({"bad": mark.reason, "marked_at": mark.marked_at})
    part = naming.part_path(target)
    try:
        part.write_text(text, "utf-8")
        files.put_in_place(part, target)
    except OSError as fault:
        raise OutputError(f"{target}: could not be written ({fault.strerror}); ask for permission") from fault
    return mark


def read_mark(path: Path) -> Mark | None:
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
        return Mark(str(found["bad"]), datetime.fromisoformat(str(found["marked_at"])))
    except (OSError, ValueError, KeyError) as fault:
        raise RunFileError(
            f"{target}: is not a mark ({fault}); write it anew with `dragrig mark --bad REASON` or remove it"
        ) from fault


def unmark(path: Path) -> bool:
    """Take a mark away; return whether there was one."""
    target = naming.mark_path(path)
    if not target.exists():
        return False
    files.remove(target)
    return True
