"""Friction of a drive that differs with direction."""

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


class DirectionAsymmetry(ForceEffect):
    """Friction is larger by `asymmetry` towards positive positions, and smaller by as much the other way."""

    id: ClassVar[str] = "direction_asymmetry"
    place: ClassVar[EffectLocation] = EffectLocation.MOTOR
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.SPEED
    summary: ClassVar[str] = "The drive's friction differs with the direction of motion."
    exposes: ClassVar[str] = "steady motion there against steady motion back"
    source: ClassVar[str] = "Armstrong-Hélouvry, Control of Machines with Friction (1991), chapter 2"
    nominal: ClassVar[str] = "drive"
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("asymmetry", "1", ParameterRole.SIZE, 0.1, -0.9, 0.9, "half the difference over the mean"),
    )

    def added(self, scene: RunState, values: Mapping[str, float]) -> FloatArray:
        """Return what is added to friction: towards positive positions, whichever way the drive moves."""
        return np.asarray(values["asymmetry"] * np.abs(scene.f_c + scene.f_v))


EFFECT = DirectionAsymmetry()
