"""Responses that several effects share: linear systems at uneven times, distance travelled, bristle deflection.

Linear systems are exact for inputs that are linear between times.
"""

import numpy as np
import numpy.typing as npt

from dragrig.rig import FloatArray
from dragrig.sim_backend.friction import Motion, linear_recursion

ComplexArray = npt.NDArray[np.complex128]


def first_order(time_s: FloatArray, driving: FloatArray, time_constant_s: float) -> FloatArray:
    """Return y with τ y' + y = driving, in equilibrium before the first time, shapes `(n,)`."""
    change = _modal(time_s, driving - driving[0], complex(-1.0 / time_constant_s))
    return np.asarray(driving[0] + change.real / time_constant_s)


def resonator(time_s: FloatArray, driving: FloatArray, frequency_hz: float, damping: float) -> FloatArray:
    """Return y with y'' + 2 ζ ω y' + ω² y = ω² driving, in equilibrium before the first time; `damping` ζ in (0, 1)."""
    omega = 2 * np.pi * frequency_hz
    pole = omega * (-damping + 1j * np.sqrt(1 - damping**2))
    change = _modal(time_s, driving - driving[0], pole)
    return np.asarray(driving[0] + change.imag * omega**2 / pole.imag)


def _modal(time_s: FloatArray, driving: FloatArray, pole: complex) -> ComplexArray:
    """Return ∫ exp(pole (t − s)) driving(s) ds from the first time on, complex, driving linear between times."""
    step = np.diff(time_s)
    scaled = pole * step
    decay = np.exp(scaled)
    small = np.abs(scaled) < 1e-4
    safe = np.where(small, 1.0, scaled)
    whole = np.where(small, 1 + scaled / 2, (decay - 1) / safe)
    later = np.where(small, 0.5 + scaled / 6, (decay - 1 - scaled) / safe**2)
    added = step * (driving[:-1] * (whole - later) + driving[1:] * later)
    return linear_recursion(np.append(0.0, decay), np.append(0.0, added))


def distance_travelled(motion: Motion, time_s: FloatArray) -> FloatArray:
    """Return the distance travelled since the motion began, both directions added up, of the times' shape."""
    index, moved = _since_break(motion, time_s)
    steps = np.abs(np.diff(motion.position(motion.breaks_s)))
    return np.asarray(np.append(0.0, np.cumsum(steps))[index] + moved)


def bristle_deflection(motion: Motion, time_s: FloatArray, length_mm: float) -> FloatArray:
    """Return a bristle's deflection over its steady one, −1 to 1, of the times' shape.

    It starts from 0, follows the motion over a sliding distance, `length_mm · dz/ds = sign − z`, and keeps its value
    while nothing moves (Dahl).
    """
    index, moved = _since_break(motion, time_s)
    signs = motion.signs.astype(np.float64)
    decay = np.exp(-np.abs(np.diff(motion.position(motion.breaks_s))) / length_mm)
    begin = linear_recursion(np.append(0.0, decay), np.append(0.0, signs * (1 - decay)))
    share = np.exp(-moved / length_mm)
    return np.asarray(begin[index] * share + signs[index] * (1 - share))


def _since_break(motion: Motion, time_s: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return the interval that each time lies in, and the distance travelled since that began."""
    breaks = motion.breaks_s
    time = np.clip(time_s, 0.0, breaks[-1])
    index = np.clip(np.searchsorted(breaks, time, side="right") - 1, 0, breaks.size - 2)
    return index, np.asarray(np.abs(motion.position(time) - motion.position(breaks[index])))
