"""A motion profile as what a drive makes in position mode: trapezoids from standstill to standstill."""

from collections.abc import Sequence
from dataclasses import dataclass

from dragrig.config.errors import DeviceError
from dragrig.rig.profile import MotionProfile, Piece

_STANDSTILL_MM_S = 1e-6
_RELATIVE = 1e-6


@dataclass(frozen=True, slots=True)
class Stroke:
    """One move that a drive makes by itself; a triangle has no steady part.

    Attributes
    ----------
    start_s, duration_s
        When it begins, from the profile's start, and how long it takes.
    end_mm
        Where it ends, relative to the profile's start.
    speed_mm_s, acceleration_mm_s2
        Greatest speed, and the acceleration of both ramps, without a sign.
    """

    start_s: float
    duration_s: float
    end_mm: float
    speed_mm_s: float
    acceleration_mm_s2: float

    @property
    def ends_s(self) -> float:
        """When it ends, from the profile's start."""
        return self.start_s + self.duration_s


def strokes_of(profile: MotionProfile) -> tuple[Stroke, ...]:
    """Cut a profile at its standstills.

    Raises
    ------
    DeviceError
        When a stretch between two standstills is no trapezoid with ramps of one acceleration.
    """
    pieces = profile.pieces()
    starts, speeds = profile.start_s.tolist(), profile.velocity_mm_s.tolist()
    positions = profile.position_mm.tolist()
    ends = [*positions[1:], float(profile.position(profile.duration_s))]
    strokes: list[Stroke] = []
    first: int | None = None
    for place, piece in enumerate(pieces):
        stands = abs(speeds[place]) <= _STANDSTILL_MM_S
        if first is None and stands and piece.acceleration_mm_s2 == 0:
            continue
        first = place if first is None else first
        after = speeds[place + 1] if place + 1 < len(speeds) else float(profile.velocity(profile.duration_s))
        if abs(after) > _STANDSTILL_MM_S:
            continue
        speed = _trapezoid_speed(pieces[first : place + 1])
        if speed is None:
            raise DeviceError(
                f"the drive cannot follow the motion from {starts[first]:g} s on: in position mode it makes strokes of "
                "one acceleration and one speed between standstills (hardware.drive.mode of the rig file)."
            )
        duration = starts[place] + piece.duration_s - starts[first]
        accel = abs(pieces[first].acceleration_mm_s2)
        strokes.append(Stroke(starts[first], duration, ends[place], speed, accel))
        first = None
    return tuple(strokes)


def _trapezoid_speed(pieces: Sequence[Piece]) -> float | None:
    if len(pieces) not in {2, 3}:
        return None
    up, down = pieces[0], pieces[-1]
    steady = pieces[1:-1]
    same = abs(up.acceleration_mm_s2 + down.acceleration_mm_s2) <= _RELATIVE * abs(up.acceleration_mm_s2)
    if not same or any(piece.acceleration_mm_s2 != 0 for piece in steady):
        return None
    return abs(up.acceleration_mm_s2) * up.duration_s
