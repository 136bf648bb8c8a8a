"""An arm that rings after every jerk and every change of force."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import (
    EffectCoordinate,
    EffectLocation,
    EffectParameter,
    MeasuringLink,
    ParameterRole,
    SensorEffect,
)
from dragrig.sim_backend.effects.dynamics import resonator
from dragrig.sim_backend.effects.run_state import RunState

REFERENCE_MASS_G = 1000.0
"""Mass on an arm that is rung by jerks alone, at a share of 1."""


class ArmCompliance(SensorEffect):
    """An oscillator between force and sensor, rung by changes of the force, by the stage's jerks, or by both.

    A share of the force rings; rung by jerks, a mass of that share of `REFERENCE_MASS_G` does.
    """

    id: ClassVar[str] = "arm_compliance"
    place: ClassVar[EffectLocation] = EffectLocation.FORCE_SENSOR
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.TRANSIENT
    summary: ClassVar[str] = "The arm that carries the sensor rings after every jerk and every change of force."
    exposes: ClassVar[str] = "accelerate, decelerate and what follows"
    link: ClassVar[MeasuringLink] = MeasuringLink.ARM
    source: ClassVar[str] = "damped oscillator under load and on a moving support; Thomson, Theory of Vibration"
    aliases: ClassVar[tuple[str, ...]] = ("payload_inertia", "channel_latency")
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("share", "1", ParameterRole.SIZE, 1.0, 0.0, 2.0, "of the force that rings"),
        EffectParameter(
            "frequency_hz",
            "Hz",
            ParameterRole.SHAPE,
            20.0,
            3.0,
            100.0,
            "resonance",
            tried=(9.0, 12.0, 16.0, 21.0, 28.0, 38.0),
        ),
        EffectParameter(
            "damping", "1", ParameterRole.SHAPE, 0.2, 0.01, 0.7, "share of critical", possible=(0.001, 0.999)
        ),
        EffectParameter(
            "by_force",
            "1",
            ParameterRole.SHAPE,
            1.0,
            0.0,
            1.0,
            "1 rung by the force alone, 0 by jerks",
            tried=(0.0, 1.0),
        ),
    )

    def shown(self, scene: RunState, force_mN: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the force as the arm passes it on; g · mm/s² is µN."""
        by_force = values["by_force"]
        pull = 1e-3 * REFERENCE_MASS_G * (1.0 - by_force) * scene.acceleration_mm_s2
        rung = resonator(scene.time_s, pull + by_force * force_mN, values["frequency_hz"], values["damping"])
        return np.asarray(force_mN + values["share"] * (rung - by_force * force_mN))


EFFECT = ArmCompliance()
