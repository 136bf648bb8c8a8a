"""Hidden effects of the force sensor and of what hangs on it."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.base import Draw, Effect, Scene
from dragrig.sim_backend.blind.motion import Floats


@dataclass(frozen=True, slots=True)
class DriftRoot(Effect):
    """Zero that creeps with the root of the run's time, somewhat different in every run."""

    name, form, rank = "force_drift", "root of time", 2
    amplitude: Annotated[float, Draw(5.0, 14.0, signed=True)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        own = 1 + 0.2 * scene.random("drift").standard_normal()
        return force + self.amplitude * own * np.sqrt(scene.motion.t / 20.0)


@dataclass(frozen=True, slots=True)
class DriftBent(Effect):
    """Zero that creeps at a rate which falls by half over some tens of seconds."""

    name, form, rank = "force_drift", "bent line", 2
    amplitude: Annotated[float, Draw(5.0, 14.0, signed=True)]
    time_s: Annotated[float, Draw(10.0, 60.0, log=True)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        own = 1 + 0.2 * scene.random("drift").standard_normal()
        grown = np.log1p(scene.motion.t / self.time_s) / np.log1p(20.0 / self.time_s)
        return np.asarray(force + self.amplitude * own * grown)


@dataclass(frozen=True, slots=True)
class NonlinearCubic(Effect):
    """Gain that changes with the square of the load."""

    name, form, rank = "force_nonlinearity", "cubic", 2
    amplitude: Annotated[float, Draw(0.05, 0.14, signed=True)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        return np.asarray(force * (1 + self.amplitude * (force / 1500.0) ** 2))


@dataclass(frozen=True, slots=True)
class NonlinearSoft(Effect):
    """Gain that falls as the load grows, as a hyperbolic tangent has it."""

    name, form, rank = "force_nonlinearity", "softening", 2
    amplitude: Annotated[float, Draw(0.06, 0.16)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        if not self.amplitude:
            return force
        full = 1500.0 / np.sqrt(3 * self.amplitude)
        return np.asarray(full * np.tanh(force / full))


@dataclass(frozen=True, slots=True)
class HysteresisDahl(Effect):
    """Hysteresis whose branches approach a band exponentially in the load."""

    name, form, rank = "force_hysteresis", "Dahl", 1
    amplitude: Annotated[float, Draw(4.0, 10.0)]
    width_mN: Annotated[float, Draw(6.0, 30.0, log=True)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        from dragrig.sim_backend.blind.effects.hysterons import dahl

        return force - self.amplitude * dahl(force, self.width_mN)


@dataclass(frozen=True, slots=True)
class HysteresisStack(Effect):
    """A stack of four plays of different widths."""

    name, form, rank = "force_hysteresis", "Prandtl stack", 1
    amplitude: Annotated[float, Draw(5.0, 12.0)]
    spread: Annotated[float, Draw(0.2, 0.7)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        from dragrig.sim_backend.blind.effects.hysterons import play

        halves = self.amplitude * (1 + self.spread * np.array([-1.0, -0.4, 0.4, 1.0]))
        return np.asarray(np.mean([play(force, half) for half in halves.tolist()], axis=0))


@dataclass(frozen=True, slots=True)
class HumHarmonics(Effect):
    """Mains pick-up with a third harmonic, at another phase in every run."""

    name, form, rank = "mains_hum", "third harmonic", 2
    amplitude: Annotated[float, Draw(2.5, 6.0)]
    mains: Annotated[float, Draw(0.0, 1.0)]
    third: Annotated[float, Draw(0.1, 0.4)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        random = scene.random("hum")
        hertz = (50.0 if self.mains < 0.7 else 60.0) + 0.03 * random.standard_normal()
        turn = 2 * np.pi * hertz * scene.motion.t + random.uniform(0, 2 * np.pi)
        return force + self.amplitude * (np.sin(turn) + self.third * np.sin(3 * turn + 1.0))


@dataclass(frozen=True, slots=True)
class HumBeating(Effect):
    """Mains pick-up whose strength swells slowly."""

    name, form, rank = "mains_hum", "beating", 2
    amplitude: Annotated[float, Draw(2.5, 6.0)]
    mains: Annotated[float, Draw(0.0, 1.0)]
    swell: Annotated[float, Draw(0.2, 0.5)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        random, t = scene.random("hum"), scene.motion.t
        hertz = (50.0 if self.mains < 0.7 else 60.0) + 0.03 * random.standard_normal()
        first, second = random.uniform(0, 2 * np.pi, 2)
        slow = 1 + self.swell * np.sin(2 * np.pi * t * 0.15 + second)
        return np.asarray(force + self.amplitude * slow * np.sin(2 * np.pi * hertz * t + first))


@dataclass(frozen=True, slots=True)
class InertiaSoft(Effect):
    """Mass times acceleration [g], through a coupling that gives way for some milliseconds."""

    name, form = "payload_inertia", "soft coupling"
    amplitude: Annotated[float, Draw(15.0, 40.0)]
    time_s: Annotated[float, Draw(0.002, 0.008)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        from dragrig.sim_backend.blind.effects.linear import low_pass

        return force + self.amplitude / 1000 * low_pass(scene.motion.a, self.time_s, 1.0, scene.motion.t)


@dataclass(frozen=True, slots=True)
class InertiaUneven(Effect):
    """Mass times acceleration [g], part of it missing while slowing down."""

    name, form = "payload_inertia", "uneven"
    amplitude: Annotated[float, Draw(15.0, 40.0)]
    missing: Annotated[float, Draw(0.1, 0.4)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        a = scene.motion.a
        return force + self.amplitude / 1000 * np.where(a > 0, a, (1 - self.missing) * a)


@dataclass(frozen=True, slots=True)
class ComplianceMode(Effect):
    """An arm that rings after every change of acceleration; the amplitude is its moving mass [g]."""

    name, form = "arm_compliance", "one mode"
    amplitude: Annotated[float, Draw(15.0, 45.0)]
    hertz: Annotated[float, Draw(12.0, 40.0, log=True)]
    damping: Annotated[float, Draw(0.03, 0.10)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        from dragrig.sim_backend.blind.effects.linear import resonance

        return force + self.amplitude / 1000 * resonance(scene.motion.a, self.hertz, self.damping, scene.motion.t)


@dataclass(frozen=True, slots=True)
class ComplianceTwoModes(Effect):
    """An arm that rings in two modes, bending and twisting."""

    name, form = "arm_compliance", "two modes"
    amplitude: Annotated[float, Draw(15.0, 45.0)]
    hertz: Annotated[float, Draw(10.0, 25.0, log=True)]
    damping: Annotated[float, Draw(0.03, 0.10)]
    ratio: Annotated[float, Draw(1.6, 2.8)]
    second: Annotated[float, Draw(0.2, 0.5)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        from dragrig.sim_backend.blind.effects.linear import resonance

        a, t = scene.motion.a, scene.motion.t
        first = resonance(a, self.hertz, self.damping, t)
        other = resonance(a, self.hertz * self.ratio, self.damping, t)
        return force + self.amplitude / 1000 * ((1 - self.second) * first + self.second * other)


FORMS: tuple[type[Effect], ...] = (
    DriftRoot, DriftBent, NonlinearCubic, NonlinearSoft, HysteresisDahl, HysteresisStack, HumHarmonics, HumBeating,
    InertiaSoft, InertiaUneven, ComplianceMode, ComplianceTwoModes,
)  # fmt: skip
