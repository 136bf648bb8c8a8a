"""A person's own nominal model, prepared for a diagnosis."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from dragrig.analysis.gap.design import Design
from dragrig.analysis.gap.narrowing import narrowed
from dragrig.analysis.gap.open_questions import of_any, of_own
from dragrig.analysis.gap.predicted_scene import acting, predicted_scene
from dragrig.analysis.gap.resembling import like_friction
from dragrig.analysis.gap.sights import LONGEST_MM, sights_of
from dragrig.analysis.gap.study import Study, part_of
from dragrig.analysis.identification.joint.problem import Problem
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.nominal.protocol import NominalModel
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.rig.runfile.schema import SIGNALS
from dragrig.sim_backend.effects.base import Effect, ForceEffect, SensorEffect
from dragrig.sim_backend.effects.scene import Scene

FORCE_UNIT = "mN"


@dataclass(frozen=True, eq=False)
class OwnStudy(Study):
    """One channel of a model that says nothing of its parts: effects of the sensor can act on it.

    Attributes
    ----------
    others
        Channels that the model predicts too.
    untried
        How many effects would act between what slides, of which the model does not tell the force.
    """

    others: tuple[str, ...] = ()
    untried: int = 0

    @classmethod
    def of(cls, selection: Selection, nominal: NominalModel, effects: Sequence[Effect]) -> "OwnStudy":
        """Prepare all runs by the first force that is predicted, the force sensor's before others.

        Raises
        ------
        AnalysisError
            Where the model predicts no force of any run, or fails.
        """
        whole = Problem.of(selection, nominal, LONGEST_MM)
        channels = tuple(dict.fromkeys(one.channel for one in whole.evidence))
        forces = _forces(selection)
        channel = next((one for one in (*SIGNALS, *channels) if one in channels and one in forces), None)
        if channel is None:
            raise AnalysisError(
                f"the model {nominal.name} predicts {', '.join(channels)} and no force in mN, which is what a "
                "diagnosis explains; name another model with --nominal."
            )
        problem = narrowed(part_of(whole, [at for at, one in enumerate(whole.evidence) if one.channel == channel]))
        others = tuple(one for one in channels if one != channel)
        untried = sum(isinstance(one, ForceEffect) for one in effects)
        bare = cls(problem, sights_of(problem.evidence), (), others, untried)
        sensor = [one for one in effects if isinstance(one, SensorEffect) and not one.nominal]
        return replace(bare, effects=acting(bare, sensor))

    def scene(self, number: int, z: FloatArray) -> tuple[Scene, float]:
        """Return what effects see of a run: its motion, and the force as predicted."""
        sight = self.sights[number]
        prediction = sight.evidence.predictor.predict(self.problem.scales.values(z), sight.evidence.blocks.nodes_s)
        return predicted_scene(sight, prediction.total), 1.0

    def counted(self, number: int, motion_sd: FloatArray) -> BoolArray:
        """Return the blocks of which the motion tells more than a single sample's noise hides."""
        return motion_sd <= self.problem.noises[number].white

    def untold(self, design: Design) -> int:
        """Return the number of effects that were not tried where candidates look like friction along the way."""
        return self.untried if like_friction(design, self.sights) else 0

    def open_questions(self) -> Iterator[str]:
        """Say what these runs and this model leave open, a sentence each."""
        yield from of_own(self.sights, self.others)
        yield from of_any(self.sights)


def _forces(selection: Selection) -> set[str]:
    """Return the channels that are forces."""
    headers = [one.run.info.header for one in selection.experiments]
    return {channel.name for header in headers for channel in header.channels if channel.units == FORCE_UNIT}
