"""The motion as the friction model uses it, and a motion profile in that form.

Units: mm and s. Position 0 is where the run starts, time 0 its first sample.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.rig.profile import TIME_TOLERANCE_S, MotionProfile

ROUNDING_MM_S = 1e-9
"""Lower speeds are rounding errors."""

SignArray = npt.NDArray[np.int8]


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Pieces of constant acceleration: state at the start of each, arrays of shape `(K,)`."""

    start_s: FloatArray
    position_mm: FloatArray
    velocity_mm_s: FloatArray
    acceleration_mm_s2: FloatArray


class Motion(Protocol):
    """A motion made of `K` smooth intervals without reversals inside."""

    def __hash__(self) -> int:
        """Hash the motion as a value: prepared forces are cached by it."""
        ...

    @property
    def breaks_s(self) -> FloatArray:
        """Ends of the intervals, shape `(K + 1,)`, from 0 to the motion's duration."""
        ...

    @property
    def signs(self) -> SignArray:
        """Direction of motion in each interval, shape `(K,)`: 1, −1, or 0 at rest."""
        ...

    @property
    def uniform(self) -> BoolArray:
        """Whether the velocity is constant in each interval, shape `(K,)`."""
        ...

    @property
    def counted(self) -> bool:
        """Whether it was measured in encoder counts."""
        ...

    def position(self, time_s: FloatArray) -> FloatArray:
        """Return the position [mm] at any times within the motion."""
        ...

    def velocity(self, time_s: FloatArray) -> FloatArray:
        """Return the velocity [mm/s] at any times within the motion."""
        ...

    def state_within_interval(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return position and velocity at times of shape `(n, m)`, each row of which lies within one interval."""
        ...

    def arrival_time(self, position_mm: FloatArray, first: int, last: int) -> FloatArray:
        """Return the last time of a position within the intervals `first` to `last`, which have no reversal."""
        ...

    def pieces(self) -> Pieces:
        """Return the motion as pieces of constant acceleration."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ProfileMotion:
    """A motion profile, its pieces divided at reversals; equal to another of the same pieces."""

    breaks_s: FloatArray
    signs: SignArray
    uniform: BoolArray
    start_mm: FloatArray
    velocity_mm_s: FloatArray
    acceleration_mm_s2: FloatArray

    def __eq__(self, other: object) -> bool:
        """Whether all pieces are the same, bit for bit."""
        return self is other or (isinstance(other, ProfileMotion) and self._bits == other._bits)

    def __hash__(self) -> int:
        """Hash consistently with equality."""
        return hash(self._bits)

    @property
    def _bits(self) -> tuple[bytes, ...]:
        state = (self.breaks_s, self.signs, self.uniform, self.start_mm, self.velocity_mm_s, self.acceleration_mm_s2)
        return tuple(array.tobytes() for array in state)

    @classmethod
    def of(cls, profile: MotionProfile) -> "ProfileMotion":
        """Prepare a profile; an empty one is at rest for an instant."""
        if not profile.start_s.size:
            zero, instant = np.zeros(1), np.array([0.0, TIME_TOLERANCE_S])
            return cls(instant, zero.astype(np.int8), zero == 0, zero, zero, zero)
        turns = _turning_times(profile)
        begin = np.union1d(profile.start_s, turns)
        piece = np.searchsorted(profile.start_s, begin, side="right") - 1
        velocity = np.where(np.isin(begin, turns), 0.0, profile.velocity(begin))
        acceleration = profile.acceleration_mm_s2[piece]
        breaks = np.append(begin, profile.duration_s)
        mean = velocity + 0.5 * acceleration * np.diff(breaks)
        signs = np.where(np.abs(mean) < ROUNDING_MM_S, 0.0, np.sign(mean)).astype(np.int8)
        return cls(breaks, signs, acceleration == 0, profile.position(begin), velocity, acceleration)

    @property
    def counted(self) -> bool:
        """False: a profile is exact."""
        return False

    def position(self, time_s: FloatArray) -> FloatArray:
        """Return the position [mm] at any times within the motion."""
        return self._position(*self._locate(time_s))

    def velocity(self, time_s: FloatArray) -> FloatArray:
        """Return the velocity [mm/s] at any times within the motion."""
        index, elapsed = self._locate(time_s)
        return np.asarray(self.velocity_mm_s[index] + self.acceleration_mm_s2[index] * elapsed)

    def state_within_interval(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return position and velocity at times of shape `(n, m)`, each row of which lies within one interval."""
        middle = 0.5 * (time_s[:, :1] + time_s[:, -1:])
        index, _ = self._locate(middle)
        elapsed = time_s - self.breaks_s[index]
        velocity = self.velocity_mm_s[index] + self.acceleration_mm_s2[index] * elapsed
        return self._position(index, elapsed), np.asarray(velocity)

    def arrival_time(self, position_mm: FloatArray, first: int, last: int) -> FloatArray:
        """Return the last time of a position within the intervals `first` to `last`, which have no reversal."""
        sign = float(self.signs[first : last + 1].sum() >= 0) * 2 - 1
        ahead = sign * (position_mm - self.start_mm[first])
        starts = sign * (self.start_mm[first : last + 1] - self.start_mm[first])
        index = first + np.clip(np.searchsorted(starts, ahead, side="right") - 1, 0, None)
        distance = np.maximum(ahead - starts[index - first], 0.0)
        speed = sign * self.velocity_mm_s[index]
        square = speed**2 + 2 * sign * self.acceleration_mm_s2[index] * distance
        mean_speed = 0.5 * (speed + np.sqrt(np.maximum(square, 0.0)))
        elapsed = np.divide(distance, mean_speed, out=np.zeros_like(distance), where=mean_speed > 0)
        return np.asarray(np.minimum(self.breaks_s[index] + elapsed, self.breaks_s[index + 1]))

    def pieces(self) -> Pieces:
        """Return the motion as pieces of constant acceleration."""
        return Pieces(self.breaks_s[:-1], self.start_mm, self.velocity_mm_s, self.acceleration_mm_s2)

    def _locate(self, time_s: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
        index = np.searchsorted(self.breaks_s[:-1], time_s, side="right") - 1
        return index, time_s - self.breaks_s[index]

    def _position(self, index: npt.NDArray[np.intp], elapsed: FloatArray) -> FloatArray:
        speed = self.velocity_mm_s[index] + 0.5 * self.acceleration_mm_s2[index] * elapsed
        return np.asarray(self.start_mm[index] + speed * elapsed)


def _turning_times(profile: MotionProfile) -> FloatArray:
    """Return when pieces reverse; at the very end of a piece it is rounding, not a reversal."""
    end = np.append(profile.start_s[1:], profile.duration_s)
    moving = profile.acceleration_mm_s2 != 0
    after = -profile.velocity_mm_s[moving] / profile.acceleration_mm_s2[moving]
    inside = (after > TIME_TOLERANCE_S) & (after < (end - profile.start_s)[moving] - TIME_TOLERANCE_S)
    return np.asarray((profile.start_s[moving] + after)[inside])
