"""Hidden effects between mucosa and capsule: friction coefficient, tack, and the first slip."""

from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.hidden_effect import (
    DRAG_RUNS,
    SLIDING_RUNS,
    CapsuleForces,
    DrawnFrom,
    HiddenEffect,
    RunConditions,
)
from dragrig.sim_backend.blind.run_plans import Floats

REFERENCE_MN = 1000.0
"""Normal force that speeds refer to."""


class StribeckRational(HiddenEffect):
    """μ falls as a rational function of speed, once the capsule has drawn in its film over a distance."""

    name, form, kinds = "stribeck", "rational, film drawn in", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(0.4, 0.9)]
    speed_mm_s: Annotated[float, DrawnFrom(1.5, 6.0, log=True)]
    power: Annotated[float, DrawnFrom(1.0, 2.2)]
    distance_mm: Annotated[float, DrawnFrom(1.1, 2.6)]

    def friction(self, run: RunConditions) -> Floats | float:
        film = -np.expm1(-np.maximum(run.motion.p, 0.0) / self.distance_mm)
        return np.asarray(self.amplitude / (1 + film * (run.speed / self.speed_mm_s) ** self.power))


class StribeckLogNormal(HiddenEffect):
    """μ falls as the error function of the logarithm of speed, through a minimum, and rises again."""

    name, form, kinds = "stribeck", "error function with minimum", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(0.4, 0.9)]
    speed_mm_s: Annotated[float, DrawnFrom(1.5, 5.0, log=True)]
    width: Annotated[float, DrawnFrom(0.5, 1.3)]
    dip: Annotated[float, DrawnFrom(0.25, 0.45)]

    def friction(self, run: RunConditions) -> Floats | float:
        from scipy.special import erfc

        decades = np.log(np.maximum(run.speed, 1e-6) / self.speed_mm_s)
        risen = np.maximum(run.speed - 12.0, 0.0) / 30.0
        return np.asarray(self.amplitude * (erfc(decades / self.width) / 2 * (1 + self.dip) + self.dip * (risen - 1)))


class StribeckRamp(HiddenEffect):
    """μ falls with the logarithm of speed between two speeds, which the normal force raises (Hersey's number)."""

    name, form, kinds = "stribeck", "log v over load", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(0.4, 0.9)]
    low_mm_s: Annotated[float, DrawnFrom(0.3, 1.0, log=True)]
    ratio: Annotated[float, DrawnFrom(6.0, 20.0, log=True)]
    load: Annotated[float, DrawnFrom(2.2, 3.2)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        hersey = np.maximum(run.speed, 1e-6) * (REFERENCE_MN / forces.normal) ** self.load
        part = np.log(hersey / self.low_mm_s) / np.log(self.ratio)
        return np.asarray(forces.coulomb * self.amplitude * np.clip(1 - part, 0.0, 1.0))


class AdhesionRoot(HiddenEffect):
    """Tack that falls as the inverse root of one plus speed squared, stronger where the contact has aged at rest."""

    name, form, kinds = "adhesion", "inverse root, aged at rest", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(11.0, 27.0)]
    speed_mm_s: Annotated[float, DrawnFrom(2.0, 10.0, log=True)]
    aged: Annotated[float, DrawnFrom(0.36, 0.62)]
    slip_mm: Annotated[float, DrawnFrom(4.0, 10.0)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        more = 1 + self.aged * np.exp(-np.maximum(run.motion.p, 0.0) / self.slip_mm)
        return np.asarray(self.amplitude * more * run.direction / np.sqrt(1 + (run.speed / self.speed_mm_s) ** 2))


class AdhesionLog(HiddenEffect):
    """Tack that falls with the logarithm of speed up to a highest speed, and with the distance that uses it up."""

    name, form, kinds = "adhesion", "logarithm, used up", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(16.0, 38.0)]
    speed_mm_s: Annotated[float, DrawnFrom(0.5, 3.0, log=True)]
    end_mm_s: Annotated[float, DrawnFrom(40.0, 120.0)]
    length_mm: Annotated[float, DrawnFrom(110.0, 200.0)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        fall = np.log1p(run.speed / self.speed_mm_s) / np.log1p(self.end_mm_s / self.speed_mm_s)
        left = np.exp(-np.maximum(run.motion.p, 0.0) / self.length_mm)
        return np.asarray(self.amplitude * left * run.direction * np.maximum(1 - fall, 0.0))


class AdhesionBend(HiddenEffect):
    """Tack that holds at low speed and falls inversely with speed beyond a bend."""

    name, form, kinds = "adhesion", "plateau and inverse", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(14.0, 34.0)]
    speed_mm_s: Annotated[float, DrawnFrom(2.0, 8.0, log=True)]
    power: Annotated[float, DrawnFrom(0.8, 1.4)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        return np.asarray(self.amplitude * run.direction * np.maximum(run.speed / self.speed_mm_s, 1.0) ** -self.power)


class FilmPower(HiddenEffect):
    """μ grows with a power of the distance."""

    name, form, kinds = "film_depletion", "power of distance", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(0.35, 0.9)]
    power: Annotated[float, DrawnFrom(1.3, 2.2)]

    def friction(self, run: RunConditions) -> Floats | float:
        return np.asarray(self.amplitude * (np.maximum(run.motion.p, 0.0) / 40.0) ** self.power)


