"""Forces on a capsule that slides: elastic resistance and normal force from contact ages, friction, viscous drag."""

import numpy as np

from dragrig.sim_backend.blind.effects.base import Parts, Scene
from dragrig.sim_backend.blind.gut import GRAVITY_M_S2, MASS_G, RADIUS_MM, Gut
from dragrig.sim_backend.blind.motion import Floats
from dragrig.sim_backend.blind.programme import USUAL_DWELL_S

_INTERVALS = 48
"""Of Simpson's rule, on each side of the place where the pressure jumps."""
_STEP_MM = 0.06
"""Travel from knot to knot; contact forces are evaluated at the knots and linear between them."""


def slide(gut: Gut, scene: Scene, *, closed: bool) -> Floats:
    """Return the force on the capsule at every sample [mN], shape `(N,)`.

    Parameters
    ----------
    closed
        Whether the wall closes about the capsule; it does not in the vacuum fixture.
    """
    motion, specimen = scene.motion, gut.specimen
    mu = specimen.mu * gut.variation.mu
    weight = MASS_G * GRAVITY_M_S2
    elastic, normal = np.zeros_like(motion.t), np.full_like(motion.t, weight)
    if closed:
        knots = _knots(scene)
        at_knots, side = _contact(gut, scene, knots)
        elastic = np.interp(motion.t, motion.t[knots], at_knots)
        normal = weight + gut.area_mm2 * np.interp(motion.t, motion.t[knots], side)
    viscous = np.sign(motion.v) * specimen.mucus * viscous_law(scene.speed)
    grip, change = scene.direction, np.zeros_like(motion.t)
    for effect in gut.effects:
        grip = effect.grip(grip, scene)
        change = change + effect.friction(scene)
    coulomb = mu * (1 + change) * normal * grip
    parts = Parts(elastic, viscous, coulomb, normal)
    total = elastic + viscous + coulomb
    for effect in gut.effects:
        total = total + effect.pull(parts, scene)
    return total


def viscous_law(speed: Floats) -> Floats:
    """Return the published viscous drag [mN] at a speed [mm/s]."""
    return np.asarray(11.24 * 0.030**0.7552 * speed**0.2448 + 0.1148 * speed)


def _knots(scene: Scene) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return the samples at which the contact is evaluated: close where age or position change fast."""
    t = scene.motion.t
    travelled = np.cumsum(np.abs(np.diff(scene.motion.p, prepend=0.0))) / _STEP_MM
    since = [t - edge for edge in scene.run.bounds_s]
    fresh = sum(np.where(one >= -0.004, np.log1p(np.maximum(one, 0.0) / 0.02) / 0.06, 0.0) for one in since)
    count = np.floor(travelled + fresh + t / 0.5)
    chosen = np.flatnonzero(np.diff(count, prepend=-1.0, append=np.inf)[:-1] > 0)
    return np.union1d(chosen, [0, t.size - 1])


def _contact(gut: Gut, scene: Scene, knots: np.ndarray[tuple[int], np.dtype[np.intp]]) -> tuple[Floats, Floats]:
    """Return elastic resistance [mN] and the pressure at the equator [kPa] at the knots."""
    motion = scene.motion
    reached = np.maximum.accumulate(motion.p - motion.p[0])
    far, first = np.unique(reached, return_index=True)
    times = motion.t[np.maximum(first, 0)].copy()
    times[0] = motion.t[max(int(np.argmax(reached > 0)) - 1, 0)]

    # What a specimen's contact really ages by is another number than what is noted.
    dwell = gut.specimen.dwell_s * (scene.run.dwell_s / USUAL_DWELL_S)

    def age(x: Floats, now: Floats, here: Floats) -> Floats:
        back = here - x
        return np.where(back >= 0, now - np.interp(back, far, times), dwell + now)

    now, here = motion.t[knots][:, None], reached[knots][:, None]
    speeds = [effect.passing(scene)[knots][:, None] for effect in gut.effects]
    length = gut.length_mm
    total = np.zeros(knots.size)
    jump = np.minimum(here, length)
    for low, high, fresh in ((np.zeros_like(jump), jump, True), (jump, np.full_like(jump, length), False)):
        wide = np.flatnonzero((high - low)[:, 0] > 1e-9)
        if not wide.size:
            continue
        a, b = low[wide], high[wide]
        where, weights = _rule(gut.rough.panels)
        x = a + (b - a) * where
        old = now[wide] - np.interp(np.maximum(here[wide] - x, 0.0), far, times)
        ages = old if fresh else np.broadcast_to(dwell + now[wide], x.shape)
        held = np.ones_like(x)
        for effect, speed in zip(gut.effects, speeds, strict=True):
            held = held * effect.contact(x / length, speed[wide])
        slant = (length - x) / RADIUS_MM * 2 * np.pi * RADIUS_MM
        total[wide] += ((b - a) * weights * gut.pressure(x, ages) * slant * held).sum(axis=1)
    end = np.full_like(here, length)
    return total, gut.pressure(end, age(end, now, here))[:, 0]


def _rule(panels: int) -> tuple[Floats, Floats]:
    """Return nodes and weights on 0 to 1: Simpson's rule in a variable that crowds the nodes at 0, or midpoints."""
    if panels:
        return (np.arange(panels) + 0.5) / panels, np.full(panels, 1 / panels)
    s = np.linspace(0.0, 1.0, 2 * _INTERVALS + 1)
    weights = np.full(s.size, 2.0)
    weights[1::2], weights[[0, -1]] = 4.0, 1.0
    return s**2, weights / (6 * _INTERVALS) * 2 * s
