"""What every kind of run has in common."""

import json
from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Self

from pydantic import Field, model_validator

from dragrig.config.base import Settings
from dragrig.config.specimen import Fixture, Specimen
from dragrig.rig.devices import Contact
from dragrig.rig.profile import MotionProfile, Phase, Piece, still, trapezoid
from dragrig.rig.runfile.model import Attribute


class Protocol(Settings):
    """A kind of run as a value: what is set, and the motion that follows from it.

    A new kind is one module of this package with one subclass; its `kind` becomes known by itself.
    """

    kind: ClassVar[str]
    fixture: ClassVar[Fixture]
    """What usually holds the gut."""
    contact: ClassVar[Contact]
    capsule: ClassVar[str]
    """Name of the usual capsule."""

    rest_s: float = Field(default=1.0, ge=0, le=3600)
    """Standing still before the motion."""
    hold_s: float = Field(default=3.0, ge=0, le=7200)
    """Standing still after the motion."""

    @abstractmethod
    def moves(self, specimen: Specimen) -> tuple[Piece, ...]:
        """Pieces of the motion proper, between rest and hold."""

    def profile(self, specimen: Specimen) -> MotionProfile:
        """Whole motion of the run on a specimen."""
        return MotionProfile.from_pieces(
            (still(self.rest_s, Phase.REST), *self.moves(specimen), still(self.hold_s, Phase.HOLD))
        )

    def strain(self) -> float:
        """Shear strain that the run goes to; 0 for a capsule that slides."""
        return 0.0

    def attributes(self) -> Mapping[str, Attribute]:
        """Return the run file's protocol attributes: kind and every parameter; lists become JSON text."""
        values = self.model_dump(mode="json")
        plain = {
            key: value if isinstance(value, str | float | int) else json.dumps(value) for key, value in values.items()
        }
        return {"kind": self.kind, **plain}

    def summary(self) -> str:
        """Return the few words that tell this run from its neighbours."""
        return self.kind


class StrokeProtocol(Protocol):
    """One stroke at constant speed; a negative travel goes the other way."""

    speed_mm_s: float = Field(gt=0, le=5000)
    """Constant speed of the stroke."""
    travel_mm: float = Field(default=40.0, ge=-5000, le=5000)
    """Length of the stroke, run-up and run-down included; negative goes the other way."""
    accel_mm_s2: float = Field(default=400.0, gt=0, le=100_000)
    """Acceleration of run-up and run-down."""

    @model_validator(mode="after")
    def _reaches_its_speed(self) -> Self:
        ramps_mm = self.speed_mm_s**2 / self.accel_mm_s2
        if ramps_mm >= abs(self.travel_mm):
            raise ValueError(
                f"travel_mm = {self.travel_mm:g} is too short for speed_mm_s = {self.speed_mm_s:g}: run-up and "
                f"run-down at accel_mm_s2 = {self.accel_mm_s2:g} alone take {ramps_mm:g} mm"
            )
        return self

    def moves(self, specimen: Specimen) -> tuple[Piece, ...]:
        """One trapezoid."""
        del specimen
        return trapezoid(self.travel_mm, self.speed_mm_s, self.accel_mm_s2)

    def summary(self) -> str:
        """Kind and speed, and the direction where it is backward."""
        return f"{self.kind} {self.speed_mm_s:g} mm/s" + (" backward" if self.travel_mm < 0 else "")
