"""Hidden effects that the catalogue does not have, in force, position and time; the right verdict is `unknown`."""

import numpy as np

from dragrig.sim_backend.blind import Floats, RunPlan
from dragrig.sim_backend.blind.effects.hidden_effect import (
    ALL_RUNS,
    DRAG_RUNS,
    PHASE,
    SLIDING_RUNS,
    CapsuleForces,
    HiddenEffect,
    RunConditions,
    drawn,
    hidden_form,
    in_log,
    resonance,
    signed,
)


@drawn(amplitude=(0.7, 1.0), load_mN=(500.0, 1000.0))
@hidden_form("sensor", "amplifier_saturates", "hard knee", rank=2)
def amplifier_saturates(effect: HiddenEffect, force: Floats, run: RunConditions) -> Floats:
    """Above a load the amplifier transmits only part of the increase."""
    return np.asarray(force - effect.amplitude * np.maximum(force - effect.load_mN, 0.0))


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
    return np.round(force / effect.amplitude) * effect.amplitude if effect.amplitude else force


@drawn(amplitude=(10.0, 25.0), time_s=(0.5, 2.0))
@hidden_form("pull", "suction", "grows at standstill", DRAG_RUNS)
def suction(effect: HiddenEffect, forces: CapsuleForces, run: RunConditions) -> Floats | float:
    """Suction that grows while the capsule stands and breaks as it moves."""
    t, (go, _, _, stop) = run.motion.t, run.plan.bounds_s
    standing = np.where(t < go, t, np.maximum(t - stop, 0.0))
    return np.asarray(-effect.amplitude * (1 - np.exp(-((standing / effect.time_s) ** 1.5))))


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


@drawn(amplitude=in_log(0.10, 0.40))
@hidden_form("position", "stage_yields", "spring", channel="position")
def stage_yields(effect: HiddenEffect, position: Floats, force: Floats, run: RunConditions) -> Floats:
    """The stage yields elastically under the measured force [mm at 1 N], and nothing brings it back to the command."""
    return np.asarray(position - effect.amplitude * (force - force[0]) / 1000.0)


@drawn(amplitude=signed(0.01, 0.04))
@hidden_form("clock", "clock_off", "some runs", channel="position")
def clock_off(effect: HiddenEffect, plan: RunPlan, t: Floats, seed: int) -> Floats:
    """The sampling clock has a relative error in some of the runs."""
    wrong = np.random.default_rng((seed, plan.order, 77)).random() < 0.5
    return t * (1 + effect.amplitude) if wrong else t
