"""The plant: forces of gut and capsule in one run, the run as it is recorded, and a campaign's run files.

A capsule slides (drag and Coulomb runs), or a dummy shears the wall and holds it (relaxation).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cached_property, partial
from math import ceil, cos, pi, prod, radians, sin
from pathlib import Path
from uuid import UUID, uuid5
from zlib import crc32

import h5py
import numpy as np
import numpy.typing as npt

from dragrig.sim_backend.blind.blind_campaign import (
    BlindCampaign,
    HiddenSpecimen,
    NoiseLevels,
    NominalErrors,
    RunVariation,
    parallel_session,
)
from dragrig.sim_backend.blind.effects.hidden_effect import (
    SIGN_CHANGE_MM_S,
    CapsuleForces,
    HiddenEffect,
    RunConditions,
)
from dragrig.sim_backend.blind.run_plans import (
    NOTED_DWELL_S,
    PLANT_WALL_MM,
    CapsuleDummy,
    Floats,
    RunList,
    RunPlan,
    planned_motion,
    sample_phases,
)

GRAVITY_M_S2 = 9.80665
_EQ14 = {
    "E1": (-0.1617, -0.3175, 3.348),
    "E2": (0.1729, -1.078, 2.078),
    "E3": (0.1653, -0.9792, 1.877),
    "eta1": (-0.01386, 0.03667, 0.0442),
    "eta2": (0.0185, -0.2205, 0.6971),
}
"""Equation (14) of the paper: kPa, and kPa s, against strain."""


@dataclass(frozen=True)
class GutContact:
    """Wall and capsule of one run, effects in the tissue included: moduli, geometry, and pressure by contact age."""

    specimen: HiddenSpecimen
    variation: RunVariation
    errors: NominalErrors
    effects: Sequence[HiddenEffect]
    ageing: float
    """Factor on stiffness of the effects that vary from run to run."""
    capsule: CapsuleDummy = field(default_factory=CapsuleDummy)

    @cached_property
    def angle(self) -> float:
        """Contact angle [rad]."""
        return radians(self.specimen.angle_deg + self.errors.angle_deg)

    @cached_property
    def length_mm(self) -> float:
        """Length of the contact along the axis."""
        return self.capsule.radius_mm * sin(self.angle)

    @cached_property
    def area_mm2(self) -> float:
        """Area of the contact, S."""
        return 2 * pi * self.capsule.radius_mm**2 * sin(self.angle)

    def diameter_mm(self, x: Floats) -> Floats:
        """Return the wall's inner diameter at `x` along the contact."""
        return 2 * np.sqrt(self.capsule.radius_mm**2 - (self.length_mm - x) ** 2)

    def strain(self, x: Floats) -> Floats:
        """Return the circumferential strain at `x`."""
        free = 2 * self.capsule.radius_mm * cos(self.angle)
        return (self.diameter_mm(x) - free) / free

    def moduli(self, strain: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Return E1, E2, E3 [kPa] and the time constants of the two branches [s] at a strain."""
        scales = self.specimen.element_scales
        E1, E2, E3, eta1, eta2 = (
            np.polyval(polynomial, strain) * scale * wrong
            for polynomial, scale, wrong in zip(_EQ14.values(), scales, self.errors.elements, strict=True)
        )
        scale = self.specimen.stiffness * self.variation.stiffness * self.ageing * self._shape_error(strain)
        first, second, third = scale.copy(), scale.copy(), scale.copy()
        for effect in self.effects:
            on_E1, on_E2, on_E3 = effect.branches(strain)
            first, second, third = first * on_E1, second * on_E2, third * on_E3
        return E1 * first, E2 * second, E3 * third, eta1 / E1, eta2 / E2

    def tail(self, age: Floats, strain: Floats) -> Floats:
        """Return the stress that effects add at an age and a strain, relative to E3."""
        if not self.effects:
            return np.zeros_like(age)
        return np.asarray(np.sum([effect.tail(age, strain) for effect in self.effects], axis=0))

    def pressure(self, x: Floats, age: Floats) -> Floats:
        """Return the wall's pressure [kPa] at `x`, first touched `age` seconds ago."""
        strain = self.strain(x)
        E1, E2, E3, tau1, tau2 = self.moduli(strain)
        fast, slow = self.relaxed(age, tau1), self.relaxed(age, tau2)
        stress = E1 * fast + E2 * slow + E3 * (1 + self.tail(age, strain))
        thinner = (1 + strain) ** -self.errors.thinning if self.errors.thinning else 1.0
        return 2 * PLANT_WALL_MM * strain * stress / self.diameter_mm(x) * thinner

    def relaxed(self, age: Floats, tau: Floats) -> Floats:
        """Return the share of a branch's stress that is left at an age."""
        part = age / tau
        return np.exp(-part if self.errors.stretch == 1 else -(np.maximum(part, 0.0) ** self.errors.stretch))

    def _shape_error(self, strain: Floats) -> Floats:
        if not self.errors.shape:
            return np.ones_like(strain)
        forms = {"linear": strain - 1, "arched": 2 * (strain - 1) ** 2 - 1, "wave": np.sin(np.pi * (strain - 0.5))}
        return np.asarray(1 + self.errors.shape * forms[self.errors.shape_form])


_STEPS_PER_SAMPLE = 4
"""Steps of the recursion per sample."""


def relaxation_force(gut: GutContact, run: RunConditions) -> Floats:
    """Return the force at every sample [mN], shape `(N,)`.

    Two Maxwell branches and a spring, with the moduli at the final strain, driven by the true motion.
    """
    from scipy.interpolate import CubicHermiteSpline
    from scipy.signal import lfilter

    plan, motion = run.plan, run.motion
    if plan.strain is None:
        raise ValueError(f"a {plan.kind} run has no shear strain")
    E1, E2, E3, tau1, tau2 = (float(values[0]) for values in gut.moduli(np.array([plan.strain])))
    h = float(motion.t[1] - motion.t[0]) / _STEPS_PER_SAMPLE
    fine_s = motion.t[0] + h * np.arange((motion.t.size - 1) * _STEPS_PER_SAMPLE + 1)
    strain = CubicHermiteSpline(motion.t, motion.p, motion.v)(fine_s) / PLANT_WALL_MM
    steps = np.diff(strain, prepend=0.0)
    stress = E3 * strain
    for modulus, tau in ((E1, tau1), (E2, tau2)):
        if gut.errors.stretch != 1:
            stress = stress + modulus * _stretched_branch(gut, fine_s, strain, tau)
            continue
        if gut.errors.ramp_step_s:
            stress = stress + modulus * _first_order_rule(strain, fine_s, tau, gut.errors.ramp_step_s)
            continue
        decay = np.exp(-h / tau)
        stress = stress + lfilter([modulus * tau / h * (1 - decay)], [1.0, -decay], steps)
    area = 2 * pi * gut.capsule.radius_mm * gut.capsule.length_mm
    force = stress[::_STEPS_PER_SAMPLE] * area
    return np.asarray(force + area * E3 * _tail_stress(gut, motion.t, strain[::_STEPS_PER_SAMPLE]))


def _stretched_branch(gut: GutContact, fine_s: Floats, strain: Floats, tau: float) -> Floats:
    """Return a branch's stress over its modulus where it does not fade exponentially: a sum over the ramp's steps."""
    from scipy.signal import oaconvolve

    # Each step of strain is made evenly over its interval: the age in its middle.
    left = gut.relaxed(fine_s - fine_s[0] + (fine_s[1] - fine_s[0]) / 2, np.array(tau))
    return _summed_over_ramp(left, strain, oaconvolve)


def _first_order_rule(strain: Floats, fine_s: Floats, tau: float, step_s: float) -> Floats:
    """Return a branch's stress over its modulus by the first-order rule at a coarse step, interpolated linearly."""
    from scipy.signal import lfilter

    every = max(round(step_s / (fine_s[1] - fine_s[0])), 1)
    at = np.append(np.arange(0, fine_s.size - 1, every), fine_s.size - 1)
    coarse = lfilter([1.0], [1.0, -np.exp(-every * (fine_s[1] - fine_s[0]) / tau)], np.diff(strain[at], prepend=0.0))
    return np.asarray(np.interp(fine_s, fine_s[at], coarse))


def _tail_stress(gut: GutContact, t: Floats, strain: Floats) -> Floats:
    """Return the stress that effects add, relative to E3: their step response summed over the steps of the ramp."""
    tail = gut.tail(t - t[0], np.full_like(t, strain[-1]))
    if not tail.any():
        return np.zeros_like(t)
    return _summed_over_ramp(tail, strain, np.convolve)


def _summed_over_ramp(response: Floats, strain: Floats, convolve: Callable[[Floats, Floats], Floats]) -> Floats:
    """Return the sum of a step's response over the steps of the ramp."""
    steps = np.diff(strain, prepend=0.0)
    moving = np.flatnonzero(np.abs(steps) > 1e-12)
    first, last = int(moving[0]), int(moving[-1]) + 1
    ramp = convolve(response, steps[first:last])[: strain.size - first]
    return np.concatenate([np.zeros(first), ramp])


_SIMPSON_INTERVALS = 48
"""Intervals of Simpson's rule on each side of the jump of the pressure."""
_KNOT_STEP_MM = 0.06
"""Travel between knots; contact forces are evaluated at the knots and interpolated linearly."""


def sliding_force(gut: GutContact, run: RunConditions, *, closed: bool) -> tuple[Floats, Floats]:
    """Return the force on the capsule and Coulomb friction before its sign at every sample [mN], shape `(N,)` each.

    Parameters
    ----------
    closed
        Whether the wall closes about the capsule; it does not in the vacuum fixture.
    """
    motion, specimen = run.motion, gut.specimen
    mu = specimen.mu * gut.variation.mu
    weight = gut.capsule.mass_g * GRAVITY_M_S2
    elastic, normal = np.zeros_like(motion.t), np.full_like(motion.t, weight)
    if closed:
        knots = _contact_knots(run)
        at_knots, side = _contact_forces(gut, run, knots)
        elastic = np.interp(motion.t, motion.t[knots], at_knots)
        normal = weight + gut.errors.side * gut.area_mm2 * np.interp(motion.t, motion.t[knots], side)
    viscous = np.sign(motion.v) * specimen.mucus * viscous_law(run.speed) * gut.errors.viscous
    if gut.errors.viscous_power:
        viscous = viscous * (np.maximum(run.speed, 1e-9) / 10.0) ** gut.errors.viscous_power
    grip, change = np.tanh(motion.v / (SIGN_CHANGE_MM_S * gut.errors.slip_speed)), np.zeros_like(motion.t)
    for effect in gut.effects:
        grip = effect.grip(grip, run)
        change = change + effect.friction(run)
    coulomb = mu * (1 + change) * normal * grip
    forces = CapsuleForces(elastic, viscous, coulomb, normal)
    total = elastic + viscous + coulomb
    for effect in gut.effects:
        total = total + effect.pull(forces, run)
    return total, mu * (1 + change) * normal


def viscous_law(speed: Floats) -> Floats:
    """Return the published viscous drag [mN] at a speed [mm/s]."""
    return np.asarray(11.24 * 0.030**0.7552 * speed**0.2448 + 0.1148 * speed)


def _contact_knots(run: RunConditions) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return the samples at which the contact is evaluated: dense where age or position change fast."""
    t = run.motion.t
    travelled = np.cumsum(np.abs(np.diff(run.motion.p, prepend=0.0))) / _KNOT_STEP_MM
    since = [t - edge for edge in run.plan.bounds_s]
    dense = sum(np.where(time_s >= -0.004, np.log1p(np.maximum(time_s, 0.0) / 0.02) / 0.06, 0.0) for time_s in since)
    count = np.floor(travelled + dense + t / 0.5)
    chosen = np.flatnonzero(np.diff(count, prepend=-1.0, append=np.inf)[:-1] > 0)
    return np.union1d(chosen, [0, t.size - 1])


def _contact_forces(
    gut: GutContact, run: RunConditions, knots: np.ndarray[tuple[int], np.dtype[np.intp]]
) -> tuple[Floats, Floats]:
    """Return elastic resistance [mN] and the pressure at the equator [kPa] at the knots."""
    motion = run.motion
    reached = np.maximum.accumulate(motion.p - motion.p[0])
    far, first = np.unique(reached, return_index=True)
    times = motion.t[np.maximum(first, 0)].copy()
    times[0] = motion.t[max(int(np.argmax(reached > 0)) - 1, 0)]

    # The true age of a specimen's contact differs from the noted one.
    dwell = gut.specimen.dwell_s * (run.plan.dwell_s / NOTED_DWELL_S)

    def age(x: Floats, now: Floats, here: Floats) -> Floats:
        back = here - x
        return np.where(back >= 0, now - np.interp(back, far, times), dwell + now)

    now, here = motion.t[knots][:, None], reached[knots][:, None]
    speeds = [effect.passing(run)[knots][:, None] for effect in gut.effects]
    length = gut.length_mm
    total = np.zeros(knots.size)
    jump = np.minimum(here, length)
    for low, high, fresh in ((np.zeros_like(jump), jump, True), (jump, np.full_like(jump, length), False)):
        wide = np.flatnonzero((high - low)[:, 0] > 1e-9)
        if not wide.size:
            continue
        a, b = low[wide], high[wide]
        where, weights = _quadrature(gut.errors.panels)
        x = a + (b - a) * where
        old = now[wide] - np.interp(np.maximum(here[wide] - x, 0.0), far, times)
        ages = old if fresh else np.broadcast_to(dwell + now[wide], x.shape)
        remaining = np.ones_like(x)
        for effect, speed in zip(gut.effects, speeds, strict=True):
            remaining = remaining * effect.contact(x / length, speed[wide])
        rise = np.maximum(length - x, 0.0) / gut.capsule.radius_mm
        slant = rise ** (1 + gut.errors.slant) * 2 * np.pi * gut.capsule.radius_mm
        total[wide] += ((b - a) * weights * gut.pressure(x, ages) * slant * remaining).sum(axis=1)
    end = np.full_like(here, length)
    return total, gut.pressure(end, age(end, now, here))[:, 0]


def _quadrature(panels: int) -> tuple[Floats, Floats]:
    """Return nodes and weights on (0, 1): Simpson's rule with nodes crowded at 0, or midpoints of so many panels."""
    if panels:
        return (np.arange(panels) + 0.5) / panels, np.full(panels, 1 / panels)
    s = np.linspace(0.0, 1.0, 2 * _SIMPSON_INTERVALS + 1)
    weights = np.full(s.size, 2.0)
    weights[1::2], weights[[0, -1]] = 4.0, 1.0
    return s**2, weights / (6 * _SIMPSON_INTERVALS) * 2 * s


ENCODER_COUNT_MM = 0.001
CONVERTER_STEP_MN = 20_000 / 2**16
"""Sixteen bits over ±10 N."""
VIBRATION_MM = 0.00015
"""Standard deviation of the scale's vibration, from sample to sample."""
CONVERTER_RANK = 4
"""Rank of effects that act after the noise."""
FINEST_STEP_HZ = 500
"""The physics is followed at least as finely as this."""
PINK_FROM_HZ = 0.02
"""Below this noise is white again: a drift of minutes is the zero offset of a run."""


@dataclass(frozen=True, slots=True)
class PlantRecord:
    """One recorded run: time [s], force [mN], position and command [mm], phase, each of shape `(N,)`."""

    run: RunPlan
    time: Floats
    force: Floats
    position: Floats
    command: Floats
    phase: npt.NDArray[np.uint8]


def _simulate_run(campaign: BlindCampaign, index: int, *, noisy: bool) -> PlantRecord:
    plan, variation, errors = campaign.runs[index], campaign.variations[index], campaign.nominal_errors
    seed = crc32(f"{campaign.seed} {campaign.programme}".encode())
    effects = tuple(effect for effect in campaign.effects if plan.kind in effect.kinds and effect.amplitude)
    time = np.arange(plan.samples) / plan.rate_hz
    # Slow records are samples of a motion that is followed finely; so are those at uneven instants.
    finer = ceil(FINEST_STEP_HZ / plan.rate_hz) * (2 if noisy and campaign.noise.jitter_s else 1)
    fine = time if finer == 1 else np.arange((plan.samples - 1) * finer + 1) / (plan.rate_hz * finer)
    true_time = fine
    for effect in effects:
        true_time = effect.clock(plan, true_time, seed)
    command = planned_motion(plan, true_time, errors.blunt_s)
    motion = command
    for effect in effects:
        motion = effect.motion(motion, RunConditions(plan, seed, command, motion))
    run = RunConditions(plan, seed, command, motion)
    ageing = prod(effect.stiffness(plan) for effect in effects)
    specimen = campaign.specimen_of(plan)
    gut = GutContact(specimen, variation, errors, effects, ageing, campaign.capsule)
    force, friction = _true_force(gut, run)
    if campaign.stage is not None:
        slip_mm_s, commanded = SIGN_CHANGE_MM_S * errors.slip_speed, motion
        # The way by which the stage gives way changes the force by a few per cent, which it hardly feels again.
        for _ in range(2):
            smooth = force - friction * np.tanh(motion.v / slip_mm_s)
            motion = campaign.stage.followed(commanded, plan.bounds_s, smooth, friction, slip_mm_s)
            run = RunConditions(plan, seed, command, motion)
            force, friction = _true_force(gut, run)
    force = specimen.gain * force
    position = motion.p if campaign.stage is None else campaign.stage.recorded(motion.p)
    for effect in effects:
        position = effect.position(position, force, run)
    force = _sensor_force(force, effects, run, range(CONVERTER_RANK))
    instants = time
    if noisy and campaign.noise.jitter_s:
        instants = time + campaign.noise.jitter_s * run.random("jitter").standard_normal(time.size)
    if finer > 1:
        force, position = np.interp(instants, fine, force), np.interp(instants, fine, position)
    if noisy:
        force = force + variation.zero_mN + _force_noise(campaign.noise, plan.rate_hz, time.size, run.random("noise"))
        force = force + unusual_noise(campaign.noise, time, run)
    force = _sensor_force(force, effects, run, range(CONVERTER_RANK, CONVERTER_RANK + 1))
    if noisy:
        step = CONVERTER_STEP_MN * 2 ** (16 - campaign.noise.bits)
        limit = 2 ** (campaign.noise.bits - 1)
        force = np.clip(np.round(force / step), -limit, limit - 1) * step
        position = position + VIBRATION_MM * run.random("encoder").standard_normal(time.size)
        position = np.round(position / ENCODER_COUNT_MM) * ENCODER_COUNT_MM
    nominal = command.p if true_time is time else planned_motion(plan, time, errors.blunt_s).p
    record = PlantRecord(plan, time, force, position, nominal, sample_phases(plan, time))
    return with_dropouts(record, campaign.noise, run) if noisy and campaign.noise.dropouts_per_s else record


def _true_force(gut: GutContact, run: RunConditions) -> tuple[Floats, Floats]:
    """Return the force of a run, and Coulomb friction before its sign [mN]."""
    zeros = np.zeros_like(run.motion.t)
    match run.plan.kind:
        case "relaxation":
            return relaxation_force(gut, run), zeros
        case "blank":
            return zeros, zeros
        case kind:
            return sliding_force(gut, run, closed=kind == "drag")


noise_free_run = partial(_simulate_run, noisy=False)
"""Returns run number `index` of a campaign without noise, offset and rounding."""
recorded_run = partial(_simulate_run, noisy=True)
"""Returns run number `index` of a campaign as sensor, encoder and converter deliver it."""


def unusual_noise(noise: NoiseLevels, time: Floats, run: RunConditions) -> Floats:
    """Return 1/f noise, hum and impulses [mN], shape `(N,)`; zeros where there are none."""
    total, rate = np.zeros_like(time), run.plan.rate_hz
    if noise.pink_mN:
        # A record of twice the length, so that its end is not its beginning.
        count = 2 * time.size
        hertz = np.fft.rfftfreq(count, 1 / rate)
        size = np.zeros_like(hertz)
        size[1:] = np.maximum(hertz[1:], PINK_FROM_HZ) ** (-noise.pink_power / 2)
        random = run.random("pink")
        spectrum = size * (random.standard_normal(hertz.size) + 1j * random.standard_normal(hertz.size))
        expected = np.sqrt(2 * (size**2).sum() * 2) / count
        total = total + noise.pink_mN * np.fft.irfft(spectrum, count)[: time.size] / expected
    if noise.hum_mN:
        random = run.random("hum of the mains")
        hertz_now = noise.hum_hz + 0.03 * random.standard_normal()
        total = total + noise.hum_mN * np.sin(2 * np.pi * (hertz_now * time + random.random()))
    if noise.impulses_per_s:
        random = run.random("impulses")
        for at in np.flatnonzero(random.random(time.size) < noise.impulses_per_s / rate).tolist():
            total[at : at + int(random.integers(1, 4))] += (
                noise.impulse_mN * random.choice([-1.0, 1.0]) * random.exponential()
            )
    return total


def with_dropouts(record: PlantRecord, noise: NoiseLevels, run: RunConditions) -> PlantRecord:
    """Return the record with stretches in which the force is held, is zero, or has no samples at all."""
    random, force = run.random("dropouts"), record.force.copy()
    here = np.ones(force.size, dtype=bool)
    for at in np.flatnonzero(random.random(force.size) < noise.dropouts_per_s / run.plan.rate_hz).tolist():
        end = at + 1 + round(noise.dropout_s * run.plan.rate_hz * random.uniform(0.5, 1.5))
        # The first sample stays: a record begins with its rest.
        part = slice(max(at, 1), end)
        force[part] = force[max(at, 1) - 1] if noise.dropout == "held" else 0.0
        here[part] = noise.dropout != "lost"
    changed = replace(record, force=force)
    columns = ("time", "force", "position", "command", "phase")
    return changed if here.all() else replace(changed, **{name: getattr(changed, name)[here] for name in columns})


def _sensor_force(force: Floats, effects: tuple[HiddenEffect, ...], run: RunConditions, ranks: range) -> Floats:
    """Return the force after the sensor effects of these ranks, lowest first."""
    for effect in sorted(effects, key=lambda effect: effect.rank):
        if effect.rank in ranks:
            force = effect.sensor(force, run)
    return force


def _force_noise(noise: NoiseLevels, rate_hz: float, samples: int, random: np.random.Generator) -> Floats:
    """Return white noise plus a stationary Ornstein-Uhlenbeck process."""
    from scipy.signal import lfilter

    decay = float(np.exp(-1 / (rate_hz * noise.correlation_s)))
    innovations = noise.slow_mN * np.sqrt(1 - decay**2) * random.standard_normal(samples)
    innovations[0] = noise.slow_mN * random.standard_normal()
    return np.asarray(noise.white_mN * random.standard_normal(samples) + lfilter([1.0], [1.0, -decay], innovations))


SESSION_START = datetime(2026, 5, 4, 9, 0, tzinfo=UTC)
_RUN_ID_NAMESPACE = UUID("6d1e2f60-2f7b-4c0e-9d0e-1f2b9a7c5e11")
_FIXTURES = {"drag": "foam", "coulomb": "vacuum", "relaxation": "vacuum", "blank": "none"}
_UNITS = {"time": "s", "force": "mN", "position": "mm", "command": "mm"}
_COMPRESSION = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
PHASES = ("rest", "accelerate", "steady", "decelerate", "hold")


def write_campaign(campaign: BlindCampaign, folder: str | Path, *, runs: str | RunList | None = None) -> None:
    """Write a campaign's run files, NNN-KIND.h5: the required part of the run format, without anything hidden.

    Parameters
    ----------
    runs
        Programme in place of the drawn one: `fresh`, or a list of runs.

    Raises
    ------
    OSError
        When a file cannot be written.
    """
    if runs is not None:
        campaign = parallel_session(campaign, runs)
    Path(folder).mkdir(parents=True, exist_ok=True)
    for index, run in enumerate(campaign.runs):
        with h5py.File(Path(folder) / f"{index:03d}-{run.kind}.h5", "w") as file:
            _write_metadata(file, campaign, run)
            _write_trace(file.create_group("entry/trace"), recorded_run(campaign, index))


def _write_metadata(file: h5py.File, campaign: BlindCampaign, run: RunPlan) -> None:
    file.attrs.update({"NX_class": "NXroot", "default": "entry", "format": "dragrig-run", "format_version": 1})
    # Conditions change a run, and so its id.
    key = [str(campaign.seed), campaign.programme, str(run.order), *campaign.conditions]
    key += [str(run.specimen)] if run.specimen else []
    session = SESSION_START + (timedelta(days=1) if campaign.programme == "fresh" else timedelta())
    entry = file.create_group("entry")
    entry.attrs.update(
        {
            "NX_class": "NXentry",
            "default": "trace",
            "backend": "external",
            "run_id": str(uuid5(_RUN_ID_NAMESPACE, " ".join(key))),
            "start_time": (session + timedelta(seconds=run.start_s)).isoformat(),
            "order": run.order,
            "status": "complete",
            "insertion_dwell_s": run.dwell_s,
        }
    )
    entry.create_group("protocol").attrs.update(_protocol_attributes(run))
    capsule = campaign.capsule
    mass = 0.0 if run.kind == "blank" else capsule.mass_g
    size = {"diameter_mm": 2 * capsule.radius_mm, "length_mm": capsule.length_mm}
    entry.create_group("capsule").attrs.update({**size, "mass_g": mass, "contact_angle_deg": capsule.angle_deg})
    specimen = {"name": "jejunum", "wall_thickness_mm": PLANT_WALL_MM, "fixture": _FIXTURES[run.kind]}
    if campaign.second is not None and campaign.exchange_recorded:
        letter = "AB"[run.specimen]
        specimen |= {"name": f"jejunum-{letter}", "id": f"J-{campaign.seed}-{letter}"}
    entry.create_group("specimen").attrs.update(specimen)


def _protocol_attributes(run: RunPlan) -> dict[str, str | float]:
    shared: dict[str, str | float] = {"kind": run.kind, "rest_s": run.rest_s, "hold_s": run.hold_s}
    if run.strain is not None:
        ramp = {"ramp_speed_mm_s": run.speed_mm_s, "ramp_accel_mm_s2": run.accel_mm_s2}
        return {**shared, "shear_strain": run.strain, **ramp}
    return {**shared, "speed_mm_s": run.speed_mm_s, "travel_mm": run.travel_mm, "accel_mm_s2": run.accel_mm_s2}


def _write_trace(group: h5py.Group, record: PlantRecord) -> None:
    group.attrs.update({"NX_class": "NXdata", "signal": "force", "axes": "time", "sample_rate_hz": record.run.rate_hz})
    for name, unit in _UNITS.items():
        values = getattr(record, name)
        data = values if name == "time" else values.astype(np.float32)
        group.create_dataset(name, data=data, **_COMPRESSION).attrs["units"] = unit
    phase = group.create_dataset("phase", data=record.phase, **_COMPRESSION)
    phase.attrs.create("names", PHASES, dtype=h5py.string_dtype())
