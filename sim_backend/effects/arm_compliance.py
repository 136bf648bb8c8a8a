"""An arm that rings after every jerk and every change of force."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import (
    Coordinate,
    Location,
    MeasuringLink,
    RunState,
    SensorEffect,
    Values,
    resonator,
    shape,
    size,
)

REFERENCE_MASS_G = 1000.0
"""Mass that rings at a share of 1 when jerks alone excite the arm."""


class ArmCompliance(SensorEffect):
    """An oscillator between force and sensor, excited by changes of the force, by the stage's jerks, or by both.

    `share` is the share of the force that rings or, excited by jerks, of the mass `REFERENCE_MASS_G`.
    """

    id = "arm_compliance"
    location = Location.FORCE_SENSOR
    coordinate = Coordinate.TRANSIENT
    summary = "The arm that carries the sensor rings after every jerk and every change of force."
    visible_in = "acceleration, deceleration and the time after them"
    link = MeasuringLink.ARM
    source = "damped oscillator under load and on a moving support; Thomson, Theory of Vibration"
    confused_with = ("payload_inertia", "channel_latency")
    similar_to = ("channel_latency", "payload_inertia")
    abrupt = True
    parameters = (
        size("share", "1", 1.0, 0.0, 2.0, "share of the force that rings"),
        shape("frequency_hz", "Hz", 20.0, 3.0, 100.0, "resonance", grid=(9.0, 12.0, 16.0, 21.0, 28.0, 38.0)),
        shape("damping", "1", 0.2, 0.01, 0.7, "share of critical", bounds=(0.001, 0.999)),
        shape("by_force", "1", 1.0, 0.0, 1.0, "1: excited by the force alone, 0: by jerks", grid=(0.0, 1.0)),
    )

    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        """Return the force transmitted by the arm; g · mm/s² is µN."""
        by_force = values["by_force"]
        pull = 1e-3 * REFERENCE_MASS_G * (1.0 - by_force) * run.acceleration_mm_s2
        rung = resonator(run.time_s, pull + by_force * force_mN, values["frequency_hz"], values["damping"])
        return np.asarray(force_mN + values["share"] * (rung - by_force * force_mN))
