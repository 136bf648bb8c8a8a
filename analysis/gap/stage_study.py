"""The stage alone, prepared for a diagnosis by the drive model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from dragrig.analysis.gap.narrowing import narrowed
from dragrig.analysis.gap.open_questions import of_any, of_stage
from dragrig.analysis.gap.predicted_scene import Friction, acting, predicted_scene
from dragrig.analysis.gap.sights import LONGEST_MM, sights_of
from dragrig.analysis.gap.study import Study
from dragrig.analysis.identification.joint.problem import Problem
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.nominal.drive import TURNING_SPEED_MM_S, DriveModel, DrivePredictor
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.sim_backend.effects.base import Effect
from dragrig.sim_backend.effects.scene import Scene


@dataclass(frozen=True, eq=False)
class StageStudy(Study):
    """The recorded motor force: guides that slide, without wall or specimen."""

    @classmethod
    def of(cls, selection: Selection, nominal: DriveModel, effects: Sequence[Effect]) -> "StageStudy":
        """Prepare all runs; raises `AnalysisError` where none recorded a motor force."""
        problem = narrowed(Problem.of(selection, nominal, LONGEST_MM))
        bare = cls(problem, sights_of(problem.evidence), ())
        return replace(bare, effects=acting(bare, [one for one in effects if one.nominal in {"", nominal.name}]))

    def scene(self, number: int, z: FloatArray) -> tuple[Scene, float]:
        """Return what effects see of a run; the motor force has no gain of its own."""
        sight, values = self.sights[number], self.problem.scales.values(z)
        predictor, time_s = sight.evidence.predictor, sight.evidence.blocks.nodes_s
        friction = None
        if isinstance(predictor, DrivePredictor):
            viscous, coulomb = predictor.friction(values, time_s)
            friction = Friction(self.values(z)["coulomb_mN"], coulomb, viscous, TURNING_SPEED_MM_S)
        return predicted_scene(sight, predictor.predict(values, time_s).total, friction), 1.0

    def counted(self, number: int, motion_sd: FloatArray) -> BoolArray:
        """Return the blocks of which the motion tells more than a single sample's noise hides."""
        return motion_sd <= self.problem.noises[number].white

    def open_questions(self) -> Iterator[str]:
        """Say what these runs leave open, a sentence each."""
        yield from of_stage(self.sights)
        yield from of_any(self.sights)
