"""Mass beyond the force sensor."""

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import (
    Coordinate,
    EffectParameter,
    Location,
    MeasuringLink,
    Role,
    SensorEffect,
    Values,
)
from dragrig.sim_backend.effects.dynamics import first_order
from dragrig.sim_backend.effects.run_state import RunState

MIN_LAG_S = 1e-4
"""A shorter lag is none."""


class PayloadInertia(SensorEffect):
    """The sensor shows mass times acceleration of what hangs on it."""

    id = "payload_inertia"
    location = Location.FORCE_SENSOR
    coordinate = Coordinate.TRANSIENT
    summary = "The mass beyond the sensor needs a force to be accelerated."
    visible_in = "accelerate and decelerate, blank runs included"
    link = MeasuringLink.PAYLOAD
    source = "Newton's second law"
    confused_with = ("arm_compliance",)
    similar_to = ("arm_compliance", "channel_latency", "stribeck", "wall_lift_off")
    abrupt = True
    parameters = (
        EffectParameter("mass_g", "g", Role.SIZE, 20.0, 0.0, 1000.0, "mass beyond the sensor"),
        EffectParameter(
            "lag_s",
            "s",
            Role.SHAPE,
            0.0,
            0.0,
            0.1,
            "time that a soft coupling takes",
            grid=(0.0, 0.006, 0.02),
        ),
    )

    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        """Return the force with that of the mass; g · mm/s² is µN."""
        pull = 1e-3 * values["mass_g"] * run.acceleration_mm_s2
        lag_s = values["lag_s"]
        return np.asarray(force_mN + (first_order(run.time_s, pull, lag_s) if lag_s > MIN_LAG_S else pull))


EFFECT = PayloadInertia()
