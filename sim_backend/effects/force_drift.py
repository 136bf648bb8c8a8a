"""A force sensor whose zero creeps during a run."""

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
from dragrig.sim_backend.effects.run_state import RunState


class ForceDrift(SensorEffect):
    """The zero goes to `drift` within a minute of the first sample, straight or as something that warms up."""

    id: ClassVar[str] = "force_drift"
    called: ClassVar[str] = "drift of the force sensor"
    place: ClassVar[EffectLocation] = EffectLocation.FORCE_SENSOR
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.TIME
    summary: ClassVar[str] = "The force sensor's zero creeps during a run."
    exposes: ClassVar[str] = "rest and hold of every run, blank runs included"
    link: ClassVar[MeasuringLink] = MeasuringLink.AMPLIFIER
    source: ClassVar[str] = "first-order warm-up; Fraden, Handbook of Modern Sensors, chapter 2"
    aliases: ClassVar[tuple[str, ...]] = ("extra_relaxation", "film_depletion")
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("drift_mN_min", "mN/min", ParameterRole.SIZE, 10.0, -200.0, 200.0, "creep in the first minute"),
        EffectParameter(
            "warm_up_s",
            "s",
            ParameterRole.SHAPE,
            30.0,
            1.0,
            3000.0,
            "its time constant",
            tried=(2.0, 7.0, 25.0, 1000.0),
        ),
    )

    def shown(self, scene: RunState, force_mN: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the force beside the zero's creep."""
        warm_up = values["warm_up_s"]
        crept = np.expm1(-scene.time_s / warm_up) / np.expm1(-60.0 / warm_up)
        return np.asarray(force_mN + values["drift_mN_min"] * crept)


EFFECT = ForceDrift()
