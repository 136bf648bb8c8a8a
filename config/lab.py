"""A lab folder: rig settings, data root, and a calibration history that is only appended to."""

from pathlib import Path

from pydantic import AwareDatetime, Field

from dragrig.config.base import Settings

RIG_FILE = "rig.toml"
CALIBRATION_FILE = "calibration.jsonl"
CONTACT_FILE = "contact.toml"


class Calibration(Settings):
    """One entry of the calibration history."""

    id: str = Field(min_length=1)
    made_at: AwareDatetime
    quantity: str = Field(pattern="^(force|encoder)$")
    made_on: str = ""
    """Backend that it was made on and holds for, its double told from it; empty for any."""
    sensor_serial: str = ""
    gain: float
    """Quantity per raw unit: mN/V for force, mm per count for the encoder."""
    gain_error: float = Field(default=0.0, ge=0)
    """Standard error of the gain; 0 where it is not known."""
    zero: float = 0.0
    """Quantity at no raw unit: mN at 0 V."""
    zero_error: float = Field(default=0.0, ge=0)
    residual: float = Field(default=0.0, ge=0)
    """Standard deviation of the fit, in the quantity's unit."""
    points: int = Field(default=0, ge=0)
    operator: str = ""
    note: str = ""


class ContactPoint(Settings):
    """Where the capsule last met what it was driven against."""

    position_mm: float
    """Absolute position of the stage."""
    made_at: AwareDatetime
    force_mN: float
    """Change of the force that told the contact."""
    operator: str = ""


def rig_file_of(start: Path) -> Path | None:
    """Return the rig file of the lab folder that `start` is in, searching upwards; None when in none."""
    for folder in (start.absolute(), *start.absolute().parents):
        if (folder / RIG_FILE).is_file():
            return folder / RIG_FILE
    return None
