"""Maxwell branches of the wall sheared by a known motion, integrated exactly: what simulator and identification share.

Everything is linear in the moduli, so that a branch is evaluated for a modulus of 1: multiply by E.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.motion import Pieces

InexactArray = TypeVar("InexactArray", npt.NDArray[np.float64], npt.NDArray[np.complex128])


@dataclass(frozen=True, slots=True, eq=False)
class MaxwellBranches:
    """Branches of unit modulus through pieces of constant acceleration, without stress at the first of them.

    Attributes
    ----------
    rates
        Relaxation rates E/η [1/s], shape `(B,)`.
    pieces
        The motion, `K` pieces.
    thickness_mm
        Thickness of the wall that is sheared.
    begin
        Stress over modulus of each branch as each piece begins, shape `(B, K)`.
    """

    rates: FloatArray
    pieces: Pieces
    thickness_mm: float
    begin: FloatArray

    @classmethod
    def through(cls, rates: FloatArray, pieces: Pieces, thickness_mm: float) -> "MaxwellBranches":
        """Integrate dσ/dt = dε/dt − rate · σ through all pieces."""
        duration = np.diff(pieces.start_s)
        rate = rates[:, None]
        driven = _driven(rate, duration, pieces.velocity_mm_s[:-1], pieces.acceleration_mm_s2[:-1]) / thickness_mm
        begin = np.zeros((rates.size, pieces.start_s.size))
        begin[:, 1:] = linear_recursion(np.exp(-rate * duration), driven)
        return cls(rates, pieces, thickness_mm, begin)

    def at(self, time_s: FloatArray) -> FloatArray:
        """Stress over modulus at times not before the first piece; shape `(B, *time_s.shape)`."""
        flat = time_s.ravel()
        index, elapsed = located(self.pieces, flat)
        rate = self.rates[:, None]
        kept = self.begin[:, index] * np.exp(-rate * elapsed)
        velocity, acceleration = self.pieces.velocity_mm_s[index], self.pieces.acceleration_mm_s2[index]
        stress = kept + _driven(rate, elapsed, velocity, acceleration) / self.thickness_mm
        return np.asarray(stress.reshape(self.rates.size, *time_s.shape))


def strain_at(pieces: Pieces, thickness_mm: float, time_s: FloatArray) -> FloatArray:
    """Shear strain since the first piece at times not before it, of the shape of `time_s`."""
    index, elapsed = located(pieces, time_s)
    velocity, acceleration = pieces.velocity_mm_s[index], pieces.acceleration_mm_s2[index]
    return np.asarray((pieces.position_mm[index] + (velocity + 0.5 * acceleration * elapsed) * elapsed) / thickness_mm)


def located(pieces: Pieces, time_s: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return which piece each time lies in, and the time since that piece began."""
    index = np.maximum(np.searchsorted(pieces.start_s, time_s, side="right") - 1, 0)
    return index, np.asarray(time_s - pieces.start_s[index])


def linear_recursion(factor: InexactArray, addend: InexactArray) -> InexactArray:
    """Return y with y[0] = addend[0] and y[i] = factor[i] · y[i − 1] + addend[i] along the last axis, by doubling."""
    factor, total = factor.copy(), addend.copy()
    shift = 1
    while shift < total.shape[-1]:
        total[..., shift:] = total[..., shift:] + factor[..., shift:] * total[..., :-shift]
        factor[..., shift:] = factor[..., shift:] * factor[..., :-shift]
        shift *= 2
    return total


def _driven(rate: FloatArray, elapsed_s: FloatArray, velocity: FloatArray, acceleration: FloatArray) -> FloatArray:
    """Stress over modulus, times wall thickness, that an unstressed branch takes up at constant acceleration."""
    lag = -np.expm1(-rate * elapsed_s) / rate
    return np.asarray(velocity * lag + acceleration * (elapsed_s - lag) / rate)
