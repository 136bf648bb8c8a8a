"""A force sensor whose gain depends on the load."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import (
    EffectCoordinate,
    EffectLocation,
    EffectParameter,
    ParameterRole,
    SensorEffect,
)
from dragrig.sim_backend.effects.run_state import RunState

REFERENCE_LOAD_MN = 500.0
"""Load at which the size is told, between drag forces and the peaks of relaxations."""


class ForceNonlinearity(SensorEffect):
    """The gain is off by `gain_error · (|f| / 500 mN)^power`."""

    id: ClassVar[str] = "force_nonlinearity"
    called: ClassVar[str] = "nonlinearity of the force sensor"
    place: ClassVar[EffectLocation] = EffectLocation.FORCE_SENSOR
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.STRAIN
    summary: ClassVar[str] = "The force sensor's gain depends on the load."
    exposes: ClassVar[str] = "relaxation peaks against drag"
    source: ClassVar[str] = "power-law error of linearity; Wheeler and Ganji, Engineering Experimentation, chapter 2"
    aliases: ClassVar[tuple[str, ...]] = ("hyperelastic_wall",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("gain_error", "1", ParameterRole.SIZE, 0.08, -0.5, 0.5, "relative, at 500 mN"),
        EffectParameter(
            "power", "1", ParameterRole.SHAPE, 1.0, 0.3, 4.0, "how it grows with load", tried=(0.5, 1.0, 2.0)
        ),
    )

    def shown(self, scene: RunState, force_mN: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the force times the gain at its load."""
        del scene
        load = np.abs(force_mN) / REFERENCE_LOAD_MN
        return np.asarray(force_mN * (1 + values["gain_error"] * load ** values["power"]))


EFFECT = ForceNonlinearity()
