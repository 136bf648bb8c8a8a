"""The wall's mass, pushed aside by the capsule."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, ForceEffect, Location, RunState, Values, size

REFERENCE_MM_S = 60.0
"""Speed that its force refers to."""


class WallInertia(ForceEffect):
    """A dynamic pressure on the cross-section: `force · (v / 60 mm/s)²`."""

    id = "wall_inertia"
    location = Location.WALL
    coordinate = Coordinate.SPEED
    summary = "The wall's mass must be pushed aside, with a force that grows with the square of speed."
    visible_in = "drag runs at high speed: the force is too high"
    source = (
        "momentum given to wall and surroundings per time, in the form of drag ½ ρ c A v²; "
        "Hoerner, Fluid-Dynamic Drag (1965), chapter 3"
    )
    confused_with = ("wall_lift_off",)
    parameters = (size("force_mN", "mN", 20.0, 0.0, 300.0, "force at 60 mm/s"),)

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        if not run.gut_closed:
            return np.zeros_like(run.time_s)
        velocity = run.velocity_mm_s / REFERENCE_MM_S
        return np.asarray(values["force_mN"] * velocity * np.abs(velocity))
