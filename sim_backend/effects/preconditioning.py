"""A fresh specimen that is stiffer in its first runs."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, ForceEffect, Location, RunState, Values, shape, size


class Preconditioning(ForceEffect):
    """Stiffness is higher by `excess · exp(−order / runs)`."""

    id = "preconditioning"
    location = Location.SPECIMEN
    coordinate = Coordinate.SESSION
    summary = "A fresh specimen is stiffer in its first runs; the excess fades from run to run."
    visible_in = "relaxation and drag runs early in the order"
    source = "preconditioning towards a steady response over cycles; Fung, Biomechanics (1993), chapter 7"
    confused_with = ("tissue_ageing",)
    parameters = (
        size("excess", "1", 0.3, 0.0, 3.0, "relative excess of stiffness in the first run"),
        shape("runs", "1", 4.0, 0.5, 5.0, "runs over which it fades", grid=(1.0, 2.0, 4.0)),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        return np.asarray(run.stiffness_force * (values["excess"] * float(np.exp(-run.order / values["runs"]))))
