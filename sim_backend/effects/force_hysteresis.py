"""Play and friction in the force chain: the reading depends on the direction of change."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, Location, RunState, SensorEffect, Values, shape, size
from dragrig.sim_backend.friction import linear_recursion


class ForceHysteresis(SensorEffect):
    """A rising force reads low by `half_width`, a falling one high; a reversal takes a change of `reversal`."""

    id = "force_hysteresis"
    display_name = "hysteresis of the force sensor"
    location = Location.FORCE_SENSOR
    coordinate = Coordinate.TRANSIENT
    summary = "Play or friction in the force chain: the reading lags a change of force."
    visible_in = "reversals of the force, small signals, the hold after a stop"
    source = "Dahl, A solid friction model, Aerospace Corporation TOR-0158 (1968), with force as its path"
    confused_with = ("presliding",)
    similar_to = ("force_nonlinearity",)
    parameters = (
        size("half_width_mN", "mN", 8.0, 0.0, 200.0, "half the width of the loop"),
        shape("reversal_mN", "mN", 10.0, 0.5, 300.0, "change of force that reverses it", grid=(5.0, 50.0)),
    )

    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        """Return the force minus the part held back, which starts at 0."""
        change = np.diff(force_mN, prepend=force_mN[:1])
        decay = np.exp(-np.abs(change) / values["reversal_mN"])
        state = linear_recursion(decay, np.sign(change) * (1 - decay))
        return np.asarray(force_mN - values["half_width_mN"] * state)
