"""What a stress in the wall does to a capsule that slides in a closed gut, and what presses on one that slides."""

from dataclasses import dataclass

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.scene import Scene
from dragrig.sim_backend.effects.wall_view import WallView
from dragrig.sim_backend.friction.wall import WallParameters


@dataclass(frozen=True, slots=True, eq=False)
class Branches:
    """Nominal hoop stress [kPa] in fast branch, slow branch and spring."""

    fast: FloatArray
    slow: FloatArray
    spring: FloatArray

    @classmethod
    def of(cls, wall: WallParameters, strain: FloatArray | float, age_s: FloatArray) -> "Branches":
        """Relax the wall for a contact age (Eq. 3); elements and strain broadcast against the ages."""
        fast_rate, slow_rate = wall.rates
        return cls(
            fast=np.asarray(strain * wall.E1 * np.exp(-age_s * fast_rate)),
            slow=np.asarray(strain * wall.E2 * np.exp(-age_s * slow_rate)),
            spring=np.asarray(strain * wall.E3 * np.ones_like(age_s)),
        )

    @classmethod
    def on_hemisphere(cls, wall: WallView) -> "Branches":
        """Return those of each point and time, shape `(n, m)`."""
        return cls.of(wall.parameters, wall.strain, wall.age_s)

    @classmethod
    def at_equator(cls, wall: WallView) -> "Branches":
        """Return those at the equator, shape `(n,)`."""
        return cls.of(wall.equator_parameters, wall.strain_at_equator, wall.equator_age_s)

    @property
    def total(self) -> FloatArray:
        """Their sum."""
        return self.fast + self.slow + self.spring


def force_of_stress(scene: Scene, wall: WallView, stress_kPa: FloatArray, equator_kPa: FloatArray) -> FloatArray:
    """Return f_e and f_c [mN] of a further hoop stress, shapes `(n, m)` and `(n,)` to `(n,)` (Eqs. 9, 12 and 13)."""
    environment = np.sign(scene.f_e) * wall.resistance(stress_kPa)
    return np.asarray(environment + scene.friction_coefficient * scene.turning * wall.pressing(equator_kPa))


def normal_force(scene: Scene) -> FloatArray:
    """Return the nominal N [mN] of a run that slides, at rest too (Eq. 13)."""
    if scene.wall is None:
        return np.full_like(scene.time_s, scene.weight_mN)
    return np.asarray(scene.weight_mN + scene.wall.pressing(Branches.at_equator(scene.wall).total))
