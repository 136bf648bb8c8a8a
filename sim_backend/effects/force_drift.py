"""A force sensor whose zero creeps during a run."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, Location, MeasuringLink, RunState, SensorEffect, Values, shape, size


class ForceDrift(SensorEffect):
    """The zero drifts by `drift` in the first minute, linearly or as a first-order warm-up."""

    id = "force_drift"
    display_name = "drift of the force sensor"
    location = Location.FORCE_SENSOR
    coordinate = Coordinate.TIME
    summary = "The force sensor's zero drifts during a run."
    visible_in = "rest and hold of every run, blank runs included"
    link = MeasuringLink.AMPLIFIER
    source = "first-order warm-up; Fraden, Handbook of Modern Sensors, chapter 2"
    confused_with = ("extra_relaxation", "film_depletion")
    similar_to = ("peristalsis",)
    free_law = "session"
    parameters = (
        size("drift_mN_min", "mN/min", 10.0, -200.0, 200.0, "drift in the first minute"),
        shape("warm_up_s", "s", 30.0, 1.0, 3000.0, "its time constant", grid=(2.0, 7.0, 25.0, 1000.0)),
    )

    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        warm_up = values["warm_up_s"]
        drift = np.expm1(-run.time_s / warm_up) / np.expm1(-60.0 / warm_up)
        return np.asarray(force_mN + values["drift_mN_min"] * drift)
