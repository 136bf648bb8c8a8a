"""Hidden effects of gut as an organ."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.base import DRAG, Draw, Effect, Parts, Phase, Scene
from dragrig.sim_backend.blind.motion import Floats


@dataclass(frozen=True, slots=True)
class FoldsHarmonics(Effect):
    """Elastic resistance modulated in position with two harmonics."""

    name, form, kinds = "folds", "two harmonics", DRAG
    amplitude: Annotated[float, Draw(0.08, 0.20)]
    period_mm: Annotated[float, Draw(3.0, 8.0, log=True)]
    phase: Phase
    second: Annotated[float, Draw(0.10, 0.2)]
    second_phase: Phase

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        turn = 2 * np.pi * scene.motion.p / self.period_mm
        wave = np.cos(turn + self.phase) + self.second * np.cos(2 * turn + self.second_phase)
        return np.asarray(self.amplitude * parts.elastic * wave)


@dataclass(frozen=True, slots=True)
class FoldsRidges(Effect):
    """Narrow ridges at equal distances, between which the wall is slack."""

    name, form, kinds = "folds", "ridges", DRAG
    amplitude: Annotated[float, Draw(0.10, 0.25)]
    period_mm: Annotated[float, Draw(3.0, 8.0, log=True)]
    phase: Phase
    sharpness: Annotated[float, Draw(0.5, 1.5)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        from scipy.special import i0e

        turn = 2 * np.pi * scene.motion.p / self.period_mm + self.phase
        ridges = np.exp(self.sharpness * (np.cos(turn) - 1)) - i0e(self.sharpness)
        return np.asarray(self.amplitude * parts.elastic * ridges * (1 + self.sharpness / 2))


@dataclass(frozen=True, slots=True)
class FoldsWandering(Effect):
    """Folds whose distance changes along the gut, with straight flanks."""

    name, form, kinds = "folds", "wandering triangle", DRAG
    amplitude: Annotated[float, Draw(0.10, 0.25)]
    period_mm: Annotated[float, Draw(3.0, 8.0, log=True)]
    phase: Phase
    wander: Annotated[float, Draw(0.02, 0.05)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        p = scene.motion.p
        turn = 2 * np.pi * p / self.period_mm + self.phase + 2 * np.pi * self.wander * np.sin(2 * np.pi * p / 33.0)
        return np.asarray(self.amplitude * parts.elastic * np.arcsin(np.sin(turn)) * 2 / np.pi)


@dataclass(frozen=True, slots=True)
class TetherPower(Effect):
    """A pull that grows with a power of the travel beyond a place, and relaxes while the capsule is held."""

    name, form, kinds = "mesentery_tether", "power, relaxes in the hold", DRAG
    amplitude: Annotated[float, Draw(12.0, 34.0)]
    place_mm: Annotated[float, Draw(12.0, 26.0)]
    power: Annotated[float, Draw(1.3, 2.8)]
    relaxes: Annotated[float, Draw(0.4, 0.7)]
    time_s: Annotated[float, Draw(0.4, 1.5)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        beyond = np.maximum(scene.motion.p - self.place_mm, 0.0) / (40.0 - self.place_mm)
        held = np.maximum(scene.motion.t - scene.run.bounds_s[3], 0.0)
        return np.asarray(self.amplitude * beyond**self.power * (1 + self.relaxes * np.expm1(-held / self.time_s)))


@dataclass(frozen=True, slots=True)
class TetherSoft(Effect):
    """A pull that stiffens gradually, as tissue that unfolds does, and gives way again and again."""

    name, form, kinds = "mesentery_tether", "soft onset, slips", DRAG
    amplitude: Annotated[float, Draw(12.0, 34.0)]
    place_mm: Annotated[float, Draw(15.0, 28.0)]
    width_mm: Annotated[float, Draw(2.0, 5.0)]
    step_mm: Annotated[float, Draw(6.0, 11.0)]
    slips: Annotated[float, Draw(0.4, 0.65)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        w, p = self.width_mm, scene.motion.p
        grown, end = (np.logaddexp(0.0, (at - self.place_mm) / w) for at in (p, np.array(40.0)))
        taut = (grown - np.logaddexp(0.0, -self.place_mm / w)) / end
        turn = np.pi * (p - self.place_mm) / self.step_mm
        return np.asarray(self.amplitude * taut * (1 - self.slips * np.sin(turn) ** 4))


@dataclass(frozen=True, slots=True)
class TetherTwoStrands(Effect):
    """Two strands that come taut one after the other; the first gives way where the second comes taut."""

    name, form, kinds = "mesentery_tether", "two strands, one gives way", DRAG
    amplitude: Annotated[float, Draw(12.0, 34.0)]
    place_mm: Annotated[float, Draw(12.0, 19.0)]
    later_mm: Annotated[float, Draw(6.0, 10.0)]
    ratio: Annotated[float, Draw(0.5, 0.9)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""

        def taut(p: Floats) -> Floats:
            beyond = p - self.place_mm - self.later_mm
            first = np.clip(p - self.place_mm, 0.0, self.later_mm) / (1 + np.exp(np.clip((beyond - 1) / 0.3, -50, 50)))
            return np.asarray(first + self.ratio * np.maximum(beyond, 0.0))

        return np.asarray(self.amplitude * taut(scene.motion.p) / taut(np.array(40.0)))


@dataclass(frozen=True, slots=True)
class PeristalsisPulses(Effect):
    """Pulses of a Gaussian shape at times of the session that are not quite equally far apart."""

    name, form, kinds = "peristalsis", "Gaussian pulses, early and late", DRAG
    amplitude: Annotated[float, Draw(7.0, 18.0)]
    period_s: Annotated[float, Draw(3.5, 8.0)]
    phase: Phase
    width: Annotated[float, Draw(0.10, 0.18)]
    wander: Annotated[float, Draw(0.03, 0.06)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        turn = scene.session_s / self.period_s + self.phase / (2 * np.pi)
        late = turn + self.wander * np.sin(1.9 * turn)
        return np.asarray(self.amplitude * np.exp(-(((late - np.round(late)) / self.width) ** 2)))


@dataclass(frozen=True, slots=True)
class PeristalsisTwitch(Effect):
    """Contractions that rise fast and fade slowly, at equal times of the session."""

    name, form, kinds = "peristalsis", "fast rise, slow fall", DRAG
    amplitude: Annotated[float, Draw(7.0, 18.0)]
    period_s: Annotated[float, Draw(3.5, 8.0)]
    phase: Phase
    rise: Annotated[float, Draw(0.05, 0.15)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        turn = np.mod(scene.session_s / self.period_s + self.phase / (2 * np.pi), 1.0)
        return np.asarray(self.amplitude * turn / self.rise * np.exp(1 - turn / self.rise))


@dataclass(frozen=True, slots=True)
class PeristalsisUneven(Effect):
    """Smooth contractions at equal times of the session, not all equally strong."""

    name, form, kinds = "peristalsis", "uneven contractions", DRAG
    amplitude: Annotated[float, Draw(8.0, 20.0)]
    period_s: Annotated[float, Draw(3.5, 8.0)]
    phase: Phase
    uneven: Annotated[float, Draw(0.1, 0.35)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        turn = scene.session_s / self.period_s + self.phase / (2 * np.pi)
        strength = 1 + self.uneven * np.sin(2.4 * np.floor(turn + 0.5))
        return np.asarray(self.amplitude * strength * ((1 + np.cos(2 * np.pi * turn)) / 2) ** 3)


FORMS: tuple[type[Effect], ...] = (
    FoldsHarmonics, FoldsRidges, FoldsWandering, TetherPower, TetherSoft, TetherTwoStrands, PeristalsisPulses,
    PeristalsisTwitch, PeristalsisUneven,     )  # fmt: skip
