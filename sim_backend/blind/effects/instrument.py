"""Hidden effects of force sensor, payload, motor and acquisition."""

from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.hidden_effect import (
    DrawnFrom,
    DrawnPhase,
    HiddenEffect,
    RunConditions,
    delayed,
    first_order,
    low_pass,
)
from dragrig.sim_backend.blind.run_plans import Floats, SampledMotion


class DriftRoot(HiddenEffect):
    """Zero that drifts with the root of the run's time, somewhat differently in every run."""

    name, form, rank = "force_drift", "root of time", 2
    amplitude: Annotated[float, DrawnFrom(5.0, 14.0, signed=True)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        own = 1 + 0.2 * run.random("drift").standard_normal()
        return force + self.amplitude * own * np.sqrt(run.motion.t / 20.0)


class DriftBent(HiddenEffect):
    """Zero that drifts at a rate which falls by half over some seconds."""

    name, form, rank = "force_drift", "bent line", 2
    amplitude: Annotated[float, DrawnFrom(5.0, 14.0, signed=True)]
    time_s: Annotated[float, DrawnFrom(3.0, 15.0, log=True)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        own = 1 + 0.3 * run.random("drift").standard_normal()
        grown = np.log1p(run.motion.t / self.time_s) / np.log1p(20.0 / self.time_s)
        return np.asarray(force + self.amplitude * own * grown)


class NonlinearCubic(HiddenEffect):
    """Gain that changes beyond a load, as where an overload stop begins to touch."""

    name, form, rank = "force_nonlinearity", "kink", 2
    amplitude: Annotated[float, DrawnFrom(0.1, 0.2, signed=True)]
    load_mN: Annotated[float, DrawnFrom(220.0, 450.0)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        beyond = np.maximum(np.abs(force) - self.load_mN, 0.0)
        return np.asarray(force + self.amplitude * np.sign(force) * beyond)


class NonlinearSoft(HiddenEffect):
    """Gain that is correct at zero and at full load, with the largest error between."""

    name, form, rank = "force_nonlinearity", "bow between two true loads", 2
    amplitude: Annotated[float, DrawnFrom(0.03, 0.08, signed=True)]
    full_mN: Annotated[float, DrawnFrom(1400.0, 2000.0)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        return np.asarray(force * (1 + self.amplitude * np.sin(np.pi * force / self.full_mN)))


class HysteresisDahl(HiddenEffect):
    """Hysteresis whose branches approach a band exponentially in the load, and which partly creeps off."""

    name, form, rank = "force_hysteresis", "Dahl with creep", 1
    amplitude: Annotated[float, DrawnFrom(5.0, 12.0)]
    width_mN: Annotated[float, DrawnFrom(6.0, 30.0, log=True)]
    creeps: Annotated[float, DrawnFrom(0.4, 0.6)]
    time_s: Annotated[float, DrawnFrom(2.0, 6.0)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        from dragrig.sim_backend.blind.effects.hidden_effect import dahl_operator, first_order

        state = dahl_operator(force, self.width_mN)
        return force - self.amplitude * (state - self.creeps * first_order(state, self.time_s, run.motion.t))


class HysteresisStack(HiddenEffect):
    """A stack of four plays of different widths, wider under load."""

    name, form, rank = "force_hysteresis", "Prandtl stack, widens", 1
    amplitude: Annotated[float, DrawnFrom(4.0, 10.0)]
    spread: Annotated[float, DrawnFrom(0.2, 0.7)]
    load_mN: Annotated[float, DrawnFrom(250.0, 500.0)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        from dragrig.sim_backend.blind.effects.hidden_effect import play_operator

        load = np.arcsinh(force / self.load_mN)
        halves = self.amplitude / self.load_mN * (1 + self.spread * np.array([-1.0, -0.4, 0.4, 1.0]))
        held = np.mean([play_operator(load, half) for half in halves.tolist()], axis=0)
        return np.asarray(self.load_mN * np.sinh(held))


class HumHarmonics(HiddenEffect):
    """Mains pick-up with a third harmonic, with a random phase in every run."""

    name, form, rank = "mains_hum", "third harmonic", 2
    amplitude: Annotated[float, DrawnFrom(2.5, 6.0)]
    mains: Annotated[float, DrawnFrom(0.0, 1.0)]
    third: Annotated[float, DrawnFrom(0.1, 0.4)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        random = run.random("hum")
        hertz = (50.0 if self.mains < 0.7 else 60.0) + 0.03 * random.standard_normal()
        turn = 2 * np.pi * hertz * run.motion.t + random.uniform(0, 2 * np.pi)
        return force + self.amplitude * (np.sin(turn) + self.third * np.sin(3 * turn + 1.0))


class HumBeating(HiddenEffect):
    """Mains pick-up whose strength swells slowly."""

    name, form, rank = "mains_hum", "beating", 2
    amplitude: Annotated[float, DrawnFrom(2.5, 6.0)]
    mains: Annotated[float, DrawnFrom(0.0, 1.0)]
    swell: Annotated[float, DrawnFrom(0.2, 0.5)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        random, t = run.random("hum"), run.motion.t
        hertz = (50.0 if self.mains < 0.7 else 60.0) + 0.03 * random.standard_normal()
        first, second = random.uniform(0, 2 * np.pi, 2)
        slow = 1 + self.swell * np.sin(2 * np.pi * t * 0.15 + second)
        return np.asarray(force + self.amplitude * slow * np.sin(2 * np.pi * hertz * t + first))


class InertiaSoft(HiddenEffect):
    """Mass times acceleration [g], through a coupling that is stiff when pushed and soft when pulled."""

    name, form = "payload_inertia", "coupling soft one way"
    amplitude: Annotated[float, DrawnFrom(15.0, 40.0)]
    time_s: Annotated[float, DrawnFrom(0.003, 0.006)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        from dragrig.sim_backend.blind.effects.hidden_effect import low_pass

        a, t = run.motion.a, run.motion.t
        slow = low_pass(np.minimum(a, 0.0), self.time_s, 1.0, t)
        return force + self.amplitude / 1000 * (np.maximum(a, 0.0) + slow)


class InertiaUneven(HiddenEffect):
    """Mass times acceleration [g], part of it missing while slowing down."""

    name, form = "payload_inertia", "uneven"
    amplitude: Annotated[float, DrawnFrom(15.0, 40.0)]
    missing: Annotated[float, DrawnFrom(0.1, 0.4)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        a = run.motion.a
        return force + self.amplitude / 1000 * np.where(a > 0, a, (1 - self.missing) * a)


class ComplianceMode(HiddenEffect):
    """An arm that rings after every change of acceleration, longer when speeding up; the amplitude is its mass [g]."""

    name, form = "arm_compliance", "one mode, unequally damped"
    amplitude: Annotated[float, DrawnFrom(15.0, 45.0)]
    hertz: Annotated[float, DrawnFrom(12.0, 40.0, log=True)]
    damping: Annotated[float, DrawnFrom(0.03, 0.07)]
    ratio: Annotated[float, DrawnFrom(1.6, 2.4)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        from dragrig.sim_backend.blind.effects.hidden_effect import resonance

        a, t = run.motion.a, run.motion.t
        faster = resonance(np.maximum(a, 0.0), self.hertz, self.damping, t)
        slower = resonance(np.minimum(a, 0.0), self.hertz, self.damping * self.ratio, t)
        return force + self.amplitude / 1000 * (faster + slower)


class ComplianceTwoModes(HiddenEffect):
    """An arm that rings in two modes, bending and twisting."""

    name, form = "arm_compliance", "two modes"
    amplitude: Annotated[float, DrawnFrom(15.0, 45.0)]
    hertz: Annotated[float, DrawnFrom(10.0, 25.0, log=True)]
    damping: Annotated[float, DrawnFrom(0.03, 0.10)]
    ratio: Annotated[float, DrawnFrom(1.6, 2.8)]
    second: Annotated[float, DrawnFrom(0.15, 0.3)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        from dragrig.sim_backend.blind.effects.hidden_effect import resonance

        a, t = run.motion.a, run.motion.t
        first = resonance(a, self.hertz, self.damping, t)
        other = resonance(a, self.hertz * self.ratio, self.damping, t)
        return force + self.amplitude / 1000 * ((1 - self.second) * first + self.second * other)


class LagSecondOrder(HiddenEffect):
    """A stage that follows as a damped second-order system; an integrator removes a share of its lag [s]."""

    name, form, channel = "servo_lag", "second order, integrated away", "position"
    amplitude: Annotated[float, DrawnFrom(0.030, 0.110, log=True)]
    damping: Annotated[float, DrawnFrom(0.9, 1.3)]
    integral_s: Annotated[float, DrawnFrom(0.5, 1.5, log=True)]
    share: Annotated[float, DrawnFrom(0.45, 0.7)]

    def motion(self, motion: SampledMotion, run: RunConditions) -> SampledMotion:
        if not self.amplitude:
            return motion
        time_s = self.amplitude / (2 * self.damping)

        def follow(values: Floats) -> Floats:
            behind = values - low_pass(values, time_s, self.damping, motion.t)
            return values - behind + self.share * first_order(behind, self.integral_s, motion.t)

        return SampledMotion(motion.t, follow(motion.p), follow(motion.v), follow(motion.a))


class LagDeadTime(HiddenEffect):
    """A stage that starts late and follows through two poles, later at speed as its voltage runs out."""

    name, form, channel = "servo_lag", "dead time, grows with speed", "position"
    amplitude: Annotated[float, DrawnFrom(0.030, 0.110, log=True)]
    dead: Annotated[float, DrawnFrom(0.2, 0.5)]
    grows: Annotated[float, DrawnFrom(0.6, 1.0)]

    def motion(self, motion: SampledMotion, run: RunConditions) -> SampledMotion:
        if not self.amplitude:
            return motion
        lag = self.amplitude * (run.plan.peak_mm_s / 40.0) ** self.grows
        late, time_s = self.dead * lag, (1 - self.dead) * lag / 2
        p, v, a = (
            low_pass(delayed(one, late, motion.t), time_s, 1.0, motion.t) for one in (motion.p, motion.v, motion.a)
        )
        return SampledMotion(motion.t, p, v, a)


class LagTwoTimes(HiddenEffect):
    """A stage that follows fast for most of the way and creeps the rest within seconds; amplitude: the fast lag [s].

    `share_1_s` is the share that creeps over the fast lag.
    """

    name, form, channel = "servo_lag", "fast, with a creeping rest", "position"
    amplitude: Annotated[float, DrawnFrom(0.030, 0.110, log=True)]
    share_1_s: Annotated[float, DrawnFrom(0.15, 0.3)]
    creep_s: Annotated[float, DrawnFrom(1.5, 3.0)]

    def motion(self, motion: SampledMotion, run: RunConditions) -> SampledMotion:
        if not self.amplitude:
            return motion
        slow = self.share_1_s * self.amplitude

        def follow(values: Floats) -> Floats:
            fast = low_pass(values, self.amplitude / 2, 1.0, motion.t)
            return (1 - slow) * fast + slow * first_order(values, self.creep_s, motion.t)

        return SampledMotion(motion.t, follow(motion.p), follow(motion.v), follow(motion.a))


class RippleHarmonics(HiddenEffect):
    """Position error periodic in position, with two harmonics [mm]."""

    name, form, channel = "velocity_ripple", "two harmonics", "position"
    amplitude: Annotated[float, DrawnFrom(0.02, 0.08, log=True)]
    period_mm: Annotated[float, DrawnFrom(1.5, 6.0, log=True)]
    phase: DrawnPhase
    second: Annotated[float, DrawnFrom(0.2, 0.4)]
    second_phase: DrawnPhase

    def motion(self, motion: SampledMotion, run: RunConditions) -> SampledMotion:
        k = 2 * np.pi / self.period_mm
        terms = ((k, self.phase, 1.0), (2 * k, self.second_phase, self.second))
        return _rippled(motion, self.amplitude, terms)


class RippleSaw(HiddenEffect):
    """Position error that rises slowly and falls fast within each period, as teeth do."""

    name, form, channel = "velocity_ripple", "rounded saw", "position"
    amplitude: Annotated[float, DrawnFrom(0.02, 0.07, log=True)]
    period_mm: Annotated[float, DrawnFrom(2.0, 6.0, log=True)]
    phase: DrawnPhase
    decay: Annotated[float, DrawnFrom(0.35, 0.6)]

    def motion(self, motion: SampledMotion, run: RunConditions) -> SampledMotion:
        k = 2 * np.pi / self.period_mm
        terms = tuple((n * k, n * self.phase, self.decay ** (n - 1) / n) for n in (1, 2, 3, 4))
        return _rippled(motion, self.amplitude, terms)


class RippleTwoPeriods(HiddenEffect):
    """Position error of two incommensurable periods, of the poles and of the screw."""

    name, form, channel = "velocity_ripple", "two periods", "position"
    amplitude: Annotated[float, DrawnFrom(0.02, 0.06, log=True)]
    period_mm: Annotated[float, DrawnFrom(1.5, 4.0, log=True)]
    phase: DrawnPhase
    ratio: Annotated[float, DrawnFrom(1.3, 2.7)]
    second: Annotated[float, DrawnFrom(0.2, 0.35)]

    def motion(self, motion: SampledMotion, run: RunConditions) -> SampledMotion:
        k = 2 * np.pi / self.period_mm
        return _rippled(motion, self.amplitude, ((k, self.phase, 1.0), (k / self.ratio, 0.0, self.second)))


class LatencySpread(HiddenEffect):
    """Force that lags or leads the position, by a time that varies from run to run [s]."""

    name, form, channel, rank = "channel_latency", "another in every run", "either", 3
    amplitude: Annotated[float, DrawnFrom(0.006, 0.020, log=True, signed=True)]
    spread: Annotated[float, DrawnFrom(0.3, 0.55)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        own = 1 + self.spread * run.random("latency").uniform(-1.0, 1.0)
        return delayed(force, self.amplitude * own, run.motion.t)


class LatencyAveraged(HiddenEffect):
    """Force that lags the position because the converter averages over preceding samples [s]."""

    name, form, channel, rank = "channel_latency", "moving average", "either", 3
    amplitude: Annotated[float, DrawnFrom(0.006, 0.020, log=True)]
    width: Annotated[float, DrawnFrom(0.5, 1.0)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        taps = np.linspace(-self.width, self.width, 9) * self.amplitude
        late = [delayed(force, self.amplitude + tap, run.motion.t) for tap in taps.tolist()]
        return np.asarray(np.mean(late, axis=0))


class LatencyGrows(HiddenEffect):
    """Force that lags the position more and more during a run, as through a filling buffer."""

    name, form, channel, rank = "channel_latency", "growing", "either", 3
    amplitude: Annotated[float, DrawnFrom(0.006, 0.018, log=True)]
    time_s: Annotated[float, DrawnFrom(2.0, 10.0)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        t = run.motion.t
        return delayed(force, self.amplitude * (1.5 - np.exp(-t / self.time_s)), t)


class ScaleBent(HiddenEffect):
    """Counts with a relative error that varies along the scale, as of an unevenly bonded tape."""

    name, form, channel = "encoder_scale", "uneven band", "position"
    amplitude: Annotated[float, DrawnFrom(0.002, 0.012, log=True, signed=True)]
    swing: Annotated[float, DrawnFrom(0.3, 0.5)]
    period_mm: Annotated[float, DrawnFrom(9.0, 25.0)]
    phase: DrawnPhase

    def position(self, position: Floats, force: Floats, run: RunConditions) -> Floats:
        swung = np.sin(2 * np.pi * position / self.period_mm + self.phase)
        return np.asarray(position * (1 + self.amplitude * (1 + self.swing * swung)))


class ScaleWarm(HiddenEffect):
    """Counts with a relative error that grows as the scale warms up during the session."""

    name, form, channel = "encoder_scale", "warming", "position"
    amplitude: Annotated[float, DrawnFrom(0.002, 0.012, log=True, signed=True)]
    warming: Annotated[float, DrawnFrom(0.7, 0.95)]

    def position(self, position: Floats, force: Floats, run: RunConditions) -> Floats:
        return position * (1 + self.amplitude * (1 - self.warming * np.exp(-run.session_s / 900.0)))


def _rippled(motion: SampledMotion, amplitude: float, terms: tuple[tuple[float, float, float], ...]) -> SampledMotion:
    """Return the motion with a sum of (wave number, phase, weight) added to its position; zero at its start."""
    p, v, a = motion.p.copy(), motion.v.copy(), motion.a.copy()
    for k, phase, weight in terms:
        turn, size = k * motion.p + phase, amplitude * weight
        p += size * (np.cos(turn) - np.cos(phase))
        v -= size * k * np.sin(turn) * motion.v
        a -= size * k * (np.sin(turn) * motion.a + k * np.cos(turn) * motion.v**2)
    return SampledMotion(motion.t, p, v, a)
