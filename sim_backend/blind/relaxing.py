"""Force of a dummy that shears the wall and holds it."""

import numpy as np

from dragrig.sim_backend.blind.effects.base import Scene
from dragrig.sim_backend.blind.gut import Gut
from dragrig.sim_backend.blind.motion import Floats
from dragrig.sim_backend.blind.programme import WALL_MM

AREA_MM2 = np.pi * 12.9 * 15.2
_FINER = 4
"""Steps of the recursion per sample."""


def relax(gut: Gut, scene: Scene) -> Floats:
    """Return the force at every sample [mN], shape `(N,)`.

    Two Maxwell branches and a spring, with the moduli at the final strain, driven by the true motion.
    """
    from scipy.interpolate import CubicHermiteSpline
    from scipy.signal import lfilter

    run, motion = scene.run, scene.motion
    if run.strain is None:
        raise ValueError(f"a {run.kind} run has no strain to relax from")
    E1, E2, E3, tau1, tau2 = (float(one[0]) for one in gut.moduli(np.array([run.strain])))
    h = float(motion.t[1] - motion.t[0]) / _FINER
    fine = motion.t[0] + h * np.arange((motion.t.size - 1) * _FINER + 1)
    strain = CubicHermiteSpline(motion.t, motion.p, motion.v)(fine) / WALL_MM
    steps = np.diff(strain, prepend=0.0)
    stress = E3 * strain
    for modulus, tau in ((E1, tau1), (E2, tau2)):
        if gut.rough.ramp_step_s:
            stress = stress + modulus * _coarse(strain, fine, tau, gut.rough.ramp_step_s)
            continue
        kept = np.exp(-h / tau)
        stress = stress + lfilter([modulus * tau / h * (1 - kept)], [1.0, -kept], steps)
    force = stress[::_FINER] * AREA_MM2
    return np.asarray(force + AREA_MM2 * E3 * _slow(gut, motion.t, strain[::_FINER]))


def _coarse(strain: Floats, fine: Floats, tau: float, step_s: float) -> Floats:
    """Return a branch's stress over its modulus by the first-order rule at a coarse step, linear in between."""
    from scipy.signal import lfilter

    every = max(round(step_s / (fine[1] - fine[0])), 1)
    at = np.append(np.arange(0, fine.size - 1, every), fine.size - 1)
    coarse = lfilter([1.0], [1.0, -np.exp(-every * (fine[1] - fine[0]) / tau)], np.diff(strain[at], prepend=0.0))
    return np.asarray(np.interp(fine, fine[at], coarse))


def _slow(gut: Gut, t: Floats, strain: Floats) -> Floats:
    """Return what effects add, as a part of E3: their answer to a step, summed over the steps of the ramp."""
    tail = gut.tail(t - t[0], np.full_like(t, strain[-1]))
    if not tail.any():
        return np.zeros_like(t)
    steps = np.diff(strain, prepend=0.0)
    moving = np.flatnonzero(np.abs(steps) > 1e-12)
    first, last = int(moving[0]), int(moving[-1]) + 1
    ramp = np.convolve(tail, steps[first:last])[: t.size - first]
    return np.concatenate([np.zeros(first), ramp])
