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
    """Zero that creeps at a rate which falls by half over some seconds."""

    name, form, rank = "force_drift", "bent line", 2
    amplitude: Annotated[float, Draw(5.0, 14.0, signed=True)]
    time_s: Annotated[float, Draw(3.0, 15.0, log=True)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        own = 1 + 0.3 * scene.random("drift").standard_normal()
        grown = np.log1p(scene.motion.t / self.time_s) / np.log1p(20.0 / self.time_s)
        return np.asarray(force + self.amplitude * own * grown)


@dataclass(frozen=True, slots=True)
class NonlinearCubic(Effect):
    """Gain that is another beyond a load, as where an overload stop begins to touch."""

    name, form, rank = "force_nonlinearity", "kink", 2
    amplitude: Annotated[float, Draw(0.1, 0.2, signed=True)]
    load_mN: Annotated[float, Draw(220.0, 450.0)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        beyond = np.maximum(np.abs(force) - self.load_mN, 0.0)
        return np.asarray(force + self.amplitude * np.sign(force) * beyond)


@dataclass(frozen=True, slots=True)
class NonlinearSoft(Effect):
    """Gain that is right at no load and again at a full one, with the largest error between."""

    name, form, rank = "force_nonlinearity", "bow between two true loads", 2
    amplitude: Annotated[float, Draw(0.03, 0.08, signed=True)]
    full_mN: Annotated[float, Draw(1400.0, 2000.0)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        return np.asarray(force * (1 + self.amplitude * np.sin(np.pi * force / self.full_mN)))


@dataclass(frozen=True, slots=True)
class HysteresisDahl(Effect):
    """Hysteresis whose branches approach a band exponentially in the load, and which creeps off in part."""

    name, form, rank = "force_hysteresis", "Dahl with creep", 1
    amplitude: Annotated[float, Draw(5.0, 12.0)]
    width_mN: Annotated[float, Draw(6.0, 30.0, log=True)]
    creeps: Annotated[float, Draw(0.4, 0.6)]
    time_s: Annotated[float, Draw(2.0, 6.0)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        from dragrig.sim_backend.blind.effects.hysterons import dahl
        from dragrig.sim_backend.blind.effects.linear import first_order

        state = dahl(force, self.width_mN)
        return force - self.amplitude * (state - self.creeps * first_order(state, self.time_s, scene.motion.t))


@dataclass(frozen=True, slots=True)
class HysteresisStack(Effect):
    """A stack of four plays of different widths, wider under load."""

    name, form, rank = "force_hysteresis", "Prandtl stack, widens", 1
    amplitude: Annotated[float, Draw(4.0, 10.0)]
    spread: Annotated[float, Draw(0.2, 0.7)]
    load_mN: Annotated[float, Draw(250.0, 500.0)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        from dragrig.sim_backend.blind.effects.hysterons import play

        load = np.arcsinh(force / self.load_mN)
        halves = self.amplitude / self.load_mN * (1 + self.spread * np.array([-1.0, -0.4, 0.4, 1.0]))
        held = np.mean([play(load, half) for half in halves.tolist()], axis=0)
        return np.asarray(self.load_mN * np.sinh(held))


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
    """Mass times acceleration [g], through a coupling that is stiff when pushed and soft when pulled."""

    name, form = "payload_inertia", "coupling soft one way"
    amplitude: Annotated[float, Draw(15.0, 40.0)]
    time_s: Annotated[float, Draw(0.003, 0.006)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        from dragrig.sim_backend.blind.effects.linear import low_pass

        a, t = scene.motion.a, scene.motion.t
        slow = low_pass(np.minimum(a, 0.0), self.time_s, 1.0, t)
        return force + self.amplitude / 1000 * (np.maximum(a, 0.0) + slow)


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
    """An arm that rings after every change of acceleration, longer when speeding up; the amplitude is its mass [g]."""

    name, form = "arm_compliance", "one mode, unequally damped"
    amplitude: Annotated[float, Draw(15.0, 45.0)]
    hertz: Annotated[float, Draw(12.0, 40.0, log=True)]
    damping: Annotated[float, Draw(0.03, 0.07)]
    ratio: Annotated[float, Draw(1.6, 2.4)]

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force recorded."""
        from dragrig.sim_backend.blind.effects.linear import resonance

        a, t = scene.motion.a, scene.motion.t
        faster = resonance(np.maximum(a, 0.0), self.hertz, self.damping, t)
        slower = resonance(np.minimum(a, 0.0), self.hertz, self.damping * self.ratio, t)
        return force + self.amplitude / 1000 * (faster + slower)


@dataclass(frozen=True, slots=True)
class ComplianceTwoModes(Effect):
    """An arm that rings in two modes, bending and twisting."""

    name, form = "arm_compliance", "two modes"
    amplitude: Annotated[float, Draw(15.0, 45.0)]
    hertz: Annotated[float, Draw(10.0, 25.0, log=True)]
    damping: Annotated[float, Draw(0.03, 0.10)]
    ratio: Annotated[float, Draw(1.6, 2.8)]
    second: Annotated[float, Draw(0.15, 0.3)]

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
