"""An arm that rings after every jerk and every change of force."""

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
from dragrig.sim_backend.effects.dynamics import resonator
from dragrig.sim_backend.effects.run_state import RunState

REFERENCE_MASS_G = 1000.0
"""Mass on an arm that is rung by jerks alone, at a share of 1."""


class ArmCompliance(SensorEffect):
    """An oscillator between force and sensor, rung by changes of the force, by the stage's jerks, or by both.

    A share of the force rings; rung by jerks, a mass of that share of `REFERENCE_MASS_G` does.
    """

    id = "arm_compliance"
    location = Location.FORCE_SENSOR
    coordinate = Coordinate.TRANSIENT
    summary = "The arm that carries the sensor rings after every jerk and every change of force."
    visible_in = "accelerate, decelerate and what follows"
    link = MeasuringLink.ARM
    source = "damped oscillator under load and on a moving support; Thomson, Theory of Vibration"
    confused_with = ("payload_inertia", "channel_latency")
    similar_to = ("channel_latency", "payload_inertia")
    abrupt = True
    parameters = (
        EffectParameter("share", "1", Role.SIZE, 1.0, 0.0, 2.0, "of the force that rings"),
        EffectParameter(
            "frequency_hz",
            "Hz",
            Role.SHAPE,
            20.0,
            3.0,
            100.0,
            "resonance",
            grid=(9.0, 12.0, 16.0, 21.0, 28.0, 38.0),
        ),
        EffectParameter("damping", "1", Role.SHAPE, 0.2, 0.01, 0.7, "share of critical", bounds=(0.001, 0.999)),
        EffectParameter(
            "by_force",
            "1",
            Role.SHAPE,
            1.0,
            0.0,
            1.0,
            "1 rung by the force alone, 0 by jerks",
            grid=(0.0, 1.0),
        ),
    )

    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        """Return the force as the arm passes it on; g · mm/s² is µN."""
        by_force = values["by_force"]
        pull = 1e-3 * REFERENCE_MASS_G * (1.0 - by_force) * run.acceleration_mm_s2
        rung = resonator(run.time_s, pull + by_force * force_mN, values["frequency_hz"], values["damping"])
        return np.asarray(force_mN + values["share"] * (rung - by_force * force_mN))


EFFECT = ArmCompliance()
