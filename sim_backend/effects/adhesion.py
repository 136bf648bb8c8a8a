"""Tack between mucosa and capsule."""

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Coordinate, EffectParameter, ForceEffect, Location, Role, Values
from dragrig.sim_backend.effects.run_state import RunState


class Adhesion(ForceEffect):
    """A friction of its own, `force / (1 + |v| / speed)`, that no normal force changes."""

    id = "adhesion"
    location = Location.INTERFACE
    coordinate = Coordinate.SPEED
    summary = "The mucosa tacks to the capsule, whatever presses on it, and the less the faster it slides."
    visible_in = "drag runs at low speed, not the Coulomb runs in the vacuum fixture"
    source = "bonds of finite lifetime that form anew while sliding; Chernyak and Leonov, Wear 108 (1986) 105"
    confused_with = ("stribeck",)
    parameters = (
        EffectParameter("force_mN", "mN", Role.SIZE, 15.0, 0.0, 200.0, "tack at rest"),
        EffectParameter(
            "speed_mm_s",
            "mm/s",
            Role.SHAPE,
            8.0,
            0.5,
            60.0,
            "where half of it is left",
            grid=(1.0, 2.5, 6.0, 12.0, 30.0),
        ),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        """Return the force of tack, which acts where the gut closes on the capsule."""
        if not run.closed:
            return np.zeros_like(run.time_s)
        return np.asarray(values["force_mN"] * run.turning / (1 + run.speed_mm_s / values["speed_mm_s"]))


EFFECT = Adhesion()
