"""Every effect of the catalogue with a law drawn at random, and effects outside it by random combination.

A form keeps the catalogue's facts about its effect: where it acts, of which coordinate it is a function, and whether
that function is monotone, periodic or fading. All else is drawn: the function, the force that it scales, and when it
acts.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dragrig.sim_backend.blind import Floats, RunPlan, SampledMotion
from dragrig.sim_backend.blind.effects.hidden_effect import (
    DRAG_RUNS,
    SLIDING_RUNS,
    TISSUE_RUNS,
    CapsuleForces,
    DrawnFrom,
    HiddenEffect,
    OneOf,
    RunConditions,
    delayed,
    drawn,
    first_order,
    hidden_form,
    in_log,
    low_pass,
    play_operator,
    resonance,
    signed,
)
from dragrig.sim_backend.blind.effects.random_laws import (
    LawFamily,
    faded,
    fading,
    hump,
    periodic,
    pulses,
    rising,
    rising_late,
    rising_soft,
    steps,
    wandering,
)

ANY_LAW = "drawn"
"""What the forms of this plant are called: they have no other name than their parameters and values."""
TYPICAL_ELASTIC_MN, TYPICAL_MN = 50.0, 105.0
"""The elastic force and all of it in a drag run at 5 to 20 mm/s, by which what scales with them is normalised."""


def in_motion(run: RunConditions, speed_mm_s: float = 0.1) -> Floats:
    """Return 0 at standstill and 1 beyond a small speed."""
    return np.asarray(-np.expm1(-((run.speed / speed_mm_s) ** 2)))


def scaled(effect: HiddenEffect, forces: CapsuleForces) -> Floats:
    """Return the factor of a drawn law, about 1: `on` is 0 for the elastic force, 1 for all of it, 2 for 1."""
    whole = forces.elastic + forces.viscous + np.abs(forces.coulomb)
    return (forces.elastic / TYPICAL_ELASTIC_MN, whole / TYPICAL_MN, np.ones_like(whole))[int(effect.on)]


@drawn(
    amplitude=(0.7, 1.0),
    begin_mm_s=(5.0, 15.0),
    reach=(0.55, 1.0),
    late_s=in_log(0.005, 0.15),
    speeds=rising,
    front=fading,
)
class LiftOffDrawn(HiddenEffect):
    """Contact is lost from the front, the more the faster; profile, law of speed and delay are drawn."""

    name, form, kinds = "wall_lift_off", ANY_LAW, DRAG_RUNS

    def passing(self, run: RunConditions) -> Floats:
        return first_order(run.speed, self.late_s, run.motion.t)

    def contact(self, where: Floats, speed: Floats) -> Floats:
        opened = self.laws["speeds"]((speed - self.begin_mm_s) / (60.0 - self.begin_mm_s))
        profile = 1 - self.laws["front"](1 - np.clip(where / self.reach, 0.0, 1.0))
        return np.asarray(1 - self.amplitude * opened * profile)


@drawn(amplitude=(20.0, 50.0), power=(1.7, 2.6), bent=signed(0.0, 0.5), law=rising_soft, on=OneOf((0.3, 0.0, 0.7)))
@hidden_form("pull", "wall_inertia", ANY_LAW, DRAG_RUNS)
def inertia_drawn(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Add a force that grows about with the square of speed, alone or with the wall's elastic force."""
    part = run.speed / 60.0
    growth = part**effect.power * (1 + effect.bent * (effect.laws["law"](part) - 0.5))
    return np.asarray(effect.amplitude * run.direction * growth * scaled(effect, forces))


@drawn(amplitude=(0.35, 0.8), slower=(0.1, 0.8), late=rising_late, even=rising, steep=OneOf((0.4, 0.6)))
@hidden_form("branches", "hyperelastic_wall", ANY_LAW, TISSUE_RUNS)
def hyperelastic_drawn(effect: HiddenEffect, strain: Floats) -> tuple[Floats, Floats, Floats]:
    """Moduli grow with strain, often far more steeply at its end, fast branches more than the spring."""
    grown = effect.laws["late" if effect.steep else "even"](strain / 2.0)
    more = effect.amplitude * (1.3 if effect.steep else 1.0) * grown
    return 1 + more, 1 + more * effect.slower**0.5, 1 + more * effect.slower


