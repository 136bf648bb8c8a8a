"""What the stage's carriage does: its motion since the last standstill, as pieces of constant acceleration.

Positions are the bench's own: 0 at the index pulse, whatever a drive takes for its zero. Times are seconds since the
motion's log began.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import MotionProfile, Phase, Piece, still, trapezoid
from dragrig.sim_backend.devices.kinematics import evaluate, position_at

_AT_LEAST_S = 1e-3
_SLIVER_S = 1e-9


@dataclass(frozen=True, slots=True)
class Carriage:
    """A motion from a standstill at `origin_mm`; each command yields another one, equal to this up to then."""

    origin_mm: float
    profile: MotionProfile

    @classmethod
    def standing(cls, position_mm: float) -> "Carriage":
        """Return one that stands."""
        return cls(position_mm, MotionProfile.from_pieces([still(_AT_LEAST_S, Phase.REST)]))

    @property
    def has_moved(self) -> bool:
        """Whether it ever moves."""
        return self.profile.motion_ends_s > 0

    def position(self, time_s: float) -> float:
        """Position [mm] at a time."""
        return self.origin_mm + position_at(self.profile, time_s)

    def positions(self, time_s: FloatArray) -> FloatArray:
        """Positions [mm] at increasing times."""
        return self.origin_mm + evaluate(self.profile, time_s).position

    def speed(self, time_s: float) -> float:
        """Signed speed [mm/s] at a time."""
        return float(self.profile.velocity(time_s)) if time_s < self.profile.duration_s else 0.0

    def moving(self, time_s: float) -> bool:
        """Whether it moves at a time or is still told to."""
        return time_s < self.profile.motion_ends_s

    def followed(self, time_s: float, pieces: Sequence[Piece]) -> "Carriage":
        """Return the motion that goes over into `pieces` at a time, with the speed that it has then."""
        return self._become((*self._until(time_s), *pieces))

    def braked(self, time_s: float, deceleration_mm_s2: float) -> "Carriage":
        """Return the motion that brakes to a standstill from a time on."""
        if not self.moving(time_s):
            return self
        return replace(self, profile=self.profile.stopped(time_s, deceleration_mm_s2))

    def _become(self, pieces: Sequence[Piece]) -> "Carriage":
        return replace(self, profile=MotionProfile.from_pieces(pieces))

    def _until(self, time_s: float) -> tuple[Piece, ...]:
        kept = []
        for piece, start in zip(self.profile.pieces(), self.profile.start_s.tolist(), strict=True):
            if start < time_s - _SLIVER_S:
                kept.append(replace(piece, duration_s=min(piece.duration_s, time_s - start)))
        rest = time_s - self.profile.duration_s
        return (*kept, still(rest, Phase.HOLD)) if rest > 0 else tuple(kept)


def pushed(distance_mm: float, duration_s: float) -> tuple[Piece, ...]:
    """Return a push by hand over a signed distance, gentle at both ends."""
    ramp_s = 0.2 * duration_s
    speed_mm_s = abs(distance_mm) / (duration_s - ramp_s)
    return trapezoid(distance_mm, speed_mm_s, speed_mm_s / ramp_s)
