"""The wall's mass, pushed aside by the capsule."""

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

REFERENCE_MM_S = 60.0
"""Speed at which its force is named."""


class WallInertia(ForceEffect):
    """A dynamic pressure on the cross-section: `force · (v / 60 mm/s)²`."""

    id: ClassVar[str] = "wall_inertia"
    place: ClassVar[EffectLocation] = EffectLocation.WALL
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.SPEED
    summary: ClassVar[str] = "The wall's mass must be pushed aside, with a force that grows with the square of speed."
    exposes: ClassVar[str] = "drag runs at high speed: the force is too high"
    source: ClassVar[str] = (
        "momentum given to wall and surroundings per time, in the form of drag ½ ρ c A v²; "
        "Hoerner, Fluid-Dynamic Drag (1965), chapter 3"
    )
    aliases: ClassVar[tuple[str, ...]] = ("wall_lift_off",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("force_mN", "mN", ParameterRole.SIZE, 20.0, 0.0, 300.0, "force at 60 mm/s"),
    )

    def added(self, scene: RunState, values: Mapping[str, float]) -> FloatArray:
        """Return the force of inertia."""
        if not scene.closed:
            return np.zeros_like(scene.time_s)
        velocity = scene.velocity_mm_s / REFERENCE_MM_S
        return np.asarray(values["force_mN"] * velocity * np.abs(velocity))


EFFECT = WallInertia()
