"""Friction coefficient that falls with speed, from boundary to mixed lubrication."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import (
    EffectCoordinate,
    EffectLocation,
    EffectParameter,
    ForceEffect,
    ParameterRole,
)
from dragrig.sim_backend.effects.run_state import RunState


class Stribeck(ForceEffect):
    """f_c grows by `ratio · exp(−(|v| / speed)^power)`."""

    id: ClassVar[str] = "stribeck"
    called: ClassVar[str] = "Stribeck friction"
    place: ClassVar[EffectLocation] = EffectLocation.INTERFACE
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.SPEED
    summary: ClassVar[str] = "The friction coefficient falls with speed, from boundary to mixed lubrication."
    exposes: ClassVar[str] = "Coulomb and drag runs at low speed"
    source: ClassVar[str] = "Stribeck (1902); exponential form of Armstrong-Hélouvry et al., Automatica 30 (1994) 1083"
    aliases: ClassVar[tuple[str, ...]] = ("adhesion",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("ratio", "1", ParameterRole.SIZE, 0.4, 0.0, 2.0, "static over Coulomb friction, less 1"),
        EffectParameter(
            "speed_mm_s",
            "mm/s",
            ParameterRole.SHAPE,
            3.0,
            0.5,
            20.0,
            "Stribeck speed",
            tried=(0.7, 1.5, 3.0, 6.0, 12.0),
        ),
        EffectParameter("power", "1", ParameterRole.SHAPE, 1.0, 0.4, 4.0, "how suddenly it falls", tried=(1.0, 2.0)),
    )

    def added(self, scene: RunState, values: Mapping[str, float]) -> FloatArray:
        """Return the Coulomb friction that is added."""
        faster = (scene.speed_mm_s / values["speed_mm_s"]) ** values["power"]
        return np.asarray(scene.f_c * values["ratio"] * np.exp(-faster))


EFFECT = Stribeck()
