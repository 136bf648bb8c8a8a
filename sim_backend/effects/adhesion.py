"""Tack between mucosa and capsule."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, ForceEffect, Location, RunState, Values, shape, size


class Adhesion(ForceEffect):
    """Friction independent of the normal force: `force / (1 + |v| / speed)`."""

    id = "adhesion"
    location = Location.INTERFACE
    coordinate = Coordinate.SPEED
    summary = "Tack between mucosa and capsule, independent of the normal force, weaker at higher speed."
    visible_in = "drag runs at low speed, not the Coulomb runs in the vacuum fixture"
    source = "bonds of finite lifetime that form anew while sliding; Chernyak and Leonov, Wear 108 (1986) 105"
    confused_with = ("stribeck",)
    parameters = (
        size("force_mN", "mN", 15.0, 0.0, 200.0, "tack at rest"),
        shape(
            "speed_mm_s", "mm/s", 8.0, 0.5, 60.0, "speed at which half of it remains", grid=(1.0, 2.5, 6.0, 12.0, 30.0)
        ),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        """Return the force of tack, which acts where the gut closes on the capsule."""
        if not run.gut_closed:
            return np.zeros_like(run.time_s)
        return np.asarray(values["force_mN"] * run.coulomb_sign / (1 + run.speed_mm_s / values["speed_mm_s"]))
