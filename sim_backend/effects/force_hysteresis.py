"""Play and friction in the force chain: what is shown depends on where the force comes from."""

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Coordinate, EffectParameter, Location, Role, SensorEffect, Values
from dragrig.sim_backend.effects.run_state import RunState
from dragrig.sim_backend.friction.wall import linear_recursion


class ForceHysteresis(SensorEffect):
    """A force that rises is shown too low by `half_width`, one that falls too high; a reversal takes `reversal` mN."""

    id = "force_hysteresis"
    display_name = "hysteresis of the force sensor"
    location = Location.FORCE_SENSOR
    coordinate = Coordinate.TRANSIENT
    summary = "Play or friction in the force chain holds back what is shown of a change of force."
    visible_in = "reversals of the force, small signals, the hold after a stop"
    source = "Dahl, A solid friction model, Aerospace Corporation TOR-0158 (1968), with force as its path"
    confused_with = ("presliding",)
    similar_to = ("force_nonlinearity",)
    parameters = (
        EffectParameter("half_width_mN", "mN", Role.SIZE, 8.0, 0.0, 200.0, "half the width of the loop"),
        EffectParameter(
            "reversal_mN",
            "mN",
            Role.SHAPE,
            10.0,
            0.5,
            300.0,
            "change of force that turns it",
            grid=(5.0, 50.0),
        ),
    )

    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        """Return the force less what is held back, which starts at nothing."""
        del run
        change = np.diff(force_mN, prepend=force_mN[:1])
        kept = np.exp(-np.abs(change) / values["reversal_mN"])
        held = linear_recursion(kept, np.sign(change) * (1 - kept))
        return np.asarray(force_mN - values["half_width_mN"] * held)


EFFECT = ForceHysteresis()
