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
from dragrig.sim_backend.friction import WallParameters


class HyperelasticWall(ForceEffect):
    """Modulus of the fast branch grows by `stiffening · ε^power`, those of slow branch and spring by a share of it.

    A wall strained fast carries more of its stress in the fast branch and so stiffens more. Where the viscosities do
    not grow with the moduli, the branches relax faster as well: rates grow as the moduli to the power `quickening`.
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
        shape(
            "quickening",
            "1",
            0.0,
            0.0,
            1.0,
            "power of a modulus's growth by which its branch relaxes faster: 0 with, 1 without a growing viscosity",
            grid=(0.0, 1.0),
        ),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        sheared, wall = run.sheared, run.wall
        if sheared is not None:
            # As for the elements themselves, the strain that is sheared to decides for the whole run.
            fast, slow = _growths(sheared.target_strain, values)
            stresses = [
                modulus * growth * sheared.branch(rate * float(growth) ** values["quickening"])
                for modulus, rate, growth in zip(sheared.moduli, sheared.rates, (fast, slow), strict=False)
            ]
            spring = slow * sheared.stresses[2]
            return np.asarray(sheared.area_mm2 * (sum(stresses) + spring - sum(sheared.stresses)))
        if wall is None:
            return np.zeros_like(run.time_s)
        front = _added_stress(HoopStress.on_hemisphere(wall), wall.parameters, wall.strain, wall.age_s, values)
        equator = _added_stress(
            HoopStress.at_equator(wall), wall.equator_parameters, wall.strain_at_equator, wall.equator_age_s, values
        )
        return force_of_hoop_stress(run, wall, front, equator)


def _growths(strain: FloatArray | float, values: Values) -> tuple[FloatArray, FloatArray]:
    """Return the factors on the fast branch's modulus, and on slow branch and spring."""
    growth = np.asarray(values["stiffening"] * strain ** values["power"])
    return 1 + growth, 1 + values["slow_share"] * growth


def _added_stress(
    nominal: HoopStress, wall: WallParameters, strain: FloatArray | float, age_s: FloatArray, values: Values
) -> FloatArray:
    """Return the hoop stress [kPa] that is added at contact ages."""
    fast, slow = _growths(strain, values)
    fast_rate, slow_rate = wall.rates

    def left(growth: FloatArray, rate: FloatArray) -> FloatArray:
        """Return a branch's stress over the nominal one, which has relaxed by the nominal rate."""
        return np.asarray(growth * np.exp(-age_s * rate * (growth ** values["quickening"] - 1)))

    added = nominal.fast * (left(fast, fast_rate) - 1) + nominal.slow * (left(slow, slow_rate) - 1)
    return np.asarray(added + nominal.spring * (slow - 1))
