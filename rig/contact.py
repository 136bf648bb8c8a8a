"""The contact that a lab folder keeps: one small file, replaced whole."""

from pathlib import Path

from dragrig.config.errors import OutputError
from dragrig.config.lab import CONTACT_FILE, ContactPoint
from dragrig.config.loading import load, to_toml
from dragrig.rig.runfile import files


def read(folder: Path) -> ContactPoint | None:
    """Return the contact that a lab folder keeps; None before the first one. Raises `SettingsError`."""
    path = folder / CONTACT_FILE
    return load(ContactPoint, path) if path.is_file() else None


def write(folder: Path, contact: ContactPoint) -> Path:
    """Keep a contact in place of the one before; raises `OutputError`."""
    path = folder / CONTACT_FILE
    part = path.with_suffix(".part")
    try:
        part.write_text(to_toml(contact), "utf-8")
        files.put_in_place(part, path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); check the folder.") from error
    finally:
        files.drop(part)
    return path
