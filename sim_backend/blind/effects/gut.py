"""Hidden effects of the gut: wall, folds, mesentery, contractions, and changes over a session."""

from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.hidden_effect import (
    DRAG_RUNS,
    TISSUE_RUNS,
    CapsuleForces,
    DrawnFrom,
    DrawnPhase,
    HiddenEffect,
    RunConditions,
    first_order,
)
from dragrig.sim_backend.blind.run_plans import Floats, RunPlan


class LiftOffFade(HiddenEffect):
    """The front part of the contact carries less as speed grows, and comes back late once the capsule slows down."""

    name, form, kinds = "wall_lift_off", "front fades, comes back late", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(0.7, 1.0)]
    speed_mm_s: Annotated[float, DrawnFrom(15.0, 30.0)]
    power: Annotated[float, DrawnFrom(2.0, 4.0)]
    front: Annotated[float, DrawnFrom(0.45, 0.75)]
    back_s: Annotated[float, DrawnFrom(0.08, 0.2, log=True)]

    def passing(self, run: RunConditions) -> Floats:
        t = run.motion.t
        log_speed = np.log(np.maximum(run.speed, 1e-9))
        return np.asarray(np.exp(np.maximum.accumulate(log_speed + t / self.back_s) - t / self.back_s))

    def contact(self, where: Floats, speed: Floats) -> Floats:
        edge = 1 / (1 + np.exp((where - self.front) / 0.04))
        return np.asarray(1 - self.amplitude * edge * (1 - 1 / (1 + (speed / self.speed_mm_s) ** self.power)))


class LiftOffPeel(HiddenEffect):
    """The contact peels from the front, over a distance, up to a place that moves back with speed."""

    name, form, kinds = "wall_lift_off", "front peels over a distance", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(0.55, 0.9)]
    speed_mm_s: Annotated[float, DrawnFrom(8.0, 14.0)]
    power: Annotated[float, DrawnFrom(0.6, 1.2)]
    distance_mm: Annotated[float, DrawnFrom(1.5, 4.0)]

    def passing(self, run: RunConditions) -> Floats:
        return np.asarray(run.speed * -np.expm1(-np.maximum(run.motion.p, 0.0) / self.distance_mm))

    def contact(self, where: Floats, speed: Floats) -> Floats:
        part = np.maximum(speed - self.speed_mm_s, 0.0) / (60.0 - self.speed_mm_s)
        lost = self.amplitude * part**self.power
        return np.asarray(1 - np.clip((lost - where) / 0.06 + 0.5, 0.0, 1.0) * np.minimum(lost / 0.06, 1.0))


class LiftOffHollow(HiddenEffect):
    """A hollow opens at the front beyond a speed, deepest where contact begins; it opens and closes sluggishly."""

    name, form, kinds = "wall_lift_off", "sluggish hollow", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(0.7, 1.0)]
    begin_mm_s: Annotated[float, DrawnFrom(6.0, 12.0)]
    width_mm_s: Annotated[float, DrawnFrom(10.0, 20.0)]
    reach: Annotated[float, DrawnFrom(0.6, 0.95)]
    time_s: Annotated[float, DrawnFrom(0.03, 0.07, log=True)]

    def passing(self, run: RunConditions) -> Floats:
        return first_order(run.speed, self.time_s, run.motion.t)

    def contact(self, where: Floats, speed: Floats) -> Floats:
        opened = 1 - np.exp(-((np.maximum(speed - self.begin_mm_s, 0.0) / self.width_mm_s) ** 2))
        depth = np.sqrt(np.maximum(1 - (where / self.reach) ** 2, 0.0))
        return np.asarray(1 - self.amplitude * opened * depth)


