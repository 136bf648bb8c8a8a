"""Hidden effects between mucosa and capsule: friction coefficient, tack, and the first slip."""

import numpy as np

from dragrig.sim_backend.blind import Floats
from dragrig.sim_backend.blind.effects.hidden_effect import (
    DRAG_RUNS,
    SLIDING_RUNS,
    CapsuleForces,
    HiddenEffect,
    RunConditions,
    drawn,
    hidden_form,
    in_log,
)

REFERENCE_MN = 1000.0
"""Normal force that speeds refer to."""


@drawn(amplitude=(0.4, 0.9), speed_mm_s=in_log(1.5, 6.0), power=(1.0, 2.2), distance_mm=(1.1, 2.6))
@hidden_form("friction", "stribeck", "rational, film drawn in", SLIDING_RUNS)
def stribeck_rational(effect: HiddenEffect, run: RunConditions) -> Floats | float:
    """μ falls as a rational function of speed, once the capsule has drawn in its film over a distance."""
    film = -np.expm1(-np.maximum(run.motion.p, 0.0) / effect.distance_mm)
    return np.asarray(effect.amplitude / (1 + film * (run.speed / effect.speed_mm_s) ** effect.power))


@drawn(amplitude=(0.4, 0.9), speed_mm_s=in_log(1.5, 5.0), width=(0.5, 1.3), dip=(0.25, 0.45))
@hidden_form("friction", "stribeck", "error function with minimum", SLIDING_RUNS)
def stribeck_log_normal(effect: HiddenEffect, run: RunConditions) -> Floats | float:
    """μ falls as the error function of the logarithm of speed, through a minimum, and rises again."""
    from scipy.special import erfc

    decades = np.log(np.maximum(run.speed, 1e-6) / effect.speed_mm_s)
    risen = np.maximum(run.speed - 12.0, 0.0) / 30.0
    return np.asarray(
        effect.amplitude * (erfc(decades / effect.width) / 2 * (1 + effect.dip) + effect.dip * (risen - 1))
    )


