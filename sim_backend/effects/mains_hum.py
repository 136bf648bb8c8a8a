"""Mains pick-up in the force channel."""

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


class MainsHum(SensorEffect):
    """A sine at the mains frequency; as no run starts in step with the mains, its phase differs from run to run."""

    id: ClassVar[str] = "mains_hum"
    place: ClassVar[EffectLocation] = EffectLocation.FORCE_SENSOR
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.FREQUENCY
    summary: ClassVar[str] = "The force channel picks up the mains."
    exposes: ClassVar[str] = "rest and every other phase of every run"
    link: ClassVar[MeasuringLink] = MeasuringLink.AMPLIFIER
    source: ClassVar[str] = "Horowitz and Hill, The Art of Electronics, chapter 8 (interference)"
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("amplitude_mN", "mN", ParameterRole.SIZE, 5.0, 0.0, 100.0, "amplitude"),
        EffectParameter(
            "frequency_hz", "Hz", ParameterRole.SHAPE, 50.0, 45.0, 65.0, "mains frequency", tried=(50.0, 60.0)
        ),
        EffectParameter("phase_rad", "rad", ParameterRole.PHASE, 0.0, -np.pi, np.pi, "at the session's first sample"),
    )

    @property
    def of_session(self) -> bool:
        """Its phase differs from run to run."""
        return True

    def shown(self, scene: RunState, force_mN: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the force with the hum on the session's clock."""
        angle = 2 * np.pi * values["frequency_hz"] * scene.session_s + values["phase_rad"]
        return np.asarray(force_mN + values["amplitude_mN"] * np.sin(angle))


EFFECT = MainsHum()
