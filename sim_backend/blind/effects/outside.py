"""Hidden effects that the catalogue does not have, in force, position and time; the right verdict is `unknown`."""

from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.hidden_effect import (
    ALL_RUNS,
    DRAG_RUNS,
    SLIDING_RUNS,
    CapsuleForces,
    DrawnFrom,
    DrawnPhase,
    HiddenEffect,
    RunConditions,
)
from dragrig.sim_backend.blind.run_plans import Floats, RunPlan


class AmplifierSaturates(HiddenEffect):
    """Above a load the amplifier transmits only part of the increase."""

    name, form, rank = "amplifier_saturates", "hard knee", 2
    amplitude: Annotated[float, DrawnFrom(0.7, 1.0)]
    load_mN: Annotated[float, DrawnFrom(500.0, 1000.0)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        return np.asarray(force - self.amplitude * np.maximum(force - self.load_mN, 0.0))


class StickSlip(HiddenEffect):
    """At low speed the capsule sticks and slips by random lengths."""

    name, form, kinds = "stick_slip", "irregular saw", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(10.0, 25.0)]
    slip_mm: Annotated[float, DrawnFrom(0.15, 0.6, log=True)]
    speed_mm_s: Annotated[float, DrawnFrom(2.0, 4.0)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        p = run.motion.p
        lengths = self.slip_mm * run.random("stick").gamma(4.0, 0.25, int(p.max() / self.slip_mm * 2) + 20)
        edges = np.concatenate([[0.0], np.cumsum(lengths)])
        at = np.clip(np.searchsorted(edges, p, side="right") - 1, 0, lengths.size - 1)
        part = (p - edges[at]) / lengths[at]
        slow = np.exp(-((run.speed / self.speed_mm_s) ** 4)) * (run.speed > 0)
        return np.asarray(self.amplitude * (lengths[at] / self.slip_mm) * (part - 0.5) * slow)


class CurrentCrosstalk(HiddenEffect):
    """The motor's current couples into the force channel in proportion to the commanded speed [mN at 60 mm/s]."""

    name, form, rank = "current_crosstalk", "proportional to speed", 2
    amplitude: Annotated[float, DrawnFrom(10.0, 25.0, signed=True)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        return force + self.amplitude * np.abs(run.command.v) / 60.0


class LooseCoupling(HiddenEffect):
    """A loose coupling lets the force drop for stretches of random length."""

    name, form, kinds = "loose_coupling", "random stretches", SLIDING_RUNS
    amplitude: Annotated[float, DrawnFrom(0.15, 0.45)]
    length_mm: Annotated[float, DrawnFrom(1.5, 6.0)]
    share: Annotated[float, DrawnFrom(0.15, 0.35)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        p, random = run.motion.p, run.random("coupling")
        firm = random.exponential(self.length_mm * (1 / self.share - 1), 200)
        loose = random.exponential(self.length_mm, 200)
        edges = np.cumsum(np.ravel(np.column_stack([firm, loose])))
        lost = np.searchsorted(edges, p) % 2 == 1
        return np.asarray(force * np.where(lost & (run.motion.v > 0), 1 - self.amplitude, 1.0))


class GainSwitches(HiddenEffect):
    """The amplifier starts with one of two gains, at random from run to run."""

    name, form, rank = "gain_switches", "two gains", 2
    amplitude: Annotated[float, DrawnFrom(0.10, 0.30)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        return force * (1 - self.amplitude * float(run.random("gain").random() < 0.5))


class FixtureCreeps(HiddenEffect):
    """The fixture gives way while the stage moves and creeps back after it stops, blank runs included."""

    name, form = "fixture_creeps", "two times"
    amplitude: Annotated[float, DrawnFrom(8.0, 20.0)]
    out_s: Annotated[float, DrawnFrom(0.3, 1.5)]
    back_s: Annotated[float, DrawnFrom(0.5, 2.0)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        go, _, _, stop = run.plan.bounds_s
        t = run.motion.t
        grown = 1 - np.exp(-np.clip(t - go, 0.0, stop - go) / self.out_s)
        return force + self.amplitude * grown * np.exp(-np.maximum(t - stop, 0.0) / self.back_s)


class FoamResonance(HiddenEffect):
    """Extra force inside one band of speed, where the foam resonates."""

    name, form, kinds = "foam_resonance", "peak in ln v", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(12.0, 28.0)]
    speed_mm_s: Annotated[float, DrawnFrom(7.0, 14.0)]
    width: Annotated[float, DrawnFrom(0.25, 0.5)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        off = np.log(np.maximum(run.speed, 1e-6) / self.speed_mm_s) / self.width
        return np.asarray(self.amplitude * run.direction * np.exp(-(off**2)))


class WallSeam(HiddenEffect):
    """A seam in the wall: one bump at one position."""

    name, form, kinds = "wall_seam", "single bump", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(12.0, 30.0)]
    place_mm: Annotated[float, DrawnFrom(8.0, 24.0)]
    width_mm: Annotated[float, DrawnFrom(0.8, 2.5)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        return np.asarray(self.amplitude * np.exp(-(((run.motion.p - self.place_mm) / self.width_mm) ** 2)))


class ThermostatZero(HiddenEffect):
    """The zero follows the room's heating, which switches on and off at times of the session, in every run."""

    name, form, rank = "thermostat_zero", "saw of session time", 2
    amplitude: Annotated[float, DrawnFrom(8.0, 20.0)]
    period_s: Annotated[float, DrawnFrom(9.0, 20.0)]
    on: Annotated[float, DrawnFrom(0.15, 0.35)]
    phase: DrawnPhase

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        turn = np.mod(run.session_s / self.period_s + self.phase / (2 * np.pi), 1.0)
        return force + self.amplitude * (np.where(turn < self.on, turn / self.on, (1 - turn) / (1 - self.on)) - 0.5)


class TableVibration(HiddenEffect):
    """The table shakes at a few hertz in every run, with varying strength."""

    name, form = "table_vibration", "narrow band"
    amplitude: Annotated[float, DrawnFrom(4.0, 10.0)]
    hertz: Annotated[float, DrawnFrom(3.0, 8.0)]
    damping: Annotated[float, DrawnFrom(0.01, 0.04)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        from dragrig.sim_backend.blind.effects.hidden_effect import resonance

        t = run.motion.t
        before = 2000
        drive = run.random("table").standard_normal(t.size + before)
        shaken = resonance(drive, self.hertz, self.damping, t)
        gain = np.sqrt(np.pi * self.hertz * (t[1] - t[0]) / (2 * self.damping))
        return np.asarray(force + self.amplitude * (shaken / gain)[before:])


class MissingBits(HiddenEffect):
    """The converter has lost its lowest bits: the force comes in steps [mN]."""

    name, form, rank = "missing_bits", "steps", 4
    amplitude: Annotated[float, DrawnFrom(12.0, 24.0)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        return np.round(force / self.amplitude) * self.amplitude if self.amplitude else force


class Suction(HiddenEffect):
    """Suction that grows while the capsule stands and breaks as it moves."""

    name, form, kinds = "suction", "grows at standstill", DRAG_RUNS
    amplitude: Annotated[float, DrawnFrom(10.0, 25.0)]
    time_s: Annotated[float, DrawnFrom(0.5, 2.0)]

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        t, (go, _, _, stop) = run.motion.t, run.plan.bounds_s
        standing = np.where(t < go, t, np.maximum(t - stop, 0.0))
        return np.asarray(-self.amplitude * (1 - np.exp(-((standing / self.time_s) ** 1.5))))


class BrakeClamps(HiddenEffect):
    """A brake closes some time after the stop and loads the sensor, the same way in every run."""

    name, form = "brake_clamps", "step after the stop"
    amplitude: Annotated[float, DrawnFrom(8.0, 20.0, signed=True)]
    after_s: Annotated[float, DrawnFrom(0.3, 1.5)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        return force + self.amplitude * (run.motion.t > run.plan.bounds_s[3] + self.after_s)


class CableLoop(HiddenEffect):
    """A cable that drags: its loop pushes in the middle of the stroke and pulls at the end, blanks included."""

    name, form, kinds = "cable_loop", "one arch", ALL_RUNS
    amplitude: Annotated[float, DrawnFrom(8.0, 20.0)]
    place_mm: Annotated[float, DrawnFrom(14.0, 26.0)]

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        p = run.motion.p / self.place_mm
        return np.asarray(force + self.amplitude * p * (1 - p))


class EncoderMisses(HiddenEffect):
    """The encoder misses counts, or counts twice, at random places; the amplitude is the distance of one jump [mm]."""

    name, form, channel = "encoder_misses", "random jumps", "position"
    amplitude: Annotated[float, DrawnFrom(0.05, 0.25, log=True)]
    every_mm: Annotated[float, DrawnFrom(4.0, 15.0)]

    def position(self, position: Floats, force: Floats, run: RunConditions) -> Floats:
        random = run.random("misses")
        at = np.cumsum(random.exponential(self.every_mm, 60))
        lost = self.amplitude * random.standard_normal(at.size)
        return np.asarray(position - np.concatenate([[0.0], np.cumsum(lost)])[np.searchsorted(at, position)])


class StageYields(HiddenEffect):
    """The stage yields elastically under the measured force [mm at 1 N], and nothing brings it back to the command."""

    name, form, channel = "stage_yields", "spring", "position"
    amplitude: Annotated[float, DrawnFrom(0.10, 0.40, log=True)]

    def position(self, position: Floats, force: Floats, run: RunConditions) -> Floats:
        return np.asarray(position - self.amplitude * (force - force[0]) / 1000.0)


class ClockOff(HiddenEffect):
    """The sampling clock has a relative error in some of the runs."""

    name, form, channel = "clock_off", "some runs", "position"
    amplitude: Annotated[float, DrawnFrom(0.01, 0.04, signed=True)]

    def clock(self, plan: RunPlan, t: Floats, seed: int) -> Floats:
        wrong = np.random.default_rng((seed, plan.order, 77)).random() < 0.5
        return t * (1 + self.amplitude) if wrong else t
