"""A lab folder: the names of its files, and where it and its runs lie, found without loading any settings."""

import tomllib
from pathlib import Path

RIG_FILE = "rig.toml"
CALIBRATION_FILE = "calibration.jsonl"
CONTACT_FILE = "contact.toml"
COMMISSIONING_FILE = "commissioning.toml"
NOTIFICATION_FILE = "notification.toml"
"""May hold passwords, so that no run file has its content."""
DEFAULT_DATA_ROOT = "runs"


def read_text(path: Path) -> str:
    """Return a text that a person may have written, without the mark that Windows' editors begin UTF-8 with.

    Raises `OSError` when it cannot be read, `UnicodeDecodeError` when it is not UTF-8.
    """
    return path.read_text("utf-8-sig")


def rig_file_of(start: Path) -> Path | None:
    """Return the rig file of the lab folder that contains `start`, searching upwards, or None."""
    for folder in (start.absolute(), *start.absolute().parents):
        if (folder / RIG_FILE).is_file():
            return folder / RIG_FILE
    return None


def data_root_of(start: Path) -> Path | None:
    """Return the data root of the lab folder that contains `start`; None outside of a lab.

    None as well where its rig file cannot be used; whoever loads it as `RigSettings` says why.
    """
    rig_file = rig_file_of(start)
    if rig_file is None:
        return None
    try:
        data = tomllib.loads(read_text(rig_file)).get("data", {})
    except (OSError, ValueError):
        return None
    root = data.get("root", DEFAULT_DATA_ROOT) if isinstance(data, dict) else None
    return rig_file.parent / root if isinstance(root, str) and root else None
