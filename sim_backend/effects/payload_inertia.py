"""Mass beyond the force sensor."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import (
    Coordinate,
    Location,
    MeasuringLink,
    RunState,
    SensorEffect,
    Values,
    first_order,
    shape,
    size,
)

MIN_LAG_S = 1e-4
"""A shorter lag is taken as 0."""


class PayloadInertia(SensorEffect):
    """The sensor measures mass times acceleration of the payload."""

    id = "payload_inertia"
    location = Location.FORCE_SENSOR
    coordinate = Coordinate.TRANSIENT
    summary = "Accelerating the mass beyond the sensor takes a force."
    visible_in = "acceleration and deceleration, blank runs included"
    link = MeasuringLink.PAYLOAD
    source = "Newton's second law"
    confused_with = ("arm_compliance",)
    similar_to = ("arm_compliance", "channel_latency", "stribeck", "wall_lift_off")
    abrupt = True
    parameters = (
        size("mass_g", "g", 20.0, 0.0, 1000.0, "mass beyond the sensor"),
        shape("lag_s", "s", 0.0, 0.0, 0.1, "time constant of a soft coupling", grid=(0.0, 0.006, 0.02)),
    )

    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        """Return the force plus that of the mass; g · mm/s² is µN."""
        pull = 1e-3 * values["mass_g"] * run.acceleration_mm_s2
        lag_s = values["lag_s"]
        return np.asarray(force_mN + (first_order(run.time_s, pull, lag_s) if lag_s > MIN_LAG_S else pull))
