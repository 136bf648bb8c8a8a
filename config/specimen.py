"""The piece of gut and what is noted about it."""

from enum import StrEnum

from pydantic import AwareDatetime, Field

from dragrig.config.base import Settings


class Fixture(StrEnum):
    """What holds the gut during a run."""

    FOAM = "foam"
    """Laid on foam and closed around the capsule: the drag test."""
    VACUUM = "vacuum"
    """Held open by the negative-pressure device: relaxation and Coulomb tests."""
    NONE = "none"
    """Nothing touches the capsule: blank runs."""


class Specimen(Settings):
    """A specimen; only name and wall thickness are needed."""

    name: str = Field(min_length=1)
    wall_thickness_mm: float = Field(default=2.5, gt=0, le=20)
    id: str = ""
    """Identity that `order` counts on; a fresh piece needs a new one."""
    animal: str = ""
    segment: str = ""
    excised_at: AwareDatetime | None = None
    mounted_at: AwareDatetime | None = None
    storage: str = ""
    temperature_degC: float | None = Field(default=None, ge=-10, le=60)