@drawn(amplitude=(0.2, 0.5), half_s=in_log(1.5, 12.0), grows=(-0.3, 0.8), faster=(0.0, 1.0), law=fading)
@hidden_form("tail", "extra_relaxation", ANY_LAW, TISSUE_RUNS)
def relaxation_drawn(effect: HiddenEffect, age_s: Floats, strain: Floats) -> Floats:
    """Stress that fades with age by a drawn law, faster and of another share at larger strain."""
    at = np.clip(strain, 0.1, 2.5)
    return np.asarray(
        effect.amplitude * at**effect.grows * faded(effect.laws["law"], age_s / effect.half_s * at**effect.faster)
    )


@drawn(
    amplitude=(0.4, 0.9),
    half_mm_s=in_log(1.2, 6.0),
    power=(0.8, 2.0),
    law=fading,
    on=OneOf((0.6, 0.4)),
    film_mm=in_log(0.3, 3.0),
)
@hidden_form("pull", "stribeck", ANY_LAW, SLIDING_RUNS)
def stribeck_drawn(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Friction falls with speed by a drawn law; it may need some travel until the film is drawn in."""
    film = -np.expm1(-np.maximum(run.motion.p, 0.0) / effect.film_mm) if effect.on else 1.0
    speed = (run.speed / effect.half_mm_s) ** effect.power
    return np.asarray(forces.coulomb * effect.amplitude * faded(effect.laws["law"], speed * film))


@drawn(amplitude=(0.4, 1.0), slip_mm=in_log(0.08, 0.5), law=fading, on=OneOf((0.7, 0.3)))
@hidden_form("pull", "breakaway", ANY_LAW, SLIDING_RUNS)
def breakaway_drawn(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Extra friction of an aged contact that is lost over a short slip."""
    size = (
        np.abs(forces.coulomb)
        if effect.on == 0
        else np.full_like(forces.coulomb, float(np.max(np.abs(forces.coulomb))))
    )
    return np.asarray(
        effect.amplitude * size * run.direction * faded(effect.laws["law"], run.motion.p / effect.slip_mm)
    )


@drawn(
    amplitude=(0.4, 0.95),
    slip_mm=in_log(0.05, 0.4),
    law=fading,
    lost=(0.0, 0.8),
    half_s=in_log(0.3, 4.0),
    release=fading,
)
@hidden_form("grip", "presliding", ANY_LAW, SLIDING_RUNS)
def presliding_drawn(effect: HiddenEffect, direction: Floats, run: RunConditions) -> Floats:
    """Friction builds up over a deflection and stays locked in at standstill, part of which may be lost in time."""
    built = 1 - faded(effect.laws["law"], np.maximum(run.motion.p, 0.0) / effect.slip_mm)
    left = 1 - effect.lost * (1 - faded(effect.laws["release"], run.held_s / effect.half_s))
    return np.asarray((1 - effect.amplitude) * direction + effect.amplitude * built * left)


@drawn(amplitude=(14.0, 36.0), half_mm_s=in_log(1.5, 10.0), power=(0.8, 1.8), law=fading)
@hidden_form("pull", "adhesion", ANY_LAW, DRAG_RUNS)
def adhesion_drawn(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Tack of its own size, weaker with speed by a drawn law."""
    return np.asarray(
        effect.amplitude * run.direction * faded(effect.laws["law"], (run.speed / effect.half_mm_s) ** effect.power)
    )


@drawn(amplitude=(0.4, 0.95), law=rising, on=OneOf((0.7, 0.3)))
@hidden_form("pull", "film_depletion", ANY_LAW, SLIDING_RUNS)
def film_drawn(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Friction grows with distance, in the Coulomb part alone or in the viscous part too."""
    part = forces.coulomb + (forces.viscous if effect.on else 0.0)
    return np.asarray(effect.amplitude * part * effect.laws["law"](run.motion.p / effect.stroke_mm))


@drawn(
    amplitude=(4.0, 11.0),
    period_mm=in_log(2.5, 10.0),
    phase=(0.0, 1.0),
    wander=(0.0, 0.05),
    law=periodic,
    on=OneOf((0.5, 0.25, 0.25)),
    gate=OneOf((0.6, 0.4)),
)
@hidden_form("pull", "folds", ANY_LAW, DRAG_RUNS)
def folds_drawn(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Force periodic in position: of the elastic force, of all of it, or of its own size; also only in motion."""
    p = run.motion.p
    turn = p / effect.period_mm + effect.phase + effect.wander * np.sin(2 * np.pi * p / 33.0)
    gate = in_motion(run) if effect.gate else 1.0
    return np.asarray(effect.amplitude * scaled(effect, forces) * effect.laws["law"](turn) * gate)


@drawn(
    amplitude=(14.0, 36.0),
    begin=(0.2, 0.6),
    law=rising,
    on=OneOf((0.2, 0.0, 0.8)),
    lost=(0.0, 0.5),
    half_s=in_log(0.3, 3.0),
)
@hidden_form("pull", "mesentery_tether", ANY_LAW, DRAG_RUNS)
def tether_drawn(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Add a pull that grows beyond some position, and may relax while the capsule is held."""
    begin = effect.begin * effect.stroke_mm
    grown = effect.laws["law"]((run.motion.p - begin) / (effect.stroke_mm - begin))
    held = run.held_s / effect.half_s
    size = scaled(effect, forces)
    return np.asarray(effect.amplitude * size * grown * (1 - effect.lost * held / (1 + held)))


@drawn(
    amplitude=(8.0, 20.0),
    period_s=in_log(3.0, 9.0),
    phase=(0.0, 1.0),
    wander=(0.0, 0.06),
    law=pulses,
    on=OneOf((0.3, 0.1, 0.6)),
)
@hidden_form("pull", "peristalsis", ANY_LAW, DRAG_RUNS)
def peristalsis_drawn(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Pulses periodic in the session's time, while holding too."""
    turn = run.session_s / effect.period_s + effect.phase
    beat = effect.laws["law"](turn + effect.wander * np.sin(1.9 * turn))
    return np.asarray(effect.amplitude * scaled(effect, forces) * beat)


@drawn(amplitude=signed(0.3, 0.6), law=rising, on=OneOf((0.5, 0.25, 0.25)), share=(0.4, 1.0))
class AgeingDrawn(HiddenEffect):
    """Stiffness drifts with the session's time; of drags it may scale friction too, or all of the force."""

    name, form, kinds = "tissue_ageing", ANY_LAW, TISSUE_RUNS

    def stiffness(self, plan: RunPlan) -> float:
        return float(1 + self.amplitude * self.laws["law"](plan.session_s / self.session_s))

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        # What is not elastic has not been scaled by the stiffness; the normal force behind the friction has.
        change = self.stiffness(run.plan) - 1
        extra = (0.0, self.share * forces.viscous, self.share * (forces.viscous + forces.coulomb))
        return change * extra[int(self.on)]


@drawn(amplitude=(0.35, 0.75), half=in_log(1.5, 5.0), grows=(-0.2, 0.6), law=fading, on=OneOf((0.7, 0.3)))
class PreconditioningDrawn(HiddenEffect):
    """A fresh specimen is stiffer, and the excess fades with the run count."""

    name, form, kinds = "preconditioning", ANY_LAW, TISSUE_RUNS

    def stiffness(self, plan: RunPlan) -> float:
        fresh = (1.0 if plan.strain is None else plan.strain) ** self.grows
        return float(1 + self.amplitude * fresh * faded(self.laws["law"], np.array(plan.order / self.half)))

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        return (self.stiffness(run.plan) - 1) * forces.viscous if self.on else 0.0


@drawn(amplitude=signed(5.0, 14.0), span_s=in_log(8.0, 40.0), law=rising_soft, spread=(0.0, 0.35))
@hidden_form("sensor", "force_drift", ANY_LAW, rank=2)
def drift_drawn(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Zero that creeps one way during a run, somewhat differently in every run."""
    own = 1 + effect.spread * run.random("drift").uniform(-1.7, 1.7)
    crept = effect.laws["law"](-np.expm1(-run.motion.t / effect.span_s))
    return np.asarray(force + effect.amplitude * own * crept)


@drawn(amplitude=signed(0.05, 0.12), full_mN=(700.0, 1800.0), law=rising)
@hidden_form("sensor", "force_nonlinearity", ANY_LAW, rank=2)
def nonlinearity_drawn(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Gain that changes one way with load, alike for push and pull."""
    return np.asarray(force * (1 + effect.amplitude * effect.laws["law"](np.abs(force) / effect.full_mN)))


@drawn(
    amplitude=(4.0, 11.0),
    widths=rising,
    creeps=(0.0, 0.5),
    time_s=in_log(1.0, 6.0),
    plays=OneOf((0.2, 0.2, 0.2, 0.2, 0.2)),
)
@hidden_form("sensor", "force_hysteresis", ANY_LAW, rank=1)
def hysteresis_drawn(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Play in the force chain: one or several of drawn widths, part of which may creep back."""
    count = int(effect.plays) + 1
    halves = effect.amplitude * (0.3 + 1.4 * effect.laws["widths"]((np.arange(count) + 0.5) / count))
    held = np.mean([play_operator(force, half) for half in halves.tolist()], axis=0)
    behind = force - held
    return np.asarray(force - behind + effect.creeps * first_order(behind, effect.time_s, run.motion.t))


@drawn(amplitude=(2.5, 6.0), mains=OneOf((0.6, 0.4)), law=periodic, swell=(0.0, 0.5), swell_hz=in_log(0.05, 0.6))
@hidden_form("sensor", "mains_hum", ANY_LAW, rank=2)
def hum_drawn(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Mains pick-up with drawn harmonics, at another phase in every run; its strength may swell."""
    random, t = run.random("hum"), run.motion.t
    hertz = (60.0 if effect.mains else 50.0) + 0.03 * random.standard_normal()
    first, second = random.random(2).tolist()
    strength = 1 + effect.swell * np.sin(2 * np.pi * (effect.swell_hz * t + second))
    return np.asarray(force + effect.amplitude * strength * effect.laws["law"](hertz * t + first))


@drawn(
    amplitude=(15.0, 40.0),
    law=rising_soft,
    bent=signed(0.0, 0.3),
    uneven=signed(0.0, 0.3),
    time_s=in_log(0.0005, 0.006),
)
@hidden_form("sensor", "payload_inertia", ANY_LAW)
def payload_drawn(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Mass times acceleration [g], bent, unlike when slowing down, and through a coupling that is not quite stiff."""
    a = low_pass(run.motion.a, effect.time_s, 1.0, run.motion.t)
    full = max(float(np.abs(a).max()), 1.0)
    bent = 1 + effect.bent * (effect.laws["law"](np.abs(a) / full) - 0.5) + effect.uneven * np.sign(a) / 2
    return np.asarray(force + effect.amplitude / 1000 * a * bent)


@drawn(
    amplitude=(15.0, 45.0),
    hertz=in_log(10.0, 40.0),
    damping=in_log(0.02, 0.10),
    modes=OneOf((0.4, 0.3, 0.3)),
    ratio=(1.4, 2.8),
    second=(0.1, 0.5),
    uneven=(0.5, 2.0),
)
@hidden_form("sensor", "arm_compliance", ANY_LAW)
def compliance_drawn(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Let an arm ring after every jerk, in one to three modes, unlike when speeding up and slowing down."""
    t, total, weights = run.motion.t, np.zeros_like(force), 0.0
    for mode in range(int(effect.modes) + 1):
        hertz, weight = effect.hertz * effect.ratio**mode, effect.second**mode
        for part, damping in (
            (np.maximum(run.motion.a, 0.0), effect.damping),
            (np.minimum(run.motion.a, 0.0), effect.damping * effect.uneven),
        ):
            total = total + weight * resonance(part, hertz, damping, t)
        weights += weight
    return np.asarray(force + effect.amplitude / 1000 * total / weights)


@drawn(
    amplitude=in_log(0.030, 0.110),
    dead=(0.0, 0.5),
    damping=(0.55, 1.4),
    creeps=(0.0, 0.3),
    creep_s=in_log(0.3, 3.0),
    grows=signed(0.0, 0.6),
)
@hidden_form("motion", "servo_lag", ANY_LAW, channel="position")
def lag_drawn(effect: HiddenEffect, motion: SampledMotion, run: RunConditions) -> SampledMotion:
    """Let the stage lag and overshoot: dead time, two poles and a creeping share, by its speed."""
    t, lag = motion.t, effect.amplitude * (run.plan.peak_mm_s / 20.0) ** effect.grows
    time_s = max((1 - effect.dead) * lag / (2 * effect.damping), 1e-4)

    def follow(values: Floats) -> Floats:
        fast = low_pass(delayed(values, effect.dead * lag, t), time_s, effect.damping, t)
        share = effect.creeps * effect.amplitude
        return (1 - share) * fast + share * first_order(values, effect.creep_s, t)

    return SampledMotion(t, follow(motion.p), follow(motion.v), follow(motion.a))


@drawn(
    amplitude=in_log(0.015, 0.060),
    period_mm=in_log(1.5, 9.0),
    phase=(0.0, 1.0),
    law=periodic,
    gate=OneOf((0.35, 0.4, 0.25)),
    settle_s=in_log(0.02, 0.3),
    begin_mm_s=(1.0, 8.0),
)
@hidden_form("motion", "velocity_ripple", ANY_LAW, channel="position")
def ripple_drawn(effect: HiddenEffect, motion: SampledMotion, run: RunConditions) -> SampledMotion:
    """Position error periodic in position: at all times, only in motion, or only above some speed."""
    t, speed = motion.t, np.abs(motion.v)
    gates = (
        np.ones_like(t),
        first_order((speed > 0.01).astype(np.float64), effect.settle_s, t),
        first_order(1 / (1 + (effect.begin_mm_s / np.maximum(speed, 1e-9)) ** 4), effect.settle_s, t),
    )
    wave = effect.laws["law"](motion.p / effect.period_mm + effect.phase)
    error = effect.amplitude * (wave - wave[0]) * gates[int(effect.gate)]
    v = np.gradient(error, t)
    return SampledMotion(t, motion.p + error, motion.v + v, motion.a + np.gradient(v, t))


@drawn(
    amplitude=DrawnFrom(0.006, 0.020, log=True, signed=True),
    spread=(0.0, 0.5),
    grows=(0.0, 0.6),
    law=rising,
    smears=(0.0, 0.8),
)
@hidden_form("sensor", "channel_latency", ANY_LAW, rank=3, channel="either")
def latency_drawn(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Force and position are not of one instant: by a time that varies, grows or is smeared over samples."""
    t = run.motion.t
    own = effect.amplitude * (1 + effect.spread * run.random("latency").uniform(-1.0, 1.0))
    late = own * (1 + effect.grows * (effect.laws["law"](t / max(float(t[-1]), 1e-9)) - 0.5))
    taps = np.linspace(-0.5, 0.5, 5) * effect.smears * effect.amplitude
    return np.asarray(np.mean([delayed(force, late + tap, t) for tap in taps.tolist()], axis=0))


@drawn(
    amplitude=DrawnFrom(0.002, 0.012, log=True, signed=True),
    law=rising_soft,
    warming=(0.0, 0.6),
    half_s=in_log(200.0, 2000.0),
)
@hidden_form("position", "encoder_scale", ANY_LAW, channel="position")
def scale_drawn(effect: HiddenEffect, position: Floats, force: Floats, run: RunConditions) -> Floats:
    """Count with an error that grows with travel, less when the scale is warm."""
    part = position / effect.stroke_mm
    grown = effect.stroke_mm * (effect.laws["law"](part) + np.minimum(part, 0.0) + np.maximum(part - 1, 0.0))
    warm = 1 - effect.warming * run.session_s / (run.session_s + effect.half_s)
    return np.asarray(position + effect.amplitude * grown * warm)


@dataclass(frozen=True, slots=True)
class Combination:
    """Where an effect outside the catalogue acts, its coordinate, and the kind of its function of that."""

    place: str
    coordinate: str
    course: str
    while_: str = "always"


SENSOR = (
    *(Combination("zero", "position", course) for course in ("rise", "hump", "wave", "levels", "wander")),
    *(Combination("zero", "position", course, "in motion") for course in ("wave", "wander")),
    *(Combination("zero", "speed", course) for course in ("rise", "hump")),
    Combination("zero", "time in motion", "hump", "in motion"),
    Combination("zero", "time held", "rise"),
    Combination("zero", "session", "wave"),
    *(Combination("gain", "position", course) for course in ("wave", "levels", "wander")),
    *(Combination("gain", "position", course, "in motion") for course in ("levels", "wander")),
    *(Combination("gain", "speed", course) for course in ("rise", "hump")),
    Combination("gain", "run", "levels"),
)
GUT = (
    *(Combination("capsule", "position", course) for course in ("hump", "wander", "levels")),
    Combination("capsule", "position", "wander", "in motion"),
    Combination("capsule", "speed", "hump"),
    Combination("capsule", "time held", "rise"),
    Combination("capsule", "time in motion", "hump"),
    *(Combination("friction", "position", course) for course in ("hump", "wave", "wander")),
    *(Combination("friction", "speed", course) for course in ("hump", "rise")),
    Combination("friction", "session", "wave"),
)
ENCODER = (
    Combination("encoder", "time", "rise"),
    Combination("encoder", "time in motion", "hump"),
    Combination("encoder", "position", "levels"),
    Combination("encoder", "load", "rise"),
    Combination("encoder", "time held", "rise"),
    Combination("encoder", "session", "wave"),
)
"""What no effect of the catalogue is: monotone laws of speed on the capsule, for instance, are, and are left out."""
PLACE_SIZES = {"zero": 20.0, "gain": 0.25, "capsule": 28.0, "friction": 0.8, "encoder": 0.3}
"""Of amplitude 1: mN, relative, mN, relative, mm."""
_FOREIGN: Mapping[str, DrawnFrom | OneOf | LawFamily] = {
    "amplitude": signed(0.4, 1.0),
    "combination": DrawnFrom(0.0, 1.0),
    "period_mm": in_log(2.5, 12.0),
    "period_s": in_log(4.0, 20.0),
    "time_s": in_log(0.4, 3.0),
    "phase": DrawnFrom(0.0, 1.0),
    "rise": rising,
    "hump": hump,
    "wave": periodic,
    "levels": steps,
    "wander": wandering,
}


class OutsideDrawn(HiddenEffect):
    """An effect that the catalogue does not have: a place, a coordinate and a course, combined at random."""

    form, ranges = ANY_LAW, _FOREIGN
    combinations: ClassVar[tuple[Combination, ...]]

    @property
    def combined(self) -> Combination:
        """The combination that was drawn."""
        return self.combinations[int(self.combination * len(self.combinations))]

    @property
    def described(self) -> str:
        one = self.combined
        return f"{one.place} by {one.coordinate}, {one.course}, {one.while_}"

    def change(self, place: str, force: Floats, run: RunConditions) -> Floats | float:
        """Return the addition at a place, shape `(N,)`; 0 where this effect does not act."""
        one = self.combined
        if one.place != place:
            return 0.0
        along = self._coordinate(one, force, run)
        gate = in_motion(run) if one.while_ == "in motion" else 1.0
        return np.asarray(self.amplitude * PLACE_SIZES[place] * self.laws[one.course](along) * gate)

    def _coordinate(self, one: Combination, force: Floats, run: RunConditions) -> Floats:
        t, p, (go, _, _, stop) = run.motion.t, run.motion.p, run.plan.bounds_s
        coordinates: Mapping[str, Floats] = {
            "position": p / self.period_mm + self.phase if one.course == "wave" else p / self.stroke_mm,
            "speed": np.log(np.maximum(run.speed, 1e-9) / 0.4) / np.log(80.0 / 0.4),
            "session": run.session_s / self.period_s + self.phase,
            "time": t / 20.0,
            "time in motion": np.clip((t - go) / (stop - go), 0.0, 1.0),
            "time held": run.held_s / self.time_s,
            "load": np.abs(force) / 1000.0,
            "run": np.full_like(t, run.random("level").random()),
        }
        return coordinates[one.coordinate]


class OutsideSensorDrawn(OutsideDrawn):
    """An effect outside the catalogue in the force sensor: its zero or its gain."""

    name, rank, combinations = "outside", 2, SENSOR
    weight = float(len(SENSOR))

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        return force * (1 + self.change("gain", force, run)) + self.change("zero", force, run)


class OutsideGutDrawn(OutsideDrawn):
    """An effect outside the catalogue between gut and capsule: a force, or a change of friction."""

    name, kinds, combinations = "outside", SLIDING_RUNS, GUT
    weight = float(len(GUT))

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        held = self.change("capsule", forces.elastic, run) if run.plan.kind == "drag" else 0.0
        return held + forces.coulomb * self.change("friction", forces.elastic, run)


class OutsideEncoderDrawn(OutsideDrawn):
    """An effect outside the catalogue in the encoder."""

    name, channel, combinations = "outside", "position", ENCODER
    weight = float(len(ENCODER))

    def position(self, position: Floats, force: Floats, run: RunConditions) -> Floats:
        return position + self.change("encoder", force, run)
