"""A wall that cannot follow the hemisphere at speed."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, ForceEffect, HoopStress, Location, RunState, Values, shape, size

MIN_LIFTED_MM = 1e-9
"""Avoids a division by a lifted length of 0."""


class WallLiftOff(ForceEffect):
    """Over the front `v^n / (v^n + speed^n)` of the contact's length, `share` of the pressure is lost."""

    id = "wall_lift_off"
    display_name = "wall lift-off"
    location = Location.WALL
    coordinate = Coordinate.SPEED
    summary = "At speed the wall cannot follow the hemisphere, and contact is lost from the front."
    visible_in = "drag runs above some 15 mm/s: f_e falls short"
    source = (
        "assumption 3 of the paper given up; contact lost where the wall's recovery is slower than the passage, "
        "as of a viscoelastic half-space at speed, Johnson, Contact Mechanics (1985), chapter 9"
    )
    confused_with = ("wall_inertia",)
    similar_to = ("wall_inertia", "peristalsis")
    parameters = (
        size("share", "1", 0.6, 0.0, 1.0, "share of the pressure lost where the wall lifts off"),
        shape(
            "speed_mm_s",
            "mm/s",
            25.0,
            8.0,
            80.0,
            "speed at which half the contact has lifted",
            grid=(10.0, 15.0, 22.0, 33.0, 50.0),
        ),
        shape("power", "1", 3.0, 1.0, 8.0, "steepness of the onset", grid=(2.0, 4.0)),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        """Return the lost part of f_e; the edge is blurred by a third of the length that lifts off."""
        wall = run.wall
        if wall is None:
            return np.zeros_like(run.time_s)
        faster = (run.speed_mm_s / values["speed_mm_s"]) ** values["power"]
        lifted_mm = wall.contact.length_mm * faster / (1 + faster)
        beyond = wall.x_mm / np.maximum(lifted_mm, MIN_LIFTED_MM)[:, None]
        gone = values["share"] * np.clip(2 - 1.5 * beyond, 0.0, 1.0) * HoopStress.on_hemisphere(wall).total
        return np.asarray(-np.sign(run.f_e) * wall.resistance(gone))
