"""A mesentery, or a fixture, that pulls back late in the stroke."""

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

REFERENCE_MM = 10.0
"""Distance beyond the onset at which its force is named."""


class MesenteryTether(ForceEffect):
    """Beyond an onset it pulls with `force · ((distance − onset) / 10 mm)^power`, moving or not."""

    id: ClassVar[str] = "mesentery_tether"
    place: ClassVar[EffectLocation] = EffectLocation.WALL
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.POSITION
    summary: ClassVar[str] = "The mesentery or the fixture pulls back late in the stroke."
    exposes: ClassVar[str] = "growth beyond some position of drag runs, and what stays of it in the hold"
    source: ClassVar[str] = "toe and linear region of a slack membrane taken up; Fung, Biomechanics (1993), chapter 7"
    aliases: ClassVar[tuple[str, ...]] = ("film_depletion", "force_drift")
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("force_mN", "mN", ParameterRole.SIZE, 10.0, 0.0, 300.0, "pull 10 mm beyond the onset"),
        EffectParameter(
            "onset_mm",
            "mm",
            ParameterRole.SHAPE,
            10.0,
            0.0,
            200.0,
            "distance where it begins",
            tried=(0.0, 10.0, 18.0, 25.0, 31.0),
        ),
        EffectParameter("power", "1", ParameterRole.SHAPE, 1.0, 1.0, 4.0, "how it grows", tried=(1.0, 2.0)),
    )

    def added(self, scene: RunState, values: Mapping[str, float]) -> FloatArray:
        """Return the pull."""
        if not scene.closed:
            return np.zeros_like(scene.time_s)
        position = scene.position_mm
        taken_up = np.maximum(np.abs(position) - values["onset_mm"], 0.0) / REFERENCE_MM
        return np.asarray(values["force_mN"] * np.sign(position) * taken_up ** values["power"])


EFFECT = MesenteryTether()
