"""Hidden effects between mucosa and capsule: what changes μ or adds tack."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.base import DRAG, SLIDING, Draw, Effect, Parts, Scene
from dragrig.sim_backend.blind.motion import Floats


@dataclass(frozen=True, slots=True)
class StribeckRational(Effect):
    """μ falls as a rational function of speed."""

    name, form, kinds = "stribeck", "rational", SLIDING
    amplitude: Annotated[float, Draw(0.4, 0.9)]
    speed_mm_s: Annotated[float, Draw(1.5, 8.0, log=True)]
    power: Annotated[float, Draw(1.0, 2.2)]

    def friction(self, scene: Scene) -> Floats | float:
        """Return the relative change of μ."""
        return np.asarray(self.amplitude / (1 + (scene.speed / self.speed_mm_s) ** self.power))


@dataclass(frozen=True, slots=True)
class StribeckLogNormal(Effect):
    """μ falls as the error function of the logarithm of speed."""

    name, form, kinds = "stribeck", "error function in ln v", SLIDING
    amplitude: Annotated[float, Draw(0.4, 0.9)]
    speed_mm_s: Annotated[float, Draw(1.5, 8.0, log=True)]
    width: Annotated[float, Draw(0.5, 1.3)]

    def friction(self, scene: Scene) -> Floats | float:
        """Return the relative change of μ."""
        from scipy.special import erfc

        decades = np.log(np.maximum(scene.speed, 1e-6) / self.speed_mm_s)
        return np.asarray(self.amplitude * erfc(decades / self.width) / 2)


@dataclass(frozen=True, slots=True)
class StribeckRamp(Effect):
    """μ falls in proportion to the logarithm of speed between two speeds."""

    name, form, kinds = "stribeck", "piecewise in log v", SLIDING
    amplitude: Annotated[float, Draw(0.4, 0.9)]
    low_mm_s: Annotated[float, Draw(0.3, 1.2, log=True)]
    ratio: Annotated[float, Draw(6.0, 20.0, log=True)]

    def friction(self, scene: Scene) -> Floats | float:
        """Return the relative change of μ."""
        part = np.log(np.maximum(scene.speed, 1e-6) / self.low_mm_s) / np.log(self.ratio)
        return np.asarray(self.amplitude * np.clip(1 - part, 0.0, 1.0))


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
    """Friction builds up as s / (s + l), to a power, and part of it stays at standstill."""

    name, form, kinds = "presliding", "hyperbola", SLIDING
    amplitude: Annotated[float, Draw(0.35, 0.9)]
    slip_mm: Annotated[float, Draw(0.03, 0.2, log=True)]
    power: Annotated[float, Draw(0.8, 2.0)]

    def grip(self, direction: Floats, scene: Scene) -> Floats:
        """Return the share of the Coulomb force that acts."""
        slip = np.maximum(scene.motion.p, 0.0)
        built = (slip / (slip + self.slip_mm)) ** self.power
        return (1 - self.amplitude) * direction + self.amplitude * built


@dataclass(frozen=True, slots=True)
class PreslidingCreep(Effect):
    """Friction builds up in a straight line over the slip, stays at standstill, and creeps off."""

    name, form, kinds = "presliding", "straight line with creep", SLIDING
    amplitude: Annotated[float, Draw(0.35, 0.9)]
    slip_mm: Annotated[float, Draw(0.08, 0.4, log=True)]
    creep: Annotated[float, Draw(0.02, 0.10)]

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
    stays: Annotated[float, Draw(0.5, 0.85)]
    release_s: Annotated[float, Draw(0.05, 0.4)]

    def grip(self, direction: Floats, scene: Scene) -> Floats:
        """Return the share of the Coulomb force that acts."""
        slip = np.maximum(scene.motion.p, 0.0)
        built = slip / np.hypot(slip, self.slip_mm)
        held = np.maximum(scene.motion.t - scene.run.bounds_s[3], 0.0)
        left = self.stays + (1 - self.stays) * np.exp(-held / self.release_s)
        return (1 - self.amplitude) * direction + self.amplitude * built * left


@dataclass(frozen=True, slots=True)
class AdhesionRoot(Effect):
    """Tack that falls as the inverse root of one plus speed squared."""

    name, form, kinds = "adhesion", "inverse root", DRAG
    amplitude: Annotated[float, Draw(14.0, 34.0)]
    speed_mm_s: Annotated[float, Draw(2.0, 10.0, log=True)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the tack [mN]."""
        return np.asarray(self.amplitude * scene.direction / np.sqrt(1 + (scene.speed / self.speed_mm_s) ** 2))


@dataclass(frozen=True, slots=True)
class AdhesionLog(Effect):
    """Tack that falls with the logarithm of speed and ends at a highest speed."""

    name, form, kinds = "adhesion", "logarithm", DRAG
    amplitude: Annotated[float, Draw(14.0, 34.0)]
    speed_mm_s: Annotated[float, Draw(0.5, 3.0, log=True)]
    end_mm_s: Annotated[float, Draw(40.0, 120.0)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the tack [mN]."""
        fall = np.log1p(scene.speed / self.speed_mm_s) / np.log1p(self.end_mm_s / self.speed_mm_s)
        return np.asarray(self.amplitude * scene.direction * np.maximum(1 - fall, 0.0))


@dataclass(frozen=True, slots=True)
class AdhesionBend(Effect):
    """Tack that holds at low speed and falls inversely with speed beyond a bend."""

    name, form, kinds = "adhesion", "plateau and inverse", DRAG
    amplitude: Annotated[float, Draw(14.0, 34.0)]
    speed_mm_s: Annotated[float, Draw(2.0, 8.0, log=True)]
    power: Annotated[float, Draw(0.6, 1.2)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the tack [mN]."""
        return np.asarray(
            self.amplitude * scene.direction * np.maximum(scene.speed / self.speed_mm_s, 1.0) ** -self.power
        )


@dataclass(frozen=True, slots=True)
class FilmPower(Effect):
    """μ grows with a power of the distance."""

    name, form, kinds = "film_depletion", "power of distance", SLIDING
    amplitude: Annotated[float, Draw(0.35, 0.9)]
    power: Annotated[float, Draw(1.3, 2.2)]

    def friction(self, scene: Scene) -> Floats | float:
        """Return the relative change of μ."""
        return np.asarray(self.amplitude * (np.maximum(scene.motion.p, 0.0) / 40.0) ** self.power)


@dataclass(frozen=True, slots=True)
class FilmStep(Effect):
    """μ grows smoothly from a wet to a wiped state about one distance."""

    name, form, kinds = "film_depletion", "logistic in distance", SLIDING
    amplitude: Annotated[float, Draw(0.35, 0.9)]
    middle_mm: Annotated[float, Draw(10.0, 25.0)]
    width_mm: Annotated[float, Draw(4.0, 9.0)]

    def friction(self, scene: Scene) -> Floats | float:
        """Return the relative change of μ."""
        lower = 1 / (1 + np.exp(self.middle_mm / self.width_mm))
        grown = 1 / (1 + np.exp(-(scene.motion.p - self.middle_mm) / self.width_mm))
        return np.asarray(self.amplitude * (grown - lower))


FORMS: tuple[type[Effect], ...] = (
    StribeckRational, StribeckLogNormal, StribeckRamp, BreakawayBump, BreakawayRamp, BreakawayPlateau,
    PreslidingHyperbola, PreslidingCreep, PreslidingRelease, AdhesionRoot, AdhesionLog, AdhesionBend, FilmPower,
    FilmStep,
)  # fmt: skip
