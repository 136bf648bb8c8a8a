"""Names of run files and of what stands beside them."""

import re
from datetime import datetime
from pathlib import Path

from dragrig.config.errors import OutputError
from dragrig.rig.runfile import schema

_KIND = re.compile(r"[a-z][a-z0-9_-]*")


def run_file_name(start_time: datetime, kind: str, order: int) -> str:
    """Return `YYYYmmdd-HHMMSS-KIND-NNN.h5`, in the time zone of `start_time`.

    Raises
    ------
    OutputError
        When a kind would not make a file name on every system.
    """
    if not _KIND.fullmatch(kind):
        raise OutputError(f"the kind {kind!r} cannot name a file; use small letters, digits, - and _")
    return f"{start_time:%Y%m%d-%H%M%S}-{kind}-{order:03d}{schema.FINISHED_SUFFIX}"


def is_recording(path: Path) -> bool:
    """Tell whether a name is that of a run that is still being recorded, or was left so."""
    return path.name.endswith(schema.RECORDING_SUFFIX)


def run_name(path: Path) -> str:
    """Return the name that a run's file, its recording, lock and mark have in common."""
    suffix = schema.RECORDING_SUFFIX if is_recording(path) else schema.FINISHED_SUFFIX
    return path.name.removesuffix(suffix)


def finished_path(path: Path) -> Path:
    """Return where the finished file of a run stands."""
    return path.with_name(run_name(path) + schema.FINISHED_SUFFIX)


def recording_path(path: Path) -> Path:
    """Return where the recording of a run stands."""
    return path.with_name(run_name(path) + schema.RECORDING_SUFFIX)


def part_path(path: Path) -> Path:
    """Return where a file is made before it is put in place."""
    return path.with_name(path.name + schema.PART_SUFFIX)


def lock_path(path: Path) -> Path:
    """Return the file whose lock the one process holds that writes a run."""
    return path.with_name(run_name(path) + schema.LOCK_SUFFIX)


def mark_path(path: Path) -> Path:
    """Return where a person's verdict on a run is kept."""
    return path.with_name(run_name(path) + ".mark.toml")
