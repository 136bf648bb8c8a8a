"""The capsule dummy."""

from typing import Literal

from pydantic import Field

from dragrig.config.base import Settings


class Capsule(Settings):
    """A cylinder with hemispherical ends."""

    name: str = Field(min_length=1)
    surface: Literal["rough", "smooth"]
    """A rough capsule sticks to the wall (relaxation), a smooth one slides."""
    diameter_mm: float = Field(gt=0, le=100)
    length_mm: float = Field(gt=0, le=200)
    mass_g: float = Field(ge=0, le=1000)
    contact_angle_deg: float = Field(default=60.0, gt=0, lt=90)
    """Angle of the contact on the hemisphere, the paper's α."""
