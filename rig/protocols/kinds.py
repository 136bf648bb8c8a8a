"""The kinds of run: relaxations, drags through the gut and without it, the way back, and any other motion."""

from typing import Self

from pydantic import Field, model_validator

from dragrig.config import Fixture, Settings, Specimen
from dragrig.rig import Contact, Phase, Piece, RunProtocol, StrokeProtocol, stationary_piece, trapezoid


class RelaxationProtocol(RunProtocol):
    """Shear relaxation: a rough capsule that does not slip is moved by strain × wall thickness, fast, and held long.

    Section 3.2 of the paper.
    """

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


class Move(Settings):
    """One stroke and the pause after it."""

    travel_mm: float = Field(ge=-5000, le=5000)
    speed_mm_s: float = Field(ge=1e-4, le=5000)
    accel_mm_s2: float = Field(default=400.0, ge=0.01, le=100_000)
    pause_s: float = Field(default=0.0, ge=0, le=3600)

    @model_validator(mode="after")
    def _goes_somewhere(self) -> Self:
        if self.travel_mm == 0:
            raise ValueError("travel_mm = 0 is no move; use pause_s of the move before")
        return self


class MotionProtocol(RunProtocol):
    """A drag with any sequence of strokes, recorded as one run."""

    kind = "motion"
    fixture = Fixture.FOAM
    contact = Contact.SLIDING
    capsule = "drag"

    strokes: tuple[Move, ...] = Field(min_length=1, max_length=1000)
    """Strokes in order, each with travel_mm and speed_mm_s, optionally accel_mm_s2 and pause_s."""

    def moves(self, specimen: Specimen) -> tuple[Piece, ...]:
        """Return trapezoids and pauses in order."""
        del specimen
        pieces: list[Piece] = []
        for stroke in self.strokes:
            pieces += trapezoid(stroke.travel_mm, stroke.speed_mm_s, stroke.accel_mm_s2)
            pieces.append(stationary_piece(stroke.pause_s, Phase.HOLD))
        return tuple(pieces)

    def summary(self) -> str:
        """Return kind and number of strokes."""
        return f"{self.kind} of {len(self.strokes)} strokes"
