"""A campaign prepared for a diagnosis: evidence, scenes, the dictionary of shapes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dragrig.analysis.gap.modulations import modulations
from dragrig.analysis.gap.nuisances import details
from dragrig.analysis.gap.sights import LONGEST_MM, Sight, sights_of
from dragrig.analysis.gap.signatures import Shape, shapes_of
from dragrig.analysis.identification.joint.problem import Problem
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.nominal.capsule import CapsuleModel
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.applied import Chain
from dragrig.sim_backend.effects.base import Effect
from dragrig.sim_backend.effects.scene import Scene


@dataclass(frozen=True, eq=False)
class Study:
    """The force of a campaign's runs, ready to be explained.

    Attributes
    ----------
    nominal
        The nominal model; effects that its settings have belong to it.
    problem
        Evidence, noise and priors.
    sights
        The runs.
    effects
        Candidates of the force channel.
    """

    nominal: CapsuleModel
    problem: Problem
    sights: tuple[Sight, ...]
    effects: tuple[Effect, ...]

    @classmethod
    def of(cls, selection: Selection, nominal: CapsuleModel, effects: Sequence[Effect]) -> "Study":
        """Prepare all runs; raises `AnalysisError` where the model predicts nothing of any of them."""
        problem = Problem.of(selection, nominal, LONGEST_MM)
        return cls(nominal, problem, sights_of(problem.evidence), tuple(effects))

    def of_runs(self, kept: Sequence[int]) -> "Study":
        """Return the study of some of the runs, in their order; noise and priors stay as all runs give them."""
        problem = self.problem
        fewer = replace(
            problem,
            evidence=tuple(problem.evidence[one] for one in kept),
            noises=tuple(problem.noises[one] for one in kept),
            noise_covariances=tuple(problem.noise_covariances[one] for one in kept),
            zero_sds=tuple(problem.zero_sds[one] for one in kept),
        )
        return replace(self, problem=fewer, sights=tuple(self.sights[one] for one in kept))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the nominal parameters."""
        return tuple(one.name for one in self.problem.nominal.parameters)

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """Every shape of every candidate."""
        return shapes_of(self.effects)

    @cached_property
    def modulations(self) -> tuple[FloatArray, ...]:
        """Smooth functions that a foreign form may differ by, for each run, shape `(K, B)`."""
        return modulations(self.sights)

    @cached_property
    def chain(self) -> Chain:
        """Effects that the nominal model has already."""
        return Chain.of(self.nominal.settings)

    def values(self, z: FloatArray) -> Mapping[str, float]:
        """Return nominal parameters in units of their priors as values by name."""
        return dict(zip(self.names, self.problem.scales.values(z).tolist(), strict=True))

    def settings(self, z: FloatArray) -> FrictionModelSettings:
        """Return the friction model of this specimen."""
        return self.nominal.settings_of(self.values(z))

    def scene(self, number: int, z: FloatArray) -> tuple[Scene, float]:
        """Return what effects see of a run, and the gain of the channel that shows it."""
        settings = self.settings(z)
        return self.sights[number].scene(settings), settings.force_gain

    def details(self, number: int, scene: Scene) -> FloatArray:
        """Return what each of `DETAILS` changes of the true force, shape `(D, n)`."""
        return details(scene, self.sights[number].condition[1])

    @property
    def start(self) -> FloatArray:
        """What is known before any run."""
        return np.zeros(len(self.names))
