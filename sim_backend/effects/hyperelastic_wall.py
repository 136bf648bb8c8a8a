"""A muscular layer that stiffens with strain."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import (
    Coordinate,
    ForceEffect,
    HoopStress,
    Location,
    RunState,
    Values,
    force_of_hoop_stress,
    shape,
    size,
)


class HyperelasticWall(ForceEffect):
    """Stress of the fast branch grows by `stiffening · ε^power`, that of slow branch and spring by `slow_share` of it.

    A wall strained fast carries more of its stress in the fast branch and so stiffens more.
    """

    id = "hyperelastic_wall"
    location = Location.WALL
    coordinate = Coordinate.STRAIN
    summary = "The muscular layer stiffens with strain, the more the faster it is strained."
    visible_in = "relaxations, whose peaks rise faster with strain; drag runs at speed"
    source = (
        "leading terms of exponential stiffening; Fung, Biomechanics (1993), chapter 7; of the intestine, "
        "Egorov et al., Journal of Biomechanics 35 (2002) 1417"
    )
    confused_with = ("extra_relaxation", "force_nonlinearity")
    parameters = (
        size("stiffening", "1", 0.3, 0.0, 5.0, "growth of stress at a strain of 100 %"),
        shape("power", "1", 2.0, 0.5, 5.0, "power of the strain", grid=(1.0, 2.5)),
        shape(
            "slow_share",
            "1",
            0.2,
            0.0,
            1.0,
            "share of the growth in slow branch and spring",
            grid=(0.0, 0.01, 0.04, 0.2, 1.0),
        ),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        power, slow_share = values["power"], values["slow_share"]
        if run.sheared is not None:
            fast, slow, spring = run.sheared.stresses
            # As for the elements themselves, the strain that is sheared to decides for the whole run.
            growth = values["stiffening"] * run.sheared.target_strain**power
            return np.asarray(run.sheared.area_mm2 * growth * (fast + slow_share * (slow + spring)))
        wall = run.wall
        if wall is None:
            return np.zeros_like(run.time_s)
        front, equator = HoopStress.on_hemisphere(wall), HoopStress.at_equator(wall)
        along = values["stiffening"] * wall.strain**power * (front.fast + slow_share * (front.slow + front.spring))
        at_end = values["stiffening"] * wall.strain_at_equator**power
        at_end = at_end * (equator.fast + slow_share * (equator.slow + equator.spring))
        return force_of_hoop_stress(run, wall, along, at_end)
