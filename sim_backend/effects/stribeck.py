"""Friction coefficient that falls with speed, from boundary to mixed lubrication."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, ForceEffect, Location, RunState, Values, shape, size


class Stribeck(ForceEffect):
    """f_c grows by `ratio · exp(−(|v| / speed)^power)`."""

    id = "stribeck"
    display_name = "Stribeck friction"
    location = Location.INTERFACE
    coordinate = Coordinate.SPEED
    summary = "The friction coefficient falls with speed, from boundary to mixed lubrication."
    visible_in = "Coulomb and drag runs at low speed"
    source = "Stribeck (1902); exponential form of Armstrong-Hélouvry et al., Automatica 30 (1994) 1083"
    confused_with = ("adhesion",)
    similar_to = ("adhesion", "breakaway", "wall_inertia")
    parameters = (
        size("ratio", "1", 0.4, 0.0, 2.0, "static over Coulomb friction, minus 1"),
        shape("speed_mm_s", "mm/s", 3.0, 0.5, 20.0, "Stribeck speed", grid=(0.7, 1.5, 3.0, 6.0, 12.0)),
        shape("power", "1", 1.0, 0.4, 4.0, "how suddenly it falls", grid=(1.0, 2.0)),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        faster = (run.speed_mm_s / values["speed_mm_s"]) ** values["power"]
        return np.asarray(run.f_c * values["ratio"] * np.exp(-faster))
