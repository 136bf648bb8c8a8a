"""Tack between mucosa and capsule."""

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


class Adhesion(ForceEffect):
    """A friction of its own, `force / (1 + |v| / speed)`, that no normal force changes."""

    id: ClassVar[str] = "adhesion"
    place: ClassVar[EffectLocation] = EffectLocation.INTERFACE
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.SPEED
    summary: ClassVar[str] = (
        "The mucosa tacks to the capsule, whatever presses on it, and the less the faster it slides."
    )
    exposes: ClassVar[str] = "drag runs at low speed, not the Coulomb runs in the vacuum fixture"
    source: ClassVar[str] = (
        "bonds of finite lifetime that form anew while sliding; Chernyak and Leonov, Wear 108 (1986) 105"
    )
    aliases: ClassVar[tuple[str, ...]] = ("stribeck",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("force_mN", "mN", ParameterRole.SIZE, 15.0, 0.0, 200.0, "tack at rest"),
        EffectParameter(
            "speed_mm_s",
            "mm/s",
            ParameterRole.SHAPE,
            8.0,
            0.5,
            60.0,
            "where half of it is left",
            tried=(1.0, 2.5, 6.0, 12.0, 30.0),
        ),
    )

    def added(self, scene: RunState, values: Mapping[str, float]) -> FloatArray:
        """Return the force of tack, which acts where the gut closes on the capsule."""
        if not scene.closed:
            return np.zeros_like(scene.time_s)
        return np.asarray(values["force_mN"] * scene.turning / (1 + scene.speed_mm_s / values["speed_mm_s"]))


EFFECT = Adhesion()
