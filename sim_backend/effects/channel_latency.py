"""Force and position that are not sampled at the same instant."""

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


class ChannelLatency(SensorEffect):
    """The force channel shows the force of `latency` ago, or of a little later where that is negative."""

    id: ClassVar[str] = "channel_latency"
    place: ClassVar[EffectLocation] = EffectLocation.ACQUISITION
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.TRANSIENT
    summary: ClassVar[str] = "Force and position are not sampled at the same instant."
    exposes: ClassVar[str] = "fast transients: force against measured position at starts and stops"
    link: ClassVar[MeasuringLink] = MeasuringLink.CLOCK
    source: ClassVar[str] = "pure delay between channels; Bendat and Piersol, Random Data, section 5.1"
    aliases: ClassVar[tuple[str, ...]] = ("arm_compliance",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("latency_s", "s", ParameterRole.SIZE, 0.008, -0.1, 0.1, "force behind position"),
    )

    def shown(self, scene: RunState, force_mN: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the force at another time; outside of the run it is as at its ends."""
        return np.asarray(np.interp(scene.time_s - values["latency_s"], scene.time_s, force_mN))


EFFECT = ChannelLatency()
