"""Linear systems and play at uneven times, exact for inputs that run straight from time to time."""

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.maxwell import linear_recursion

ComplexArray = npt.NDArray[np.complex128]


def first_order(time_s: FloatArray, driving: FloatArray, time_constant_s: float) -> FloatArray:
    """Return y with τ y' + y = driving, in balance before the first time, shapes `(n,)`."""
    change = _modal(time_s, driving - driving[0], complex(-1.0 / time_constant_s))
    return np.asarray(driving[0] + change.real / time_constant_s)


def resonator(time_s: FloatArray, driving: FloatArray, frequency_hz: float, damping: float) -> FloatArray:
    """Return y with y'' + 2 ζ ω y' + ω² y = ω² driving, in balance before the first time; `damping` ζ in (0, 1)."""
    omega = 2 * np.pi * frequency_hz
    pole = omega * (-damping + 1j * np.sqrt(1 - damping**2))
    change = _modal(time_s, driving - driving[0], pole)
    return np.asarray(driving[0] + change.imag * omega**2 / pole.imag)


def play(driving: FloatArray, half_width: float) -> FloatArray:
    """Return the output of a play (backlash) operator that starts centred: it follows with a gap of `half_width`."""
    followed = np.empty_like(driving)
    now = float(driving[0])
    for index, value in enumerate(driving.tolist()):
        now = min(max(now, value - half_width), value + half_width)
        followed[index] = now
    return followed


def _modal(time_s: FloatArray, driving: FloatArray, pole: complex) -> ComplexArray:
    """Return ∫ exp(pole (t − s)) driving(s) ds from the first time on, complex, driving straight between times."""
    step = np.diff(time_s)
    scaled = pole * step
    kept = np.exp(scaled)
    small = np.abs(scaled) < 1e-4
    safe = np.where(small, 1.0, scaled)
    whole = np.where(small, 1 + scaled / 2, (kept - 1) / safe)
    later = np.where(small, 0.5 + scaled / 6, (kept - 1 - scaled) / safe**2)
    added = step * (driving[:-1] * (whole - later) + driving[1:] * later)
    return linear_recursion(np.append(0.0, kept), np.append(0.0, added))
