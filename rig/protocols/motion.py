"""Any other motion: a list of moves, each with its own speed and pause; reversals included."""

from collections.abc import Iterator
from typing import ClassVar, Self

from pydantic import Field, model_validator

from dragrig.config.settings import Settings
from dragrig.config.specimen import Fixture, Specimen
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase, Piece, stationary_piece, trapezoid
from dragrig.rig.protocols.run_protocol import RunProtocol


class Move(Settings):
    """One stroke and the pause after it."""

    travel_mm: float = Field(ge=-5000, le=5000)
    speed_mm_s: float = Field(gt=0, le=5000)
    accel_mm_s2: float = Field(default=400.0, gt=0, le=100_000)
    pause_s: float = Field(default=0.0, ge=0, le=3600)

    @model_validator(mode="after")
    def _goes_somewhere(self) -> Self:
        if self.travel_mm == 0:
            raise ValueError("travel_mm = 0 is no move; use pause_s of the move before")
        return self


class MotionProtocol(RunProtocol):
    """A drag with any sequence of strokes, recorded as one run."""

    kind: ClassVar[str] = "motion"
    fixture: ClassVar[Fixture] = Fixture.FOAM
    contact: ClassVar[Contact] = Contact.SLIDING
    capsule: ClassVar[str] = "drag"

    strokes: tuple[Move, ...] = Field(min_length=1, max_length=1000)
    """Strokes one after the other, each with travel_mm and speed_mm_s; accel_mm_s2 and pause_s where wanted."""

    def moves(self, specimen: Specimen) -> tuple[Piece, ...]:
        """Trapezoids and pauses one after the other."""
        del specimen
        return tuple(self._pieces())

    def _pieces(self) -> Iterator[Piece]:
        for stroke in self.strokes:
            yield from trapezoid(stroke.travel_mm, stroke.speed_mm_s, stroke.accel_mm_s2)
            yield stationary_piece(stroke.pause_s, Phase.HOLD)

    def summary(self) -> str:
        """Kind and number of strokes."""
        return f"{self.kind} of {len(self.strokes)} strokes"