class InertiaPower(HiddenEffect):
    """A force that grows faster than the square of speed."""

    name, form, kinds = "wall_inertia", "power above two", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(20.0, 50.0)]
    power: Annotated[float, DrawnFrom(2.7, 3.4)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        return np.asarray(self.amplitude * run.direction * (run.speed / 60.0) ** self.power)


class InertiaBending(HiddenEffect):
    """A force with the square of speed that turns linear at high speed."""

    name, form, kinds = "wall_inertia", "square that bends over", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(20.0, 50.0)]
    speed_mm_s: Annotated[float, DrawnFrom(12.0, 40.0)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        v, bend = run.speed, self.speed_mm_s
        return np.asarray(self.amplitude * run.direction * (v / 60.0) ** 2 * (1 + 60.0 / bend) / (1 + v / bend))


class HyperelasticLock(HiddenEffect):
    """Moduli grow with a power of strain, fast branches more than the spring."""

    name, form, kinds = "hyperelastic_wall", "power of strain", TISSUE_RUNS
    amplitude: Annotated[float, DrawnFrom(0.3, 0.7)]
    power: Annotated[float, DrawnFrom(1.6, 3.5)]
    slower: Annotated[float, DrawnFrom(0.2, 0.7)]

    def branches(self, strain: Floats) -> tuple[Floats, Floats, Floats]:
        more = self.amplitude * (np.maximum(strain, 0.0) / 2) ** self.power
        return 1 + more, 1 + more * self.slower, 1 + more * self.slower**2


class HyperelasticKink(HiddenEffect):
    """Moduli grow while fibres straighten, between two strains."""

    name, form, kinds = "hyperelastic_wall", "straightened fibres", TISSUE_RUNS
    amplitude: Annotated[float, DrawnFrom(0.25, 0.55)]
    strain: Annotated[float, DrawnFrom(0.5, 0.9)]
    span: Annotated[float, DrawnFrom(0.4, 0.8)]
    slower: Annotated[float, DrawnFrom(0.2, 0.7)]

    def branches(self, strain: Floats) -> tuple[Floats, Floats, Floats]:
        low, high = (np.logaddexp(0.0, (strain - at) / 0.05) * 0.05 for at in (self.strain, self.strain + self.span))
        more = self.amplitude * (low - high) / self.span
        return 1 + more, 1 + more * self.slower, 1 + more * self.slower**2


class HyperelasticBent(HiddenEffect):
    """Moduli that grow steeply about one strain and less beyond it, in the fast branches alone."""

    name, form, kinds = "hyperelastic_wall", "steep about one strain", TISSUE_RUNS
    amplitude: Annotated[float, DrawnFrom(0.3, 0.6)]
    strain: Annotated[float, DrawnFrom(1.0, 1.7)]
    power: Annotated[float, DrawnFrom(2.5, 5.0)]
    slower: Annotated[float, DrawnFrom(0.2, 0.7)]

    def branches(self, strain: Floats) -> tuple[Floats, Floats, Floats]:
        risen = (np.maximum(strain, 0.0) / self.strain) ** self.power
        more = self.amplitude * risen / (1 + risen)
        return 1 + more, 1 + more * self.slower, np.ones_like(strain)


class RelaxationStretched(HiddenEffect):
    """Stress that fades as a stretched exponential of age, the faster the further the wall is strained."""

    name, form, kinds = "extra_relaxation", "stretched, faster with strain", TISSUE_RUNS
    amplitude: Annotated[float, DrawnFrom(0.2, 0.6)]
    time_s: Annotated[float, DrawnFrom(4.0, 15.0, log=True)]
    power: Annotated[float, DrawnFrom(0.45, 0.8)]
    faster: Annotated[float, DrawnFrom(0.6, 1.2)]

    def tail(self, age_s: Floats, strain: Floats) -> Floats:
        time_s = self.time_s * np.clip(strain, 0.2, 2.5) ** -self.faster
        return np.asarray(self.amplitude * np.exp(-((np.maximum(age_s, 0.0) / time_s) ** self.power)))


class RelaxationPower(HiddenEffect):
    """Stress that fades as a power of age, of a share that grows with strain."""

    name, form, kinds = "extra_relaxation", "power law, grows with strain", TISSUE_RUNS
    amplitude: Annotated[float, DrawnFrom(0.15, 0.45)]
    time_s: Annotated[float, DrawnFrom(1.5, 6.0, log=True)]
    power: Annotated[float, DrawnFrom(0.5, 1.2)]
    grows: Annotated[float, DrawnFrom(0.35, 0.65)]

    def tail(self, age_s: Floats, strain: Floats) -> Floats:
        share = self.amplitude * (np.maximum(strain, 0.0) / 1.2) ** self.grows
        return np.asarray(share * (1 + np.maximum(age_s, 0.0) / self.time_s) ** -self.power)


class RelaxationLog(HiddenEffect):
    """Stress that fades with the logarithm of age, to nothing at a last age, in wall strained beyond some strain."""

    name, form, kinds = "extra_relaxation", "logarithm, beyond a strain", TISSUE_RUNS
    amplitude: Annotated[float, DrawnFrom(0.2, 0.5)]
    time_s: Annotated[float, DrawnFrom(0.8, 3.0, log=True)]
    last_s: Annotated[float, DrawnFrom(60.0, 400.0, log=True)]
    strain: Annotated[float, DrawnFrom(0.03, 0.12)]

    def tail(self, age_s: Floats, strain: Floats) -> Floats:
        fall = np.log1p(np.maximum(age_s, 0.0) / self.time_s) / np.log1p(self.last_s / self.time_s)
        share = self.amplitude * np.maximum(strain - self.strain, 0.0) / (1.5 - self.strain)
        return np.asarray(share * np.maximum(1 - fall, 0.0))


class FoldsHarmonics(HiddenEffect):
    """Elastic resistance modulated in position with two harmonics."""

    name, form, kinds = "folds", "two harmonics", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(0.08, 0.20)]
    period_mm: Annotated[float, DrawnFrom(3.0, 8.0, log=True)]
    phase: DrawnPhase
    second: Annotated[float, DrawnFrom(0.10, 0.2)]
    second_phase: DrawnPhase

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        turn = 2 * np.pi * run.motion.p / self.period_mm
        wave = np.cos(turn + self.phase) + self.second * np.cos(2 * turn + self.second_phase)
        return np.asarray(self.amplitude * forces.elastic * wave)