class FilmStep(HiddenEffect):
    """μ grows smoothly from a wet to a wiped state about one distance."""

    name, form, kinds = "film_depletion", "logistic in distance", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(0.35, 0.9)]
    middle_mm: Annotated[float, DrawnFrom(10.0, 25.0)]
    width_mm: Annotated[float, DrawnFrom(2.5, 4.5)]

    def friction(self, run: RunConditions) -> Floats | float:
        lower = 1 / (1 + np.exp(self.middle_mm / self.width_mm))
        grown = 1 / (1 + np.exp(-(run.motion.p - self.middle_mm) / self.width_mm))
        return np.asarray(self.amplitude * (grown - lower))


class BreakawayBump(HiddenEffect):
    """Extra friction of an aged contact that fades as a Gaussian of the slip."""

    name, form, kinds = "breakaway", "Gaussian in slip", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(0.4, 1.0)]
    slip_mm: Annotated[float, DrawnFrom(0.12, 0.5, log=True)]

    def friction(self, run: RunConditions) -> Floats | float:
        return np.asarray(self.amplitude * np.exp(-((run.motion.p / self.slip_mm) ** 2)))


class BreakawayRamp(HiddenEffect):
    """Extra friction of an aged contact that falls in a straight line with slip."""

    name, form, kinds = "breakaway", "linear decay", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(0.4, 1.0)]
    slip_mm: Annotated[float, DrawnFrom(0.25, 0.9, log=True)]

    def friction(self, run: RunConditions) -> Floats | float:
        return np.asarray(self.amplitude * np.clip(1 - run.motion.p / self.slip_mm, 0.0, 1.0))


class BreakawayPlateau(HiddenEffect):
    """Extra friction of an aged contact that holds for a while of slip and then goes along half a cosine."""

    name, form, kinds = "breakaway", "plateau and half cosine", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(0.4, 1.0)]
    plateau_mm: Annotated[float, DrawnFrom(0.03, 0.15)]
    slip_mm: Annotated[float, DrawnFrom(0.15, 0.5, log=True)]

    def friction(self, run: RunConditions) -> Floats | float:
        part = np.clip((run.motion.p - self.plateau_mm) / self.slip_mm, 0.0, 1.0)
        return np.asarray(self.amplitude * (1 + np.cos(np.pi * part)) / 2)


class PreslidingHyperbola(HiddenEffect):
    """Friction builds up as s / (s + l), to a power; at standstill it fades inversely with time."""

    name, form, kinds = "presliding", "hyperbola both ways", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(0.35, 0.9)]
    slip_mm: Annotated[float, DrawnFrom(0.03, 0.2, log=True)]
    power: Annotated[float, DrawnFrom(0.8, 2.0)]
    half_s: Annotated[float, DrawnFrom(1.0, 4.0, log=True)]

    def grip(self, direction: Floats, run: RunConditions) -> Floats:
        slip = np.maximum(run.motion.p, 0.0)
        built = (slip / (slip + self.slip_mm)) ** self.power
        held = np.maximum(run.motion.t - run.plan.bounds_s[3], 0.0)
        return (1 - self.amplitude) * direction + self.amplitude * built / (1 + held / self.half_s)


class PreslidingCreep(HiddenEffect):
    """Friction builds up in a straight line over the slip, stays at standstill, and creeps off."""

    name, form, kinds = "presliding", "straight line with creep", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(0.35, 0.9)]
    slip_mm: Annotated[float, DrawnFrom(0.08, 0.4, log=True)]
    creep: Annotated[float, DrawnFrom(0.12, 0.19)]

    def grip(self, direction: Floats, run: RunConditions) -> Floats:
        built = np.clip(run.motion.p / self.slip_mm, 0.0, 1.0)
        held = np.maximum(run.motion.t - run.plan.bounds_s[3], 0.0)
        return (1 - self.amplitude) * direction + self.amplitude * built * (1 - self.creep * np.log1p(held / 0.05))


class PreslidingRelease(HiddenEffect):
    """Friction builds up as s / √(s² + l²); at standstill part of it springs back and the rest stays."""

    name, form, kinds = "presliding", "root with release", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(0.45, 0.95)]
    slip_mm: Annotated[float, DrawnFrom(0.06, 0.3, log=True)]
    stays: Annotated[float, DrawnFrom(0.4, 0.7)]
    release_s: Annotated[float, DrawnFrom(0.3, 0.9)]

    def grip(self, direction: Floats, run: RunConditions) -> Floats:
        slip = np.maximum(run.motion.p, 0.0)
        built = slip / np.hypot(slip, self.slip_mm)
        held = np.maximum(run.motion.t - run.plan.bounds_s[3], 0.0)
        left = self.stays + (1 - self.stays) * np.exp(-held / self.release_s)
        return (1 - self.amplitude) * direction + self.amplitude * built * left
