"""An aged contact that takes more force to start."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, ForceEffect, Location, RunState, Values, shape, size


class Breakaway(ForceEffect):
    """f_c grows by `ratio · exp(−distance / slip)` over the distance since the start."""

    id = "breakaway"
    display_name = "breakaway friction"
    location = Location.INTERFACE
    coordinate = Coordinate.TRANSIENT
    summary = "An aged contact needs more force to start and loses it over a short slip."
    visible_in = "the first tenths of a millimetre of Coulomb and drag runs"
    source = (
        "contact ageing renewed over a memory length; Dieterich, Journal of Geophysical Research 84 (1979) 2161; "
        "Baumberger and Caroli, Advances in Physics 55 (2006) 279"
    )
    confused_with = ("presliding",)
    parameters = (
        size("ratio", "1", 0.5, 0.0, 5.0, "friction at the start over Coulomb friction, minus 1"),
        shape("slip_mm", "mm", 0.2, 0.02, 2.0, "slip over which it decays", grid=(0.05, 0.1, 0.2, 0.4, 0.8)),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        return np.asarray(run.f_c * values["ratio"] * np.exp(-run.slip.slid_mm / values["slip_mm"]))