class FoldsRidges(HiddenEffect):
    """Narrow ridges at equal distances, between which the wall is slack."""

    name, form, kinds = "folds", "ridges", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(0.10, 0.25)]
    period_mm: Annotated[float, DrawnFrom(3.0, 8.0, log=True)]
    phase: DrawnPhase
    sharpness: Annotated[float, DrawnFrom(0.5, 1.5)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        from scipy.special import i0e

        turn = 2 * np.pi * run.motion.p / self.period_mm + self.phase
        ridges = np.exp(self.sharpness * (np.cos(turn) - 1)) - i0e(self.sharpness)
        return np.asarray(self.amplitude * forces.elastic * ridges * (1 + self.sharpness / 2))


class FoldsWandering(HiddenEffect):
    """Folds whose distance changes along the gut, with straight flanks."""

    name, form, kinds = "folds", "wandering triangle", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(0.10, 0.25)]
    period_mm: Annotated[float, DrawnFrom(3.0, 8.0, log=True)]
    phase: DrawnPhase
    wander: Annotated[float, DrawnFrom(0.02, 0.05)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        p = run.motion.p
        turn = 2 * np.pi * p / self.period_mm + self.phase + 2 * np.pi * self.wander * np.sin(2 * np.pi * p / 33.0)
        return np.asarray(self.amplitude * forces.elastic * np.arcsin(np.sin(turn)) * 2 / np.pi)


class TetherPower(HiddenEffect):
    """A pull that grows with a power of the travel beyond a place, and relaxes while the capsule is held."""

    name, form, kinds = "mesentery_tether", "power, relaxes in the hold", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(12.0, 34.0)]
    place_mm: Annotated[float, DrawnFrom(12.0, 26.0)]
    power: Annotated[float, DrawnFrom(1.3, 2.8)]
    relaxes: Annotated[float, DrawnFrom(0.4, 0.7)]
    time_s: Annotated[float, DrawnFrom(0.4, 1.5)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        beyond = np.maximum(run.motion.p - self.place_mm, 0.0) / (40.0 - self.place_mm)
        held = np.maximum(run.motion.t - run.plan.bounds_s[3], 0.0)
        return np.asarray(self.amplitude * beyond**self.power * (1 + self.relaxes * np.expm1(-held / self.time_s)))


class TetherSoft(HiddenEffect):
    """A pull that stiffens gradually, as tissue that unfolds does, and gives way again and again."""

    name, form, kinds = "mesentery_tether", "soft onset, slips", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(12.0, 34.0)]
    place_mm: Annotated[float, DrawnFrom(15.0, 28.0)]
    width_mm: Annotated[float, DrawnFrom(2.0, 5.0)]
    step_mm: Annotated[float, DrawnFrom(6.0, 11.0)]
    slips: Annotated[float, DrawnFrom(0.4, 0.65)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        w, p = self.width_mm, run.motion.p
        grown, end = (np.logaddexp(0.0, (at - self.place_mm) / w) for at in (p, np.array(40.0)))
        taut = (grown - np.logaddexp(0.0, -self.place_mm / w)) / end
        turn = np.pi * (p - self.place_mm) / self.step_mm
        return np.asarray(self.amplitude * taut * (1 - self.slips * np.sin(turn) ** 4))


class TetherTwoStrands(HiddenEffect):
    """Two strands that come taut one after the other; the first gives way where the second comes taut."""

    name, form, kinds = "mesentery_tether", "two strands, one gives way", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(12.0, 34.0)]
    place_mm: Annotated[float, DrawnFrom(12.0, 19.0)]
    later_mm: Annotated[float, DrawnFrom(6.0, 10.0)]
    ratio: Annotated[float, DrawnFrom(0.5, 0.9)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:

        def taut(p: Floats) -> Floats:
            beyond = p - self.place_mm - self.later_mm
            first = np.clip(p - self.place_mm, 0.0, self.later_mm) / (1 + np.exp(np.clip((beyond - 1) / 0.3, -50, 50)))
            return np.asarray(first + self.ratio * np.maximum(beyond, 0.0))

        return np.asarray(self.amplitude * taut(run.motion.p) / taut(np.array(40.0)))


class PeristalsisPulses(HiddenEffect):
    """Pulses of a Gaussian shape at slightly irregular times of the session."""

    name, form, kinds = "peristalsis", "Gaussian pulses, early and late", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(7.0, 18.0)]
    period_s: Annotated[float, DrawnFrom(3.5, 8.0)]
    phase: DrawnPhase
    width: Annotated[float, DrawnFrom(0.10, 0.18)]
    wander: Annotated[float, DrawnFrom(0.03, 0.06)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        turn = run.session_s / self.period_s + self.phase / (2 * np.pi)
        late = turn + self.wander * np.sin(1.9 * turn)
        return np.asarray(self.amplitude * np.exp(-(((late - np.round(late)) / self.width) ** 2)))


class PeristalsisTwitch(HiddenEffect):
    """Contractions that rise fast and fade slowly, periodic in the session's time."""

    name, form, kinds = "peristalsis", "fast rise, slow fall", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(7.0, 18.0)]
    period_s: Annotated[float, DrawnFrom(3.5, 8.0)]
    phase: DrawnPhase
    rise: Annotated[float, DrawnFrom(0.05, 0.15)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        turn = np.mod(run.session_s / self.period_s + self.phase / (2 * np.pi), 1.0)
        return np.asarray(self.amplitude * turn / self.rise * np.exp(1 - turn / self.rise))


class PeristalsisUneven(HiddenEffect):
    """Smooth contractions, periodic in the session's time, of varying strength."""

    name, form, kinds = "peristalsis", "uneven contractions", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(8.0, 20.0)]
    period_s: Annotated[float, DrawnFrom(3.5, 8.0)]
    phase: DrawnPhase
    uneven: Annotated[float, DrawnFrom(0.1, 0.35)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        turn = run.session_s / self.period_s + self.phase / (2 * np.pi)
        strength = 1 + self.uneven * np.sin(2.4 * np.floor(turn + 0.5))
        return np.asarray(self.amplitude * strength * ((1 + np.cos(2 * np.pi * turn)) / 2) ** 3)


class AgeingRoot(HiddenEffect):
    """Stiffness drifts with the root of the session's time, and is reset in part whenever the gut is wetted."""

    name, form, kinds = "tissue_ageing", "root of time, wetted", TISSUE_RUNS
    amplitude: Annotated[float, DrawnFrom(0.3, 0.6, signed=True)]
    every_s: Annotated[float, DrawnFrom(600.0, 1000.0)]
    share: Annotated[float, DrawnFrom(0.15, 0.3)]

    def stiffness(self, plan: RunPlan) -> float:
        lasting, dried = (plan.start_s / 3000.0) ** 0.5, (plan.start_s / self.every_s) % 1.0
        return float(1 + self.amplitude * ((1 - self.share) * lasting + self.share * dried))


class AgeingLate(HiddenEffect):
    """Stiffness drifts slowly at first and faster later on, modulated by the room's temperature."""

    name, form, kinds = "tissue_ageing", "late, swings", TISSUE_RUNS
    amplitude: Annotated[float, DrawnFrom(0.25, 0.5, signed=True)]
    power: Annotated[float, DrawnFrom(1.2, 2.0)]
    swing: Annotated[float, DrawnFrom(0.1, 0.2)]
    period_s: Annotated[float, DrawnFrom(500.0, 1000.0)]

    def stiffness(self, plan: RunPlan) -> float:
        swung = 1 + self.swing * np.sin(2 * np.pi * plan.start_s / self.period_s)
        return float(1 + self.amplitude * (plan.start_s / 3000.0) ** self.power * swung)


class AgeingTurn(HiddenEffect):
    """Stiffness changes from one value to another about a time within the session."""

    name, form, kinds = "tissue_ageing", "change-over", TISSUE_RUNS
    amplitude: Annotated[float, DrawnFrom(0.25, 0.5, signed=True)]
    middle_s: Annotated[float, DrawnFrom(900.0, 2000.0)]
    width_s: Annotated[float, DrawnFrom(400.0, 750.0)]

    def stiffness(self, plan: RunPlan) -> float:
        now, start = (1 / (1 + np.exp(-(t - self.middle_s) / self.width_s)) for t in (plan.start_s, 0.0))
        return float(1 + self.amplitude * (now - start) / (1 - start))


class PreconditioningRational(HiddenEffect):
    """A fresh specimen is stiffer, more so at larger strain; the excess fades with the run count."""

    name, form, kinds = "preconditioning", "rational, grows with strain", TISSUE_RUNS
    amplitude: Annotated[float, DrawnFrom(0.35, 0.7)]
    runs: Annotated[float, DrawnFrom(1.5, 4.0)]
    power: Annotated[float, DrawnFrom(1.0, 2.0)]
    grows: Annotated[float, DrawnFrom(0.3, 0.6)]

    def stiffness(self, plan: RunPlan) -> float:
        fresh = (1.0 if plan.strain is None else plan.strain) ** self.grows
        return float(1 + self.amplitude * fresh / (1 + (plan.order / self.runs) ** self.power))


class PreconditioningBell(HiddenEffect):
    """The stiffness of a fresh specimen fades as a Gaussian of the run count."""

    name, form, kinds = "preconditioning", "Gaussian of run count", TISSUE_RUNS
    amplitude: Annotated[float, DrawnFrom(0.35, 0.7)]
    runs: Annotated[float, DrawnFrom(2.0, 9.0)]

    def stiffness(self, plan: RunPlan) -> float:
        return float(1 + self.amplitude * np.exp(-((plan.order / self.runs) ** 2)))
