"""Hidden effects of the first slip: friction of an aged contact, and friction that builds up."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.base import SLIDING, Draw, Effect, Scene
from dragrig.sim_backend.blind.motion import Floats


@dataclass(frozen=True, slots=True)
class BreakawayBump(Effect):
    """Extra friction of an aged contact that fades as a Gaussian of the slip."""

    name, form, kinds = "breakaway", "Gaussian in slip", SLIDING
    amplitude: Annotated[float, Draw(0.4, 1.0)]
    slip_mm: Annotated[float, Draw(0.12, 0.5, log=True)]

    def friction(self, scene: Scene) -> Floats | float:
        """Return the relative change of μ."""
        return np.asarray(self.amplitude * np.exp(-((scene.motion.p / self.slip_mm) ** 2)))


@dataclass(frozen=True, slots=True)
class BreakawayRamp(Effect):
    """Extra friction of an aged contact that falls in a straight line with slip."""

    name, form, kinds = "breakaway", "linear decay", SLIDING
    amplitude: Annotated[float, Draw(0.4, 1.0)]
    slip_mm: Annotated[float, Draw(0.25, 0.9, log=True)]

    def friction(self, scene: Scene) -> Floats | float:
        """Return the relative change of μ."""
        return np.asarray(self.amplitude * np.clip(1 - scene.motion.p / self.slip_mm, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class BreakawayPlateau(Effect):
    """Extra friction of an aged contact that holds for a while of slip and then goes along half a cosine."""

    name, form, kinds = "breakaway", "plateau and half cosine", SLIDING
    amplitude: Annotated[float, Draw(0.4, 1.0)]
    plateau_mm: Annotated[float, Draw(0.03, 0.15)]
    slip_mm: Annotated[float, Draw(0.15, 0.5, log=True)]

    def friction(self, scene: Scene) -> Floats | float:
        """Return the relative change of μ."""
        part = np.clip((scene.motion.p - self.plateau_mm) / self.slip_mm, 0.0, 1.0)
        return np.asarray(self.amplitude * (1 + np.cos(np.pi * part)) / 2)


@dataclass(frozen=True, slots=True)
class PreslidingHyperbola(Effect):
    """Friction builds up as s / (s + l), to a power; at standstill it fades inversely with time."""

    name, form, kinds = "presliding", "hyperbola both ways", SLIDING
    amplitude: Annotated[float, Draw(0.35, 0.9)]
    slip_mm: Annotated[float, Draw(0.03, 0.2, log=True)]
    power: Annotated[float, Draw(0.8, 2.0)]
    half_s: Annotated[float, Draw(1.0, 4.0, log=True)]

    def grip(self, direction: Floats, scene: Scene) -> Floats:
        """Return the share of the Coulomb force that acts."""
        slip = np.maximum(scene.motion.p, 0.0)
        built = (slip / (slip + self.slip_mm)) ** self.power
        held = np.maximum(scene.motion.t - scene.run.bounds_s[3], 0.0)
        return (1 - self.amplitude) * direction + self.amplitude * built / (1 + held / self.half_s)


@dataclass(frozen=True, slots=True)
class PreslidingCreep(Effect):
    """Friction builds up in a straight line over the slip, stays at standstill, and creeps off."""

    name, form, kinds = "presliding", "straight line with creep", SLIDING
    amplitude: Annotated[float, Draw(0.35, 0.9)]
    slip_mm: Annotated[float, Draw(0.08, 0.4, log=True)]
    creep: Annotated[float, Draw(0.12, 0.19)]

    def grip(self, direction: Floats, scene: Scene) -> Floats:
        """Return the share of the Coulomb force that acts."""
        built = np.clip(scene.motion.p / self.slip_mm, 0.0, 1.0)
        held = np.maximum(scene.motion.t - scene.run.bounds_s[3], 0.0)
        return (1 - self.amplitude) * direction + self.amplitude * built * (1 - self.creep * np.log1p(held / 0.05))


@dataclass(frozen=True, slots=True)
class PreslidingRelease(Effect):
    """Friction builds up as s / √(s² + l²); at standstill part of it springs back and the rest stays."""

    name, form, kinds = "presliding", "root with release", SLIDING
    amplitude: Annotated[float, Draw(0.45, 0.95)]
    slip_mm: Annotated[float, Draw(0.06, 0.3, log=True)]
    stays: Annotated[float, Draw(0.4, 0.7)]
    release_s: Annotated[float, Draw(0.3, 0.9)]

    def grip(self, direction: Floats, scene: Scene) -> Floats:
        """Return the share of the Coulomb force that acts."""
        slip = np.maximum(scene.motion.p, 0.0)
        built = slip / np.hypot(slip, self.slip_mm)
        held = np.maximum(scene.motion.t - scene.run.bounds_s[3], 0.0)
        left = self.stays + (1 - self.stays) * np.exp(-held / self.release_s)
        return (1 - self.amplitude) * direction + self.amplitude * built * left


FORMS: tuple[type[Effect], ...] = (
    BreakawayBump,
    BreakawayRamp,
    BreakawayPlateau,
    PreslidingHyperbola,
    PreslidingCreep,
    PreslidingRelease,
)
