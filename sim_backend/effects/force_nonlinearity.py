"""A force sensor whose gain depends on the load."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, Location, RunState, SensorEffect, Values, shape, size

REFERENCE_LOAD_MN = 500.0
"""Load that the size refers to, between drag forces and the peaks of relaxations."""


class ForceNonlinearity(SensorEffect):
    """The gain has the relative error `gain_error · (|f| / 500 mN)^power`."""

    id = "force_nonlinearity"
    display_name = "nonlinearity of the force sensor"
    location = Location.FORCE_SENSOR
    coordinate = Coordinate.STRAIN
    summary = "The force sensor's gain depends on the load."
    visible_in = "relaxation peaks against drag"
    source = "power-law error of linearity; Wheeler and Ganji, Engineering Experimentation, chapter 2"
    confused_with = ("hyperelastic_wall",)
    free_law = "load"
    parameters = (
        size("gain_error", "1", 0.08, -0.5, 0.5, "relative, at 500 mN"),
        shape("power", "1", 1.0, 0.3, 4.0, "how it grows with load", grid=(0.5, 1.0, 2.0)),
    )

    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        load = np.abs(force_mN) / REFERENCE_LOAD_MN
        return np.asarray(force_mN * (1 + values["gain_error"] * load ** values["power"]))
