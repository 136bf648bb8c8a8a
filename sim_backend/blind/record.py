"""One run as it is recorded, and as it would be without noise."""

from dataclasses import dataclass
from math import prod
from zlib import crc32

import numpy as np
import numpy.typing as npt

from dragrig.sim_backend.blind.effects.base import Effect, Scene
from dragrig.sim_backend.blind.gut import Gut
from dragrig.sim_backend.blind.motion import Floats, commanded, phases
from dragrig.sim_backend.blind.programme import RATE_HZ, RunPlan
from dragrig.sim_backend.blind.relaxing import relax
from dragrig.sim_backend.blind.secret import Secret, without_effects
from dragrig.sim_backend.blind.sliding import slide
from dragrig.sim_backend.blind.specimen import Noise

COUNT_MM = 0.001
STEP_MN = 20_000 / 2**16
"""Sixteen bits over ±10 N."""
JITTER_MM = 0.00015
"""What vibration moves the scale by, from sample to sample."""
LAST_RANK = 4
"""Of what acts behind the noise."""


@dataclass(frozen=True, slots=True)
class Trace:
    """One run: time [s], force [mN], position and command [mm], phase, each of shape `(N,)`."""

    run: RunPlan
    time: Floats
    force: Floats
    position: Floats
    command: Floats
    phase: npt.NDArray[np.uint8]


def ideal(secret: Secret, index: int) -> Trace:
    """Return run number `index` without noise, offset and rounding."""
    return _trace(secret, index, noisy=False)


def recorded(secret: Secret, index: int) -> Trace:
    """Return run number `index` as sensor, encoder and converter deliver it."""
    return _trace(secret, index, noisy=True)


@dataclass(frozen=True, slots=True)
class Signature:
    """What the effects do to one run: force [mN] and position [mm] with them minus those without, shape `(N,)`."""

    run: RunPlan
    time: Floats
    force: Floats
    position: Floats


def signature(secret: Secret) -> tuple[Signature, ...]:
    """Return what the effects do, run by run, noise-free and on the same specimen."""
    bare = without_effects(secret)
    found = []
    for index, run in enumerate(secret.runs):
        one, other = ideal(secret, index), ideal(bare, index)
        found.append(Signature(run, one.time, one.force - other.force, one.position - other.position))
    return tuple(found)


def _trace(secret: Secret, index: int, *, noisy: bool) -> Trace:
    run, variation = secret.runs[index], secret.variations[index]
    seed = crc32(f"{secret.seed} {secret.programme}".encode())
    effects = tuple(one for one in secret.effects if run.kind in one.kinds)
    time = np.arange(run.samples) / RATE_HZ
    true_time = time
    for effect in effects:
        true_time = effect.clock(run, true_time, seed)
    command = commanded(run, true_time, secret.rough.blunt_s)
    motion = command
    for effect in effects:
        motion = effect.motion(motion, Scene(run, seed, command, motion))
    scene = Scene(run, seed, command, motion)
    ageing = prod(effect.stiffness(run) for effect in effects)
    gut = Gut(secret.specimen, variation, secret.rough, effects, ageing)
    force = secret.specimen.gain * _on_sensor(gut, scene)
    position = motion.p
    for effect in effects:
        position = effect.position(position, force, scene)
    force = _through(force, effects, scene, range(LAST_RANK))
    if noisy:
        force = force + variation.zero_mN + _noise(secret.noise, time.size, scene.random("noise"))
    force = _through(force, effects, scene, range(LAST_RANK, LAST_RANK + 1))
    if noisy:
        force = np.clip(np.round(force / STEP_MN), -(2**15), 2**15 - 1) * STEP_MN
        position = position + JITTER_MM * scene.random("encoder").standard_normal(time.size)
        position = np.round(position / COUNT_MM) * COUNT_MM
    nominal = commanded(run, time, secret.rough.blunt_s).p if true_time is not time else command.p
    return Trace(run, time, force, position, nominal, phases(run, time))


def _on_sensor(gut: Gut, scene: Scene) -> Floats:
    """Return what gut and capsule do to the sensor [mN]."""
    if scene.run.kind == "blank":
        return np.zeros_like(scene.motion.t)
    if scene.run.kind == "relaxation":
        return relax(gut, scene)
    return slide(gut, scene, closed=scene.run.kind == "drag")


def _through(force: Floats, effects: tuple[Effect, ...], scene: Scene, ranks: range) -> Floats:
    """Return the force behind the effects of these ranks, lowest first."""
    for effect in sorted(effects, key=lambda one: one.rank):
        if effect.rank in ranks:
            force = effect.sensor(force, scene)
    return force


def _noise(noise: Noise, samples: int, random: np.random.Generator) -> Floats:
    """Return white noise plus a stationary Ornstein-Uhlenbeck process."""
    from scipy.signal import lfilter

    kept = float(np.exp(-1 / (RATE_HZ * noise.correlation_s)))
    drive = noise.slow_mN * np.sqrt(1 - kept**2) * random.standard_normal(samples)
    drive[0] = noise.slow_mN * random.standard_normal()
    return np.asarray(noise.white_mN * random.standard_normal(samples) + lfilter([1.0], [1.0, -kept], drive))
