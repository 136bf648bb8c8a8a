"""Hidden effects of force sensor, payload, motor and acquisition."""

import numpy as np

from dragrig.sim_backend.blind import Floats, RunPlan, SampledMotion
from dragrig.sim_backend.blind.effects.hidden_effect import (
    ALL_RUNS,
    PHASE,
    SLIDING_RUNS,
    DrawnFrom,
    HiddenEffect,
    RunConditions,
    dahl_operator,
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


@drawn(amplitude=signed(5.0, 14.0))
@hidden_form("sensor", "force_drift", "root of time", rank=2)
def drift_root(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Zero that drifts with the root of the run's time, somewhat differently in every run."""
    own = 1 + 0.2 * run.random("drift").standard_normal()
    return force + effect.amplitude * own * np.sqrt(run.motion.t / 20.0)


@drawn(amplitude=signed(5.0, 14.0), time_s=in_log(3.0, 15.0))
@hidden_form("sensor", "force_drift", "bent line", rank=2)
def drift_bent(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Zero that drifts at a rate which falls by half over some seconds."""
    own = 1 + 0.3 * run.random("drift").standard_normal()
    grown = np.log1p(run.motion.t / effect.time_s) / np.log1p(20.0 / effect.time_s)
    return np.asarray(force + effect.amplitude * own * grown)


@drawn(amplitude=signed(0.1, 0.2), load_mN=(220.0, 450.0))
@hidden_form("sensor", "force_nonlinearity", "kink", rank=2)
def nonlinear_cubic(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Gain that changes beyond a load, as where an overload stop begins to touch."""
    beyond = np.maximum(np.abs(force) - effect.load_mN, 0.0)
    return np.asarray(force + effect.amplitude * np.sign(force) * beyond)


@drawn(amplitude=signed(0.03, 0.08), full_mN=(1400.0, 2000.0))
@hidden_form("sensor", "force_nonlinearity", "bow between two true loads", rank=2)
def nonlinear_soft(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Gain that is correct at zero and at full load, with the largest error between."""
    return np.asarray(force * (1 + effect.amplitude * np.sin(np.pi * force / effect.full_mN)))


@drawn(amplitude=(5.0, 12.0), width_mN=in_log(6.0, 30.0), creeps=(0.4, 0.6), time_s=(2.0, 6.0))
@hidden_form("sensor", "force_hysteresis", "Dahl with creep", rank=1)
def hysteresis_dahl(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Hysteresis whose branches approach a band exponentially in the load, and which partly creeps off."""
    state = dahl_operator(force, effect.width_mN)
    return force - effect.amplitude * (state - effect.creeps * first_order(state, effect.time_s, run.motion.t))


@drawn(amplitude=(4.0, 10.0), spread=(0.2, 0.7), load_mN=(250.0, 500.0))
@hidden_form("sensor", "force_hysteresis", "Prandtl stack, widens", rank=1)
def hysteresis_stack(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """A stack of four plays of different widths, wider under load."""
    load = np.arcsinh(force / effect.load_mN)
    halves = effect.amplitude / effect.load_mN * (1 + effect.spread * np.array([-1.0, -0.4, 0.4, 1.0]))
    held = np.mean([play_operator(load, half) for half in halves.tolist()], axis=0)
    return np.asarray(effect.load_mN * np.sinh(held))


@drawn(amplitude=(2.5, 6.0), mains=(0.0, 1.0), third=(0.1, 0.4))
@hidden_form("sensor", "mains_hum", "third harmonic", rank=2)
def hum_harmonics(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Mains pick-up with a third harmonic, with a random phase in every run."""
    random = run.random("hum")
    hertz = (50.0 if effect.mains < 0.7 else 60.0) + 0.03 * random.standard_normal()
    turn = 2 * np.pi * hertz * run.motion.t + random.uniform(0, 2 * np.pi)
    return force + effect.amplitude * (np.sin(turn) + effect.third * np.sin(3 * turn + 1.0))


@drawn(amplitude=(2.5, 6.0), mains=(0.0, 1.0), swell=(0.2, 0.5))
@hidden_form("sensor", "mains_hum", "beating", rank=2)
def hum_beating(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Mains pick-up whose strength swells slowly."""
    random, t = run.random("hum"), run.motion.t
    hertz = (50.0 if effect.mains < 0.7 else 60.0) + 0.03 * random.standard_normal()
    first, second = random.uniform(0, 2 * np.pi, 2)
    slow = 1 + effect.swell * np.sin(2 * np.pi * t * 0.15 + second)
    return np.asarray(force + effect.amplitude * slow * np.sin(2 * np.pi * hertz * t + first))


@drawn(amplitude=(15.0, 40.0), time_s=(0.003, 0.006))
@hidden_form("sensor", "payload_inertia", "coupling soft one way")
def inertia_soft(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Mass times acceleration [g], through a coupling that is stiff when pushed and soft when pulled."""
    a, t = run.motion.a, run.motion.t
    slow = low_pass(np.minimum(a, 0.0), effect.time_s, 1.0, t)
    return force + effect.amplitude / 1000 * (np.maximum(a, 0.0) + slow)


@drawn(amplitude=(15.0, 40.0), missing=(0.1, 0.4))
@hidden_form("sensor", "payload_inertia", "uneven")
def inertia_uneven(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Mass times acceleration [g], part of it missing while slowing down."""
    a = run.motion.a
    return force + effect.amplitude / 1000 * np.where(a > 0, a, (1 - effect.missing) * a)


@drawn(amplitude=(15.0, 45.0), hertz=in_log(12.0, 40.0), damping=(0.03, 0.07), ratio=(1.6, 2.4))
@hidden_form("sensor", "arm_compliance", "one mode, unequally damped")
def compliance_mode(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """An arm that rings after every change of acceleration, longer when speeding up; the amplitude is its mass [g]."""
    a, t = run.motion.a, run.motion.t
    faster = resonance(np.maximum(a, 0.0), effect.hertz, effect.damping, t)
    slower = resonance(np.minimum(a, 0.0), effect.hertz, effect.damping * effect.ratio, t)
    return force + effect.amplitude / 1000 * (faster + slower)


@drawn(amplitude=(15.0, 45.0), hertz=in_log(10.0, 25.0), damping=(0.03, 0.10), ratio=(1.6, 2.8), second=(0.15, 0.3))
@hidden_form("sensor", "arm_compliance", "two modes")
def compliance_two_modes(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """An arm that rings in two modes, bending and twisting."""
    a, t = run.motion.a, run.motion.t
    first = resonance(a, effect.hertz, effect.damping, t)
    second_mode = resonance(a, effect.hertz * effect.ratio, effect.damping, t)
    return force + effect.amplitude / 1000 * ((1 - effect.second) * first + effect.second * second_mode)


@drawn(amplitude=in_log(0.030, 0.110), damping=(0.9, 1.3), integral_s=in_log(0.5, 1.5), share=(0.45, 0.7))
@hidden_form("motion", "servo_lag", "second order, integrated away", channel="position")
def lag_second_order(effect: HiddenEffect, motion: SampledMotion, run: RunConditions) -> SampledMotion:
    """A stage that follows as a damped second-order system; an integrator removes a share of its lag [s]."""
    time_s = effect.amplitude / (2 * effect.damping)

    def follow(values: Floats) -> Floats:
        behind = values - low_pass(values, time_s, effect.damping, motion.t)
        return values - behind + effect.share * first_order(behind, effect.integral_s, motion.t)

    return SampledMotion(motion.t, follow(motion.p), follow(motion.v), follow(motion.a))


@drawn(amplitude=in_log(0.030, 0.110), dead=(0.2, 0.5), grows=(0.6, 1.0))
@hidden_form("motion", "servo_lag", "dead time, grows with speed", channel="position")
def lag_dead_time(effect: HiddenEffect, motion: SampledMotion, run: RunConditions) -> SampledMotion:
    """A stage that starts late and follows through two poles, later at speed as its voltage runs out."""
    lag = effect.amplitude * (run.plan.peak_mm_s / 40.0) ** effect.grows
    late, time_s = effect.dead * lag, (1 - effect.dead) * lag / 2
    p, v, a = (
        low_pass(delayed(signal, late, motion.t), time_s, 1.0, motion.t) for signal in (motion.p, motion.v, motion.a)
    )
    return SampledMotion(motion.t, p, v, a)


@drawn(amplitude=in_log(0.030, 0.110), share_1_s=(0.15, 0.3), creep_s=(1.5, 3.0))
@hidden_form("motion", "servo_lag", "fast, with a creeping rest", channel="position")
def lag_two_times(effect: HiddenEffect, motion: SampledMotion, run: RunConditions) -> SampledMotion:
    """A stage that follows fast for most of the way and creeps the rest within seconds; amplitude: the fast lag [s].

    `share_1_s` is the share that creeps over the fast lag.
    """
    slow = effect.share_1_s * effect.amplitude

    def follow(values: Floats) -> Floats:
        fast = low_pass(values, effect.amplitude / 2, 1.0, motion.t)
        return (1 - slow) * fast + slow * first_order(values, effect.creep_s, motion.t)

    return SampledMotion(motion.t, follow(motion.p), follow(motion.v), follow(motion.a))


@drawn(
    amplitude=in_log(0.02, 0.08),
    period_mm=in_log(1.5, 6.0),
    phase=PHASE,
    second=(0.2, 0.4),
    second_phase=PHASE,
)
@hidden_form("motion", "velocity_ripple", "two harmonics", channel="position")
def ripple_harmonics(effect: HiddenEffect, motion: SampledMotion, run: RunConditions) -> SampledMotion:
    """Position error periodic in position, with two harmonics [mm]."""
    k = 2 * np.pi / effect.period_mm
    terms = ((k, effect.phase, 1.0), (2 * k, effect.second_phase, effect.second))
    return _rippled(motion, effect.amplitude, terms)


@drawn(amplitude=in_log(0.02, 0.07), period_mm=in_log(2.0, 6.0), phase=PHASE, decay=(0.35, 0.6))
@hidden_form("motion", "velocity_ripple", "rounded saw", channel="position")
def ripple_saw(effect: HiddenEffect, motion: SampledMotion, run: RunConditions) -> SampledMotion:
    """Position error that rises slowly and falls fast within each period, as teeth do."""
    k = 2 * np.pi / effect.period_mm
    terms = tuple((n * k, n * effect.phase, effect.decay ** (n - 1) / n) for n in (1, 2, 3, 4))
    return _rippled(motion, effect.amplitude, terms)


@drawn(
    amplitude=in_log(0.02, 0.06),
    period_mm=in_log(1.5, 4.0),
    phase=PHASE,
    ratio=(1.3, 2.7),
    second=(0.2, 0.35),
)
@hidden_form("motion", "velocity_ripple", "two periods", channel="position")
def ripple_two_periods(effect: HiddenEffect, motion: SampledMotion, run: RunConditions) -> SampledMotion:
    """Position error of two incommensurable periods, of the poles and of the screw."""
    k = 2 * np.pi / effect.period_mm
    return _rippled(motion, effect.amplitude, ((k, effect.phase, 1.0), (k / effect.ratio, 0.0, effect.second)))


@drawn(amplitude=DrawnFrom(0.006, 0.020, log=True, signed=True), spread=(0.3, 0.55))
@hidden_form("sensor", "channel_latency", "another in every run", rank=3, channel="either")
def latency_spread(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Force that lags or leads the position, by a time that varies from run to run [s]."""
    own = 1 + effect.spread * run.random("latency").uniform(-1.0, 1.0)
    return delayed(force, effect.amplitude * own, run.motion.t)


@drawn(amplitude=in_log(0.006, 0.020), width=(0.5, 1.0))
@hidden_form("sensor", "channel_latency", "moving average", rank=3, channel="either")
def latency_averaged(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Force that lags the position because the converter averages over preceding samples [s]."""
    taps = np.linspace(-effect.width, effect.width, 9) * effect.amplitude
    late = [delayed(force, effect.amplitude + tap, run.motion.t) for tap in taps.tolist()]
    return np.asarray(np.mean(late, axis=0))


@drawn(amplitude=in_log(0.006, 0.018), time_s=(2.0, 10.0))
@hidden_form("sensor", "channel_latency", "growing", rank=3, channel="either")
def latency_grows(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Force that lags the position more and more during a run, as through a filling buffer."""
    t = run.motion.t
    return delayed(force, effect.amplitude * (1.5 - np.exp(-t / effect.time_s)), t)


@drawn(amplitude=DrawnFrom(0.002, 0.012, log=True, signed=True), swing=(0.3, 0.5), period_mm=(9.0, 25.0), phase=PHASE)
@hidden_form("position", "encoder_scale", "uneven band", channel="position")
def scale_bent(effect: HiddenEffect, position: Floats, force: Floats, run: RunConditions) -> Floats:
    """Counts with a relative error that varies along the scale, as of an unevenly bonded tape."""
    swung = np.sin(2 * np.pi * position / effect.period_mm + effect.phase)
    return np.asarray(position * (1 + effect.amplitude * (1 + effect.swing * swung)))


@drawn(amplitude=DrawnFrom(0.002, 0.012, log=True, signed=True), warming=(0.7, 0.95))
@hidden_form("position", "encoder_scale", "warming", channel="position")
def scale_warm(effect: HiddenEffect, position: Floats, force: Floats, run: RunConditions) -> Floats:
    """Counts with a relative error that grows as the scale warms up during the session."""
    return position * (1 + effect.amplitude * (1 - effect.warming * np.exp(-run.session_s / 900.0)))


# Effects that the catalogue does not have.


@drawn(amplitude=(0.7, 1.0), load_mN=(500.0, 1000.0))
@hidden_form("sensor", "amplifier_saturates", "hard knee", rank=2)
def amplifier_saturates(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Above a load the amplifier transmits only part of the increase."""
    return np.asarray(force - effect.amplitude * np.maximum(force - effect.load_mN, 0.0))


@drawn(amplitude=signed(10.0, 25.0))
@hidden_form("sensor", "current_crosstalk", "proportional to speed", rank=2)
def current_crosstalk(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """The motor's current couples into the force channel in proportion to the commanded speed [mN at 60 mm/s]."""
    return force + effect.amplitude * np.abs(run.command.v) / 60.0


@drawn(amplitude=(0.15, 0.45), length_mm=(1.5, 6.0), share=(0.15, 0.35))
@hidden_form("sensor", "loose_coupling", "random stretches", SLIDING_RUNS)
def loose_coupling(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """A loose coupling lets the force drop for stretches of random length."""
    p, random = run.motion.p, run.random("coupling")
    firm = random.exponential(effect.length_mm * (1 / effect.share - 1), 200)
    loose = random.exponential(effect.length_mm, 200)
    edges = np.cumsum(np.ravel(np.column_stack([firm, loose])))
    lost = np.searchsorted(edges, p) % 2 == 1
    return np.asarray(force * np.where(lost & (run.motion.v > 0), 1 - effect.amplitude, 1.0))


@drawn(amplitude=(0.10, 0.30))
@hidden_form("sensor", "gain_switches", "two gains", rank=2)
def gain_switches(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """The amplifier starts with one of two gains, at random from run to run."""
    return force * (1 - effect.amplitude * float(run.random("gain").random() < 0.5))


@drawn(amplitude=(8.0, 20.0), out_s=(0.3, 1.5), back_s=(0.5, 2.0))
@hidden_form("sensor", "fixture_creeps", "two times")
def fixture_creeps(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """The fixture gives way while the stage moves and creeps back after it stops, blank runs included."""
    go, _, _, stop = run.plan.bounds_s
    t = run.motion.t
    grown = 1 - np.exp(-np.clip(t - go, 0.0, stop - go) / effect.out_s)
    return force + effect.amplitude * grown * np.exp(-np.maximum(t - stop, 0.0) / effect.back_s)


@drawn(amplitude=(8.0, 20.0), period_s=(9.0, 20.0), on=(0.15, 0.35), phase=PHASE)
@hidden_form("sensor", "thermostat_zero", "saw of session time", rank=2)
def thermostat_zero(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """The zero follows the room's heating, which switches on and off at times of the session, in every run."""
    turn = np.mod(run.session_s / effect.period_s + effect.phase / (2 * np.pi), 1.0)
    return force + effect.amplitude * (np.where(turn < effect.on, turn / effect.on, (1 - turn) / (1 - effect.on)) - 0.5)


@drawn(amplitude=(4.0, 10.0), hertz=(3.0, 8.0), damping=(0.01, 0.04))
@hidden_form("sensor", "table_vibration", "narrow band")
def table_vibration(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """The table shakes at a few hertz in every run, with varying strength."""
    t = run.motion.t
    before = 2000
    drive = run.random("table").standard_normal(t.size + before)
    shaken = resonance(drive, effect.hertz, effect.damping, t)
    gain = np.sqrt(np.pi * effect.hertz * (t[1] - t[0]) / (2 * effect.damping))
    return np.asarray(force + effect.amplitude * (shaken / gain)[before:])


@drawn(amplitude=(12.0, 24.0))
@hidden_form("sensor", "missing_bits", "steps", rank=4)
def missing_bits(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """The converter has lost its lowest bits: the force comes in steps [mN]."""
    return np.round(force / effect.amplitude) * effect.amplitude


@drawn(amplitude=signed(8.0, 20.0), after_s=(0.3, 1.5))
@hidden_form("sensor", "brake_clamps", "step after the stop")
def brake_clamps(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """A brake closes some time after the stop and loads the sensor, the same way in every run."""
    return force + effect.amplitude * (run.motion.t > run.plan.bounds_s[3] + effect.after_s)


@drawn(amplitude=(8.0, 20.0), place_mm=(14.0, 26.0))
@hidden_form("sensor", "cable_loop", "one arch", ALL_RUNS)
def cable_loop(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """A cable that drags: its loop pushes in the middle of the stroke and pulls at the end, blanks included."""
    p = run.motion.p / effect.place_mm
    return np.asarray(force + effect.amplitude * p * (1 - p))


@drawn(amplitude=in_log(0.05, 0.25), every_mm=(4.0, 15.0))
@hidden_form("position", "encoder_misses", "random jumps", channel="position")
def encoder_misses(effect: HiddenEffect, position: Floats, force: Floats, run: RunConditions) -> Floats:
    """The encoder misses counts, or counts twice, at random places; the amplitude is the distance of one jump [mm]."""
    random = run.random("misses")
    at = np.cumsum(random.exponential(effect.every_mm, 60))
    lost = effect.amplitude * random.standard_normal(at.size)
    return np.asarray(position - np.concatenate([[0.0], np.cumsum(lost)])[np.searchsorted(at, position)])


@drawn(amplitude=in_log(0.20, 0.60))
@hidden_form("position", "stage_yields", "spring", channel="position")
def stage_yields(effect: HiddenEffect, position: Floats, force: Floats, run: RunConditions) -> Floats:
    """The stage yields to the measured force [mm at 1 N], further than under any position loop."""
    return np.asarray(position - effect.amplitude * (force - force[0]) / 1000.0)


@drawn(amplitude=signed(0.01, 0.04))
@hidden_form("clock", "clock_off", "some runs", channel="position")
def clock_off(effect: HiddenEffect, plan: RunPlan, t: Floats, seed: int) -> Floats:
    """The sampling clock has a relative error in some of the runs."""
    wrong = np.random.default_rng((seed, plan.order, 77)).random() < 0.5
    return t * (1 + effect.amplitude) if wrong else t


def _rippled(motion: SampledMotion, amplitude: float, terms: tuple[tuple[float, float, float], ...]) -> SampledMotion:
    """Return the motion with a sum of (wave number, phase, weight) added to its position; zero at its start."""
    p, v, a = motion.p.copy(), motion.v.copy(), motion.a.copy()
    for k, phase, weight in terms:
        turn, size = k * motion.p + phase, amplitude * weight
        p += size * (np.cos(turn) - np.cos(phase))
        v -= size * k * np.sin(turn) * motion.v
        a -= size * k * (np.sin(turn) * motion.a + k * np.cos(turn) * motion.v**2)
    return SampledMotion(motion.t, p, v, a)
