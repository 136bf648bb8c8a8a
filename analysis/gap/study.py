"""A campaign prepared for a diagnosis: evidence, scenes, the dictionary of shapes."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np

from dragrig.analysis.gap.modulations import modulations
from dragrig.analysis.gap.sights import Sight
from dragrig.analysis.gap.signatures import Shape, shapes_of
from dragrig.analysis.identification.joint.problem import Problem
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.sim_backend.effects.applied import Chain
from dragrig.sim_backend.effects.base import Effect
from dragrig.sim_backend.effects.scene import Scene

if TYPE_CHECKING:
    from dragrig.analysis.gap.design import Design


@dataclass(frozen=True, eq=False)
class Study(ABC):
    """The force of a campaign's runs, ready to be explained; what a nominal model is to it, a subclass says.

    Attributes
    ----------
    problem
        Evidence, noise and priors.
    sights
        The runs.
    effects
        Candidates of the force channel.
    """

    problem: Problem
    sights: tuple[Sight, ...]
    effects: tuple[Effect, ...]

    @abstractmethod
    def scene(self, number: int, z: FloatArray) -> tuple[Scene, float]:
        """Return what effects see of a run, and the gain of the channel that shows it."""

    def scenes(self, z: FloatArray) -> Iterator[tuple[Scene, float]]:
        """Give `scene` of each run in turn; that of a repeat shares all but its place in the session with the first."""
        first: dict[int, tuple[Scene, float]] = {}
        for number, (sight, like) in enumerate(zip(self.sights, self.problem.alike, strict=True)):
            if like == number:
                first[number] = self.scene(number, z)
                yield first[number]
                continue
            scene, gain = first[like]
            order = sight.experiment.run.info.header.order
            yield replace(scene, session_start_s=sight.session_start_s, order=order), gain

    @abstractmethod
    def open_questions(self) -> Iterator[str]:
        """Say what these runs and this model leave open, a sentence each."""

    @property
    def chain(self) -> Chain:
        """Effects that the nominal model has already; none unless said."""
        return Chain((), (), (), ())

    @property
    def start(self) -> FloatArray:
        """Nominal parameters in units of their priors that a diagnosis starts from: what is known before any run."""
        return np.zeros(len(self.names))

    def details(self, number: int, scene: Scene) -> FloatArray:
        """Return what each detail of the model that may be off changes, shape `(D, n)`; none unless said."""
        del number
        return np.zeros((0, scene.time_s.size))

    def doubts(self, z: FloatArray) -> list[FloatArray]:
        """Return what is not known of each run's block means beside its noise, one standard deviation, shape `(B,)`."""
        return self.problem.uncertainties(z)

    def counted(self, number: int, motion_sd: FloatArray) -> BoolArray | None:
        """Return the blocks of a run that say how large a gap is, shape `(B,)`; None, all of them, unless said.

        Parameters
        ----------
        motion_sd
            What the motion leaves uncertain of each block [mN], shape `(B,)`.
        """
        del number, motion_sd
        return None

    def simulator(self, z: FloatArray) -> FrictionModelSettings | None:
        """Return the friction model that effects may be added to for the simulator; None unless there is one."""
        del z
        return None

    def untold(self, design: "Design") -> int:
        """Return how many effects that cannot be tried may look like a design's candidates; 0 unless said."""
        del design
        return 0

    @property
    def channel(self) -> str:
        """The force that is explained."""
        return self.problem.evidence[0].channel

    def of_runs(self, kept: Sequence[int]) -> Self:
        """Return the study of some of the runs, in their order; noise and priors stay as all runs give them."""
        return replace(self, problem=part_of(self.problem, kept), sights=tuple(self.sights[one] for one in kept))

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

    def values(self, z: FloatArray) -> Mapping[str, float]:
        """Return nominal parameters in units of their priors as values by name."""
        return dict(zip(self.names, self.problem.scales.values(z).tolist(), strict=True))


def part_of(problem: Problem, kept: Sequence[int]) -> Problem:
    """Return a problem with some of its evidence, in that order."""
    return replace(
        problem,
        evidence=tuple(problem.evidence[one] for one in kept),
        noises=tuple(problem.noises[one] for one in kept),
        zero_sds=tuple(problem.zero_sds[one] for one in kept),
    )
