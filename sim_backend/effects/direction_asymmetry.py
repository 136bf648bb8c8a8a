"""Friction of a drive that differs with direction."""

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Coordinate, EffectParameter, ForceEffect, Location, Role, Values
from dragrig.sim_backend.effects.run_state import RunState


class DirectionAsymmetry(ForceEffect):
    """Friction is larger by `asymmetry` towards positive positions, and smaller by as much the other way."""

    id = "direction_asymmetry"
    location = Location.MOTOR
    coordinate = Coordinate.SPEED
    summary = "The drive's friction differs with the direction of motion."
    visible_in = "steady motion there against steady motion back"
    source = "Armstrong-Hélouvry, Control of Machines with Friction (1991), chapter 2"
    nominal = "drive"
    parameters = (EffectParameter("asymmetry", "1", Role.SIZE, 0.1, -0.9, 0.9, "half the difference over the mean"),)

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        """Return what is added to friction: towards positive positions, whichever way the drive moves."""
        return np.asarray(values["asymmetry"] * np.abs(run.f_c + run.f_v))


EFFECT = DirectionAsymmetry()
