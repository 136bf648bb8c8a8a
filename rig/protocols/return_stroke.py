"""The driven return stroke, recorded like any other run."""

from pydantic import Field

from dragrig.config import Fixture, Specimen
from dragrig.rig import Contact, Piece, RunProtocol, trapezoid


class ReturnProtocol(RunProtocol):
    """One stroke back to the start of the run before; fixture and contact are that run's."""

    kind = "return"
    fixture = Fixture.FOAM
    contact = Contact.SLIDING
    capsule = "drag"

    travel_mm: float = Field(ge=-5000, le=5000)
    speed_mm_s: float = Field(default=20.0, ge=1e-4, le=5000)
    accel_mm_s2: float = Field(default=400.0, ge=0.01, le=100_000)
    rest_s: float = Field(default=0.5, ge=0, le=3600)
    hold_s: float = Field(default=0.5, ge=0, le=7200)

    def moves(self, specimen: Specimen) -> tuple[Piece, ...]:
        """Return one trapezoid, or a triangle where the stroke is short."""
        del specimen
        return trapezoid(self.travel_mm, self.speed_mm_s, self.accel_mm_s2)
