"""A run whose force some other model than the friction model predicts, as effects see it."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass

import numpy as np

from dragrig.analysis.gap.sights import Sight
from dragrig.analysis.gap.signatures import shapes_of, signature
from dragrig.analysis.gap.study import Study
from dragrig.config.specimen import Fixture
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.sim_backend.effects.base import Effect
from dragrig.sim_backend.effects.scene import Scene

ACTS_MN = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Friction:
    """Friction by its parts, at the times of a scene, shape `(n,)`.

    Attributes
    ----------
    coulomb_mN
        Coulomb friction at speed.
    coulomb, viscous
        Both parts with their signs [mN].
    turning_mm_s
        Speed over which the first turns its sign.
    """

    coulomb_mN: float
    coulomb: FloatArray
    viscous: FloatArray
    turning_mm_s: float


@dataclass(frozen=True, eq=False)
class PredictedScene(Scene):
    """A run without wall or specimen: friction that does not depend on any stiffness, in a force as predicted.

    Attributes
    ----------
    predicted
        The whole nominal force, shape `(n,)`.
    """

    _: KW_ONLY
    predicted: FloatArray

    @property
    def nominal(self) -> FloatArray:
        """The nominal force."""
        return self.predicted

    @property
    def stiff(self) -> FloatArray:
        """Nothing grows with the stiffness of a wall."""
        return np.zeros_like(self.time_s)


def predicted_scene(sight: Sight, predicted: FloatArray, friction: Friction | None = None) -> PredictedScene:
    """Return a run as effects see it, at the nodes of its blocks.

    Parameters
    ----------
    predicted
        The nominal force there, shape `(n,)`.
    friction
        What of it is friction between two surfaces that slide; nothing slides without.
    """
    time_s = sight.evidence.blocks.nodes_s
    nothing = np.zeros_like(time_s)
    parts = friction or Friction(0.0, nothing, nothing, 1.0)
    return PredictedScene(
        time_s=time_s,
        session_start_s=sight.session_start_s,
        order=sight.experiment.run.info.header.order,
        contact=Contact.NONE if friction is None else Contact.SLIDING,
        # Sliding under a given load with no wall around it, which is what the vacuum fixture is.
        fixture=Fixture.NONE if friction is None else Fixture.VACUUM,
        dwell_s=sight.experiment.insertion_dwell_s,
        motion=sight.experiment.motion,
        regularisation_mm_s=parts.turning_mm_s,
        f_e=nothing,
        f_v=parts.viscous,
        f_c=parts.coulomb,
        weight_mN=parts.coulomb_mN,
        friction_coefficient=1.0,
        shear=nothing,
        predicted=predicted,
    )


def acting(study: Study, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return the effects that change anything in any of the runs."""
    scenes = [study.scene(number, study.start) for number in range(len(study.sights))]
    return tuple(
        effect
        for effect in effects
        if any(
            np.abs(signature(shape, *scene)).max(initial=0.0) > ACTS_MN
            for shape in shapes_of([effect])
            for scene in scenes
        )
    )
