"""Friction that builds up over a deflection of the interface, and stays locked in at standstill."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import (
    Coordinate,
    ForceEffect,
    Location,
    RunState,
    Values,
    bristle_deflection,
    normal_force,
    shape,
    size,
)


class Presliding(ForceEffect):
    """A share of f_c becomes `μ N z`, with z a bristle's deflection over its steady one."""

    id = "presliding"
    display_name = "presliding friction"
    location = Location.INTERFACE
    coordinate = Coordinate.TRANSIENT
    summary = "Friction builds up over a bristle deflection instead of at once, and stays locked in at standstill."
    visible_in = "the first tenths of a millimetre, and the hold after stopping, of Coulomb and drag runs"
    source = (
        "Dahl, Aerospace Corporation report TOR-0158(3107-18)-1 (1968); bristles of Canudas de Wit et al., "
        "IEEE Transactions on Automatic Control 40 (1995) 419"
    )
    confused_with = ("breakaway", "force_hysteresis")
    similar_to = ("breakaway",)
    parameters = (
        size("share", "1", 0.6, 0.0, 1.0, "share of Coulomb friction that builds up gradually"),
        shape(
            "deflection_mm",
            "mm",
            0.1,
            0.01,
            2.0,
            "distance over which it builds up",
            grid=(0.03, 0.06, 0.12, 0.25, 0.5),
        ),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        """Return the bristles' friction minus the Coulomb friction that they replace."""
        if not run.sliding:
            return np.zeros_like(run.time_s)
        bristles = bristle_deflection(run.motion, run.time_s, values["deflection_mm"])
        friction = run.friction_coefficient * normal_force(run) * bristles
        return np.asarray(values["share"] * (friction - run.f_c))
