"""Hidden effects of gut as an organ, and of its change through a session."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dragrig.sim_backend.blind.effects.base import DRAG, TISSUE, Draw, Effect, Parts, Phase, Scene
from dragrig.sim_backend.blind.motion import Floats
from dragrig.sim_backend.blind.programme import RunPlan


@dataclass(frozen=True, slots=True)
class FoldsHarmonics(Effect):
    """Elastic resistance modulated in position with two harmonics."""

    name, form, kinds = "folds", "two harmonics", DRAG
    amplitude: Annotated[float, Draw(0.08, 0.20)]
    period_mm: Annotated[float, Draw(3.0, 8.0, log=True)]
    phase: Phase
    second: Annotated[float, Draw(0.3, 0.7)]
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
    sharpness: Annotated[float, Draw(1.0, 3.5)]

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
    wander: Annotated[float, Draw(0.1, 0.3)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        p = scene.motion.p
        turn = 2 * np.pi * p / self.period_mm + self.phase + 2 * np.pi * self.wander * np.sin(2 * np.pi * p / 33.0)
        return np.asarray(self.amplitude * parts.elastic * np.arcsin(np.sin(turn)) * 2 / np.pi)


@dataclass(frozen=True, slots=True)
class TetherPower(Effect):
    """A pull that grows with a power of the travel beyond a place."""

    name, form, kinds = "mesentery_tether", "power beyond a place", DRAG
    amplitude: Annotated[float, Draw(10.0, 30.0)]
    place_mm: Annotated[float, Draw(12.0, 26.0)]
    power: Annotated[float, Draw(1.3, 2.8)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        beyond = np.maximum(scene.motion.p - self.place_mm, 0.0) / (40.0 - self.place_mm)
        return np.asarray(self.amplitude * beyond**self.power)


@dataclass(frozen=True, slots=True)
class TetherSoft(Effect):
    """A pull that stiffens gradually, as tissue that unfolds does."""

    name, form, kinds = "mesentery_tether", "soft onset", DRAG
    amplitude: Annotated[float, Draw(10.0, 30.0)]
    place_mm: Annotated[float, Draw(15.0, 28.0)]
    width_mm: Annotated[float, Draw(2.0, 5.0)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        w = self.width_mm
        grown, end = (np.logaddexp(0.0, (p - self.place_mm) / w) for p in (scene.motion.p, np.array(40.0)))
        return np.asarray(self.amplitude * (grown - np.logaddexp(0.0, -self.place_mm / w)) / end)


@dataclass(frozen=True, slots=True)
class TetherTwoStrands(Effect):
    """Two strands that come taut one after the other, each a spring."""

    name, form, kinds = "mesentery_tether", "two strands", DRAG
    amplitude: Annotated[float, Draw(10.0, 30.0)]
    place_mm: Annotated[float, Draw(10.0, 20.0)]
    later_mm: Annotated[float, Draw(5.0, 12.0)]
    ratio: Annotated[float, Draw(0.5, 2.0)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""

        def taut(p: Floats) -> Floats:
            first, second = np.maximum(p - self.place_mm, 0.0), np.maximum(p - self.place_mm - self.later_mm, 0.0)
            return np.asarray(first + self.ratio * second)

        return np.asarray(self.amplitude * taut(scene.motion.p) / taut(np.array(40.0)))


@dataclass(frozen=True, slots=True)
class PeristalsisPulses(Effect):
    """Pulses of a Gaussian shape at equal times of the session."""

    name, form, kinds = "peristalsis", "Gaussian pulses", DRAG
    amplitude: Annotated[float, Draw(7.0, 18.0)]
    period_s: Annotated[float, Draw(3.5, 8.0)]
    phase: Phase
    width: Annotated[float, Draw(0.08, 0.16)]

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return the force [mN]."""
        turn = scene.session_s / self.period_s + self.phase / (2 * np.pi)
        off = turn - np.round(turn)
        return np.asarray(self.amplitude * np.exp(-((off / self.width) ** 2)))


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


@dataclass(frozen=True, slots=True)
class AgeingRoot(Effect):
    """Stiffness drifts with the root of the session's time."""

    name, form, kinds = "tissue_ageing", "root of time", TISSUE
    amplitude: Annotated[float, Draw(0.25, 0.5, signed=True)]

    def stiffness(self, run: RunPlan) -> float:
        """Return the factor on all stiffness."""
        return float(1 + self.amplitude * (run.start_s / 3000.0) ** 0.5)


@dataclass(frozen=True, slots=True)
class AgeingLate(Effect):
    """Stiffness drifts slowly at first and faster later on."""

    name, form, kinds = "tissue_ageing", "late", TISSUE
    amplitude: Annotated[float, Draw(0.25, 0.5, signed=True)]
    power: Annotated[float, Draw(1.2, 2.0)]

    def stiffness(self, run: RunPlan) -> float:
        """Return the factor on all stiffness."""
        return float(1 + self.amplitude * (run.start_s / 3000.0) ** self.power)


@dataclass(frozen=True, slots=True)
class AgeingTurn(Effect):
    """Stiffness changes over from one value to another about a time within the session."""

    name, form, kinds = "tissue_ageing", "change-over", TISSUE
    amplitude: Annotated[float, Draw(0.25, 0.5, signed=True)]
    middle_s: Annotated[float, Draw(900.0, 2000.0)]
    width_s: Annotated[float, Draw(250.0, 600.0)]

    def stiffness(self, run: RunPlan) -> float:
        """Return the factor on all stiffness."""
        now, start = (1 / (1 + np.exp(-(t - self.middle_s) / self.width_s)) for t in (run.start_s, 0.0))
        return float(1 + self.amplitude * (now - start) / (1 - start))


@dataclass(frozen=True, slots=True)
class PreconditioningRational(Effect):
    """The stiffness of a fresh specimen fades as a rational function of the run count."""

    name, form, kinds = "preconditioning", "rational", TISSUE
    amplitude: Annotated[float, Draw(0.35, 0.7)]
    runs: Annotated[float, Draw(1.5, 5.0)]
    power: Annotated[float, Draw(1.0, 2.0)]

    def stiffness(self, run: RunPlan) -> float:
        """Return the factor on all stiffness."""
        return float(1 + self.amplitude / (1 + (run.order / self.runs) ** self.power))


@dataclass(frozen=True, slots=True)
class PreconditioningBell(Effect):
    """The stiffness of a fresh specimen fades as a Gaussian of the run count."""

    name, form, kinds = "preconditioning", "Gaussian of run count", TISSUE
    amplitude: Annotated[float, Draw(0.35, 0.7)]
    runs: Annotated[float, Draw(2.0, 9.0)]

    def stiffness(self, run: RunPlan) -> float:
        """Return the factor on all stiffness."""
        return float(1 + self.amplitude * np.exp(-((run.order / self.runs) ** 2)))


FORMS: tuple[type[Effect], ...] = (
    FoldsHarmonics, FoldsRidges, FoldsWandering, TetherPower, TetherSoft, TetherTwoStrands, PeristalsisPulses,
    PeristalsisTwitch, PeristalsisUneven, AgeingRoot, AgeingLate, AgeingTurn, PreconditioningRational,
    PreconditioningBell,
)  # fmt: skip
