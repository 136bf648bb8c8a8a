"""Motion profiles: pieces of constant acceleration, evaluated exactly at any time; and the arrays they are made of.

Units: mm and s. Time 0 is the first sample; position 0 is where the run starts.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
AnyFloatArray: TypeAlias = npt.NDArray[np.float32] | npt.NDArray[np.float64]
PhaseArray: TypeAlias = npt.NDArray[np.uint8]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
IndexArray: TypeAlias = npt.NDArray[np.intp]


def read_only(array: npt.NDArray[np.generic]) -> None:
    """Forbid writing to `array` from here on."""
    array.flags.writeable = False


TIME_TOLERANCE_S = 1e-9
"""A phase includes its first instant and excludes its last, to within this tolerance."""


class Phase(IntEnum):
    """Phase of the motion, with its number in run files."""

    REST = 0
    ACCELERATE = 1
    STEADY = 2
    DECELERATE = 3
    HOLD = 4


@dataclass(frozen=True, slots=True)
class Piece:
    """A piece of a motion with constant acceleration."""

    duration_s: float
    acceleration_mm_s2: float
    phase: Phase


@dataclass(frozen=True, slots=True)
class MotionExtremes:
    """Extremes of a motion; positions are relative to its start."""

    lowest_mm: float
    highest_mm: float
    speed_mm_s: float
    acceleration_mm_s2: float


@dataclass(frozen=True, eq=False)
class MotionProfile:
    """A motion from standstill, as `K` pieces of constant acceleration."""

    start_s: FloatArray
    position_mm: FloatArray
    velocity_mm_s: FloatArray
    acceleration_mm_s2: FloatArray
    """`start_s`, `position_mm`, `velocity_mm_s`, `acceleration_mm_s2`: state at the start of each piece, shape `(K,)`.
    """
    phase: PhaseArray
    """Phase of each piece, shape `(K,)`."""
    duration_s: float
    """End of the last piece. Beyond it the stage stays where it is."""

    @classmethod
    def from_pieces(cls, pieces: Iterable[Piece]) -> "MotionProfile":
        """Chain pieces from standstill at position 0; pieces of zero duration are dropped."""
        chain = [piece for piece in pieces if piece.duration_s > 0]
        duration = np.array([piece.duration_s for piece in chain])
        acceleration = np.array([piece.acceleration_mm_s2 for piece in chain])
        edges = np.concatenate(([0.0], np.cumsum(duration)))
        velocity = np.concatenate(([0.0], np.cumsum(acceleration * duration)))
        velocity[np.abs(velocity) < 1e-9] = 0.0
        # An absurd distance is for its limits to refuse, not for a warning here.
        with np.errstate(over="ignore", invalid="ignore"):
            travel = velocity[:-1] * duration + 0.5 * acceleration * duration**2
        profile = cls(
            start_s=edges[:-1],
            position_mm=np.concatenate(([0.0], np.cumsum(travel)))[:-1],
            velocity_mm_s=velocity[:-1],
            acceleration_mm_s2=acceleration,
            phase=np.array([piece.phase for piece in chain], dtype=np.uint8),
            duration_s=float(edges[-1]),
        )
        for array in (profile.start_s, profile.position_mm, profile.velocity_mm_s, profile.acceleration_mm_s2):
            read_only(array)
        read_only(profile.phase)
        return profile

    def pieces(self) -> tuple[Piece, ...]:
        """Return the pieces of this profile, as `from_pieces` takes them."""
        durations = np.diff(np.append(self.start_s, self.duration_s)).tolist()
        phases = map(Phase, self.phase.tolist())
        return tuple(map(Piece, durations, self.acceleration_mm_s2.tolist(), phases))

    @cached_property
    def motion_ends_s(self) -> float:
        """Time of the last standstill; 0 when the stage never moves."""
        moving = (self.velocity_mm_s != 0) | (self.acceleration_mm_s2 != 0)
        if not moving.any():
            return 0.0
        ends = np.append(self.start_s[1:], self.duration_s)
        return float(ends[moving][-1])

    def samples(self, sample_rate_hz: float) -> int:
        """Return the number of samples of the whole profile."""
        return round(self.duration_s * sample_rate_hz)

    def position(self, time_s: npt.ArrayLike) -> FloatArray:
        """Return the position [mm] at any times [s]."""
        index, elapsed = self._locate(time_s)
        return np.asarray(
            self.position_mm[index]
            + (self.velocity_mm_s[index] + 0.5 * self.acceleration_mm_s2[index] * elapsed) * elapsed
        )

    def velocity(self, time_s: npt.ArrayLike) -> FloatArray:
        """Return the velocity [mm/s] at any times [s]."""
        index, elapsed = self._locate(time_s)
        return np.asarray(self.velocity_mm_s[index] + self.acceleration_mm_s2[index] * elapsed)

    def acceleration(self, time_s: npt.ArrayLike) -> FloatArray:
        """Return the acceleration [mm/s²] at any times [s]; 0 outside the profile."""
        time = np.asarray(time_s, dtype=float)
        index, _ = self._locate(time)
        return np.where((time < 0) | (time >= self.duration_s), 0.0, self.acceleration_mm_s2[index])

    def phase_at(self, time_s: npt.ArrayLike) -> PhaseArray:
        """Return the phase at any times [s], as numbers of `Phase`."""
        index, _ = self._locate(np.asarray(time_s, dtype=float) + TIME_TOLERANCE_S)
        return np.asarray(self.phase[index])

    def extremes(self) -> MotionExtremes:
        """Return the extremes of the motion, run-up and run-down included."""
        ends = np.append(self.start_s, self.duration_s)
        moving = self.acceleration_mm_s2 != 0
        turning_s = np.full_like(self.start_s, -1.0)
        turning_s[moving] = -self.velocity_mm_s[moving] / self.acceleration_mm_s2[moving]
        inside = (turning_s > 0) & (turning_s < np.diff(ends))
        positions = self.position(np.concatenate((ends, self.start_s[inside] + turning_s[inside])))
        return MotionExtremes(
            lowest_mm=float(positions.min()),
            highest_mm=float(positions.max()),
            speed_mm_s=float(np.abs(self.velocity(ends)).max()),
            acceleration_mm_s2=float(np.abs(self.acceleration_mm_s2).max()) if self.acceleration_mm_s2.size else 0.0,
        )

    def stopped(self, time_s: float, deceleration_mm_s2: float, hold_s: float = 0.0) -> "MotionProfile":
        """Return this motion up to `time_s`, then braked to a standstill and held for `hold_s`."""
        pieces: list[Piece] = []
        for piece, start in zip(self.pieces(), self.start_s, strict=True):
            remaining_s = time_s - float(start)
            if remaining_s <= 0:
                break
            pieces.append(Piece(min(piece.duration_s, remaining_s), piece.acceleration_mm_s2, piece.phase))
        speed = float(self.velocity(time_s))
        if speed != 0:
            braking_s = abs(speed) / deceleration_mm_s2
            pieces.append(Piece(braking_s, -np.sign(speed) * deceleration_mm_s2, Phase.DECELERATE))
        pieces.append(Piece(hold_s, 0.0, Phase.HOLD))
        return MotionProfile.from_pieces(pieces)

    def _locate(self, time_s: npt.ArrayLike) -> tuple[npt.NDArray[np.intp], FloatArray]:
        time = np.clip(np.asarray(time_s, dtype=float), 0.0, self.duration_s)
        index = np.clip(np.searchsorted(self.start_s, time, side="right") - 1, 0, None)
        return index, time - self.start_s[index]


def trapezoid(travel_mm: float, speed_mm_s: float, accel_mm_s2: float) -> tuple[Piece, ...]:
    """Return the pieces of a trapezoidal move; the travel is signed, speed and acceleration are positive.

    A move too short for the speed becomes a triangle: it has no steady phase.
    """
    direction = float(np.sign(travel_mm))
    ramp_s = speed_mm_s / accel_mm_s2
    steady_mm = abs(travel_mm) - speed_mm_s * ramp_s
    if steady_mm < 0:
        ramp_s = float(np.sqrt(abs(travel_mm) / accel_mm_s2))
        steady_mm = 0.0
    return (
        Piece(ramp_s, direction * accel_mm_s2, Phase.ACCELERATE),
        Piece(steady_mm / speed_mm_s, 0.0, Phase.STEADY),
        Piece(ramp_s, -direction * accel_mm_s2, Phase.DECELERATE),
    )


def stationary_piece(duration_s: float, phase: Phase) -> Piece:
    """Return a piece at standstill."""
    return Piece(duration_s, 0.0, phase)
