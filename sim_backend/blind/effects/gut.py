"""Hidden effects of the gut: wall, folds, mesentery, contractions, changes over a session, friction, and first slip."""

import numpy as np

from dragrig.sim_backend.blind import Floats, RunPlan
from dragrig.sim_backend.blind.effects.hidden_effect import (
    DRAG_RUNS,
    PHASE,
    SLIDING_RUNS,
    TISSUE_RUNS,
    CapsuleForces,
    HiddenEffect,
    RunConditions,
    drawn,
    first_order,
    hidden_form,
    in_log,
    signed,
)


@drawn(amplitude=(0.7, 1.0), speed_mm_s=(15.0, 30.0), power=(2.0, 4.0), front=(0.45, 0.75), back_s=in_log(0.08, 0.2))
class LiftOffFade(HiddenEffect):
    """The front part of the contact carries less as speed grows, and comes back late once the capsule slows down."""

    name, form, kinds = "wall_lift_off", "front fades, comes back late", DRAG_RUNS

    def passing(self, run: RunConditions) -> Floats:
        t = run.motion.t
        log_speed = np.log(np.maximum(run.speed, 1e-9))
        return np.asarray(np.exp(np.maximum.accumulate(log_speed + t / self.back_s) - t / self.back_s))

    def contact(self, where: Floats, speed: Floats) -> Floats:
        edge = 1 / (1 + np.exp((where - self.front) / 0.04))
        return np.asarray(1 - self.amplitude * edge * (1 - 1 / (1 + (speed / self.speed_mm_s) ** self.power)))


@drawn(amplitude=(0.55, 0.9), speed_mm_s=(8.0, 14.0), power=(0.6, 1.2), distance_mm=(1.5, 4.0))
class LiftOffPeel(HiddenEffect):
    """The contact peels from the front, over a distance, up to a place that moves back with speed."""

    name, form, kinds = "wall_lift_off", "front peels over a distance", DRAG_RUNS

    def passing(self, run: RunConditions) -> Floats:
        return np.asarray(run.speed * -np.expm1(-np.maximum(run.motion.p, 0.0) / self.distance_mm))

    def contact(self, where: Floats, speed: Floats) -> Floats:
        part = np.maximum(speed - self.speed_mm_s, 0.0) / (60.0 - self.speed_mm_s)
        lost = self.amplitude * part**self.power
        return np.asarray(1 - np.clip((lost - where) / 0.06 + 0.5, 0.0, 1.0) * np.minimum(lost / 0.06, 1.0))


@drawn(
    amplitude=(0.7, 1.0),
    begin_mm_s=(6.0, 12.0),
    width_mm_s=(10.0, 20.0),
    reach=(0.6, 0.95),
    time_s=in_log(0.03, 0.07),
)
class LiftOffHollow(HiddenEffect):
    """A hollow opens at the front beyond a speed, deepest where contact begins; it opens and closes sluggishly."""

    name, form, kinds = "wall_lift_off", "sluggish hollow", DRAG_RUNS

    def passing(self, run: RunConditions) -> Floats:
        return first_order(run.speed, self.time_s, run.motion.t)

    def contact(self, where: Floats, speed: Floats) -> Floats:
        opened = 1 - np.exp(-((np.maximum(speed - self.begin_mm_s, 0.0) / self.width_mm_s) ** 2))
        depth = np.sqrt(np.maximum(1 - (where / self.reach) ** 2, 0.0))
        return np.asarray(1 - self.amplitude * opened * depth)


