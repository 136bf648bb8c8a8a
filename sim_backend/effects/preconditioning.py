"""A fresh specimen that is stiffer in its first runs."""

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


class Preconditioning(ForceEffect):
    """Stiffness is higher by `excess · exp(−order / runs)`."""

    id: ClassVar[str] = "preconditioning"
    place: ClassVar[EffectLocation] = EffectLocation.SPECIMEN
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.SESSION
    summary: ClassVar[str] = "The first runs on a fresh specimen are stiffer, which fades from run to run."
    exposes: ClassVar[str] = "relaxation and drag runs early in the order"
    source: ClassVar[str] = (
        "preconditioning towards a steady response over cycles; Fung, Biomechanics (1993), chapter 7"
    )
    aliases: ClassVar[tuple[str, ...]] = ("tissue_ageing",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter(
            "excess", "1", ParameterRole.SIZE, 0.3, 0.0, 3.0, "relative excess of stiffness in the first run"
        ),
        EffectParameter(
            "runs", "1", ParameterRole.SHAPE, 4.0, 0.5, 5.0, "runs over which it fades", tried=(1.0, 2.0, 4.0)
        ),
    )

    def added(self, scene: RunState, values: Mapping[str, float]) -> FloatArray:
        """Return the force of the stiffness that is added."""
        return np.asarray(scene.stiff * (values["excess"] * float(np.exp(-scene.order / values["runs"]))))


EFFECT = Preconditioning()
