"""Any other motion: a list of strokes, each with its own speed and pause; reversals included."""

from typing import Self

from pydantic import Field, model_validator

from dragrig.config import Fixture, Settings, Specimen
from dragrig.rig import Contact, Phase, Piece, RunProtocol, stationary_piece, trapezoid


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
