"""Friction of a drive that differs with direction."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, ForceEffect, Location, RunState, Values, size


class DirectionAsymmetry(ForceEffect):
    """Friction is larger by `asymmetry` towards positive positions, and smaller by as much the other way."""

    id = "direction_asymmetry"
    location = Location.MOTOR
    coordinate = Coordinate.SPEED
    summary = "The drive's friction differs with the direction of motion."
    visible_in = "steady motion forwards against steady motion backwards"
    source = "Armstrong-Hélouvry, Control of Machines with Friction (1991), chapter 2"
    nominal = "drive"
    parameters = (size("asymmetry", "1", 0.1, -0.9, 0.9, "half the difference over the mean"),)

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        """Return the added friction, which resists motion towards positive position whichever way the drive moves."""
        return np.asarray(values["asymmetry"] * np.abs(run.f_c + run.f_v))
