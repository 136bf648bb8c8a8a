"""The specimen: the piece of gut, its fixture, and the capsule dummy."""

from datetime import date, datetime, time, timedelta
from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import AwareDatetime, BeforeValidator, Field, model_validator

from dragrig.config.settings import Settings

UNSTATED = "unknown"
"""What a run file says of a specimen where nobody stated it."""
SPECIMEN_FACTS = ("id", "animal", "segment", "excised_at", "mounted_at", "storage", "temperature_degC")
"""Keys of a specimen that only somebody at the rig can state."""


class Fixture(StrEnum):
    """The holder of the gut during a run."""

    FOAM = "foam"
    """Laid on foam and closed around the capsule: the drag test."""
    VACUUM = "vacuum"
    """Held open by the negative-pressure device: relaxation and Coulomb tests."""
    NONE = "none"
    """Nothing touches the capsule: blank runs."""


def _at_this_place(value: object) -> object:
    """Return a moment with its offset from UTC: a time of day is the latest such, anything without offset is local."""
    moment = (
        _parsed_time(str(value))
        if isinstance(value, str | int | float | date) and not isinstance(value, datetime)
        else value
    )
    if isinstance(moment, time):
        now = datetime.now().astimezone()
        at = datetime.combine(now.date(), moment)
        at = at if at.tzinfo is not None else at.astimezone()
        return at if at <= now else at - timedelta(days=1)
    try:
        return moment.astimezone() if isinstance(moment, datetime) and moment.tzinfo is None else moment
    except (OSError, OverflowError):  # Windows knows no local time before 1970
        raise ValueError(f"{moment} is before the years whose local time this computer knows") from None


def _parsed_time(text: str) -> datetime | time:
    try:
        return time.fromisoformat(text) if text[2:3] == ":" else datetime.fromisoformat(text)
    except ValueError:
        raise ValueError("is neither a time of day nor a date and time, as 09:15 or 2026-05-04T09:15") from None


Moment = Annotated[AwareDatetime, BeforeValidator(_at_this_place)]


class Specimen(Settings):
    """The specimen."""

    name: str = Field(min_length=1)
    wall_thickness_mm: float = Field(default=2.5, gt=0, le=20)
    id: str = ""
    """Identity of the piece: runs of the same id share their history; a fresh piece needs a new id."""
    animal: str = ""
    segment: str = ""
    excised_at: Moment | None = None
    """When it was taken from the animal: `2026-05-04T09:15:00+02:00`, or `09:15` for the latest such time here."""
    mounted_at: Moment | None = None
    storage: str = ""
    """What it lay in until it was mounted."""
    temperature_degC: float | None = Field(default=None, ge=-10, le=60)
    """Of the bath."""

    @property
    def not_stated(self) -> tuple[str, ...]:
        """Keys of `SPECIMEN_FACTS` without a value."""
        return tuple(key for key in SPECIMEN_FACTS if getattr(self, key) in {None, ""})

    @model_validator(mode="after")
    def _excised_before_it_is_mounted(self) -> Self:
        if self.excised_at is not None and self.mounted_at is not None and self.mounted_at < self.excised_at:
            mounted, excised = f"{self.mounted_at:%Y-%m-%d %H:%M}", f"{self.excised_at:%Y-%m-%d %H:%M}"
            raise ValueError(f"mounted_at ({mounted}) comes before excised_at ({excised})")
        return self


class Capsule(Settings):
    """A cylinder with hemispherical ends."""

    name: str = Field(min_length=1)
    surface: Literal["rough", "smooth"]
    """A rough capsule sticks to the wall (relaxation), a smooth one slides."""
    diameter_mm: float = Field(gt=0, le=100)
    length_mm: float = Field(gt=0, le=200)
    mass_g: float = Field(ge=0, le=1000)
    contact_angle_deg: float = Field(default=60.0, gt=0, lt=90)
    """Contact angle on the hemisphere, the paper's α."""
