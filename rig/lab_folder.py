"""Files of a lab folder: the calibration history (one JSON line per entry, append-only) and the contact position."""

import json
import os
from pathlib import Path

from dragrig.config.errors import OutputError, SettingsError
from dragrig.config.rig import CALIBRATION_FILE, CONTACT_FILE, Calibration, ContactPoint
from dragrig.config.settings import parse, read_settings_file, to_toml
from dragrig.rig.runfile.filesystem import replace_text


def read_calibrations(folder: Path) -> tuple[Calibration, ...]:
    """Return every entry of a lab folder's history, oldest first; empty where there is no history.

    Raises `SettingsError` for a line that is no calibration, by its number.
    """
    path = folder / CALIBRATION_FILE
    try:
        lines = path.read_text("utf-8").splitlines()
    except FileNotFoundError:
        return ()
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: cannot be read ({error}); check the file.") from error
    entries: list[Calibration] = []
    for number, line in enumerate(lines, 1):
        source = f"{path}, line {number}"
        if not line.strip():
            continue
        try:
            data = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise SettingsError(f"{source}: is not JSON ({error}); restore the line from a copy.") from error
        if not isinstance(data, dict):
            raise SettingsError(f"{source}: is not a JSON object with the keys of a calibration.")
        entries.append(parse(Calibration, data, source))
    return tuple(entries)


def latest_calibration(
    folder: Path, quantity: str = "force", made_on: str = "", sensor_serial: str = ""
) -> Calibration | None:
    """Return the latest entry for a quantity (force, encoder); None before the first one.

    Parameters
    ----------
    made_on
        Backend that it must be valid for; empty for any.
    sensor_serial
        Sensor that it must be valid for; empty for any. An entry without a serial number is valid for every sensor.
    """
    entries = [
        entry
        for entry in read_calibrations(folder)
        if entry.quantity == quantity
        and (not made_on or entry.made_on in {"", made_on})
        and (not sensor_serial or entry.sensor_serial in {"", sensor_serial})
    ]
    return entries[-1] if entries else None


def append_calibration(folder: Path, entry: Calibration) -> None:
    """Add an entry to a lab folder's history.

    Raises
    ------
    SettingsError
        When the history already has an entry of this id, or holds a line that is no calibration.
    OutputError
        When the history cannot be written.
    """
    path = folder / CALIBRATION_FILE
    if any(earlier.id == entry.id for earlier in read_calibrations(folder)):
        raise SettingsError(f"{path}: id = {entry.id!r} is in the history already; choose another.")
    try:
        with path.open("a+b") as history:
            # An editor may have left the last line without its end; the new entry must not join it.
            text = path.read_bytes()
            line_end = b"\n" if text and not text.endswith(b"\n") else b""
            history.write(line_end + entry.model_dump_json().encode() + b"\n")
            history.flush()
            os.fsync(history.fileno())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); check the folder.") from error


def read_contact(folder: Path) -> ContactPoint | None:
    """Return the contact stored in a lab folder, or None; raises `SettingsError`."""
    path = folder / CONTACT_FILE
    return read_settings_file(ContactPoint, path) if path.is_file() else None


def write_contact(folder: Path, contact: ContactPoint) -> Path:
    """Store a contact in place of the one before; raises `OutputError`."""
    path = folder / CONTACT_FILE
    replace_text(path, to_toml(contact))
    return path
