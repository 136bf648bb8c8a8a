"""Shear relaxation: a rough capsule that does not slip is moved by strain × wall thickness, then held."""

from typing import Self

from pydantic import Field, model_validator

from dragrig.config import Fixture, Specimen
from dragrig.rig import Contact, Piece, RunProtocol, trapezoid


class RelaxationProtocol(RunProtocol):
    """A fast ramp to a shear strain, and a long hold (section 3.2 of the paper)."""

    kind = "relaxation"
    fixture = Fixture.VACUUM
    contact = Contact.STICKING
    capsule = "rough"

    shear_strain: float = Field(gt=0, le=5)
    """Strain that is held: the ramp's travel over the wall thickness; 1 is 100 %."""
    ramp_speed_mm_s: float = Field(default=20.0, ge=1e-4, le=5000)
    """Speed of the ramp, where the ramp is long enough to reach it."""
    ramp_accel_mm_s2: float = Field(default=2000.0, ge=0.01, le=100_000)
    """Acceleration at both ends of the ramp."""
    hold_s: float = Field(default=20.0, ge=0, le=7200)
    """Standstill after the ramp, while the wall relaxes."""

    @model_validator(mode="after")
    def _ramp_is_a_ramp(self) -> Self:
        if self.ramp_speed_mm_s / self.ramp_accel_mm_s2 > 1.0:
            raise ValueError("ramp_accel_mm_s2 is so low that the ramp takes over a second to reach its speed")
        return self

    def moves(self, specimen: Specimen) -> tuple[Piece, ...]:
        """Return one ramp of strain × wall thickness; a triangle where it is too short for the ramp's speed."""
        return trapezoid(self.shear_strain * specimen.wall_thickness_mm, self.ramp_speed_mm_s, self.ramp_accel_mm_s2)

    def strain(self) -> float:
        """Return the strain that is held."""
        return self.shear_strain

    def summary(self) -> str:
        """Return kind and strain."""
        return f"{self.kind} {100 * self.shear_strain:g} %"
