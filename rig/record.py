"""The session's record beside its run files: everything needed to go on with it, or to repeat it."""

import tomllib
from datetime import UTC
from pathlib import Path

from pydantic import AwareDatetime

from dragrig.config.base import Settings
from dragrig.config.errors import RunFileError, SettingsError, plain
from dragrig.config.loading import load, parse, to_toml
from dragrig.config.model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.config.rig import RigSettings
from dragrig.config.specimen import Specimen
from dragrig.rig.runfile import read_info

_PATTERN = "session-*.toml"


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
    """Absolute position of the contact that touch-off found; none where it is not known."""
    beside: Path | None = None
    """Folder that files named in the plan are relative to."""
    plan: Plan
    specimen: Specimen
    model: FrictionModelSettings
    rig: RigSettings

    def file_name(self) -> str:
        """Name of the record in the campaign's folder, in UTC, so that names stay in order when clocks are put back."""
        return f"session-{self.begun_at.astimezone(UTC):%Y%m%d-%H%M%SZ}.toml"


def write_record(record: SessionRecord, folder: Path) -> Path:
    """Put the record into the campaign's folder; raises `OSError`."""
    path = folder / record.file_name()
    with path.open("x", encoding="utf-8", newline="\n") as file:
        file.write(to_toml(record))
    return path


def record_in(run_file: Path) -> SessionRecord:
    """Read the record that a run carries of the session it belongs to.

    Raises
    ------
    RunFileError
        When the file is no run file, or one that was not made by this software.
    SettingsError
        When its settings cannot be used.
    """
    settings = read_info(run_file).header.settings_toml
    if not settings:
        raise RunFileError(f"{run_file}: carries no settings of a session, so that it cannot be made again.")
    try:
        return parse(SessionRecord, tomllib.loads(settings), f"settings in {run_file}")
    except tomllib.TOMLDecodeError as error:
        raise RunFileError(f"{run_file}: its settings are damaged ({error}).") from error


def records_in(folder: Path) -> tuple[tuple[SessionRecord, ...], tuple[str, ...]]:
    """Read every record of a campaign, the earliest first, and say what is wrong with those that are damaged."""
    found: list[SessionRecord] = []
    damaged: list[str] = []
    for path in sorted(folder.glob(_PATTERN)):
        try:
            found.append(load(SessionRecord, path))
        except SettingsError as error:
            damaged.append(plain(error))
    return tuple(found), tuple(damaged)


def latest_record(folder: Path) -> SessionRecord:
    """Read the newest record of a campaign; raises `RunFileError` when there is none, `SettingsError` when damaged."""
    records = sorted(folder.glob(_PATTERN))
    if not records:
        raise RunFileError(f"{folder}: holds no session-….toml, so there is no session to go on with.")
    return load(SessionRecord, records[-1])
