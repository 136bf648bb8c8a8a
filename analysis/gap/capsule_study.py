"""The capsule in the gut, prepared for a diagnosis by the friction model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dragrig.analysis.gap.known import with_known_hum, without_hum
from dragrig.analysis.gap.nuisances import details, doubt
from dragrig.analysis.gap.open_questions import of_any, of_capsule
from dragrig.analysis.gap.sights import LONGEST_MM, sights_of
from dragrig.analysis.gap.study import Study
from dragrig.analysis.identification.joint.problem import Problem
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.nominal.capsule import CapsuleModel
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.sim_backend.effects.applied import NOMINAL, Chain
from dragrig.sim_backend.effects.base import Effect
from dragrig.sim_backend.effects.scene import Scene


@dataclass(frozen=True, eq=False)
class CapsuleStudy(Study):
    """The force sensor's channel; effects that the model's settings have belong to the nominal model."""

    nominal: CapsuleModel

    @classmethod
    def of(cls, selection: Selection, nominal: CapsuleModel, effects: Sequence[Effect]) -> "CapsuleStudy":
        """Prepare all runs; raises `AnalysisError` where the model predicts nothing of any of them."""
        problem = with_known_hum(Problem.of(selection, nominal, LONGEST_MM), Chain.of(nominal.settings))
        own = tuple(one for one in effects if one.nominal in {"", NOMINAL})
        return cls(problem, sights_of(problem.evidence), own, nominal)

    @cached_property
    def chain(self) -> Chain:
        """Effects that the nominal model has already, but for the hum of the mains."""
        return without_hum(Chain.of(self.nominal.settings))

    def simulator(self, z: FloatArray) -> FrictionModelSettings:
        """Return the friction model of this specimen."""
        return self.nominal.settings_of(self.values(z))

    def scene(self, number: int, z: FloatArray) -> tuple[Scene, float]:
        """Return what effects see of a run, and the gain of the force sensor."""
        settings = self.simulator(z)
        return self.sights[number].scene(settings), settings.force_gain

    def details(self, number: int, scene: Scene) -> FloatArray:
        """Return what each of `DETAILS` changes of the true force, shape `(D, n)`."""
        return details(scene, self.sights[number].condition[1])

    def doubts(self, z: FloatArray) -> list[FloatArray]:
        """Return what the motion leaves uncertain, and of sheared walls what steps of a programme do."""
        found = super().doubts(z)
        for number, sight in enumerate(self.sights):
            if sight.acquisition.contact is Contact.STICKING:
                scene, gain = self.scene(number, z)
                found[number] = np.hypot(found[number], gain * sight.of_blocks(doubt(scene)))
        return found

    def open_questions(self) -> Iterator[str]:
        """Say what these runs leave open, a sentence each."""
        yield from of_capsule(self.sights)
        yield from of_any(self.sights)