@drawn(amplitude=(0.4, 0.9), low_mm_s=in_log(0.3, 1.0), ratio=in_log(6.0, 20.0), load=(2.2, 3.2))
@hidden_form("pull", "stribeck", "log v over load", SLIDING_RUNS)
def stribeck_ramp(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """μ falls with the logarithm of speed between two speeds, which the normal force raises (Hersey's number)."""
    hersey = np.maximum(run.speed, 1e-6) * (REFERENCE_MN / forces.normal) ** effect.load
    part = np.log(hersey / effect.low_mm_s) / np.log(effect.ratio)
    return np.asarray(forces.coulomb * effect.amplitude * np.clip(1 - part, 0.0, 1.0))


@drawn(amplitude=(11.0, 27.0), speed_mm_s=in_log(2.0, 10.0), aged=(0.36, 0.62), slip_mm=(4.0, 10.0))
@hidden_form("pull", "adhesion", "inverse root, aged at rest", DRAG_RUNS)
def adhesion_root(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Tack that falls as the inverse root of one plus speed squared, stronger where the contact has aged at rest."""
    more = 1 + effect.aged * np.exp(-np.maximum(run.motion.p, 0.0) / effect.slip_mm)
    return np.asarray(effect.amplitude * more * run.direction / np.sqrt(1 + (run.speed / effect.speed_mm_s) ** 2))


@drawn(amplitude=(16.0, 38.0), speed_mm_s=in_log(0.5, 3.0), end_mm_s=(40.0, 120.0), length_mm=(110.0, 200.0))
@hidden_form("pull", "adhesion", "logarithm, used up", DRAG_RUNS)
def adhesion_log(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Tack that falls with the logarithm of speed up to a highest speed, and with the distance that uses it up."""
    fall = np.log1p(run.speed / effect.speed_mm_s) / np.log1p(effect.end_mm_s / effect.speed_mm_s)
    left = np.exp(-np.maximum(run.motion.p, 0.0) / effect.length_mm)
    return np.asarray(effect.amplitude * left * run.direction * np.maximum(1 - fall, 0.0))


@drawn(amplitude=(14.0, 34.0), speed_mm_s=in_log(2.0, 8.0), power=(0.8, 1.4))
@hidden_form("pull", "adhesion", "plateau and inverse", DRAG_RUNS)
def adhesion_bend(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Tack that holds at low speed and falls inversely with speed beyond a bend."""
    return np.asarray(
        effect.amplitude * run.direction * np.maximum(run.speed / effect.speed_mm_s, 1.0) ** -effect.power
    )


@drawn(amplitude=(0.35, 0.9), power=(1.3, 2.2))
@hidden_form("friction", "film_depletion", "power of distance", SLIDING_RUNS)
def film_power(effect: HiddenEffect, run: RunConditions) -> Floats | float:
    """μ grows with a power of the distance."""
    return np.asarray(effect.amplitude * (np.maximum(run.motion.p, 0.0) / 40.0) ** effect.power)


@drawn(amplitude=(0.35, 0.9), middle_mm=(10.0, 25.0), width_mm=(2.5, 4.5))
@hidden_form("friction", "film_depletion", "logistic in distance", SLIDING_RUNS)
def film_step(effect: HiddenEffect, run: RunConditions) -> Floats | float:
    """μ grows smoothly from a wet to a wiped state about one distance."""
    lower = 1 / (1 + np.exp(effect.middle_mm / effect.width_mm))
    grown = 1 / (1 + np.exp(-(run.motion.p - effect.middle_mm) / effect.width_mm))
    return np.asarray(effect.amplitude * (grown - lower))


@drawn(amplitude=(0.4, 1.0), slip_mm=in_log(0.12, 0.5))
@hidden_form("friction", "breakaway", "Gaussian in slip", SLIDING_RUNS)
def breakaway_bump(effect: HiddenEffect, run: RunConditions) -> Floats | float:
    """Extra friction of an aged contact that fades as a Gaussian of the slip."""
    return np.asarray(effect.amplitude * np.exp(-((run.motion.p / effect.slip_mm) ** 2)))


@drawn(amplitude=(0.4, 1.0), slip_mm=in_log(0.25, 0.9))
@hidden_form("friction", "breakaway", "linear decay", SLIDING_RUNS)
def breakaway_ramp(effect: HiddenEffect, run: RunConditions) -> Floats | float:
    """Extra friction of an aged contact that falls in a straight line with slip."""
    return np.asarray(effect.amplitude * np.clip(1 - run.motion.p / effect.slip_mm, 0.0, 1.0))


@drawn(amplitude=(0.4, 1.0), plateau_mm=(0.03, 0.15), slip_mm=in_log(0.15, 0.5))
@hidden_form("friction", "breakaway", "plateau and half cosine", SLIDING_RUNS)
def breakaway_plateau(effect: HiddenEffect, run: RunConditions) -> Floats | float:
    """Extra friction of an aged contact that holds for a while of slip and then goes along half a cosine."""
    part = np.clip((run.motion.p - effect.plateau_mm) / effect.slip_mm, 0.0, 1.0)
    return np.asarray(effect.amplitude * (1 + np.cos(np.pi * part)) / 2)


@drawn(amplitude=(0.35, 0.9), slip_mm=in_log(0.03, 0.2), power=(0.8, 2.0), half_s=in_log(1.0, 4.0))
@hidden_form("grip", "presliding", "hyperbola both ways", SLIDING_RUNS)
def presliding_hyperbola(effect: HiddenEffect, direction: Floats, run: RunConditions) -> Floats:
    """Friction builds up as s / (s + l), to a power; at standstill it fades inversely with time."""
    slip = np.maximum(run.motion.p, 0.0)
    built = (slip / (slip + effect.slip_mm)) ** effect.power
    held = np.maximum(run.motion.t - run.plan.bounds_s[3], 0.0)
    return (1 - effect.amplitude) * direction + effect.amplitude * built / (1 + held / effect.half_s)


@drawn(amplitude=(0.35, 0.9), slip_mm=in_log(0.08, 0.4), creep=(0.12, 0.19))
@hidden_form("grip", "presliding", "straight line with creep", SLIDING_RUNS)
def presliding_creep(effect: HiddenEffect, direction: Floats, run: RunConditions) -> Floats:
    """Friction builds up in a straight line over the slip, stays at standstill, and creeps off."""
    built = np.clip(run.motion.p / effect.slip_mm, 0.0, 1.0)
    held = np.maximum(run.motion.t - run.plan.bounds_s[3], 0.0)
    return (1 - effect.amplitude) * direction + effect.amplitude * built * (1 - effect.creep * np.log1p(held / 0.05))


@drawn(amplitude=(0.45, 0.95), slip_mm=in_log(0.06, 0.3), stays=(0.4, 0.7), release_s=(0.3, 0.9))
@hidden_form("grip", "presliding", "root with release", SLIDING_RUNS)
def presliding_release(effect: HiddenEffect, direction: Floats, run: RunConditions) -> Floats:
    """Friction builds up as s / √(s² + l²); at standstill part of it springs back and the rest stays."""
    slip = np.maximum(run.motion.p, 0.0)
    built = slip / np.hypot(slip, effect.slip_mm)
    held = np.maximum(run.motion.t - run.plan.bounds_s[3], 0.0)
    left = effect.stays + (1 - effect.stays) * np.exp(-held / effect.release_s)
    return (1 - effect.amplitude) * direction + effect.amplitude * built * left
