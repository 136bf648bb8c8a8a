"""Runs of a single stroke: drags at constant speed through the gut and without it, and the way back."""

from pydantic import Field

from dragrig.config import Fixture, Specimen
from dragrig.rig import Contact, Piece, RunProtocol, StrokeProtocol, trapezoid


class DragProtocol(StrokeProtocol):
    """Constant-speed drag through the gut closed around the capsule."""

    kind = "drag"
    fixture = Fixture.FOAM
    contact = Contact.SLIDING
    capsule = "drag"


class CoulombProtocol(StrokeProtocol):
    """Constant-speed drag through the gut held open: friction without wall contact pressure."""

    kind = "coulomb"
    fixture = Fixture.VACUUM
    contact = Contact.SLIDING
    capsule = "smooth"


class BlankProtocol(StrokeProtocol):
    """The stage moves with nothing attached: the record shows the rig alone."""

    kind = "blank"
    fixture = Fixture.NONE
    contact = Contact.NONE
    capsule = "none"


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
