"""Linear systems sampled with the record."""

import numpy as np

from dragrig.sim_backend.blind.motion import Floats


def second_order(values: Floats, natural: float, damping: float, t: Floats) -> Floats:
    """Return the answer of ω² / (s² + 2ζωs + ω²), at rest before the first sample, input linear between samples."""
    from scipy.signal import cont2discrete, lfilter

    system = (np.array([natural**2]), np.array([1.0, 2 * damping * natural, natural**2]))
    numerator, denominator, _ = cont2discrete(system, float(t[1] - t[0]), method="foh")
    return np.asarray(lfilter(np.ravel(numerator), denominator, values))


def low_pass(values: Floats, time_s: float, damping: float, t: Floats) -> Floats:
    """Return the values through two poles at `1 / time_s`, or a pair of them with less damping."""
    return second_order(values, 1 / time_s, damping, t)


def resonance(values: Floats, hertz: float, damping: float, t: Floats) -> Floats:
    """Return the values as a mass on a spring passes them on: the quasi-static part and the ringing."""
    return second_order(values, 2 * np.pi * hertz, damping, t)


def delayed(values: Floats, seconds: Floats | float, t: Floats) -> Floats:
    """Return the values as they were `seconds` ago; the ends are held."""
    return np.interp(t - seconds, t, values)


def first_order(values: Floats, time_s: float, t: Floats) -> Floats:
    """Return the values through one pole at `1 / time_s`, at rest before the first sample."""
    from scipy.signal import lfilter

    kept = float(np.exp(-(t[1] - t[0]) / time_s))
    return np.asarray(lfilter([1 - kept], [1.0, -kept], values))
