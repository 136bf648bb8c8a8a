"""A wall whose stiffness drifts with session time."""

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

REFERENCE_S = 3600.0
"""Session time at which its size is named."""


class TissueAgeing(ForceEffect):
    """Stiffness changes by `change` in the first hour, as `1 − exp(−time / constant)`: a line for a long constant."""

    id: ClassVar[str] = "tissue_ageing"
    place: ClassVar[EffectLocation] = EffectLocation.SPECIMEN
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.SESSION
    summary: ClassVar[str] = "Stiffness drifts with session time, as the tissue dries or loses its tone."
    exposes: ClassVar[str] = "a trend across relaxation and drag runs with their start time"
    source: ClassVar[str] = (
        "power law in time for water and tone lost post mortem; data in Nicolle and Palierne, "
        "Journal of the Mechanical Behavior of Biomedical Materials 3 (2010) 630"
    )
    aliases: ClassVar[tuple[str, ...]] = ("preconditioning",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter(
            "change", "1", ParameterRole.SIZE, 0.2, -0.9, 3.0, "relative change of stiffness in the first hour"
        ),
        EffectParameter(
            "power",
            "1",
            ParameterRole.SHAPE,
            1.0,
            0.2,
            8.0,
            "power of the session's time: below 1 it slows down, above it sets in late",
            tried=(0.35, 0.7, 1.4, 2.8),
        ),
    )

    def added(self, scene: RunState, values: Mapping[str, float]) -> FloatArray:
        """Return the force of the stiffness that is added."""
        aged = (np.maximum(scene.session_s, 0.0) / REFERENCE_S) ** values["power"]
        return np.asarray(scene.stiff * values["change"] * aged)


EFFECT = TissueAgeing()
