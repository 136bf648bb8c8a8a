"""Mass beyond the force sensor."""

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
from dragrig.sim_backend.effects.dynamics import first_order
from dragrig.sim_backend.effects.run_state import RunState

MIN_LAG_S = 1e-4
"""A shorter lag is none."""


class PayloadInertia(SensorEffect):
    """The sensor shows mass times acceleration of what hangs on it."""

    id: ClassVar[str] = "payload_inertia"
    place: ClassVar[EffectLocation] = EffectLocation.FORCE_SENSOR
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.TRANSIENT
    summary: ClassVar[str] = "The mass beyond the sensor needs a force to be accelerated."
    exposes: ClassVar[str] = "accelerate and decelerate, blank runs included"
    link: ClassVar[MeasuringLink] = MeasuringLink.PAYLOAD
    source: ClassVar[str] = "Newton's second law"
    aliases: ClassVar[tuple[str, ...]] = ("arm_compliance",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("mass_g", "g", ParameterRole.SIZE, 20.0, 0.0, 1000.0, "mass beyond the sensor"),
        EffectParameter(
            "lag_s",
            "s",
            ParameterRole.SHAPE,
            0.0,
            0.0,
            0.1,
            "time that a soft coupling takes",
            tried=(0.0, 0.006, 0.02),
        ),
    )

    def shown(self, scene: RunState, force_mN: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the force with that of the mass; g · mm/s² is µN."""
        pull = 1e-3 * values["mass_g"] * scene.acceleration_mm_s2
        lag_s = values["lag_s"]
        return np.asarray(force_mN + (first_order(scene.time_s, pull, lag_s) if lag_s > MIN_LAG_S else pull))


EFFECT = PayloadInertia()