@drawn(amplitude=(20.0, 50.0), power=(2.7, 3.4))
@hidden_form("pull", "wall_inertia", "power above two", DRAG_RUNS)
def inertia_power(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """A force that grows faster than the square of speed."""
    return np.asarray(effect.amplitude * run.direction * (run.speed / 60.0) ** effect.power)


@drawn(amplitude=(20.0, 50.0), speed_mm_s=(12.0, 40.0))
@hidden_form("pull", "wall_inertia", "square that bends over", DRAG_RUNS)
def inertia_bending(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """A force with the square of speed that turns linear at high speed."""
    v, bend = run.speed, effect.speed_mm_s
    return np.asarray(effect.amplitude * run.direction * (v / 60.0) ** 2 * (1 + 60.0 / bend) / (1 + v / bend))


@drawn(amplitude=(0.3, 0.7), power=(1.6, 3.5), slower=(0.2, 0.7))
@hidden_form("branches", "hyperelastic_wall", "power of strain", TISSUE_RUNS)
def hyperelastic_lock(effect: HiddenEffect, strain: Floats) -> tuple[Floats, Floats, Floats]:
    """Moduli grow with a power of strain, fast branches more than the spring."""
    more = effect.amplitude * (np.maximum(strain, 0.0) / 2) ** effect.power
    return 1 + more, 1 + more * effect.slower, 1 + more * effect.slower**2


@drawn(amplitude=(0.25, 0.55), strain=(0.5, 0.9), span=(0.4, 0.8), slower=(0.2, 0.7))
@hidden_form("branches", "hyperelastic_wall", "straightened fibres", TISSUE_RUNS)
def hyperelastic_kink(effect: HiddenEffect, strain: Floats) -> tuple[Floats, Floats, Floats]:
    """Moduli grow while fibres straighten, between two strains."""
    low, high = (np.logaddexp(0.0, (strain - at) / 0.05) * 0.05 for at in (effect.strain, effect.strain + effect.span))
    more = effect.amplitude * (low - high) / effect.span
    return 1 + more, 1 + more * effect.slower, 1 + more * effect.slower**2


@drawn(amplitude=(0.3, 0.6), strain=(1.0, 1.7), power=(2.5, 5.0), slower=(0.2, 0.7))
@hidden_form("branches", "hyperelastic_wall", "steep about one strain", TISSUE_RUNS)
def hyperelastic_bent(effect: HiddenEffect, strain: Floats) -> tuple[Floats, Floats, Floats]:
    """Moduli that grow steeply about one strain and less beyond it, in the fast branches alone."""
    risen = (np.maximum(strain, 0.0) / effect.strain) ** effect.power
    more = effect.amplitude * risen / (1 + risen)
    return 1 + more, 1 + more * effect.slower, np.ones_like(strain)


@drawn(amplitude=(0.2, 0.6), time_s=in_log(4.0, 15.0), power=(0.45, 0.8), faster=(0.6, 1.2))
@hidden_form("tail", "extra_relaxation", "stretched, faster with strain", TISSUE_RUNS)
def relaxation_stretched(effect: HiddenEffect, age_s: Floats, strain: Floats) -> Floats:
    """Stress that fades as a stretched exponential of age, the faster the further the wall is strained."""
    time_s = effect.time_s * np.clip(strain, 0.2, 2.5) ** -effect.faster
    return np.asarray(effect.amplitude * np.exp(-((np.maximum(age_s, 0.0) / time_s) ** effect.power)))


@drawn(amplitude=(0.15, 0.45), time_s=in_log(1.5, 6.0), power=(0.5, 1.2), grows=(0.35, 0.65))
@hidden_form("tail", "extra_relaxation", "power law, grows with strain", TISSUE_RUNS)
def relaxation_power(effect: HiddenEffect, age_s: Floats, strain: Floats) -> Floats:
    """Stress that fades as a power of age, of a share that grows with strain."""
    share = effect.amplitude * (np.maximum(strain, 0.0) / 1.2) ** effect.grows
    return np.asarray(share * (1 + np.maximum(age_s, 0.0) / effect.time_s) ** -effect.power)


@drawn(amplitude=(0.2, 0.5), time_s=in_log(0.8, 3.0), last_s=in_log(60.0, 400.0), strain=(0.03, 0.12))
@hidden_form("tail", "extra_relaxation", "logarithm, beyond a strain", TISSUE_RUNS)
def relaxation_log(effect: HiddenEffect, age_s: Floats, strain: Floats) -> Floats:
    """Stress that fades with the logarithm of age, to nothing at a last age, in wall strained beyond some strain."""
    fall = np.log1p(np.maximum(age_s, 0.0) / effect.time_s) / np.log1p(effect.last_s / effect.time_s)
    share = effect.amplitude * np.maximum(strain - effect.strain, 0.0) / (1.5 - effect.strain)
    return np.asarray(share * np.maximum(1 - fall, 0.0))


@drawn(amplitude=(0.08, 0.20), period_mm=in_log(3.0, 8.0), phase=PHASE, second=(0.10, 0.2), second_phase=PHASE)
@hidden_form("pull", "folds", "two harmonics", DRAG_RUNS)
def folds_harmonics(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Elastic resistance modulated in position with two harmonics."""
    turn = 2 * np.pi * run.motion.p / effect.period_mm
    wave = np.cos(turn + effect.phase) + effect.second * np.cos(2 * turn + effect.second_phase)
    return np.asarray(effect.amplitude * forces.elastic * wave)


@drawn(amplitude=(0.10, 0.25), period_mm=in_log(3.0, 8.0), phase=PHASE, sharpness=(0.5, 1.5))
@hidden_form("pull", "folds", "ridges", DRAG_RUNS)
def folds_ridges(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Narrow ridges at equal distances, between which the wall is slack."""
    from scipy.special import i0e

    turn = 2 * np.pi * run.motion.p / effect.period_mm + effect.phase
    ridges = np.exp(effect.sharpness * (np.cos(turn) - 1)) - i0e(effect.sharpness)
    return np.asarray(effect.amplitude * forces.elastic * ridges * (1 + effect.sharpness / 2))


@drawn(amplitude=(0.10, 0.25), period_mm=in_log(3.0, 8.0), phase=PHASE, wander=(0.02, 0.05))
@hidden_form("pull", "folds", "wandering triangle", DRAG_RUNS)
def folds_wandering(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Folds whose distance changes along the gut, with straight flanks."""
    p = run.motion.p
    turn = 2 * np.pi * p / effect.period_mm + effect.phase + 2 * np.pi * effect.wander * np.sin(2 * np.pi * p / 33.0)
    return np.asarray(effect.amplitude * forces.elastic * np.arcsin(np.sin(turn)) * 2 / np.pi)


@drawn(amplitude=(12.0, 34.0), place_mm=(12.0, 26.0), power=(1.3, 2.8), relaxes=(0.4, 0.7), time_s=(0.4, 1.5))
@hidden_form("pull", "mesentery_tether", "power, relaxes in the hold", DRAG_RUNS)
def tether_power(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """A pull that grows with a power of the travel beyond a place, and relaxes while the capsule is held."""
    beyond = np.maximum(run.motion.p - effect.place_mm, 0.0) / (40.0 - effect.place_mm)
    return np.asarray(
        effect.amplitude * beyond**effect.power * (1 + effect.relaxes * np.expm1(-run.held_s / effect.time_s))
    )


@drawn(amplitude=(12.0, 34.0), place_mm=(15.0, 28.0), width_mm=(2.0, 5.0), step_mm=(6.0, 11.0), slips=(0.4, 0.65))
@hidden_form("pull", "mesentery_tether", "soft onset, slips", DRAG_RUNS)
def tether_soft(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """A pull that stiffens gradually, as tissue that unfolds does, and gives way again and again."""
    w, p = effect.width_mm, run.motion.p
    grown, end = (np.logaddexp(0.0, (at - effect.place_mm) / w) for at in (p, np.array(40.0)))
    taut = (grown - np.logaddexp(0.0, -effect.place_mm / w)) / end
    turn = np.pi * (p - effect.place_mm) / effect.step_mm
    return np.asarray(effect.amplitude * taut * (1 - effect.slips * np.sin(turn) ** 4))


@drawn(amplitude=(12.0, 34.0), place_mm=(12.0, 19.0), later_mm=(6.0, 10.0), ratio=(0.5, 0.9))
@hidden_form("pull", "mesentery_tether", "two strands, one gives way", DRAG_RUNS)
def tether_two_strands(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Two strands that come taut one after the other; the first gives way where the second comes taut."""

    def taut(p: Floats) -> Floats:
        beyond = p - effect.place_mm - effect.later_mm
        first = np.clip(p - effect.place_mm, 0.0, effect.later_mm) / (1 + np.exp(np.clip((beyond - 1) / 0.3, -50, 50)))
        return np.asarray(first + effect.ratio * np.maximum(beyond, 0.0))

    return np.asarray(effect.amplitude * taut(run.motion.p) / taut(np.array(40.0)))


@drawn(amplitude=(7.0, 18.0), period_s=(3.5, 8.0), phase=PHASE, width=(0.10, 0.18), wander=(0.03, 0.06))
@hidden_form("pull", "peristalsis", "Gaussian pulses, early and late", DRAG_RUNS)
def peristalsis_pulses(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Pulses of a Gaussian shape at slightly irregular times of the session."""
    turn = run.session_s / effect.period_s + effect.phase / (2 * np.pi)
    late = turn + effect.wander * np.sin(1.9 * turn)
    return np.asarray(effect.amplitude * np.exp(-(((late - np.round(late)) / effect.width) ** 2)))


@drawn(amplitude=(7.0, 18.0), period_s=(3.5, 8.0), phase=PHASE, rise=(0.05, 0.15))
@hidden_form("pull", "peristalsis", "fast rise, slow fall", DRAG_RUNS)
def peristalsis_twitch(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Contractions that rise fast and fade slowly, periodic in the session's time."""
    turn = np.mod(run.session_s / effect.period_s + effect.phase / (2 * np.pi), 1.0)
    return np.asarray(effect.amplitude * turn / effect.rise * np.exp(1 - turn / effect.rise))


@drawn(amplitude=(8.0, 20.0), period_s=(3.5, 8.0), phase=PHASE, uneven=(0.1, 0.35))
@hidden_form("pull", "peristalsis", "uneven contractions", DRAG_RUNS)
def peristalsis_uneven(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Smooth contractions, periodic in the session's time, of varying strength."""
    turn = run.session_s / effect.period_s + effect.phase / (2 * np.pi)
    strength = 1 + effect.uneven * np.sin(2.4 * np.floor(turn + 0.5))
    return np.asarray(effect.amplitude * strength * ((1 + np.cos(2 * np.pi * turn)) / 2) ** 3)


@drawn(amplitude=signed(0.3, 0.6), every_s=(600.0, 1000.0), share=(0.15, 0.3))
@hidden_form("stiffness", "tissue_ageing", "root of time, wetted", TISSUE_RUNS)
def ageing_root(effect: HiddenEffect, plan: RunPlan) -> float:
    """Stiffness drifts with the root of the session's time, and is reset in part whenever the gut is wetted."""
    lasting, dried = (plan.start_s / 3000.0) ** 0.5, (plan.start_s / effect.every_s) % 1.0
    return float(1 + effect.amplitude * ((1 - effect.share) * lasting + effect.share * dried))


@drawn(amplitude=signed(0.25, 0.5), power=(1.2, 2.0), swing=(0.1, 0.2), period_s=(500.0, 1000.0))
@hidden_form("stiffness", "tissue_ageing", "late, swings", TISSUE_RUNS)
def ageing_late(effect: HiddenEffect, plan: RunPlan) -> float:
    """Stiffness drifts slowly at first and faster later on, modulated by the room's temperature."""
    swung = 1 + effect.swing * np.sin(2 * np.pi * plan.start_s / effect.period_s)
    return float(1 + effect.amplitude * (plan.start_s / 3000.0) ** effect.power * swung)


@drawn(amplitude=signed(0.25, 0.5), middle_s=(900.0, 2000.0), width_s=(400.0, 750.0))
@hidden_form("stiffness", "tissue_ageing", "change-over", TISSUE_RUNS)
def ageing_turn(effect: HiddenEffect, plan: RunPlan) -> float:
    """Stiffness changes from one value to another about a time within the session."""
    now, start = (1 / (1 + np.exp(-(t - effect.middle_s) / effect.width_s)) for t in (plan.start_s, 0.0))
    return float(1 + effect.amplitude * (now - start) / (1 - start))


@drawn(amplitude=(0.35, 0.7), runs=(1.5, 4.0), power=(1.0, 2.0), grows=(0.3, 0.6))
@hidden_form("stiffness", "preconditioning", "rational, grows with strain", TISSUE_RUNS)
def preconditioning_rational(effect: HiddenEffect, plan: RunPlan) -> float:
    """A fresh specimen is stiffer, more so at larger strain; the excess fades with the run count."""
    fresh = (1.0 if plan.strain is None else plan.strain) ** effect.grows
    return float(1 + effect.amplitude * fresh / (1 + (plan.order / effect.runs) ** effect.power))


@drawn(amplitude=(0.35, 0.7), runs=(2.0, 9.0))
@hidden_form("stiffness", "preconditioning", "Gaussian of run count", TISSUE_RUNS)
def preconditioning_bell(effect: HiddenEffect, plan: RunPlan) -> float:
    """The stiffness of a fresh specimen fades as a Gaussian of the run count."""
    return float(1 + effect.amplitude * np.exp(-((plan.order / effect.runs) ** 2)))


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
    return (1 - effect.amplitude) * direction + effect.amplitude * built / (1 + run.held_s / effect.half_s)


@drawn(amplitude=(0.35, 0.9), slip_mm=in_log(0.08, 0.4), creep=(0.12, 0.19))
@hidden_form("grip", "presliding", "straight line with creep", SLIDING_RUNS)
def presliding_creep(effect: HiddenEffect, direction: Floats, run: RunConditions) -> Floats:
    """Friction builds up in a straight line over the slip, stays at standstill, and creeps off."""
    built = np.clip(run.motion.p / effect.slip_mm, 0.0, 1.0)
    return (1 - effect.amplitude) * direction + effect.amplitude * built * (
        1 - effect.creep * np.log1p(run.held_s / 0.05)
    )


@drawn(amplitude=(0.45, 0.95), slip_mm=in_log(0.06, 0.3), stays=(0.4, 0.7), release_s=(0.3, 0.9))
@hidden_form("grip", "presliding", "root with release", SLIDING_RUNS)
def presliding_release(effect: HiddenEffect, direction: Floats, run: RunConditions) -> Floats:
    """Friction builds up as s / √(s² + l²); at standstill part of it springs back and the rest stays."""
    slip = np.maximum(run.motion.p, 0.0)
    built = slip / np.hypot(slip, effect.slip_mm)
    left = effect.stays + (1 - effect.stays) * np.exp(-run.held_s / effect.release_s)
    return (1 - effect.amplitude) * direction + effect.amplitude * built * left


# Effects that the catalogue does not have.


@drawn(amplitude=(10.0, 25.0), slip_mm=in_log(0.15, 0.6), speed_mm_s=(2.0, 4.0))
@hidden_form("pull", "stick_slip", "irregular saw", SLIDING_RUNS)
def stick_slip(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """At low speed the capsule sticks and slips by random lengths."""
    p = run.motion.p
    lengths = effect.slip_mm * run.random("stick").gamma(4.0, 0.25, int(p.max() / effect.slip_mm * 2) + 20)
    edges = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.clip(np.searchsorted(edges, p, side="right") - 1, 0, lengths.size - 1)
    part = (p - edges[at]) / lengths[at]
    slow = np.exp(-((run.speed / effect.speed_mm_s) ** 4)) * (run.speed > 0)
    return np.asarray(effect.amplitude * (lengths[at] / effect.slip_mm) * (part - 0.5) * slow)


@drawn(amplitude=(12.0, 28.0), speed_mm_s=(7.0, 14.0), width=(0.25, 0.5))
@hidden_form("pull", "foam_resonance", "peak in ln v", DRAG_RUNS)
def foam_resonance(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Extra force inside one band of speed, where the foam resonates."""
    off = np.log(np.maximum(run.speed, 1e-6) / effect.speed_mm_s) / effect.width
    return np.asarray(effect.amplitude * run.direction * np.exp(-(off**2)))


@drawn(amplitude=(12.0, 30.0), place_mm=(8.0, 24.0), width_mm=(0.8, 2.5))
@hidden_form("pull", "wall_seam", "single bump", DRAG_RUNS)
def wall_seam(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """A seam in the wall: one bump at one position."""
    return np.asarray(effect.amplitude * np.exp(-(((run.motion.p - effect.place_mm) / effect.width_mm) ** 2)))


@drawn(amplitude=(10.0, 25.0), time_s=(0.5, 2.0))
@hidden_form("pull", "suction", "grows at standstill", DRAG_RUNS)
def suction(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Suction that grows while the capsule stands and breaks as it moves."""
    t, (go, _, _, stop) = run.motion.t, run.plan.bounds_s
    standing = np.where(t < go, t, np.maximum(t - stop, 0.0))
    return np.asarray(-effect.amplitude * (1 - np.exp(-((standing / effect.time_s) ** 1.5))))
