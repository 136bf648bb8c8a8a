"""What is tested: the piece of gut, what holds it, and the capsule dummy."""

from enum import StrEnum
from typing import Literal

from pydantic import AwareDatetime, Field

from dragrig.config.settings import Settings


class Fixture(StrEnum):
    """What holds the gut during a run."""

    FOAM = "foam"
    """Laid on foam and closed around the capsule: the drag test."""
    VACUUM = "vacuum"
    """Held open by the negative-pressure device: relaxation and Coulomb tests."""
    NONE = "none"
    """Nothing touches the capsule: blank runs."""


class Specimen(Settings):
    """The specimen."""

    name: str = Field(min_length=1)
    wall_thickness_mm: float = Field(default=2.5, gt=0, le=20)
    id: str = ""
    """Identity of the piece: runs of the same id share their history; a fresh piece needs a new id."""
    animal: str = ""
    segment: str = ""
    excised_at: AwareDatetime | None = None
    mounted_at: AwareDatetime | None = None
    storage: str = ""
    temperature_degC: float | None = Field(default=None, ge=-10, le=60)


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
