"""Hidden effects between mucosa and capsule: what changes μ or adds tack."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.base import DRAG, SLIDING, Draw, Effect, Parts, Scene
from dragrig.sim_backend.blind.motion import Floats

REFERENCE_MN = 1000.0
"""Normal force at which speeds are told."""


@dataclass(frozen=True, slots=True)
class StribeckRational(Effect):
    """μ falls as a rational function of speed, once the capsule has drawn in its film over a distance."""

    name, form, kinds = "stribeck", "rational, film drawn in", SLIDING
    amplitude: Annotated[float, Draw(0.4, 0.9)]
    speed_mm_s: Annotated[float, Draw(1.5, 6.0, log=True)]
    power: Annotated[float, Draw(1.0, 2.2)]
    distance_mm: Annotated[float, Draw(1.1, 2.6)]

    def friction(self, scene: Scene) -> Floats | float:
        """Return the relative change of μ."""
        film = -np.expm1(-np.maximum(scene.motion.p, 0.0) / self.distance_mm)
        return np.asarray(self.amplitude / (1 + film * (scene.speed / self.speed_mm_s) ** self.power))


@dataclass(frozen=True, slots=True)
class StribeckLogNormal(Effect):
    """μ falls as the error function of the logarithm of speed, through a minimum, and rises again."""

    name, form, kinds = "stribeck", "error function with minimum", SLIDING
    amplitude: Annotated[float, Draw(0.4, 0.9)]
    speed_mm_s: Annotated[float, Draw(1.5, 5.0, log=True)]
    width: Annotated[float, Draw(0.5, 1.3)]
    dip: Annotated[float, Draw(0.25, 0.45)]

    def friction(self, scene: Scene) -> Floats | float:
        """Return the relative change of μ."""
        from scipy.special import erfc

        decades = np.log(np.maximum(scene.speed, 1e-6) / self.speed_mm_s)
        risen = np.maximum(scene.speed - 12.0, 0.0) / 30.0
        return np.asarray(self.amplitude * (erfc(decades / self.width) / 2 * (1 + self.dip) + self.dip * (risen - 1)))


@dataclass(frozen=True, slots=True)
class StribeckRamp(Effect):
    """μ falls with the logarithm of speed between two speeds, which the normal force raises (Hersey's number)."""

    name, form, kinds = "stribeck", "log v over load", SLIDING
    amplitude: Annotated[float, Draw(0.4, 0.9)]
    low_mm_s: Annotated[float, Draw(0.3, 1.0, log=True)]
    ratio: Annotated[float, Draw(6.0, 20.0, log=True)]
    load: Annotated[float, Draw(2.2, 3.2)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the friction that is added [mN]."""
        hersey = np.maximum(scene.speed, 1e-6) * (REFERENCE_MN / parts.normal) ** self.load
        part = np.log(hersey / self.low_mm_s) / np.log(self.ratio)
        return np.asarray(parts.coulomb * self.amplitude * np.clip(1 - part, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class AdhesionRoot(Effect):
    """Tack that falls as the inverse root of one plus speed squared, stronger where the contact has aged at rest."""

    name, form, kinds = "adhesion", "inverse root, aged at rest", DRAG
    amplitude: Annotated[float, Draw(11.0, 27.0)]
    speed_mm_s: Annotated[float, Draw(2.0, 10.0, log=True)]
    aged: Annotated[float, Draw(0.36, 0.62)]
    slip_mm: Annotated[float, Draw(4.0, 10.0)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the tack [mN]."""
        more = 1 + self.aged * np.exp(-np.maximum(scene.motion.p, 0.0) / self.slip_mm)
        return np.asarray(self.amplitude * more * scene.direction / np.sqrt(1 + (scene.speed / self.speed_mm_s) ** 2))


@dataclass(frozen=True, slots=True)
class AdhesionLog(Effect):
    """Tack that falls with the logarithm of speed to a highest one, and with the distance that uses it up."""

    name, form, kinds = "adhesion", "logarithm, used up", DRAG
    amplitude: Annotated[float, Draw(16.0, 38.0)]
    speed_mm_s: Annotated[float, Draw(0.5, 3.0, log=True)]
    end_mm_s: Annotated[float, Draw(40.0, 120.0)]
    length_mm: Annotated[float, Draw(110.0, 200.0)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the tack [mN]."""
        fall = np.log1p(scene.speed / self.speed_mm_s) / np.log1p(self.end_mm_s / self.speed_mm_s)
        left = np.exp(-np.maximum(scene.motion.p, 0.0) / self.length_mm)
        return np.asarray(self.amplitude * left * scene.direction * np.maximum(1 - fall, 0.0))


@dataclass(frozen=True, slots=True)
class AdhesionBend(Effect):
    """Tack that holds at low speed and falls inversely with speed beyond a bend."""

    name, form, kinds = "adhesion", "plateau and inverse", DRAG
    amplitude: Annotated[float, Draw(14.0, 34.0)]
    speed_mm_s: Annotated[float, Draw(2.0, 8.0, log=True)]
    power: Annotated[float, Draw(0.8, 1.4)]

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
    width_mm: Annotated[float, Draw(2.5, 4.5)]

    def friction(self, scene: Scene) -> Floats | float:
        """Return the relative change of μ."""
        lower = 1 / (1 + np.exp(self.middle_mm / self.width_mm))
        grown = 1 / (1 + np.exp(-(scene.motion.p - self.middle_mm) / self.width_mm))
        return np.asarray(self.amplitude * (grown - lower))


FORMS: tuple[type[Effect], ...] = (
    StribeckRational, StribeckLogNormal, StribeckRamp,     AdhesionRoot, AdhesionLog, AdhesionBend, FilmPower,
    FilmStep,
)  # fmt: skip
